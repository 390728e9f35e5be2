"""What the arm's poses and the target can determine at all; refusals name the motion that is missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.problem import Problem
from calibration.rotations import rotation_vector
from surfclass.types import Float64

FEWEST_POSES = 3
LEAST_TURN_RAD = np.radians(10.0)
LEAST_SECOND_TURN_RAD = np.radians(4.0)
_SAME_TURN_RAD = np.radians(1.0)
_SAME_PLACE_M = 0.005
_LEAST_WIDTH = 1e-3  # of the target, across its longest direction, as a share of it


def axis_spread(rotations: NDArray[Any]) -> tuple[Float64, Float64]:
    """Returns how far poses (n, 3, 3) turn about each of their principal axes.

    Returns:
        (3,) rad, from the greatest: the range of the poses' turns from their middle about each axis; and
        the axes (3, 3), a row each, in the outer frame.
    """
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    middle = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    vectors = rotation_vector(rotations @ middle.T)
    _, axes = np.linalg.eigh(vectors.T @ vectors)
    along = vectors @ axes[:, ::-1]
    return np.ptp(along, axis=0), axes[:, ::-1].T


def motion_faults(flange: NDArray[Any]) -> list[str]:
    """Returns why the arm's poses (n, 4, 4) cannot determine a hand-eye transform; empty if they can."""
    poses = np.asarray(flange, np.float64)
    if len(poses) < FEWEST_POSES:
        return [f"not enough poses: {len(poses)}, needed are {FEWEST_POSES}; 12 or more give a good result"]
    first, second = np.triu_indices(len(poses), 1)
    between = np.swapaxes(poses[first, :3, :3], 1, 2) @ poses[second, :3, :3]
    turns = np.linalg.norm(rotation_vector(between), axis=1)
    apart = np.linalg.norm(poses[first, :3, 3] - poses[second, :3, 3], axis=1)
    same = (turns < _SAME_TURN_RAD) & (apart < _SAME_PLACE_M)
    distinct = len(poses) - len({int(number) for number in second[same]})
    if turns.max() < LEAST_TURN_RAD:
        fault = (
            f"poses too alike: no two differ by more than {np.degrees(turns.max()):.1f}°, needed are "
            f"{np.degrees(LEAST_TURN_RAD):.0f}°; turn the flange by 30° or more about two different axes"
        )
        return [fault]
    if distinct < FEWEST_POSES:
        fault = (
            f"not enough poses: only {distinct} of {len(poses)} differ by more than 1° or 5 mm, needed are "
            f"{FEWEST_POSES} or more different ones; 12 or more give a good result"
        )
        return [fault]
    axis, left = _common_axis(between, poses[first, :3, :3])
    if left < LEAST_SECOND_TURN_RAD:
        fault = (
            f"insufficient rotation: all poses turn about one axis only, base {_words(axis)}, to within "
            f"{np.degrees(left):.1f}°, so the camera's place along it stays open; turn the flange about "
            f"another axis than that one, such as base {_words(_across(axis))}, by 30° or more"
        )
        return [fault]
    return []


def target_fault(problem: Problem) -> str | None:
    """Returns why the target cannot determine its own pose, or None."""
    if not problem.sizeless and not len(problem.probed):
        width = np.linalg.svd(problem.target - problem.target.mean(axis=0), compute_uv=False)
        if len(problem.target) < 3:
            return f"degenerate target: {len(problem.target)} points, needed are 3 that are not on a line"
        if width[1] <= _LEAST_WIDTH * width[0]:
            return (
                f"degenerate target: its {len(problem.target)} points lie on a line, so its turn about the "
                "line stays open; use points that span a plane"
            )
    return None


def open_directions(covariance: NDArray[Any], most_m: float, most_rad: float) -> list[str]:
    """Returns what of the hand-eye transform is not determined, a sentence for each direction.

    Args:
        covariance: (6, 6) rotation in the camera's frame (rad), translation in the outer frame (m).
        most_m: Standard deviation from which on a direction counts as open.
        most_rad: Likewise of a turn.
    """
    faults = []
    for part, most, what, unit, factor in (
        (slice(3, 6), most_m, "the camera's place along", "mm", 1e3),
        (slice(0, 3), most_rad, "the camera's turn about its own", "°", 180 / np.pi),
    ):
        values, vectors = np.linalg.eigh(covariance[part, part])
        for value, vector in zip(values, vectors.T, strict=True):
            if value > most**2:
                faults.append(
                    f"not determined: {what} {_words(vector)} is known to no better than "
                    f"{np.sqrt(value) * factor:.2g} {unit}; add poses that turn the camera about axes across "
                    "the ones so far, by 30° or more"
                )
    return faults


def missing_turns(flange: Sequence[NDArray[Any]]) -> Float64:
    """Returns a unit axis (3,) in `base` about which the poses have turned least so far."""
    if len(flange) < 2:
        return np.array([0.0, 0.0, 1.0])
    least: Float64 = axis_spread(np.stack([pose[:3, :3] for pose in flange]))[1][2]
    return least


def _common_axis(between: Float64, first: Float64) -> tuple[Float64, float]:
    """The axis of `base` that most motions turn about, and how far they turn off it, rad (greatest).

    A motion that turns about the axis leaves it where it is; how far it is moved is what is looked at, so
    turns of any size count by what they do.
    """
    motions = first @ between @ np.swapaxes(first, 1, 2)
    moving = (motions - np.eye(3)).reshape(-1, 3)
    _, _, vt = np.linalg.svd(moving, full_matrices=False)
    axis = vt[2]
    axis = axis if axis[np.abs(axis).argmax()] > 0 else -axis
    chord = np.linalg.norm(motions @ axis - axis, axis=1)
    return axis, float(2 * np.arcsin(min(1.0, chord.max() / 2)))


def _across(axis: Float64) -> Float64:
    helper = np.eye(3)[np.abs(axis).argmin()]
    across = helper - axis * (axis @ helper)
    unit: Float64 = across / np.linalg.norm(across)
    return unit


def _words(vector: Float64) -> str:
    return f"({vector[0]:+.2f}, {vector[1]:+.2f}, {vector[2]:+.2f})"
