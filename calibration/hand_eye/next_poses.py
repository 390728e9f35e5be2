"""Which poses of the arm would tell most about the hand-eye transform next."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calibration.hand_eye.adjustment import Fit
from calibration.hand_eye.adjustment_columns import pixel_rows, position_rows
from calibration.hand_eye.normal_equations import parts_of
from calibration.hand_eye.observations import Observations
from calibration.hand_eye.problem import Problem, Seen, ray_frames
from calibration.hand_eye.start import mean_pose
from calibration.rotations import rotation_matrix
from surfclass.types import Float64

_TILTS_DEG = (-35, 0, 35)
_ROLLS_DEG = (-90, -45, 0, 45, 90)
_DISTANCES = (0.8, 1.0, 1.25)
_ARM_M = 0.5  # a turn of the camera counts as the shift of a point so far away
_WEAK = 1e-6  # of the greatest information, so that what is not known yet counts as very unsure
_MARGIN_PX = 10


@dataclass(frozen=True, slots=True, eq=False)
class NextPose:
    """A proposal.

    Attributes:
        base_T_flange: (4, 4) where to bring the flange.
        words: The same for people, from the middle of the poses so far.
        gain: By how much of itself the uncertainty of the hand-eye transform goes down, 0…1.
    """

    base_T_flange: Float64
    words: str
    gain: float


def propose(problem: Problem, fit: Fit, seen: Observations, count: int = 3) -> list[NextPose]:
    """Returns the poses that reduce the hand-eye transform's uncertainty most, best first (A-optimal).

    Candidates look at the target's middle, tilted by up to 35° and rolled by up to 90° from the middle of
    the poses so far; each is taken to see what a whole view sees. Whether the arm reaches them is for the
    arm to say.

    Args:
        problem: The observations.
        fit: The adjustment of them.
        seen: For the image's size.
        count: How many.
    """
    camera_T_target = _middle(problem, fit)
    candidates = []
    for tilt_x, tilt_y, roll, distance in product(_TILTS_DEG, _TILTS_DEG, _ROLLS_DEG, _DISTANCES):
        view = _turned(problem, camera_T_target, np.radians([tilt_x, tilt_y, roll]), distance)
        if _in_image(problem, fit, view, seen.image_size):
            candidates.append((_flange(problem, fit, view), _words(tilt_x, tilt_y, roll, distance)))
    if not candidates:
        return []
    flange = np.stack([pose for pose, _ in candidates])
    gained = _information(_extended(problem, fit, flange), fit, twist_sd(problem, fit))
    have = fit.reduced + _WEAK * np.diag(np.diag(fit.reduced))
    chosen: list[NextPose] = []
    for _ in range(count):
        now = _uncertainty(have)
        after = np.array([_uncertainty(have + one) for one in gained])
        best = int(after.argmin())
        pose, words = candidates[best]
        chosen.append(NextPose(pose, words, 1 - float(after[best]) / now))
        have = have + gained[best]
    return chosen


def _middle(problem: Problem, fit: Fit) -> Float64:
    """`camera_T_target` in the middle of the views, the target in the middle of the image."""
    flange = problem.flange if problem.in_hand else np.linalg.inv(problem.flange)
    x, y = fit.state.x, fit.state.y
    poses = np.linalg.inv(flange @ x) @ y if problem.in_hand else np.linalg.inv(x) @ np.linalg.inv(flange) @ y
    middle = mean_pose(np.asarray(poses, np.float64))
    centre = middle[:3, :3] @ fit.state.target.mean(axis=0) + middle[:3, 3]
    # Turned about the camera, so that the target's middle comes to the optical axis.
    away = np.cross(centre / np.linalg.norm(centre), [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(away))
    if sine > 0:
        turn = np.eye(4)
        turn[:3, :3] = rotation_matrix(away / sine * np.arctan2(sine, centre[2] / np.linalg.norm(centre)))
        middle = turn @ middle
    return middle


def _turned(problem: Problem, camera_T_target: Float64, angles: Float64, distance: float) -> Float64:
    """The view from a camera that is tilted about the target's middle, rolled and moved away."""
    centre = camera_T_target[:3, :3] @ problem.target.mean(axis=0) + camera_T_target[:3, 3]
    roll = rotation_matrix(np.array([0.0, 0.0, angles[2]]))
    rotation = roll @ rotation_matrix(np.array([angles[0], angles[1], 0.0])) @ camera_T_target[:3, :3]
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = distance * centre - rotation @ problem.target.mean(axis=0)
    return view


def _flange(problem: Problem, fit: Fit, camera_T_target: Float64) -> Float64:
    """The flange's pose from which the camera sees the target so."""
    x, y = fit.state.x, fit.state.y
    if problem.in_hand:
        return np.asarray(y @ np.linalg.inv(x @ camera_T_target), np.float64)
    return np.asarray(x @ camera_T_target @ np.linalg.inv(y), np.float64)


