"""Where the joint adjustment begins: each view's own pose of the target, then the best closed form."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.hand_eye.adjustment_columns import State
from calibration.hand_eye.closed_forms import pair_motions, park_martin, solve_all
from calibration.hand_eye.problem import Problem
from calibration.hand_eye.single_pose import align
from calibration.outcome import RefusedError
from calibration.projection import projected
from calibration.rotations import rotation_matrix, rotation_vector
from surfclass.errors import InputError
from surfclass.types import Bool, Float64

_SUBSETS = 60
_SUBSET = 4
_SEED = 5
_FAR = 3.0  # times the middle point's residual: a mistaken point, which must not turn its whole view
_NEAR_PX, _NEAR_M = 0.5, 0.001
_TRIMS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A rough solution.

    Attributes:
        x: (4, 4) as `State.x`.
        y: (4, 4) as `State.y`.
        misfit_m: (n,) how far each pose of the target is from where the rest puts it, a turn counted at
            the target's own size; nan where the view does not give one.
    """

    x: Float64
    y: Float64
    misfit_m: Float64

    @property
    def score(self) -> float:
        """What is least for the best guess: half of the poses may be wrong."""
        return float(np.nanmedian(self.misfit_m))


def target_poses(problem: Problem, intrinsics: Float64 | None) -> tuple[Float64, Bool]:
    """Returns each view's `camera_T_target` (n, 4, 4), and whether it has one (n,)."""
    poses = np.tile(np.eye(4), (problem.poses, 1, 1))
    known = np.zeros(problem.poses, np.bool_)
    for view in range(problem.poses):
        found = _from_positions(problem, view)
        if found is None and intrinsics is not None:
            found = _from_pixels(problem, view, intrinsics)
        if found is not None:
            poses[view], known[view] = found, True
    return poses, known


def moving(problem: Problem) -> Float64:
    """Returns (n, 4, 4) the poses as A X = X B takes them: `base_T_flange`, or its inverse (eye_to_hand)."""
    if problem.in_hand:
        return problem.flange
    return np.asarray(np.linalg.inv(problem.flange), np.float64)


def guess_of(
    problem: Problem, poses: Float64, known: Bool, inverted: bool = False
) -> tuple[Guess, dict[str, Guess]]:
    """Returns the best of the closed forms over all poses and over many small sets of them, and each form.

    Args:
        problem: The observations.
        poses: (n, 4, 4) `camera_T_target`.
        known: (n,) which of them there are.
        inverted: Whether to read `base_T_flange` as its inverse, the other hypothesis.

    Raises:
        RefusedError: If fewer than three views give the target's pose.
    """
    if known.sum() < 3:
        raise RefusedError(
            f"not enough poses: {int(known.sum())} of {problem.poses} views show enough of the target to "
            "place it (3 points in space that are not on a line, or 4 pixels), needed are 3 or more"
        )
    arm = moving(problem)
    arm = np.asarray(np.linalg.inv(arm), np.float64) if inverted else arm
    size = float(np.linalg.norm(problem.target - problem.target.mean(axis=0), axis=1).mean())
    try:
        forms = solve_all(arm[known], poses[known])
    except InputError as error:
        raise RefusedError(f"poses too alike: {error}") from None
    guesses = {name: _judged(x, arm, poses, known, size) for name, x in forms.items()}
    every = list(guesses.values())
    rng = np.random.default_rng(_SEED)
    numbers = np.flatnonzero(known)
    for _ in range(_SUBSETS if len(numbers) > _SUBSET else 0):
        part = rng.choice(numbers, _SUBSET, replace=False)
        try:
            x = park_martin(*pair_motions(arm[part], poses[part]))
        except InputError:
            continue
        every.append(_judged(x, arm, poses, known, size, part))
    best = min(every, key=lambda guess: guess.score)
    good = known & (best.misfit_m <= 4 * best.score + 1e-9)
    with contextlib.suppress(InputError):  # the good ones may be one pose several times
        for x in solve_all(arm[good], poses[good]).values():
            refined = _judged(x, arm, poses, known, size, np.flatnonzero(good))
            best = min(best, refined, key=lambda guess: guess.score)
    return best, guesses


