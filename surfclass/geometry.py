"""Cameras as geometry: rays, points, projection, and the surface point behind every colour pixel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import Camera, DepthCorrection, DepthRig, Rig
from surfclass.types import Bool, Float32, Float64, Transform, freeze

JUMP = 0.03
"""Neighbouring readings whose depths differ by more than this share belong to different surfaces."""

_UNDISTORT_TOLERANCE = 1e-9  # tangents of angles; 1e-6 px of a camera with a focal length of 1000 px
_MAX_SHIFT_PX = 0.5  # how far a colour pixel's depth sample may lie from where its point projects to
_SEARCH_STEPS = 3


def rays(camera: Camera) -> Float32:
    """Returns the undistorted x/z and y/z of every pixel: (2, h, w) float32, cached and read-only.

    Raises:
        ConfigurationError: If the distortion folds the image over, so that a pixel has no one ray.
    """
    return _rays(camera)


@lru_cache(maxsize=16)
def _rays(camera: Camera) -> Float32:
    h, w = camera.shape
    y, x = np.mgrid[:h, :w].astype(np.float64)
    xd, yd = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    return _frozen(np.stack(_undistort(xd, yd, camera)))


def _frozen(array: NDArray[Any]) -> Float32:
    return freeze(np.ascontiguousarray(array, dtype=np.float32))


def _undistort(xd: Float64, yd: Float64, camera: Camera) -> tuple[Float64, Float64]:
    """Newton's method on the distortion model; its Jacobian must stay positive, else it has folded."""
    if not any(camera.distortion):
        return xd, yd
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xd.copy(), yd.copy()
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / d(x) is slope · x
        ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - yd
        jxx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        jyy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        jxy = x * y * slope + 2 * p1 * x + 2 * p2 * y
        det = jxx * jyy - jxy * jxy
        if det.min() <= 0:
            break
        x -= (ex * jyy - ey * jxy) / det
        y -= (ey * jxx - ex * jxy) / det
        if max(np.abs(ex).max(), np.abs(ey).max()) < _UNDISTORT_TOLERANCE:
            return x, y
    raise ConfigurationError(
        f"camera: distortion {camera.distortion} has no inverse over the {camera.size[0]} × "
        f"{camera.size[1]} image; calibrate with boards that reach into its corners"
    )


def _distort(x: Any, y: Any, camera: Camera) -> tuple[Any, Any]:
    """Returns the pixels of the rays (x/z, y/z); arrays of any float type, new ones."""
    if any(camera.distortion):
        k1, k2, p1, p2, k3 = camera.distortion
        xy, xx, yy = x * y, x * x, y * y
        r2 = xx + yy
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x, y = (
            x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx),
            y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy,
        )
    return x * camera.fx + camera.cx, y * camera.fy + camera.cy


def project(points: NDArray[Any], camera: Camera) -> NDArray[Any]:
    """Returns the pixels (…, 2) of points (…, 3) in the camera's frame, with its distortion.

    Raises:
        InputError: If a point is not in front of the camera: it has no image.
    """
    z = points[..., 2]
    if not (z > 0).all():
        raise InputError(f"project: {int((~(z > 0)).sum())} points are not in front of the camera")
    return np.stack(_distort(points[..., 0] / z, points[..., 1] / z, camera), axis=-1)


def depth_to_points(depth_mm: NDArray[Any], camera: Camera) -> Float32:
    """Returns the point of every pixel in the depth camera's frame (Eq. 3.3–3.5), after undistortion.

    Args:
        depth_mm: (h, w) along the optical axis, 0 = no return.
        camera: The depth camera.

    Returns:
        (3, h, w) float32, m; zeros where there is no return.

    Raises:
        InputError: If the image has not the camera's size.
    """
    check_size(depth_mm, camera)
    points = np.empty((3, *camera.shape), np.float32)
    np.multiply(depth_mm, np.float32(1e-3), out=points[2], casting="same_kind")
    np.multiply(rays(camera), points[2], out=points[:2])
    return points


def corrected_depth(depth_mm: NDArray[Any], rig: DepthRig) -> NDArray[Any]:
    """Returns the depth image as the rig's `depth_correction` has it: the image itself where there is none.

    Args:
        depth_mm: (h, w) as the sensor reads it, along the optical axis, 0 = no return.
        rig: Its depth camera and the correction.

    Returns:
        (h, w) mm; float32 where it is corrected; 0 = no return, or a reading beyond the infinite.

    Raises:
        InputError: If the image has not the camera's size.
    """
    check_size(depth_mm, rig.depth)
    correction = rig.depth_correction
    if correction is None:
        return depth_mm
    multiplier = _multiplier(correction, rig.depth.shape)
    depth: Float32 = np.multiply(depth_mm, multiplier, dtype=np.float32, casting="same_kind")
    if correction.inverse_offset_per_m:
        offset = np.float32(1e-3 * correction.inverse_offset_per_m)  # 1 / (1/z + c) = z / (1 + c z)
        stretch = 1 + offset * depth
        depth = np.divide(depth, stretch, out=np.zeros_like(depth), where=stretch > 0)
    return depth