def _in_image(problem: Problem, fit: Fit, view: Float64, size: tuple[int, int] | None) -> bool:
    points = fit.state.target @ view[:3, :3].T + view[:3, 3]
    if (points[:, 2] <= 0).any():
        return False
    if size is None or not fit.state.intrinsics[0]:
        return True
    k = fit.state.intrinsics
    pixel = points[:, :2] / points[:, 2:] * k[:2] + k[2:4]
    return bool((pixel > _MARGIN_PX).all() and (pixel < np.array(size) - _MARGIN_PX).all())


def _extended(problem: Problem, fit: Fit, flange: Float64) -> Problem:
    """A problem of the candidates alone, each of which sees all points as a view so far does."""
    count, points = len(flange), len(problem.target)
    pose, point = np.repeat(np.arange(count), points), np.tile(np.arange(points), count)
    none = Seen(pose[:0], point[:0], np.zeros((0, 2)), np.zeros(0))
    pixels, positions = none, replace(none, value=np.zeros((0, 3)))
    if len(problem.pixels.pose):
        pixels = Seen(pose, point, np.zeros((len(pose), 2)), np.ones(len(pose)))
    if len(problem.positions.pose):
        in_view = fit.state.target @ _middle(problem, fit)[:3, :3].T + _middle(problem, fit)[:3, 3]
        positions = Seen(pose, point, in_view[point], np.ones(len(pose)))
    return replace(
        problem,
        flange=flange,
        q=None,
        jacobian=None,
        pixels=pixels,
        positions=positions,
        rays=ray_frames(positions.value),
        new_across=np.full(len(positions.pose), bool(problem.new_across.any())),
        order=np.arange(count),
    )


def twist_sd(problem: Problem, fit: Fit) -> Float64:
    """Returns (6,) how far a pose of the arm is from its read-out: turns (rad), then shifts (m)."""
    noise = fit.noise.deviation(problem.jacobian is not None)
    if problem.jacobian is None:
        return noise
    squares = np.einsum("nij,nij->i", problem.jacobian, problem.jacobian) / problem.poses
    return np.asarray(np.sqrt(squares) * noise, np.float64)


def _information(problem: Problem, fit: Fit, deviation_sd: Float64) -> Float64:
    """(n, g, g) what each pose would tell of the global parameters, its own deviation eliminated."""
    state = replace(fit.state, deviation=np.zeros((problem.poses, 6)))
    told: Float64 = np.zeros((problem.poses, fit.places.size, fit.places.size))
    cross = np.zeros((problem.poses, fit.places.size, 6))
    own = np.tile(np.diag(1 / deviation_sd**2), (problem.poses, 1, 1))
    noise = fit.noise
    across = noise.across if problem.new_across.any() else np.inf
    for seen, rows_of, sd in (
        (problem.pixels, pixel_rows, np.full(2, noise.pixel)),
        (problem.positions, position_rows, np.array([across, across, noise.along])),
    ):
        if not len(seen.pose):
            continue
        rows = rows_of(problem, state, fit.free, fit.places)
        weight = (1 / sd)[None, :, None]
        by_global, by_deviation = rows.by_global * weight, rows.by_deviation * weight
        for pose, part in enumerate(parts_of(seen.pose, problem.poses)):
            a = by_global[part].reshape(-1, fit.places.size)
            b = by_deviation[part].reshape(-1, 6)
            told[pose] += a.T @ a
            cross[pose] += a.T @ b
            own[pose] += b.T @ b
    reduced: Float64 = told - cross @ np.linalg.inv(own) @ np.swapaxes(cross, 1, 2)
    return reduced


def _uncertainty(normal: Float64) -> float:
    """Mean square of the hand-eye transform's errors, m²: shifts, and turns at `_ARM_M`."""
    covariance = np.linalg.inv(normal)[:6, :6]
    return float(_ARM_M**2 * np.trace(covariance[:3, :3]) + np.trace(covariance[3:, 3:]))


def _words(tilt_x: float, tilt_y: float, roll: float, distance: float) -> str:
    parts = []
    if tilt_y:
        parts.append(f"look at the target from {abs(tilt_y)}° further {'right' if tilt_y > 0 else 'left'}")
    if tilt_x:
        parts.append(f"from {abs(tilt_x)}° further {'above' if tilt_x > 0 else 'below'}")
    if roll:
        parts.append(f"roll the camera by {abs(roll)}° {'anticlockwise' if roll > 0 else 'clockwise'}")
    if distance != 1.0:
        parts.append(f"go {abs(distance - 1):.0%} {'nearer' if distance < 1 else 'further away'}")
    return ", ".join(parts) or "the middle of the poses so far"
