"""Where rays meet the surfaces, and which light reaches a place: exact for flat rectangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.sim.surfaces import Surface
from surfclass.types import Float32, Transform

_NEAR_M = 0.02
_PENUMBRA_M = 0.02
_SELF_M = 1e-4  # closer crossings are the surface itself or the edge it shares


def length(vectors: NDArray[Any]) -> Float32:
    """Returns (…,) the length of vectors (…, 3); several times faster than numpy.linalg.norm."""
    return np.asarray(np.sqrt(np.einsum("...k,...k->...", vectors, vectors)), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A surface in a camera's frame.

    Attributes:
        surface: What it is.
        corner: (3,) float32 m; `along_s`, `along_t` and `normal` (3,) unit.
    """

    surface: Surface
    corner: Float32
    along_s: Float32
    along_t: Float32
    normal: Float32

    @property
    def corners(self) -> Float32:
        """(4, 3) m."""
        s, t = self.along_s * self.surface.size_m[0], self.along_t * self.surface.size_m[1]
        return np.array([self.corner, self.corner + s, self.corner + s + t, self.corner + t], np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What each pixel sees; planes of shape (h, w).

    Attributes:
        faces: The scene's surfaces in the camera's frame.
        face: int16 index in `faces`, −1 where the ray meets nothing.
        z: float32 m along the optical axis, 0 where nothing.
        s: float32 m, place on the surface; `t` likewise.
    """

    faces: tuple[Face, ...]
    face: NDArray[np.int16]
    z: Float32
    s: Float32
    t: Float32


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """The part of an image where one face is seen: a box of pixels and which of them."""

    rows: slice
    columns: slice
    seen: NDArray[np.bool_]


def faces_from(surfaces: Sequence[Surface], camera_T_base: Transform) -> tuple[Face, ...]:
    """Returns the surfaces in the camera's frame."""
    turn = camera_T_base.rotation
    return tuple(
        Face(
            surface,
            (camera_T_base @ surface.corner).astype(np.float32),
            (turn @ surface.along_s).astype(np.float32),
            (turn @ surface.along_t).astype(np.float32),
            (turn @ surface.normal).astype(np.float32),
        )
        for surface in surfaces
    )


def cast(faces: tuple[Face, ...], rays: Float32) -> Hits:
    """Returns what each ray of `rays` (2, h, w: x/z, y/z) meets first; only fronts are seen."""
    shape = rays.shape[1:]
    index = np.full(shape, -1, np.int16)
    nearest = np.full(shape, np.inf, np.float32)
    place_s, place_t = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    columns = rays[0].min(axis=0), rays[0].max(axis=0)
    rows = rays[1].min(axis=1), rays[1].max(axis=1)
    for number, face in enumerate(faces):
        if float(face.normal @ face.corner) >= 0:
            continue  # seen from behind
        box = _box_of(face, rows, columns)
        if box is None:
            continue
        x, y = rays[0][box], rays[1][box]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (face.normal @ face.corner) / (face.normal[0] * x + face.normal[1] * y + face.normal[2])
        s = z * (face.along_s[0] * x + face.along_s[1] * y + face.along_s[2]) - face.along_s @ face.corner
        t = z * (face.along_t[0] * x + face.along_t[1] * y + face.along_t[2]) - face.along_t @ face.corner
        width, height = face.surface.size_m
        won = (z > _NEAR_M) & (z < nearest[box]) & (s >= 0) & (s <= width) & (t >= 0) & (t <= height)
        nearest[box][won] = z[won]
        index[box][won] = number
        place_s[box][won], place_t[box][won] = s[won], t[won]
    nearest[index < 0] = 0
    return Hits(faces, index, nearest, place_s, place_t)


def crop_of(hits: Hits, number: int) -> Crop | None:
    """Returns where face `number` is seen, or None."""
    seen = hits.face == number
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if rows.size == 0:
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return Crop(*box, seen[box])


def lit_share(
    hits: Hits, number: int, crop: Crop, rays: Float32, source: Float32, source_radius_m: float
) -> Float32:
    """Returns which share of a disc-shaped source is visible from the pixels of one face.

    Only faces whose front sees the source are asked: those of a closed body tile its silhouette
    once, so the sum of what they cover is right in the penumbra too.

    Args:
        hits: The scene.
        number: The face that is lit.
        crop: Where it is seen.
        rays: (2, h, w) of the whole image.
        source: (3,) m, in the frame of the faces.
        source_radius_m: The penumbra follows from it.

    Returns:
        (h, w) 0…1 over the crop.
    """
    own = hits.faces[number]
    box = crop.rows, crop.columns
    s, t, z = hits.s[box], hits.t[box], hits.z[box]
    covered = np.zeros(s.shape, np.float32)
    for other_number, other in enumerate(hits.faces):
        if other_number == number or float((source - other.corner) @ other.normal) <= 0:
            continue
        bounds = _shadow_bounds(own, other, source)
        if bounds is None:
            continue
        (s_low, t_low), (s_high, t_high) = bounds
        inside = crop.seen & (s > s_low) & (s < s_high) & (t > t_low) & (t < t_high)
        if inside.any():
            points = rays[0][box][inside] * z[inside], rays[1][box][inside] * z[inside], z[inside]
            covered[inside] += _covered(points, other, source, source_radius_m)
    return np.asarray(1 - np.minimum(covered, 1), dtype=np.float32)


def _covered(
    points: tuple[Float32, Float32, Float32], other: Face, source: Float32, source_radius_m: float
) -> Float32:
    """(n,) share of the source that `other` hides from the points."""
    x, y, z = points
    n, lift = other.normal, float((source - other.corner) @ other.normal)
    height = (x - other.corner[0]) * n[0] + (y - other.corner[1]) * n[1] + (z - other.corner[2]) * n[2]
    # Heights over the occluder's plane: the ray crosses it where they change sign.
    with np.errstate(divide="ignore", invalid="ignore"):
        part = -height / (np.float32(lift) - height)
    between = (height < -_SELF_M) & np.isfinite(part)
    part = np.where(between, part, np.float32(0))
    crossing = [p + part * (to - p) - at for p, to, at in zip(points, source, other.corner, strict=True)]
    blur = np.maximum(np.float32(source_radius_m) * part, np.float32(1e-6))
    share = between.astype(np.float32)
    for axis, length in zip((other.along_s, other.along_t), other.surface.size_m, strict=True):
        place = crossing[0] * axis[0] + crossing[1] * axis[1] + crossing[2] * axis[2]
        overlap = np.minimum(place + blur, np.float32(length)) - np.maximum(place - blur, 0)
        share *= np.clip(overlap / (2 * blur), 0, 1)
    return np.asarray(share, dtype=np.float32)


def _shadow_bounds(own: Face, other: Face, source: Float32) -> tuple[Float32, Float32] | None:
    """Lowest and highest (s, t) on `own` that the shadow of `other` can reach; None: it casts none."""
    source_height = np.float32((source - own.corner) @ own.normal)
    corners = other.corners
    heights = _heights(own, corners)
    if source_height <= 0 or heights.max() <= _SELF_M or heights.min() >= source_height:
        return None
    if heights.max() > 0.98 * source_height:  # as high as the source: its shadow goes on for ever
        return np.full(2, -np.inf, np.float32), np.full(2, np.inf, np.float32)
    outline = _above(corners, heights)
    heights = _heights(own, outline)
    ground = source + (outline - source) * (source_height / (source_height - heights))[:, None]
    places = np.stack([(ground - own.corner) @ own.along_s, (ground - own.corner) @ own.along_t], axis=1)
    return places.min(axis=0) - np.float32(_PENUMBRA_M), places.max(axis=0) + np.float32(_PENUMBRA_M)


def _heights(own: Face, points: Float32) -> Float32:
    return np.asarray((points - own.corner) @ own.normal, dtype=np.float32)


def _above(outline: Float32, heights: Float32) -> Float32:
    """The part (m, 3) of a polygon (n, 3) whose height is not negative."""
    kept: list[Float32] = []
    for index, (a, b) in enumerate(zip(heights, np.roll(heights, -1), strict=True)):
        here, following = outline[index], outline[(index + 1) % len(outline)]
        if a >= 0:
            kept.append(here)
        if (a >= 0) != (b >= 0):
            kept.append(here + (following - here) * (a / (a - b)))
    return np.array(kept, np.float32)


def _box_of(
    face: Face, rows: tuple[Float32, Float32], columns: tuple[Float32, Float32]
) -> tuple[slice, slice] | None:
    """The pixels that can see the face: a box around its corners' projection."""
    corners = face.corners
    if (corners[:, 2] < _NEAR_M).all():
        return None
    if (corners[:, 2] < _NEAR_M).any():
        return slice(0, rows[0].size), slice(0, columns[0].size)
    x, y = corners[:, 0] / corners[:, 2], corners[:, 1] / corners[:, 2]
    down = np.flatnonzero((rows[1] >= y.min()) & (rows[0] <= y.max()))
    across = np.flatnonzero((columns[1] >= x.min()) & (columns[0] <= x.max()))
    if down.size == 0 or across.size == 0:
        return None
    return slice(down[0], down[-1] + 1), slice(across[0], across[-1] + 1)
