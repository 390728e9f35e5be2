"""The whole solution of a hand-eye calibration: what is refused, what is left out, what is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.hand_eye.adjustment import Fit, adjust, deviations_of
from calibration.hand_eye.adjustment_columns import Free, State
from calibration.hand_eye.arm_offsets import ArmOffsets, free_offsets
from calibration.hand_eye.camera_share import camera_share
from calibration.hand_eye.intrinsics import ESTIMATED, estimate_intrinsics
from calibration.hand_eye.leave_out import LeftOut, in_outer_frame, left_out, whole_points
from calibration.hand_eye.normal_equations import Noise
from calibration.hand_eye.observability import motion_faults, open_directions, target_fault
from calibration.hand_eye.observations import Observations
from calibration.hand_eye.problem import Problem, problem_of
from calibration.hand_eye.start import Guess, guess_of, state_of, target_poses
from calibration.hand_eye.variance import adjust_weighted
from calibration.outcome import Note, RefusedError
from surfclass.types import Bool, Float64

_OUTLIER = 16.0  # mean square of a pose's deviation, in the middle pose's
_SMALLEST_MIDDLE = 0.05  # what counts as the middle pose's at least: data without any noise
_FEWEST_TO_CHECK = 4  # poses that a leave-one-out needs
_SWAPPED = 1 / 3  # of the misfit as given: below it, the other reading of the poses is the right one
_WORST_MISFIT_M = 0.05
_SCALE_OFF = 0.01
_SCALE_SIGMAS = 5.0
_OPEN_M = 0.02
_OPEN_RAD = np.radians(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Everything that a calibration found.

    Attributes:
        problem: The observations in canonical order.
        fit: The joint adjustment without the outliers.
        left_out: Leave-one-out and jackknife; None where there are too few poses for it.
        guesses: The closed forms, by name.
        scale: Factor on the target's size that fits best, and its standard deviation; None where the
            target's shape came from probing.
        arm: Offsets of the arm, where they were asked for.
        camera_sd: (6,) what the camera's own uncertainty adds, as `sd`; zeros where it is not known.
    """

    problem: Problem
    fit: Fit
    left_out: LeftOut | None
    guesses: dict[str, Guess]
    scale: tuple[float, float] | None
    arm: ArmOffsets | None
    camera_sd: Float64 = field(default_factory=lambda: np.zeros(6))

    @property
    def covariance(self) -> Float64:
        """(6, 6) of the hand-eye transform: rotation in the camera's frame, translation in the outer one.

        By jackknife over the poses, or the formal one where there are too few poses for that.
        """
        formal = in_outer_frame(self.fit, self.fit.covariance)
        return formal if self.left_out is None else self.left_out.covariance

    @property
    def sd(self) -> Float64:
        """(6,) the standard deviations to trust: the jackknife's, but none smaller than the formal one.

        Both scatter where there are few poses, and of two estimates that scatter the smaller one is the
        one that misleads. The camera's own uncertainty comes on top.
        """
        formal = np.diag(in_outer_frame(self.fit, self.fit.covariance))
        return np.sqrt(np.maximum(formal, np.diag(self.covariance)) + self.camera_sd**2)


def solve(
    seen: Observations,
    flange_offset_m: float,
    note: Note,
    joint_offsets: bool = False,
    flange_offset: bool = False,
    pinhole_sd: Sequence[float] | None = None,
) -> Solution:
    """Returns the hand-eye transform and all that goes with it.

    Args:
        seen: The observations; any order of poses and points gives the same answer.
        flange_offset_m: The last D-H length, where views have joint angles.
        note: Called at each step.
        joint_offsets: Whether to estimate the arm's joint offsets.
        flange_offset: Whether to estimate the last D-H length.
        pinhole_sd: Standard deviations of the camera's fx, fy, cx, cy, px, where they are known.

    Raises:
        RefusedError: Naming what the data cannot determine, and what to do.
        InputError: If joint or flange offsets are asked for without joint angles.
    """
    faults = motion_faults(np.stack([view.base_T_flange.matrix for view in seen.views]))
    problem = problem_of(seen, flange_offset_m)
    target = target_fault(problem)
    if faults or target:
        raise RefusedError(*faults, *([target] if target else []))
    intrinsics, free = _intrinsics(problem, seen)
    note(f"{problem.poses} poses, {len(problem.target)} points of the target: closed forms")
    poses, known = target_poses(problem, intrinsics)
    guess, guesses = guess_of(problem, poses, known)
    _check_frames(problem, poses, known, guess, seen)
    start = state_of(problem, guess, intrinsics)
    first = known & (guess.misfit_m <= 6 * guess.score + 1e-6)
    scale = _check_scale(problem, start, free, first)
    note("joint adjustment")
    fit = _without_outliers(problem, start, free, first, seen)
    arm = None
    if joint_offsets or flange_offset:
        arm = free_offsets(problem, fit, joint_offsets, flange_offset)
        fit = adjust(problem, arm.fit.state, arm.fit.free, arm.fit.noise, fit.keep)
    open_ = open_directions(in_outer_frame(fit, fit.covariance), _OPEN_M, _OPEN_RAD)
    if open_:
        raise RefusedError(*open_)
    note("leaving out each pose")
    rest = left_out(problem, fit) if fit.keep.sum() >= _FEWEST_TO_CHECK else None
    shared = np.zeros(6)
    if pinhole_sd is not None and not free.intrinsics and seen.intrinsics is not None:
        shared = camera_share(problem, fit, pinhole_sd)
    return Solution(problem, fit, rest, guesses, scale, arm, shared)


