"""A reflector disc's centre from its outline: sub-pixel edges and a circle of known radius (A.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.discs_plane import LEAST_SLOPE, InversePlane, tukey
from calibration.hand_eye.single_pose import plane_basis
from surfclass.geometry import project, rays
from surfclass.rig import Camera
from surfclass.types import Bool, Float32, Float64

_STEP_PX = 0.25
_WINDOWS_PX = (None, 5.0, 3.5)  # how far from where the outline was last found it is looked for, each round
_FIRST_WINDOW = 0.4  # of the radius
_LEVEL = 0.25  # of the way from the background to the disc's darker places
_DARKER = 0.15  # share of the disc's pixels that are darker still: speckle has deep gaps
_NOISE_SD = 3.5
_HIGHEST = 0.6
_SPREAD_PX = 0.5  # outwards: where an edge of 0.5 to 1 px falls to that level
_SPREAD_SD_PX = 1.0
_TUKEY = 4.685
_LEAST_SCALE_PX = 0.05
_SETTLED = 1e-6  # m of shift, px of spread
_ARC_PX = 8.0  # outline points of one arc count as one: speckle is as large


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A disc's outline as fitted.

    Attributes:
        centre: (3,) m in the camera's frame.
        basis: (2, 3) unit vectors along the plane.
        covariance: (2, 2) m² of the centre along `basis`, as if outline points were independent.
        correlation: By how much that is too small, as far as this outline alone can tell.
        spread_px: How far outwards of a disc of the known radius the outline was found.
        rms_px: Of the outline's points, without the outliers.
        edge: (m, 2) px, the outline's points that agree.
        coverage: Share of the outline that they are.
        gap: Largest missing piece, as a share of the outline.
    """

    centre: Float64
    basis: Float64
    covariance: Float64
    correlation: float
    spread_px: float
    rms_px: float
    edge: Float64
    coverage: float
    gap: float


def tangents_at(pixels: NDArray[Any], camera: Camera) -> Float64:
    """Returns the undistorted x/z and y/z (n, 2) of pixels (n, 2), anywhere within the image."""
    grid = rays(camera)
    return np.column_stack([sampled(grid[axis], pixels[:, 0], pixels[:, 1]) for axis in (0, 1)])


def sampled(image: Float32, x: NDArray[Any], y: NDArray[Any]) -> Float64:
    """Returns an image's values between its pixels, bilinearly; beyond its border, continued."""
    h, w = image.shape
    column = np.clip(np.floor(x).astype(np.int64), 0, w - 2)
    row = np.clip(np.floor(y).astype(np.int64), 0, h - 2)
    right, down = x - column, y - row
    upper = (1 - right) * image[row, column] + right * image[row, column + 1]
    lower = (1 - right) * image[row + 1, column] + right * image[row + 1, column + 1]
    between: Float64 = (1 - down) * upper + down * lower
    return between


def fit_outline(
    image: Float32,
    camera: Camera,
    plane: InversePlane,
    pixel: Float64,
    radius_m: float,
    *,
    again: bool = False,
) -> Circle | str:
    """Returns the circle in `plane` whose outline the image shows near `pixel` (2,), or why there is none.

    Works on rays and in the plane, so that neither the lens nor the perspective shifts the centre
    (an ellipse's centre is not where the disc's centre is seen). Edges are taken low on their flank:
    there the speckle of the disc itself moves them least, and all outwards by much the same, which is
    a free parameter of the fit.

    Args:
        image: (h, w) IR, not filtered.
        camera: That took it.
        plane: Of the disc.
        pixel: (2,) about where its centre is seen.
        radius_m: Of the disc.
        again: Whether `pixel` is from such a fit, so that the outline need not be looked for far away.
    """
    centre = plane.meet(tangents_at(pixel[None], camera))[0]
    basis = plane_basis(plane.normal)
    found: Circle | str = "no outline"
    for window in _WINDOWS_PX[1:] if again else _WINDOWS_PX:
        if not centre[2] > radius_m:
            return "no outline in front of the camera"
        found = _round(image, camera, plane, centre, basis, radius_m, window)
        if isinstance(found, str):
            return found
        centre = found.centre
    return found


