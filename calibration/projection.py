"""The pinhole camera with OpenCV's distortion, and how its pixels change with everything they depend on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rotations import rotation_matrix, skew
from surfclass.rig import Camera
from surfclass.types import Float64

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""A camera as nine numbers, in this order."""


def parameters_of(camera: Camera) -> Float64:
    """Returns the nine numbers of a camera."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def projected(points: NDArray[Any], parameters: NDArray[Any]) -> Float64:
    """Returns the pixels (…, 2) of points (…, 3) in the camera's frame; z must not be 0."""
    p = np.asarray(points, np.float64)
    return _distorted(p[..., 0] / p[..., 2], p[..., 1] / p[..., 2], np.asarray(parameters, np.float64))[0]


def projected_with_jacobians(
    points: NDArray[Any], parameters: NDArray[Any]
) -> tuple[Float64, Float64, Float64]:
    """Returns the pixels of points, and how they change, analytically.

    Args:
        points: (n, 3) m, in the camera's frame; z must not be 0.
        parameters: (9,) of one camera, or (n, 9): each point's own.

    Returns:
        Pixels (n, 2), their derivatives by the point (n, 2, 3) and by the parameters (n, 2, 9).
    """
    p = np.asarray(points, np.float64)
    x, y, depth = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], p[:, 2]
    pixels, by_ray, by_parameters = _distorted(x, y, np.asarray(parameters, np.float64))
    zero, one = np.zeros_like(x), np.ones_like(x)
    ray = np.stack([np.stack([one, zero, -x], axis=-1), np.stack([zero, one, -y], axis=-1)], axis=1)
    return pixels, by_ray @ (ray / depth[:, None, None]), by_parameters


def by_motion(points: NDArray[Any]) -> Float64:
    """Returns (n, 3, 6): how points (n, 3) move with a small motion of their frame.

    That is a rotation vector (rad) and a translation (m), applied on the left: `exp(ω) p + v`.
    """
    p = np.asarray(points, np.float64)
    return np.concatenate([-skew(p), np.broadcast_to(np.eye(3), (*p.shape[:-1], 3, 3))], axis=-1)


def moved(matrices: NDArray[Any], small: NDArray[Any]) -> Float64:
    """Returns the rigid motions (…, 4, 4) after small ones (…, 6) as in `by_motion`."""
    step = np.zeros((*np.shape(small)[:-1], 4, 4))
    step[..., :3, :3] = rotation_matrix(np.asarray(small)[..., :3])
    step[..., :3, 3] = np.asarray(small)[..., 3:]
    step[..., 3, 3] = 1
    product: Float64 = step @ matrices
    return product


def _distorted(x: Float64, y: Float64, parameters: Float64) -> tuple[Float64, Float64, Float64]:
    """Pixels (…, 2) of rays, and their derivatives by the ray (…, 2, 2) and the parameters (…, 2, 9)."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(parameters, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / d(x) is slope · x
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    across = x * y * slope + 2 * p1 * x + 2 * p2 * y
    dx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    dy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    by_ray = np.stack(
        [np.stack([fx * dx, fx * across], axis=-1), np.stack([fy * across, fy * dy], axis=-1)], axis=-2
    )
    zero, one = np.zeros_like(x), np.ones_like(x)
    powers = r2, r2 * r2, r2 * r2 * r2
    in_u = [xd, zero, one, zero, *(fx * x * power for power in powers[:2])]
    in_u += [fx * 2 * x * y, fx * (r2 + 2 * x * x), fx * x * powers[2]]
    in_v = [zero, yd, zero, one, *(fy * y * power for power in powers[:2])]
    in_v += [fy * (r2 + 2 * y * y), fy * 2 * x * y, fy * y * powers[2]]
    pixels = np.stack([fx * xd + cx, fy * yd + cy], axis=-1)
    return pixels, by_ray, np.stack([np.stack(in_u, axis=-1), np.stack(in_v, axis=-1)], axis=-2)