def outliers(surprise: Float64, keep: Bool) -> Bool:
    """Returns which poses (n,) do not fit, by the mean squares of their deviations and the middle one's."""
    middle = max(float(np.median(surprise[keep])), _SMALLEST_MIDDLE)
    return surprise > _OUTLIER * middle


def _intrinsics(problem: Problem, seen: Observations) -> tuple[Float64 | None, Free]:
    if seen.intrinsics is not None:
        return seen.intrinsics.vector, Free()
    if not len(problem.pixels.pose):
        return None, Free()
    if len(problem.positions.pose):  # the pixels add nothing that the positions do not have
        raise RefusedError(
            "intrinsics are missing, though points have both pixels and camera_m; give the intrinsics that "
            "camera_m was computed with, or leave the pixels out"
        )
    return estimate_intrinsics(problem, seen.image_size), Free(intrinsics=ESTIMATED)


def _check_frames(problem: Problem, poses: Float64, known: Bool, guess: Guess, seen: Observations) -> None:
    """Refuses where the poses fit better as their inverse, or not at all."""
    swapped, _ = guess_of(problem, poses, known, inverted=True)
    as_given = f"{guess.score * 1e3:.2f} mm"
    other = "eye_to_hand" if problem.in_hand else "eye_in_hand"
    if swapped.score < _SWAPPED * guess.score and guess.score > 1e-4:
        raise RefusedError(
            f"base and hand look swapped: the poses fit as flange_T_base to {swapped.score * 1e3:.2f} mm, as "
            f"base_T_flange to {as_given} (median over the poses); either base_T_flange holds its inverse, "
            f"or the mounting is {other}, not {seen.mounting}"
        )
    if guess.score > _WORST_MISFIT_M:
        raise RefusedError(
            f"the poses do not fit together: the target is {as_given} from where the others put it (median), "
            "and no better with base and hand swapped; check that each pose belongs to its view, that the "
            "target's points are in the right order, and that its size is right"
        )


def _check_scale(problem: Problem, start: State, free: Free, keep: Bool) -> tuple[float, float] | None:
    """Returns the target's scale and its standard deviation; refuses where it is another size than stated."""
    if problem.shape_from_probing or problem.sizeless:
        return None
    fit = adjust_weighted(problem, start, replace(free, scale=True), keep)
    value = fit.state.scale
    sd = float(np.sqrt(fit.covariance[fit.places.scale, fit.places.scale][0, 0]))
    off = abs(value - 1)
    if off > _SCALE_OFF and off > _SCALE_SIGMAS * sd:
        spacing = _spacing(problem.target)
        raise RefusedError(
            f"the target has another size: by the arm's motions it is {value:.4f} ± {sd:.4f} of what was "
            f"stated, so its squares (nearest points) look like {spacing * value * 1e3:.1f} mm, not "
            f"{spacing * 1e3:.4g} mm; measure it, or check that the intrinsics belong to this image size"
        )
    return value, sd


def _spacing(target: Float64) -> float:
    apart = np.linalg.norm(target[:, None] - target[None], axis=2)
    apart[np.diag_indices(len(target))] = np.inf
    return float(np.median(apart.min(axis=1)))


def _without_outliers(problem: Problem, start: State, free: Free, first: Bool, seen: Observations) -> Fit:
    """The adjustment of the poses that fit each other; those that do not are found round by round."""
    keep, noise = first, Noise()
    for _ in range(6):
        fit = adjust_weighted(problem, start, free, keep, noise)
        own = deviations_of(problem, fit.state, fit.noise, whole_points(fit))
        surprise = np.mean((own / fit.noise.deviation(problem.jacobian is not None)) ** 2, axis=1)
        good = ~outliers(surprise, keep)
        if good.sum() < max(3, problem.poses / 2):
            names = ", ".join(sorted(seen.views[problem.order[pose]].name for pose in np.flatnonzero(~good)))
            raise RefusedError(
                f"{int((~good).sum())} of {problem.poses} poses do not fit the others ({names}); check that "
                "each pose belongs to its view and that neither target nor camera has moved"
            )
        if (good == keep).all():
            break
        keep, start = good, fit.state
    return fit