def multiplier_terms(x: NDArray[Any], y: NDArray[Any], count: int) -> Float64:
    """Returns (count, …) the terms of `DepthCorrection.multiplier` at places of -1…1 in the image."""
    order = {1: 0, 3: 1, 6: 2, 10: 3}[count]
    return np.stack([x ** (degree - j) * y**j for degree in range(order + 1) for j in range(degree + 1)])


@lru_cache(maxsize=4)
def _multiplier(correction: DepthCorrection, shape: tuple[int, int]) -> Float32:
    y, x = (np.linspace(-1, 1, side) for side in shape)
    place = np.meshgrid(x, y)
    terms = multiplier_terms(*place, len(correction.multiplier))
    return _frozen(np.tensordot(np.array(correction.multiplier), terms, axes=1))


def check_size(depth_mm: NDArray[Any], camera: Camera) -> None:
    """Raises InputError where a depth image has not its camera's size."""
    if depth_mm.shape != camera.shape:
        raise InputError(f"depth image: shape {depth_mm.shape}, the rig's depth camera has {camera.shape}")


def fit_plane(points: NDArray[Any]) -> tuple[Float64, float]:
    """Returns the plane `normal · p = offset` nearest to points (n, 3), by least squares across it.

    The normal (3,) is unit and turned to the frame's origin, so that the offset (m) is not positive.

    Raises:
        InputError: If there are fewer than three points, or they lie on a line.
    """
    p = np.asarray(points, np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or len(p) < 3 or not np.isfinite(p).all():
        raise InputError(f"plane: points of shape {p.shape}, needed are 3 or more finite ones (n, 3)")
    centre = p.mean(axis=0)
    _, width, axes = np.linalg.svd(p - centre, full_matrices=False)
    if width[1] <= 1e-6 * max(width[0], 1e-12):
        raise InputError(f"plane: the {len(p)} points lie on a line")
    normal = axes[2] if axes[2] @ centre <= 0 else -axes[2]
    return normal, float(normal @ centre)


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredDepth:
    """The surface point that each colour pixel sees, and where the depth camera measured it.

    Attributes:
        point: (3, H, W) float32, m, in `rgb`; zeros where there is none.
        u: (H, W) float32, column of the point in the depth image, px; meaningful where `has_point`.
        v: (H, W) float32, row likewise.
        has_point: (H, W) bool.
    """

    point: Float32
    u: Float32
    v: Float32
    has_point: Bool


def register(depth_mm: NDArray[Any], rig: Rig) -> RegisteredDepth:
    """Finds the surface point of every colour pixel, with occlusion and without inventing depth.

    Each pixel's ray is searched from its nearest possible surface on: a depth is assumed, the
    point projected into the depth image, the inverse depth read there (it is linear over a plane, so
    interpolating it is exact) and taken as the next assumption. What counts in the end is only a
    place between four readings of one surface, that projects back to itself, and that no nearer
    surface hides from the colour camera.

    Args:
        depth_mm: (h, w) as the sensor reads it, along its optical axis, 0 = no return.
        rig: Its cameras, `depth_correction`, and `rgb_T_depth` (the thesis' text says the inverse, against
            its notation).

    Raises:
        InputError: If the image has not the depth camera's size.
    """
    depth_mm = corrected_depth(depth_mm, rig)
    pair = _pair(rig.rgb, rig.depth, rig.transforms.rgb_T_depth)
    inverse, x, y = _in_rgb(depth_mm, pair)
    nearest, hidden = _nearest_surface(inverse, x, y, rig.rgb, pair.cell_px)
    filled = np.where(inverse > 0, inverse, cv2.dilate(inverse, np.ones((5, 5), np.uint8)))

    w: NDArray[Any] = nearest
    for _ in range(_SEARCH_STEPS - 1):
        u, v = pair.place(w)
        w = cv2.remap(filled, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    u, v = pair.place(w)
    assumed = w
    w = cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    # Nearest to half a pixel up and left is the top left corner of the four readings around (u, v).
    corner = u - np.float32(0.5), v - np.float32(0.5)
    whole = cv2.remap(_on_one_surface(inverse), *corner, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    has_point: Bool = (whole > 0) & (cv2.absdiff(assumed, w) <= pair.tolerance) & (w >= hidden)

    z = np.divide(1, w, out=np.zeros_like(w), where=has_point)
    point = np.empty((3, *rig.rgb.shape), np.float32)
    np.multiply(rays(rig.rgb), z, out=point[:2])
    point[2] = z
    return RegisteredDepth(point, u, v, has_point)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """What two cameras and their transform fix for every frame.

    Attributes:
        depth: The depth camera.
        ray_in_rgb: (3, h, w) each depth pixel's ray (x/z, y/z, 1), turned into `rgb`.
        to_rgb: (3,) m, the depth camera's centre in `rgb`.
        column, row, scale: (H, W) each; with the inverse depth w that is assumed for a colour
            pixel, its depth pixel is `(column + w to_depth[0]) / (scale + w to_depth[2])` and so on. Where
            the depth camera has distortion these are its rays, else its pixels.
        to_depth: The three factors of w.
        tolerance: 1/m, the change of w that moves the depth pixel by `_MAX_SHIFT_PX`.
        cell_px: Side of a z-buffer cell that a depth image fills without gaps, colour pixels.
    """

    depth: Camera
    ray_in_rgb: Float32
    to_rgb: Float32
    column: Float32
    row: Float32
    scale: Float32
    to_depth: Float32
    tolerance: float
    cell_px: int

    def place(self, w: Float32) -> tuple[Float32, Float32]:
        """Returns where in the depth image (u, v) the colour pixels with inverse depths w (H, W) lie."""
        with np.errstate(divide="ignore", invalid="ignore"):  # a place at infinity has no reading
            factor = 1 / (self.scale + w * self.to_depth[2])
            u = (self.column + w * self.to_depth[0]) * factor
            v = (self.row + w * self.to_depth[1]) * factor
            return _distort(u, v, self.depth) if any(self.depth.distortion) else (u, v)


@lru_cache(maxsize=4)
def _pair(rgb: Camera, depth: Camera, rgb_T_depth: tuple[tuple[float, ...], ...]) -> _Pair:
    pose = Transform("rgb", "depth", np.array(rgb_T_depth))
    back = pose.inverse
    forward_rays = np.tensordot(pose.rotation, _homogeneous(depth), axes=1)
    backward_rays = np.tensordot(back.rotation, _homogeneous(rgb), axes=1)
    pixels = np.eye(3) if any(depth.distortion) else depth.matrix
    column, row, scale = np.tensordot(pixels, backward_rays, axes=1)
    baseline = float(np.linalg.norm(back.translation))
    return _Pair(
        depth=depth,
        ray_in_rgb=_frozen(forward_rays),
        to_rgb=_frozen(pose.translation),
        column=_frozen(column),
        row=_frozen(row),
        scale=_frozen(scale),
        to_depth=_frozen(pixels @ back.translation),
        tolerance=_MAX_SHIFT_PX / max(max(depth.fx, depth.fy) * baseline, 1e-9),
        cell_px=int(np.ceil(max(rgb.fx / depth.fx, rgb.fy / depth.fy))),
    )


def _homogeneous(camera: Camera) -> Float64:
    x, y = rays(camera).astype(np.float64)
    return np.stack([x, y, np.ones_like(x)])


def _in_rgb(depth_mm: NDArray[Any], pair: _Pair) -> tuple[Float32, Float32, Float32]:
    """Returns 1/z, x/z and y/z in `rgb` of each depth pixel; 1/z is 0 where there is no reading."""
    depth_m = np.multiply(depth_mm, np.float32(1e-3), dtype=np.float32, casting="same_kind")
    z = pair.ray_in_rgb[2] * depth_m + pair.to_rgb[2]
    seen = (depth_m > 0) & (z > 0)
    inverse = np.divide(1, z, out=np.zeros_like(z), where=seen)
    x = (pair.ray_in_rgb[0] * depth_m + pair.to_rgb[0]) * inverse
    y = (pair.ray_in_rgb[1] * depth_m + pair.to_rgb[1]) * inverse
    return inverse, x, y


def _on_one_surface(inverse: Float32) -> NDArray[np.uint8]:
    """1 where a pixel and its right, lower and lower right neighbours are readings without a jump."""
    high = np.maximum(inverse[:, 1:], inverse[:, :-1])
    low = np.minimum(inverse[:, 1:], inverse[:, :-1])
    high = np.maximum(high[1:], high[:-1])
    low = np.minimum(low[1:], low[:-1])
    one = np.zeros(inverse.shape, np.uint8)
    one[:-1, :-1] = low > (1 - JUMP) * high  # false where one of the four has no reading
    return one


def _nearest_surface(
    inverse: Float32, x: Float32, y: Float32, rgb: Camera, cell_px: int
) -> tuple[Float32, Float32]:
    """Splats the readings into coarse cells of the colour image, the nearest winning.

    Returns:
        (H, W) inverse depth to start each pixel's search from: the nearest around its cell; and
        (H, W) the inverse depth below which a point is hidden by its own cell.
    """
    h, w = rgb.shape
    rows, columns = -(-h // cell_px), -(-w // cell_px)
    u, v = _distort(x, y, rgb)
    column = np.floor((u + 0.5) / cell_px).astype(np.int32)
    row = np.floor((v + 0.5) / cell_px).astype(np.int32)
    inside = (inverse > 0) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    splat = np.zeros(rows * columns, np.float32)
    np.maximum.at(splat, (row * columns + column)[inside], inverse[inside])
    cells = splat.reshape(rows, columns)

    # Closing fills cells between the readings of one surface without moving its outline.
    closed = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    around = cv2.dilate(cells, np.ones((3, 3), np.uint8))
    far_around = cv2.dilate(around, np.ones((9, 9), np.uint8))
    start = np.where(around > 0, around, far_around)

    def per_pixel(cells: NDArray[Any]) -> NDArray[Any]:
        size = (columns * cell_px, rows * cell_px)
        full: NDArray[Any] = cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST)
        return full[:h, :w]

    return per_pixel(start), per_pixel(closed * np.float32(1 - JUMP))
