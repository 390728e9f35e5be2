"""The classical closed forms of A X = X B, over all pairs of poses: initial guesses, and for comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rotations import rotation_matrix, rotation_vector, skew
from surfclass.errors import InputError
from surfclass.types import Float64

_LEAST_TURN_RAD = 1e-3  # of a pair; the axis of a smaller one is noise
_MOST_PAIRS = 6000  # more take long and tell no more


def solve_all(flange: NDArray[Any], target: NDArray[Any]) -> dict[str, Float64]:
    """Returns X of A X = X B by each method that has an answer.

    Args:
        flange: (n, 4, 4) `base_T_flange` (eye_in_hand) or its inverse (eye_to_hand).
        target: (n, 4, 4) `camera_T_target`.

    Returns:
        By method: (4, 4) `flange_T_camera` (eye_in_hand) or `base_T_camera` (eye_to_hand).

    Raises:
        InputError: If there are fewer than three poses.
    """
    a, b = pair_motions(flange, target)
    found: dict[str, Float64] = {}
    for name, method in METHODS.items():
        try:
            x = method(a, b)
        except np.linalg.LinAlgError:
            continue
        if np.isfinite(x).all():
            found[name] = x
    return found


def pair_motions(flange: NDArray[Any], target: NDArray[Any]) -> tuple[Float64, Float64]:
    """Returns A (m, 4, 4) and B (m, 4, 4), the motions between all pairs of poses that turn.

    Raises:
        InputError: If there are fewer than three poses, or none turns.
    """
    f, t = np.asarray(flange, np.float64), np.asarray(target, np.float64)
    if f.shape != t.shape or f.ndim != 3 or f.shape[1:] != (4, 4) or len(f) < 3:
        raise InputError(f"hand-eye: poses {f.shape} and {t.shape}, needed are 3 or more pairs of (n, 4, 4)")
    # Each pair both ways: noise makes a motion and its inverse count a little differently.
    first, second = np.nonzero(~np.eye(len(f), dtype=np.bool_))
    chord = np.linalg.norm(f[second, :3, :3] - f[first, :3, :3], axis=(1, 2)) / np.sqrt(2)
    turned = chord > _LEAST_TURN_RAD
    if not turned.any():
        raise InputError("hand-eye: no two poses differ by a turn")
    if len(first) > _MOST_PAIRS:  # those that turn most tell most
        turned &= chord >= np.partition(chord, -_MOST_PAIRS)[-_MOST_PAIRS] * (1 - 1e-12)
    first, second = first[turned], second[turned]
    return np.linalg.inv(f[second]) @ f[first], t[second] @ np.linalg.inv(t[first])


def tsai_lenz(a: Float64, b: Float64) -> Float64:
    """Rotation by modified Rodrigues vectors, then the translation (Tsai and Lenz 1989).

    Their vector has no value for a half turn: the camera's axes are turned by each of four rotations
    first, and the answer that fits best is kept.
    """
    ours, theirs = _half_sines(a), _half_sines(b)
    rotations = []
    for turn in (np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])):
        turned = theirs @ turn.T
        vector = _least_squares(skew(ours + turned), turned - ours)
        p = 2 * vector / np.sqrt(1 + vector @ vector)
        square = float(p @ p)
        rotation = (1 - square / 2) * np.eye(3)
        rotation += (np.outer(p, p) + np.sqrt(max(4 - square, 0.0)) * skew(p)) / 2
        rotations.append(rotation @ turn)
    best = min(rotations, key=lambda one: float(np.sum((theirs @ one.T - ours) ** 2)))
    return _with_translation(best, a, b)


def park_martin(a: Float64, b: Float64) -> Float64:
    """Rotation by the logarithms' least squares, then the translation (Park and Martin 1994)."""
    moment = rotation_vector(b[:, :3, :3]).T @ rotation_vector(a[:, :3, :3])
    return _with_translation(_nearest_rotation(moment.T), a, b)


def horaud_dornaika(a: Float64, b: Float64) -> Float64:
    """Rotation by the quaternion that turns unit axes into each other, then the translation (1995)."""
    ours, theirs = (_axes(motions) for motions in (a, b))
    matrix = _left(ours) - _right(theirs)
    normal = np.einsum("nij,nik->jk", matrix, matrix)
    _, vectors = np.linalg.eigh(normal)
    return _with_translation(_of_quaternion(vectors[:, 0]), a, b)


def daniilidis(a: Float64, b: Float64) -> Float64:
    """Rotation and translation at once by unit dual quaternions (Daniilidis 1999)."""
    (a_real, a_dual), (b_real, b_dual) = _dual_quaternions(a), _dual_quaternions(b)
    rows = np.zeros((len(a), 6, 8))
    rows[:, :3, 0] = rows[:, 3:, 4] = a_real - b_real
    rows[:, :3, 1:4] = rows[:, 3:, 5:] = skew(a_real + b_real)
    rows[:, 3:, 0] = a_dual - b_dual
    rows[:, 3:, 1:4] = skew(a_dual + b_dual)
    _, _, vt = np.linalg.svd(rows.reshape(-1, 8), full_matrices=False)
    u, v = vt[6], vt[7]
    # The combination a·u + b·v that is a unit dual quaternion: its real and dual parts are at right
    # angles (a quadratic in a/b or b/a, whichever stays finite), and the real part is 1 long.
    square = np.array([u[:4] @ u[4:], u[:4] @ v[4:] + v[:4] @ u[4:], v[:4] @ v[4:]])
    turned = abs(square[0]) < abs(square[2])
    roots = np.roots(square[::-1] if turned else square).real
    ratios = [(1.0, root) if turned else (root, 1.0) for root in roots]
    candidates = [a * u + b * v for a, b in ratios]
    best = max(candidates, key=lambda one: float(one[:4] @ one[:4]) / float(one @ one))
    real, dual = best[:4], best[4:]
    length = np.linalg.norm(real)
    if length == 0:
        raise np.linalg.LinAlgError("no unit dual quaternion")
    real, dual = real / length, dual / length
    x = np.eye(4)
    x[:3, :3] = _of_quaternion(real)
    conjugate = real * np.array([1, -1, -1, -1])
    x[:3, 3] = 2 * (_left(dual[None])[0] @ conjugate)[1:]
    return x


