"""What the camera's own uncertainty adds to the hand-eye transform's: no view of one camera shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.hand_eye.adjustment import Fit, adjust
from calibration.hand_eye.problem import Problem
from calibration.rotations import difference
from surfclass.types import Float64, Transform


def camera_share(problem: Problem, fit: Fit, pinhole_sd: Sequence[float]) -> Float64:
    """Returns (6,) standard deviations: rotation in the camera's frame, translation in the outer one.

    Each of the four numbers is moved by its standard deviation, and the adjustment is done again from where
    it was. What the camera's calibration has in common between them (its covariance) is left out.

    Args:
        problem: What was adjusted.
        fit: How it came out.
        pinhole_sd: Of fx, fy, cx, cy, px.
    """
    before = _hand_eye(fit)
    squares = np.zeros(6)
    for number, sd in enumerate(pinhole_sd):
        if sd > 0:
            again = _with_camera(problem, fit, number, sd)
            squares += difference(_hand_eye(again), before) ** 2
    share: Float64 = np.sqrt(squares)
    return share


def _with_camera(problem: Problem, fit: Fit, number: int, step: float) -> Fit:
    """The adjustment with one of fx, fy, cx, cy larger by `step`."""
    old = fit.state.intrinsics
    new = old.copy()
    new[number] += step
    # Depth was measured; where across its ray a point lies was computed with the camera.
    points = problem.positions.value.copy()
    axis = number % 2
    pixel = old[axis] * points[:, axis] / points[:, 2] + old[axis + 2]
    points[:, axis] = points[:, 2] * (pixel - new[axis + 2]) / new[axis]
    moved = replace(problem, positions=replace(problem.positions, value=points))
    return adjust(moved, replace(fit.state, intrinsics=new), fit.free, fit.noise, fit.keep)


def _hand_eye(fit: Fit) -> Transform:
    return Transform("outer", "camera", fit.state.x)
