"""Hand-eye from one pose: disc centres, rigid alignment and the transform's order (appendix A)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.geometry import fit_plane
from surfclass.types import Float64, Transform

_CIRCLE_STEPS = 100
_CIRCLE_TOLERANCE_M = 1e-12
_LEAST_WIDTH = 1e-3  # of a point set, across its longest direction, as a share of it


def plane_basis(normal: NDArray[Any]) -> Float64:
    """Returns two unit vectors (2, 3) that span the plane across `normal` and are at right angles.

    Lengths in the plane are kept, which the rotations by A.1 and A.2's angles to the axes do not.
    """
    n = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    helper = np.eye(3)[np.abs(n).argmin()]
    first = np.cross(n, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(n, first)])


def fit_circle(points: NDArray[Any], radius_m: float) -> Float64:
    """Returns the centre (2,) of a circle of known radius through boundary points (n, 2).

    Minimises the sum of squared `distance − radius` (A.3; without the square, as printed, the
    radius would not matter) by Gauss–Newton from the centre of a circle of free radius.

    Raises:
        InputError: If fewer than three points are given, they lie on a line, or no circle of that
            radius comes near them.
    """
    p = np.asarray(points, np.float64)
    if p.ndim != 2 or p.shape[1] != 2 or len(p) < 3 or not (np.isfinite(p).all() and radius_m > 0):
        raise InputError(f"circle of {radius_m} m: points {p.shape}, needed are 3 or more finite ones (n, 2)")
    middle = p.mean(axis=0)
    q = p - middle
    free, _, rank, _ = np.linalg.lstsq(np.column_stack([2 * q, np.ones(len(q))]), (q * q).sum(1), rcond=1e-9)
    if rank < 3:
        raise InputError(f"circle of {radius_m} m: the {len(p)} points lie on a line")
    centre = free[:2]
    for _ in range(_CIRCLE_STEPS):
        away = q - centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        step = np.linalg.lstsq(-away / distance[:, None], radius_m - distance, rcond=None)[0]
        centre = centre + step
        if np.abs(step).max() < _CIRCLE_TOLERANCE_M * max(1.0, radius_m):
            break
    rms = np.sqrt(np.mean((np.linalg.norm(q - centre, axis=1) - radius_m) ** 2))
    if not rms < 0.5 * radius_m:
        raise InputError(f"circle of {radius_m} m: the {len(p)} points miss it by {rms:.4f} m rms")
    found: Float64 = centre + middle
    return found


def disc_centre(surface: NDArray[Any], boundary_rays: NDArray[Any], radius_m: float) -> Float64:
    """Returns the centre (3,) of a flat disc of known radius.

    The disc's plane is fitted to all its readings, and its outline is where the boundary's rays
    meet that plane: single depth readings, least of all those at an edge, are never relied on (A.4).

    Args:
        surface: (n, 3) points on the disc and around it in its plane, m.
        boundary_rays: (m, 2) x/z and y/z of its outline.
        radius_m: The disc's.

    Raises:
        InputError: If the points do not determine a plane, a ray does not meet it, or the outline
            does not determine the circle.
    """
    normal, offset = fit_plane(surface)
    rays = np.column_stack([np.asarray(boundary_rays, np.float64), np.ones(len(boundary_rays))])
    along = rays @ normal
    if not (along * offset > 0).all():
        raise InputError("disc: part of its outline does not meet its plane in front of the camera")
    outline = rays * (offset / along)[:, None]
    basis = plane_basis(normal)
    centre = fit_circle(outline @ basis.T, radius_m)
    return basis.T @ centre + offset * normal


def align(source: NDArray[Any], target: NDArray[Any], dst: str, src: str) -> Transform:
    """Returns the rigid motion that takes `source` nearest to `target` (A.5), by SVD.

    The determinant is held at +1: coplanar discs fit their mirror image just as well.

    Args:
        source: (n, 3) m, in frame `src`.
        target: (n, 3) m, the same points in frame `dst`.
        dst: Frame of the result's outcome.
        src: Frame that it takes coordinates from.

    Raises:
        InputError: If fewer than three points are given or they lie on a line.
    """
    f, t = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if f.shape != t.shape or f.ndim != 2 or f.shape[1] != 3 or len(f) < 3:
        raise InputError(f"{dst}_T_{src}: points {f.shape} and {t.shape}, needed are 3 or more pairs (n, 3)")
    if not (np.isfinite(f).all() and np.isfinite(t).all()):
        raise InputError(f"{dst}_T_{src}: some points are not finite")
    f_mean, t_mean = f.mean(axis=0), t.mean(axis=0)
    width = np.linalg.svd(f - f_mean, compute_uv=False)
    if width[1] <= _LEAST_WIDTH * width[0]:
        raise InputError(f"{dst}_T_{src}: the {len(f)} points lie on a line, so a turn about it stays open")
    u, _, vt = np.linalg.svd((f - f_mean).T @ (t - t_mean))
    handed = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    matrix = np.eye(4)
    matrix[:3, :3] = vt.T @ np.diag([1, 1, handed]) @ u.T
    matrix[:3, 3] = t_mean - matrix[:3, :3] @ f_mean
    return Transform(dst, src, matrix)


def hand_eye_of_pose(base_T_flange: Transform, base_T_depth: Transform) -> Transform:
    """Returns `flange_T_depth` from one pose: `inv(base_T_flange) @ base_T_depth` (A.8, in this order).

    Several poses want one joint least squares, not an average of these.

    Raises:
        ValueError: If the two do not share their outer frame.
    """
    return base_T_flange.inverse @ base_T_depth
