"""Flat rectangles of material, each with its own texture that depends on the place on it alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.materials import INDEX, MATERIALS
from drivers.sim.relief import Patch
from surfclass.types import Float32, Float64

TEXEL_M = 0.00035
_LEVELS = 5
_ALBEDO_UNIT = 1 / 65535
_SLOPE_UNIT = 1 / 8192

Texel = TypeVar("Texel", np.uint16, np.int16)
# Says for every texel of a patch which of the surface's materials it is: (h, w) uint8.
Layout = Callable[[Patch], NDArray[np.uint8]]


@dataclass(frozen=True, eq=False)
class Surface:
    """A rectangle in `base`; seen from its front s runs to the right and t downwards.

    Attributes:
        name: Unique in a scene; with the seed it decides the texture.
        corner: (3,) m, where s = t = 0.
        along_s: (3,) unit; `along_t` likewise, at right angles.
        size_m: Width along s, height along t.
        materials: Names in `MATERIALS`.
        layout: Where each of them is; None: the first one everywhere.
        coarseness: Texels this many times larger, for what is only a background.
    """

    name: str
    corner: Float64
    along_s: Float64
    along_t: Float64
    size_m: tuple[float, float]
    materials: tuple[str, ...]
    layout: Layout | None = None
    coarseness: float = 1.0
    normal: Float64 = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "normal", np.cross(self.along_t, self.along_s))

    @property
    def corners(self) -> Float64:
        """(4, 3) m in `base`."""
        s, t = self.size_m[0] * self.along_s, self.size_m[1] * self.along_t
        return np.array([self.corner, self.corner + s, self.corner + s + t, self.corner + t])


@dataclass(frozen=True, eq=False)
class Texture:
    """A surface's baked look, with ever coarser copies for views from afar.

    Attributes:
        texel_m: Of the finest copy; each next one is twice as coarse.
        albedo: Copies (h, w, 3) uint16, 65535 is 1.
        slope: Copies (h, w, 2) int16, height's slope along s and t times 8192.
        material: (h, w) uint8, index in `MATERIALS`, finest only.
    """

    texel_m: float
    albedo: tuple[NDArray[np.uint16], ...]
    slope: tuple[NDArray[np.int16], ...]
    material: NDArray[np.uint8]

    def sample(self, s: Float32, t: Float32, footprint_m: Float32) -> tuple[Float32, Float32]:
        """Returns albedo (…, 3) and slope (…, 2) at places on the surface, averaged over `footprint_m`."""
        level = np.clip(np.log2(footprint_m / self.texel_m), 0, len(self.albedo) - 1).astype(np.float32)
        albedo = np.zeros((*s.shape, 3), np.float32)
        slope = np.zeros((*s.shape, 2), np.float32)
        for index in range(int(level.min()), int(np.ceil(level.max())) + 1):
            share = np.maximum(0, 1 - np.abs(level - np.float32(index)))[..., None]
            texel = np.float32(self.texel_m * 2**index)
            u, v = s / texel - np.float32(0.5), t / texel - np.float32(0.5)
            albedo += share * _look_up(self.albedo[index], u, v)
            slope += share * _look_up(self.slope[index], u, v)
        return albedo * np.float32(_ALBEDO_UNIT), slope * np.float32(_SLOPE_UNIT)

    def material_at(self, s: Float32, t: Float32) -> NDArray[np.uint8]:
        """Returns the index in `MATERIALS` at places on the surface."""
        height, width = self.material.shape
        column = np.clip((s / np.float32(self.texel_m)).astype(np.int32), 0, width - 1)
        row = np.clip((t / np.float32(self.texel_m)).astype(np.int32), 0, height - 1)
        return np.asarray(self.material[row, column])


def _look_up(image: NDArray[np.uint16] | NDArray[np.int16], u: Float32, v: Float32) -> Float32:
    picked = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(picked, dtype=np.float32)


def bake(surface: Surface, seed: int, texel_m: float) -> Texture:
    """Returns the surface's texture in a world with that seed."""
    texel_m *= surface.coarseness
    patch = Patch(surface.size_m, texel_m, seed, surface.name)
    choice = np.zeros(patch.shape, np.uint8) if surface.layout is None else surface.layout(patch)
    albedo = np.zeros((*patch.shape, 3), np.float32)
    height = np.zeros(patch.shape, np.float32)
    material = np.zeros(patch.shape, np.uint8)
    for index, name in enumerate(surface.materials):
        here = choice == index
        look_albedo, look_height = MATERIALS[INDEX[name]].look(patch)
        albedo[here], height[here] = look_albedo[here], look_height[here]
        material[here] = INDEX[name]
    slope = np.stack([_slope(height, 1, texel_m), _slope(height, 0, texel_m)], axis=2)
    # A step between two materials is an edge of paint or scale, not a cliff.
    np.clip(slope, -1.5, 1.5, out=slope)
    albedos = _copies(np.round(np.clip(albedo, 0.004, 1) / _ALBEDO_UNIT).astype(np.uint16))
    slopes = _copies(np.round(slope / _SLOPE_UNIT).astype(np.int16))
    return Texture(texel_m, albedos, slopes, material)


def _slope(height: Float32, axis: int, texel_m: float) -> Float32:
    return np.asarray(np.gradient(height, texel_m, axis=axis), dtype=np.float32)


def _copies(finest: NDArray[Texel]) -> tuple[NDArray[Texel], ...]:
    copies = [finest]
    while len(copies) < _LEVELS and min(copies[-1].shape[:2]) >= 2:
        previous = copies[-1]
        # Even sizes keep texel k of the coarse copy exactly over texels 2k and 2k + 1.
        odd = (previous.shape[0] % 2, previous.shape[1] % 2)
        even = cv2.copyMakeBorder(previous, 0, odd[0], 0, odd[1], cv2.BORDER_REPLICATE)
        half = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        copies.append(half.astype(finest.dtype))
    return tuple(copies)


def bands(*edges_m: float, rough_m: float = 0.012) -> Layout:
    """Returns a layout of strips along s that meet at ragged edges, as a blasted patch ends in rust."""

    def layout(patch: Patch) -> NDArray[np.uint8]:
        ragged = patch.s + np.float32(rough_m) * patch.fractal("edge", 0.060, 6, 0.55)
        choice = np.zeros(patch.shape, np.uint8)
        for edge in edges_m:
            choice += ragged > edge
        return choice

    return layout


def checker(square_m: float, columns: int, rows: int) -> Layout:
    """Returns a layout of `columns` × `rows` squares in the middle; index 1 is the dark one."""

    def layout(patch: Patch) -> NDArray[np.uint8]:
        column = np.floor((patch.s - patch.size_m[0] / 2) / square_m + columns / 2).astype(np.int32)
        row = np.floor((patch.t - patch.size_m[1] / 2) / square_m + rows / 2).astype(np.int32)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        return np.asarray(inside & ((column + row) % 2 == 0), dtype=np.uint8)

    return layout


def discs(centres_m: tuple[tuple[float, float], ...], radius_m: float) -> Layout:
    """Returns a layout of discs (index 1) at places (s, t) of the surface."""

    def layout(patch: Patch) -> NDArray[np.uint8]:
        choice = np.zeros(patch.shape, np.uint8)
        for s, t in centres_m:
            choice |= np.asarray((patch.s - s) ** 2 + (patch.t - t) ** 2 <= radius_m**2, dtype=np.uint8)
        return choice

    return layout
