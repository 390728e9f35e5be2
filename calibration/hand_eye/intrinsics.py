"""A camera's intrinsics from hand-eye views, where nobody has told them: where the joint fit begins."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.problem import Problem
from calibration.outcome import RefusedError
from surfclass.types import Float64

ESTIMATED = 8
"""Of fx fy cx cy k1 k2 p1 p2 k3: all but k3, which hand-eye views do not tell from k2."""

_FEWEST_VIEWS = 4
_FEWEST_POINTS = 6
_FLAT = 1e-3  # of a target's third direction, as a share of its first


def estimate_intrinsics(problem: Problem, size: tuple[int, int] | None) -> Float64:
    """Returns fx fy cx cy k1 k2 p1 p2 k3 (9,) from the pixels alone (Zhang 2000 for a flat target).

    Args:
        problem: The observations.
        size: Width and height of the image, px; without it, the box around all pixels.

    Raises:
        RefusedError: If the views cannot determine them.
    """
    views = [problem.pixels.pose == view for view in range(problem.poses)]
    views = [own for own in views if own.sum() >= _FEWEST_POINTS]
    if len(views) < _FEWEST_VIEWS:
        raise RefusedError(
            f"intrinsics are missing, and only {len(views)} views have {_FEWEST_POINTS} or more pixels to "
            f"estimate them from, needed are {_FEWEST_VIEWS}; give the observations their intrinsics"
        )
    middle = problem.target.mean(axis=0)
    _, spread, axes = np.linalg.svd(problem.target - middle)
    pixels = [problem.pixels.value[own].astype(np.float32) for own in views]
    low = np.min([one.min(axis=0) for one in pixels], axis=0)
    high = np.max([one.max(axis=0) for one in pixels], axis=0)
    image = size or (int(high[0] + low[0]) + 1, int(high[1] + low[1]) + 1)
    flat = spread[2] <= _FLAT * spread[0]
    axes = axes * np.sign(np.linalg.det(axes)) if not flat else axes
    local = (problem.target - middle) @ axes.T
    if flat:
        local[:, 2] = 0
    points = [local[problem.pixels.point[own]].astype(np.float32) for own in views]
    matrix: NDArray[Any] = np.eye(3)
    distortion: NDArray[Any] = np.zeros(5)
    flags = cv2.CALIB_FIX_K3
    if not flat:
        matrix = _linear([(local[problem.pixels.point[own]], problem.pixels.value[own]) for own in views])
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            points, pixels, image, matrix, distortion, flags=flags
        )
    except cv2.error:  # these views give it no start
        matrix = np.full((3, 3), np.nan)
    found = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:5]])
    if not np.isfinite(found).all() or found[:2].min() <= 0:
        raise RefusedError(
            "intrinsics are missing, and the views do not determine them: tilt the camera to the target by "
            "20–40° in several directions, or give the observations their intrinsics"
        )
    return found


def _linear(views: list[tuple[Float64, Float64]]) -> Float64:
    """The camera matrix of views of a solid target, by the direct linear transform of each."""
    found = []
    for points, pixels in views:
        rows = np.zeros((2 * len(points), 12))
        one = np.column_stack([points, np.ones(len(points))])
        rows[0::2, :4], rows[1::2, 4:8] = one, one
        rows[0::2, 8:], rows[1::2, 8:] = -pixels[:, :1] * one, -pixels[:, 1:] * one
        scale = np.abs(rows).max(axis=0)
        projection = (np.linalg.svd(rows / scale)[2][-1] / scale).reshape(3, 4)
        _, r = np.linalg.qr(np.linalg.inv(projection[:, :3]))  # M = K R, so M⁻¹ = Rᵀ K⁻¹
        matrix = np.linalg.inv(r)
        found.append(np.abs(matrix / matrix[2, 2]))
    middle: Float64 = np.median(found, axis=0)
    middle[0, 1] = 0
    return middle