def state_of(problem: Problem, guess: Guess, intrinsics: Float64 | None) -> State:
    """Returns where the adjustment begins."""
    y = guess.y
    target = problem.target.copy()
    if problem.shape_from_probing:
        if len(problem.probed) >= 3:
            y = align(problem.target[problem.probed], problem.fixed, "fixed", "target").matrix
        target[problem.probed] = (problem.fixed - y[:3, 3]) @ y[:3, :3]
    return State(
        x=guess.x,
        y=y,
        target=target,
        intrinsics=np.zeros(9) if intrinsics is None else intrinsics,
        deviation=np.zeros((problem.poses, 6)),
        scale=1.0,
        offsets=np.zeros(6),
        flange_offset_m=0.0,
    )


def _judged(
    x: Float64, arm: Float64, poses: Float64, known: Bool, size: float, part: np.ndarray | None = None
) -> Guess:
    """The target's pose by one X: the middle one of all views, and how far each is from it."""
    each = arm @ x @ poses
    which = np.flatnonzero(known) if part is None else part
    y = mean_pose(each[which])
    turn = rotation_vector(y[:3, :3].T @ each[:, :3, :3])
    misfit = np.linalg.norm(each[:, :3, 3] - y[:3, 3], axis=1) + size * np.linalg.norm(turn, axis=1)
    return Guess(x, y, np.where(known, misfit, np.nan))


def mean_pose(poses: Float64) -> Float64:
    """Returns the pose in the middle of several (n, 4, 4): medians, so that a few may be wrong."""
    u, _, vt = np.linalg.svd(poses[:, :3, :3].sum(axis=0))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    around = rotation_vector(rotation.T @ poses[:, :3, :3])
    result = np.eye(4)
    result[:3, :3] = rotation @ rotation_matrix(np.median(around, axis=0))
    result[:3, 3] = np.median(poses[:, :3, 3], axis=0)
    return result


def _from_positions(problem: Problem, view: int) -> Float64 | None:
    own = np.flatnonzero(problem.positions.pose == view)
    if len(own) < 3:
        return None
    points, measured = problem.target[problem.positions.point[own]], problem.positions.value[own]
    try:
        found = align(points, measured, "camera", "target")
        good = _near(np.linalg.norm(found @ points - measured, axis=1), _NEAR_M)
        if good.sum() >= 3:
            found = align(points[good], measured[good], "camera", "target")
    except InputError:  # on a line
        return None
    return found.matrix


def _near(misses: Float64, least: float) -> Bool:
    """Which points are not far off beside the others."""
    return misses <= max(_FAR * float(np.median(misses)), least)


def _from_pixels(problem: Problem, view: int, intrinsics: Float64) -> Float64 | None:
    own = problem.pixels.pose == view
    if own.sum() < 4:
        return None
    points, pixels = problem.target[problem.pixels.point[own]], problem.pixels.value[own]
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) < 2:
        return None
    f = intrinsics
    matrix = np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1.0]])
    good = np.ones(len(points), np.bool_)
    pose = np.eye(4)
    for _ in range(_TRIMS):
        p, uv = points[good], pixels[good]
        found, turn, shift = cv2.solvePnP(p, uv, matrix, f[4:], flags=cv2.SOLVEPNP_SQPNP)
        if not found:
            return None
        turn, shift = cv2.solvePnPRefineLM(p, uv, matrix, f[4:], turn, shift)
        pose[:3, :3] = rotation_matrix(turn.ravel())
        pose[:3, 3] = shift.ravel()
        if not np.isfinite(pose).all():
            return None
        shown = projected(points @ pose[:3, :3].T + pose[:3, 3], f)
        better = _near(np.linalg.norm(shown - pixels, axis=1), _NEAR_PX)
        if better.sum() < 4 or (better == good).all():
            break
        good = better
    return pose