def andreff(a: Float64, b: Float64) -> Float64:
    """Rotation and translation as one linear system by Kronecker products (Andreff et al. 2001)."""
    count = len(a)
    rows = np.zeros((count, 12, 12))
    rotation_a, rotation_b = a[:, :3, :3], b[:, :3, :3]
    kronecker = np.einsum("nij,nkl->nikjl", rotation_a, rotation_b).reshape(count, 9, 9)
    rows[:, :9, :9] = np.eye(9) - kronecker
    rows[:, 9:, :9] = np.einsum("ij,nk->nijk", np.eye(3), b[:, :3, 3]).reshape(count, 3, 9)
    rows[:, 9:, 9:] = np.eye(3) - rotation_a
    target = np.concatenate([np.zeros((count, 9)), a[:, :3, 3]], axis=1)
    found = np.linalg.lstsq(rows.reshape(-1, 12), target.ravel(), rcond=None)[0]
    nine = found[:9].reshape(3, 3)
    if not np.linalg.norm(nine) > 0:
        raise np.linalg.LinAlgError("no rotation")
    # The linear system knows of no rotation: its nine numbers are the nearest one up to a length.
    return _with_translation(_nearest_rotation(nine), a, b)


METHODS: Mapping[str, Callable[[Float64, Float64], Float64]] = {
    "tsai": tsai_lenz,
    "park": park_martin,
    "horaud": horaud_dornaika,
    "daniilidis": daniilidis,
    "andreff": andreff,
}
"""By the name that the result uses."""


def _with_translation(rotation: Float64, a: Float64, b: Float64) -> Float64:
    """X of its rotation: (R_A − 1) t = R t_B − t_A."""
    x = np.eye(4)
    x[:3, :3] = rotation
    x[:3, 3] = _least_squares(a[:, :3, :3] - np.eye(3), b[:, :3, 3] @ rotation.T - a[:, :3, 3])
    return x


def _least_squares(rows: Float64, right: Float64) -> Float64:
    found = np.linalg.lstsq(rows.reshape(-1, rows.shape[-1]), right.ravel(), rcond=None)[0]
    return np.asarray(found, np.float64)


def _nearest_rotation(matrix: Float64) -> Float64:
    """The rotation R that makes tr(Rᵀ M) greatest."""
    u, _, vt = np.linalg.svd(matrix)
    nearest: Float64 = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return nearest


def _half_sines(motions: Float64) -> Float64:
    """2 sin(angle/2) about the axis."""
    vector = rotation_vector(motions[:, :3, :3])
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    sines: Float64 = 2 * np.sin(angle / 2) * vector / np.maximum(angle, 1e-12)
    return sines


def _axes(motions: Float64) -> Float64:
    """(n, 4) the unit axes as pure quaternions."""
    vector = rotation_vector(motions[:, :3, :3])
    unit = vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-12)
    return np.concatenate([np.zeros((len(unit), 1)), unit], axis=1)


def _dual_quaternions(motions: Float64) -> tuple[Float64, Float64]:
    """The vector parts (n, 3) of the real and of the dual quaternion."""
    vector = rotation_vector(motions[:, :3, :3])
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    real = np.sin(angle / 2) * vector / np.maximum(angle, 1e-12)
    t = motions[:, :3, 3]
    return real, (np.cos(angle / 2) * t + np.cross(t, real)) / 2


def _left(q: Float64) -> Float64:
    """(n, 4, 4) the matrix of a product with `q` (w, x, y, z) on the left."""
    w, v = q[:, 0], q[:, 1:]
    return _product(w, v, skew(v))


def _right(q: Float64) -> Float64:
    """(n, 4, 4) the matrix of a product with `q` on the right."""
    w, v = q[:, 0], q[:, 1:]
    return _product(w, v, -skew(v))


def _product(w: Float64, v: Float64, cross: Float64) -> Float64:
    matrix = np.empty((len(w), 4, 4))
    matrix[:, 0, 0] = w
    matrix[:, 0, 1:] = -v
    matrix[:, 1:, 0] = v
    matrix[:, 1:, 1:] = w[:, None, None] * np.eye(3) + cross
    return matrix


def _of_quaternion(q: Float64) -> Float64:
    """The rotation of a unit quaternion (w, x, y, z)."""
    w, v = (q[0], q[1:]) if q[0] >= 0 else (-q[0], -q[1:])
    sine = float(np.linalg.norm(v))
    if sine == 0:
        return np.eye(3)
    return rotation_matrix(v / sine * 2 * np.arctan2(sine, w))