def circle_points(centre: Float64, basis: Float64, radius_m: float, count: int) -> Float64:
    """Returns (count, 3) m: points of a circle, evenly spaced."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    points: Float64 = centre + radius_m * np.column_stack([np.cos(angle), np.sin(angle)]) @ basis
    return points


def _round(
    image: Float32,
    camera: Camera,
    plane: InversePlane,
    centre: Float64,
    basis: Float64,
    radius_m: float,
    window_px: float | None,
) -> Circle | str:
    radius_px = camera.fx * radius_m / centre[2]
    count = int(np.clip(2 * np.pi * radius_px, 32, 200))
    ring = circle_points(centre, basis, radius_m, count)
    at = project(ring, camera)
    outwards = project(centre + 1.02 * (ring - centre), camera) - at
    # The image of the radius does not cross the outline at a right angle where the disc is tilted.
    along = np.roll(at, -1, axis=0) - np.roll(at, 1, axis=0)
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    crossing = (normal * outwards).sum(axis=1)
    normal *= np.sign(crossing)[:, None]
    scale = 0.02 * radius_m / np.abs(crossing)  # m of radius for 1 px across the outline

    reach = max(3.0, _FIRST_WINDOW * radius_px) if window_px is None else min(window_px, 0.6 * radius_px)
    if _leaves(at, camera, min(reach, 3.0)):
        return "cut off by the image's border"
    offset, seen = _edges(image, at, normal, reach, centre, basis, radius_m, camera)
    if seen.sum() < max(12, 0.4 * count):
        return "no edge where a disc's outline would be"
    edge = at + offset[:, None] * normal
    flat = (plane.meet(tangents_at(edge, camera)) - centre) @ basis.T
    distance = np.linalg.norm(flat, axis=1)
    direction = flat / np.maximum(distance, 1e-9)[:, None]
    rows = np.column_stack([direction / scale[:, None], np.ones(count)])
    off = (distance - radius_m) / scale
    return _solved(rows, off, seen, edge, centre, basis, radius_px)


def _leaves(pixels: Float64, camera: Camera, margin: float) -> bool:
    last = np.array(camera.size) - 1.0
    return bool((pixels < margin).any() or (pixels > last - margin).any())


def _edges(
    image: Float32,
    at: Float64,
    normal: Float64,
    reach: float,
    centre: Float64,
    basis: Float64,
    radius_m: float,
    camera: Camera,
) -> tuple[Float64, Bool]:
    """Returns where along each normal the image last falls below the level, and along which it does."""
    offsets = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    places = at[:, None] + offsets[None, :, None] * normal[:, None]
    profile = sampled(image, places[..., 0], places[..., 1])
    inside = np.concatenate([circle_points(centre, basis, share * radius_m, 48) for share in (0.3, 0.5, 0.7)])
    inside = project(inside, camera)
    bright = float(np.quantile(sampled(image, inside[:, 0], inside[:, 1]), _DARKER))
    beyond = project(centre + 1.35 * (circle_points(centre, basis, radius_m, 96) - centre), camera)
    dark = sampled(image, beyond[:, 0], beyond[:, 1])
    base = float(np.median(dark))
    noise = 1.4826 * float(np.median(np.abs(dark - base)))
    if bright - base < 2 * noise:
        return np.zeros(len(at)), np.zeros(len(at), bool)
    level = base + min(max(_LEVEL * (bright - base), _NOISE_SD * noise), _HIGHEST * (bright - base))
    above = profile > level
    last = profile.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
    seen = above.any(axis=1) & (last < profile.shape[1] - 1)
    last = np.minimum(last, profile.shape[1] - 2)
    each = np.arange(len(at))
    high, low = profile[each, last], profile[each, last + 1]
    share = np.clip((high - level) / np.maximum(high - low, 1e-9), 0, 1)
    return offsets[last] + _STEP_PX * share, seen


def _solved(
    rows: Float64, off: Float64, seen: Bool, edge: Float64, centre: Float64, basis: Float64, radius_px: float
) -> Circle | str:
    """Robust least squares of the shift along the plane and the spread outwards, which has a weak prior."""
    count = len(off)
    used = np.flatnonzero(seen)
    a, b = rows[used], off[used]
    prior = np.diag([0, 0, 1 / _SPREAD_SD_PX**2])
    solution = np.array([0.0, 0.0, float(np.median(b))])
    weights, scale = np.ones(len(b)), 1.0
    for _ in range(12):
        residual = b - a @ solution
        scale = max(1.4826 * float(np.median(np.abs(residual))), _LEAST_SCALE_PX)
        weights = np.clip(1 - (residual / (_TUKEY * scale)) ** 2, 0, None) ** 2
        hessian = (a * weights[:, None]).T @ a + scale**2 * prior
        right = (a * weights[:, None]).T @ b + scale**2 * prior @ [0, 0, _SPREAD_PX]
        step = np.linalg.solve(hessian, right) - solution
        solution = solution + step
        if np.abs(step).max() < _SETTLED:
            break
    residual = b - a @ solution
    kept = weights > 0.1
    if kept.sum() < 12:
        return "no round outline"
    limit = _TUKEY * scale
    influence, slope = tukey(residual / limit)
    inverse_hessian = np.linalg.inv(max(float(slope.mean()), LEAST_SLOPE) * a.T @ a + scale**2 * prior)
    variance = limit**2 * float((influence**2).sum()) / max(1, int(np.count_nonzero(influence)) - 3)
    variance = max(variance, _LEAST_SCALE_PX**2)
    covariance = (variance * inverse_hessian @ (a.T @ a) @ inverse_hessian)[:2, :2]
    arcs = max(8, round(2 * np.pi * radius_px / _ARC_PX))
    scores = np.zeros((arcs, 3))
    np.add.at(scores, used * arcs // count, a * (limit * influence)[:, None])
    clustered = arcs / (arcs - 3) * (inverse_hessian @ (scores.T @ scores) @ inverse_hessian)[:2, :2]
    correlation = float(np.trace(np.linalg.solve(covariance, clustered))) / 2
    marks = used[kept]
    gaps = np.diff(np.append(marks, marks[0] + count)) - 1
    rms = float(np.sqrt(np.mean(residual[kept] ** 2)))
    return Circle(
        centre + solution[:2] @ basis,
        basis,
        covariance,
        correlation,
        float(solution[2]),
        rms,
        edge[marks],
        float(len(marks) / count),
        float(gaps.max() / count),
    )
