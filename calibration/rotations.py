"""Rigid motions as six numbers, which is what a least squares turns: a rotation vector and a translation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.types import Float64, Transform

_SMALL = 1e-8


def rotation_matrix(vector: NDArray[Any]) -> Float64:
    """Returns (…, 3, 3) rotations about the vectors (…, 3), by their lengths in radians (Rodrigues)."""
    v = np.asarray(vector, np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    cross = skew(v)
    safe = np.where(angle < _SMALL, 1.0, angle)
    first = np.where(angle < _SMALL, 1.0, np.sin(safe) / safe)
    second = np.where(angle < _SMALL, 0.5, 2 * np.sin(safe / 2) ** 2 / safe**2)
    matrix: Float64 = np.eye(3) + first * cross + second * (cross @ cross)
    return matrix


def rotation_vector(matrix: NDArray[Any]) -> Float64:
    """Returns (…, 3) the vectors of rotations (…, 3, 3), of angles 0…π; exact near both ends."""
    m = np.asarray(matrix, np.float64)
    # By the unit quaternion: of its four forms the one whose divisor is largest.
    trace = np.trace(m, axis1=-2, axis2=-1)
    squares = np.stack([trace, *(2 * m[..., i, i] - trace for i in range(3))], axis=-1) + 1  # 4 q²
    off = np.stack([m[..., k, j] - m[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1)
    products = np.empty((*m.shape[:-2], 4, 4))  # 4 q qᵀ, of which one row is enough
    products[..., 0, 1:] = products[..., 1:, 0] = off
    products[..., 1:, 1:] = m + np.swapaxes(m, -1, -2)
    for k in range(4):
        products[..., k, k] = squares[..., k]
    best = squares.argmax(axis=-1)[..., None]
    row = np.take_along_axis(products, best[..., None], axis=-2)[..., 0, :]
    quaternion = row / (2 * np.sqrt(np.take_along_axis(squares, best, axis=-1)))
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[..., :1])
    scale = np.where(sine < _SMALL, 2.0, angle / np.where(sine < _SMALL, 1.0, sine))
    vector: Float64 = quaternion[..., 1:] * scale
    return vector


def skew(vector: NDArray[Any]) -> Float64:
    """Returns (…, 3, 3): the matrix that takes a point to `vector × point`."""
    v = np.asarray(vector, np.float64)
    zero = np.zeros(v.shape[:-1])
    rows = [[zero, -v[..., 2], v[..., 1]], [v[..., 2], zero, -v[..., 0]], [-v[..., 1], v[..., 0], zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def motion(six: NDArray[Any], dst: str, src: str) -> Transform:
    """Returns `dst_T_src` of a rotation vector (rad) and a translation (m), (6,) in this order."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(np.asarray(six)[:3])
    matrix[:3, 3] = np.asarray(six)[3:]
    return Transform(dst, src, matrix)


def six_of(transform: Transform) -> Float64:
    """Returns the rotation vector and the translation (6,) of a rigid motion."""
    return np.concatenate([rotation_vector(transform.rotation), transform.translation])


def difference(found: Transform, true: Transform) -> Float64:
    """Returns how far `found` is from `true`: rotation vector (rad) and translation (m), (6,).

    The rotation is the one that is left in `true`'s source frame; the translation is the difference of
    the two translations.
    """
    left = rotation_vector(true.rotation.T @ found.rotation)
    return np.concatenate([left, found.translation - true.translation])
