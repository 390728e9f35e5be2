"""Surface normals of a depth image: planes fitted to the inverse depth, by sums over windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import ConfigurationError
from surfclass.geometry import check_size, depth_to_points, rays
from surfclass.rig import Camera
from surfclass.types import Bool, Float32, Float64

_BAND_EDGES_M = (0.0, 0.7, 1.4, 2.8, np.inf)  # readings in one band of distances share one window size
_BAND_CENTRES_M = (0.5, 1.0, 2.0, 4.0)
_COARSE_FROM_PX = 40  # windows from this side on are summed from blocks of 4 × 4 pixels, others 2 × 2
_WINDOW_SHARES = (1.0, 0.6)  # what finds no plane in the whole window may lie on a small surface
_THIN = 0.25  # a plane thinner than this share of tau_kappa needs no better window
_BETTER = 0.5  # an eccentric window must have less than this share of the centred one's variance
_COUNTED = np.linspace(-1, 1, 7)  # where in a window the literal count of inliers looks, per axis


@dataclass(frozen=True, slots=True)
class NormalSettings:
    """What counts as a neighbour, and when a fitted plane is the surface (Eq. 3.6 and its text).

    A depth camera's noise grows with the square of the distance z (in metres), so nothing here is
    one number for all distances.

    Attributes:
        radius_m: Half the window's side at 1 m (τ_μ); it grows as z^1.5, so that the normals are as
            good far away as near.
        min_neighbours: Fewest readings in a window; at least 4.
        tau_alpha: The plane's thickness must stay below its width: λ_min < λ_mid / τ_α.
        tau_kappa_m: More than half of the readings must lie within `tau_kappa_m + tau_kappa_growth z²`
            of the plane (τ_κ).
        tau_kappa_growth: As above, 1/m.
    """

    radius_m: float = 0.026
    min_neighbours: int = 30
    tau_alpha: float = 4.0
    tau_kappa_m: float = 0.003
    tau_kappa_growth: float = 0.004

    def __post_init__(self) -> None:
        positive = (self.radius_m, self.tau_alpha, self.tau_kappa_m)
        if not all(np.isfinite(positive)) or min(positive) <= 0 or not 0 <= self.tau_kappa_growth < np.inf:
            raise ConfigurationError(f"{self}: radius_m, tau_alpha and tau_kappa_m must be positive")
        if self.min_neighbours < 4:
            raise ConfigurationError(
                f"min_neighbours: {self.min_neighbours}, at least 4 readings determine a plane and its error"
            )


DEFAULT_SETTINGS = NormalSettings()


@dataclass(frozen=True, slots=True, eq=False)
class Normals:
    """The normals of a depth image.

    Attributes:
        normal: (3, h, w) float32, unit, in the depth camera's frame and turned to it; zeros where
            not `valid`.
        valid: (h, w) bool.
    """

    normal: Float32
    valid: Bool


def estimate_normals(
    depth_mm: NDArray[Any], camera: Camera, settings: NormalSettings = DEFAULT_SETTINGS
) -> Normals:
    """Fits a plane around every reading (Eq. 3.6's PCA, done where the noise is even).

    On a plane the inverse depth is linear in the ray (x/z, y/z), and a structured-light camera's noise
    is even in inverse depth, so the least-squares plane is one linear fit over sums in a window.
    Pixels share windows in blocks of 2 × 2 (far away 4 × 4). Near creases and jumps, where the centred
    window fails or an eccentric one fits much better, the best of the eccentric windows that hold
    the pixel serves; a pixel farther than 2 τ_κ from its plane has no normal. What is left without is
    tried again with a smaller window.

    Args:
        depth_mm: (h, w) along the optical axis, 0 = no return.
        camera: The depth camera.
        settings: Window and thresholds.

    Raises:
        InputError: If the image has not the camera's size.
    """
    check_size(depth_mm, camera)
    points = depth_to_points(depth_mm, camera)
    seen = points[2] > 0
    normal = np.zeros_like(points)
    valid = np.zeros(camera.shape, bool)
    blocks = {1: _moments(points[2], camera)}
    for low, high, centre in zip(_BAND_EDGES_M[:-1], _BAND_EDGES_M[1:], _BAND_CENTRES_M, strict=True):
        band = seen & (points[2] >= low) & (points[2] < high)
        if not band.any():
            continue
        side_px = 2 * settings.radius_m * max(camera.fx, camera.fy) * np.sqrt(centre)
        block_px = 4 if side_px >= _COARSE_FROM_PX else 2
        for finer in (1, 2)[: block_px // 2]:
            blocks.setdefault(2 * finer, _halved(blocks[finer]))
        for share in _WINDOW_SHARES:
            reach = max(1, round((share * side_px / block_px - 1) / 2))
            part = _rectangle(band, block_px, 2 * reach + 1)
            if part is None:
                break
            own = tuple(slice(s.start // block_px, -(-s.stop // block_px)) for s in part)
            found, served = _normals_in(
                points[:, *part], band[part], blocks[block_px][:, *own], reach, settings
            )
            np.copyto(normal[:, *part], found, where=served)
            valid[part] |= served
            band[part] &= ~served
    return Normals(normal, valid)


def _rectangle(band: Bool, block_px: int, margin: int) -> tuple[slice, slice] | None:
    """The whole blocks around the band's pixels and `margin` blocks more; None where there is no pixel."""
    sides = []
    for axis, length in ((1, band.shape[0]), (0, band.shape[1])):
        index = np.flatnonzero(band.any(axis=axis))
        if index.size == 0:
            return None
        first = max(0, int(index[0]) // block_px - margin) * block_px
        sides.append(slice(first, min(length, (int(index[-1]) // block_px + 1 + margin) * block_px)))
    return sides[0], sides[1]


def _normals_in(
    points: Float32, band: Bool, blocks: Float64, reach: int, settings: NormalSettings
) -> tuple[Float32, Bool]:
    """Returns normals (3, h, w) of one part of the image, and which pixels of `band` have one."""
    shape = band.shape
    block_px = -(-shape[0] // blocks.shape[1])
    planes = _fit(blocks, reach, settings)
    planes = _best_window(planes, blocks, reach, settings)
    accepted = planes.accepted | _majority_within(planes, points, reach, block_px, settings)

    normal = _per_pixel(planes.normal, block_px, shape)
    away = _per_pixel(planes.offset, block_px, shape) - np.einsum("ihw,ihw->hw", normal, points)
    served = band & (_per_pixel(accepted, block_px, shape))
    served &= np.abs(away) <= 2 * _tau_kappa(points[2], settings)
    return np.negative(normal), served


@dataclass(frozen=True, slots=True, eq=False)
class _Planes:
    """A plane `normal · p = offset` for each block of pixels.

    Attributes:
        normal: (3, rows, columns) float32, unit, away from the camera.
        offset: (rows, columns) float32, m, positive.
        variance: (rows, columns) float32, m², of the readings about the plane (λ_min).
        sound: (rows, columns) bool: enough neighbours, and flat against its width (Eq. 3.6).
        accepted: (rows, columns) bool: sound, and so thin that more than half of the readings are
            within τ_κ for certain: by Chebyshev's inequality at most `variance / τ_κ²` are not.
    """

    normal: Float32
    offset: Float32
    variance: Float32
    sound: Bool
    accepted: Bool


def _tau_kappa(z: NDArray[Any], settings: NormalSettings) -> Any:
    return settings.tau_kappa_m + settings.tau_kappa_growth * (z * z)


def _moments(depth_m: Float32, camera: Camera) -> Float64:
    """Returns 1, x, y, xx, xy, yy, w, xw, yw, ww of the readings (x, y: ray, w: inverse depth), else 0.

    In float64, for variances are small differences of these sums; padded to whole blocks.
    """
    h, w = camera.shape
    sums = np.zeros((10, h + -h % 4, w + -w % 4))
    inside = sums[:, :h, :w]
    x, y = rays(camera)
    one, mx, my, inverse = inside[0], inside[1], inside[2], inside[6]
    one[:] = depth_m > 0
    np.multiply(x, one, out=mx)
    np.multiply(y, one, out=my)
    np.multiply(mx, x, out=inside[3])
    np.multiply(mx, y, out=inside[4])
    np.multiply(my, y, out=inside[5])
    np.divide(1, depth_m, out=inverse, where=depth_m > 0)
    np.multiply(inverse, x, out=inside[7])
    np.multiply(inverse, y, out=inside[8])
    np.multiply(inverse, inverse, out=inside[9])
    return sums


def _halved(sums: Float64) -> Float64:
    """Sums of 2 × 2 neighbours."""
    columns = sums[:, :, 0::2] + sums[:, :, 1::2]
    summed: Float64 = columns[:, 0::2] + columns[:, 1::2]
    return summed


def _fit(blocks: Float64, reach: int, settings: NormalSettings) -> _Planes:
    """Least squares `w = a x + b y + c` over the (2 reach + 1)² blocks around each block."""
    sums = np.empty_like(blocks)
    side = (2 * reach + 1, 2 * reach + 1)
    for source, target in zip(blocks, sums, strict=True):
        cv2.boxFilter(source, cv2.CV_64F, side, target, normalize=False, borderType=cv2.BORDER_CONSTANT)
    count = sums[0].copy()
    sums /= np.maximum(count, 1)
    _, x, y, xx, xy, yy, w, xw, yw, ww = sums
    xx -= x * x
    xy -= x * y
    yy -= y * y
    xw -= x * w
    yw -= y * w
    ww -= w * w
    spread = xx * yy - xy * xy
    sound = (count >= settings.min_neighbours) & (spread > 1e-6 * (xx + yy) ** 2)
    scale = 1 / np.where(sound, spread, 1)
    a = (xw * yy - yw * xy) * scale
    b = (yw * xx - xw * xy) * scale
    c = w - a * x - b * y
    offset = 1 / np.sqrt(np.maximum(a * a + b * b + c * c, 1e-12))
    z = 1 / np.maximum(w, 1e-6)
    # An error of w is one of z² times it along the ray, and of offset / z times that across the plane.
    thickness = np.maximum(ww - a * xw - b * yw, 0) * (z * offset) ** 2
    width = _narrow_variance(a, b, x, y, z, xx, xy, yy, spread)
    sound &= thickness * settings.tau_alpha < width
    tau = _tau_kappa(z, settings)
    return _Planes(
        (np.stack([a, b, c]) * offset).astype(np.float32),
        offset.astype(np.float32),
        thickness.astype(np.float32),
        sound,
        sound & (thickness < 0.5 * tau * tau),
    )


def _narrow_variance(
    a: Float64,
    b: Float64,
    x: Float64,
    y: Float64,
    z: Float64,
    xx: Float64,
    xy: Float64,
    yy: Float64,
    spread: Float64,
) -> Float64:
    """λ_mid: the smaller eigenvalue of the readings' covariance within the plane, m².

    The point on the plane at ray (x, y) is p = (x, y, 1) / w(x, y). With J = ∂p/∂(x, y) the covariance
    has the eigenvalues of `C · JᵀJ`, C being that of the rays.
    """
    square = x * x + y * y + 1
    az, bz = a * z, b * z
    gxx = 1 - 2 * az * x + az * az * square
    gyy = 1 - 2 * bz * y + bz * bz * square
    gxy = az * bz * square - bz * x - az * y
    trace = xx * gxx + 2 * xy * gxy + yy * gyy
    determinant = spread * (gxx * gyy - gxy * gxy)
    smaller: Float64 = z * z * (trace - np.sqrt(np.maximum(trace * trace - 4 * determinant, 0))) / 2
    return smaller


def _best_window(planes: _Planes, blocks: Float64, reach: int, settings: NormalSettings) -> _Planes:
    """Replaces a block's plane by the thinnest of the eccentric windows that hold it.

    Only where that is needed or much better, and only by a plane that the block itself lies on.
    """
    count, x, y, w = (blocks[i].astype(np.float32) for i in (0, 1, 2, 6))
    scale = 1 / np.maximum(count, 1)
    x, y, w = x * scale, y * scale, w * scale
    z = 1 / np.maximum(w, np.float32(1e-6))
    tau = _tau_kappa(z, settings)
    thick = planes.variance > (_THIN * tau) ** 2
    limit = np.where(planes.accepted, np.where(thick, _BETTER * planes.variance, 0), np.inf)
    variance = limit.astype(np.float32)
    rows, columns = variance.shape
    row, column = np.mgrid[:rows, :columns].astype(np.int32)
    source = row * columns + column
    own = source.copy()
    steps = sorted({-reach, -(reach // 2), 0, reach // 2, reach})
    for down in steps:
        for right in steps:
            if down == right == 0:
                continue
            here = np.s_[max(0, -down) : rows - max(0, down), max(0, -right) : columns - max(0, right)]
            there = np.s_[max(0, down) : rows - max(0, -down), max(0, right) : columns - max(0, -right)]
            n, d = planes.normal[:, *there], planes.offset[there]
            away = z[here] * np.abs(n[0] * x[here] + n[1] * y[here] + n[2] - d * w[here])
            better = planes.accepted[there] & (planes.variance[there] < variance[here])
            better &= (away <= tau[here]) & (count[here] > 0)
            np.copyto(variance[here], planes.variance[there], where=better)
            np.copyto(source[here], own[there], where=better)
    flat = source.ravel()
    return _Planes(
        planes.normal.reshape(3, -1)[:, flat].reshape(3, rows, columns),
        planes.offset.ravel()[flat].reshape(rows, columns),
        planes.variance.ravel()[flat].reshape(rows, columns),
        planes.sound.ravel()[flat].reshape(rows, columns),
        planes.accepted.ravel()[flat].reshape(rows, columns),
    )


def _majority_within(
    planes: _Planes, points: Float32, reach: int, block_px: int, settings: NormalSettings
) -> Bool:
    """Counts the readings within τ_κ where Chebyshev's inequality leaves it open, over 7 × 7 places."""
    result = np.zeros_like(planes.sound)
    row, column = np.nonzero(planes.sound & ~planes.accepted)
    if row.size == 0:
        return result
    h, w = points.shape[1:]
    steps = np.rint(_COUNTED * (reach + 0.5) * block_px * 0.9).astype(np.int64)
    at_row = (row * block_px + block_px // 2)[:, None, None] + steps[:, None]
    at_column = (column * block_px + block_px // 2)[:, None, None] + steps[None, :]
    inside = (at_row >= 0) & (at_row < h) & (at_column >= 0) & (at_column < w)
    place = np.where(inside, at_row * w + at_column, 0)
    neighbour = points.reshape(3, -1)[:, place]
    read = inside & (neighbour[2] > 0)
    away = np.einsum("ib,ibrc->brc", planes.normal[:, row, column], neighbour)
    away -= planes.offset[row, column][:, None, None]
    near = read & (np.abs(away) <= _tau_kappa(neighbour[2], settings))
    result[row, column] = 2 * near.sum(axis=(1, 2)) > read.sum(axis=(1, 2))
    return result


def _per_pixel(blocks: NDArray[Any], block_px: int, shape: tuple[int, int]) -> NDArray[Any]:
    """Each block's value at its pixels; (…, rows, columns) to (…, h, w)."""
    wide = np.repeat(np.repeat(blocks, block_px, axis=-1), block_px, axis=-2)
    return wide[..., : shape[0], : shape[1]]
