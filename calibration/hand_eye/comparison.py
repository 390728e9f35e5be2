"""The closed forms beside the joint adjustment: by the same residuals, and left out in the same way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.hand_eye.adjustment import Fit
from calibration.hand_eye.adjustment_columns import State
from calibration.hand_eye.closed_forms import solve_all
from calibration.hand_eye.leave_out import Misses, misses_of, mistakes
from calibration.hand_eye.problem import Problem
from calibration.hand_eye.start import moving, target_poses
from calibration.rotations import difference
from surfclass.errors import InputError
from surfclass.types import Bool, Float64, Transform

_MOST_LEFT_OUT = 60  # poses


@dataclass(frozen=True, slots=True, eq=False)
class ClosedForm:
    """What one closed form gives.

    Attributes:
        x: (4, 4) the hand-eye transform.
        apart: (6,) from the joint adjustment's: rotation vector (rad), translation (m).
        rms: Of its residuals, px and m; None for what was not seen.
        left_out: Likewise, each pose predicted by the others; None for sets of many poses, where it
            would take long.
    """

    x: Float64
    apart: Float64
    rms: tuple[float | None, float | None]
    left_out: tuple[float | None, float | None]


def compare(problem: Problem, fit: Fit) -> dict[str, ClosedForm]:
    """Returns what each closed form makes of the poses that a fit used, by name.

    The target's pose is the mean over the poses, and its points are as stated.
    """
    intrinsics = fit.state.intrinsics if len(problem.pixels.pose) else None
    poses, known = target_poses(problem, intrinsics)
    used = known & fit.keep
    arm = moving(problem)
    found: dict[str, ClosedForm] = {}
    left = _left_out(problem, fit, arm, poses, used)
    for name, x in solve_all(arm[used], poses[used]).items():
        whole = misses_of(problem, _state(fit, problem, x, arm[used], poses[used]))
        apart = difference(Transform("a", "b", x), Transform("a", "b", fit.state.x))
        found[name] = ClosedForm(x, apart, rms_of(problem, fit, whole), left.get(name, (None, None)))
    return found


def rms_of(problem: Problem, fit: Fit, misses: Misses) -> tuple[float | None, float | None]:
    """Returns the root mean squares over the points of the poses that a fit used, px and m.

    A point counts by the length of its residual; one that is a mistake by itself does not count.
    """
    pixel = fit.keep[problem.pixels.pose] & ~mistakes(fit.pixel_weight)
    position = fit.keep[problem.positions.pose] & ~mistakes(fit.position_weight)
    return _rms(misses.pixel[pixel]), _rms(misses.position[position])


def _left_out(
    problem: Problem, fit: Fit, arm: Float64, poses: Float64, used: Bool
) -> dict[str, tuple[float | None, float | None]]:
    each: dict[str, Misses] = {}
    if used.sum() > _MOST_LEFT_OUT:
        return {}
    for pose in np.flatnonzero(used):
        rest = used.copy()
        rest[pose] = False
        try:
            forms = solve_all(arm[rest], poses[rest])
        except InputError:  # the others do not turn, or are too few
            return {}
        for name, x in forms.items():
            here = misses_of(problem, _state(fit, problem, x, arm[rest], poses[rest]))
            so_far = each.setdefault(name, Misses(here.pixel.copy(), here.position.copy()))
            so_far.pixel[problem.pixels.pose == pose] = here.pixel[problem.pixels.pose == pose]
            so_far.position[problem.positions.pose == pose] = here.position[problem.positions.pose == pose]
    return {name: rms_of(problem, fit, misses) for name, misses in each.items()}


def _state(fit: Fit, problem: Problem, x: Float64, arm: Float64, poses: Float64) -> State:
    placed = arm @ x @ poses
    u, _, vt = np.linalg.svd(placed[:, :3, :3].sum(axis=0))
    y = np.eye(4)
    y[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    y[:3, 3] = placed[:, :3, 3].mean(axis=0)
    return replace(fit.state, x=x, y=y, target=problem.target, scale=1.0, offsets=np.zeros(6))


def _rms(lengths: Float64) -> float | None:
    return float(np.sqrt(np.mean(lengths**2))) if len(lengths) else None
