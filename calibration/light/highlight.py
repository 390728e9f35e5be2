"""Where the light is, from the highlight and the diffuse region of one semi-gloss board (Eq. 4.5–4.10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from surfclass.errors import ConfigurationError, InputError
from surfclass.geometry import fit_plane, rays
from surfclass.rig import Camera
from surfclass.types import Bool, Float32, Float64, SurfaceView

_PLANE_ROUNDS = 4
_MOST_SAMPLES = 20_000
_SEARCH = 240  # distances, evenly spaced in their logarithm
_REFINEMENTS = 60
_INVERSE_GOLDEN = (np.sqrt(5) - 1) / 2


@dataclass(frozen=True, slots=True)
class LightSearch:
    """How a board's image is split, and where the light is searched.

    Attributes:
        specular_above: Fraction of full scale above which a pixel is of the highlight (τ_s, Eq. 4.5).
        diffuse_below: Fraction below which it is diffuse (τ_d, Eq. 4.7).
        saturated_from: Fraction from which a pixel is saturated, and so never diffuse.
        dark_below: Fraction below which a pixel is noise.
        guard: Width of the band around the highlight that is left out, in units of the highlight's
            own radius: the lobe's tail is below τ_d and still not diffuse.
        nearest_m: Where the search for the light's distance from the highlight begins.
        farthest_m: Where it ends.
    """

    specular_above: float = 0.7
    diffuse_below: float = 0.7
    saturated_from: float = 0.98
    dark_below: float = 0.02
    guard: float = 1.5
    nearest_m: float = 0.05
    farthest_m: float = 3.0

    def __post_init__(self) -> None:
        if not 0 <= self.dark_below < self.diffuse_below <= self.specular_above < 1:
            raise ConfigurationError(f"{self}: allowed is dark_below < diffuse_below <= specular_above < 1")
        if not 0 < self.nearest_m < self.farthest_m or self.guard < 0:
            raise ConfigurationError(f"{self}: allowed is 0 < nearest_m < farthest_m and guard >= 0")


DEFAULT_SEARCH = LightSearch()


@dataclass(frozen=True, slots=True, eq=False)
class LightPosition:
    """The light as one board shows it.

    Attributes:
        position_rgb_m: (3,) its place, in `rgb` (Eq. 4.10).
        highlight_m: (3,) the highlight's centroid on the board, p.
        direction: (3,) unit, from there to the light (Eq. 4.6).
        distance_m: From there to the light (Eq. 4.8).
        relative_spread: Of the diffuse reflectance over the board: standard deviation over mean.
        diffuse: (h, w) bool, the pixels that it was judged by.
    """

    position_rgb_m: Float64
    highlight_m: Float64
    direction: Float64
    distance_m: float
    relative_spread: float
    diffuse: Bool


def locate_light(
    intensity: Float32,
    view: SurfaceView,
    camera: Camera,
    polynomial: tuple[float, float, float],
    search: LightSearch = DEFAULT_SEARCH,
) -> LightPosition:
    """Locates the light from one view of a flat semi-gloss board that fills the image.

    Args:
        intensity: (h, w) grey fractions of full scale.
        view: The board's geometry, for the same pixels.
        camera: The colour camera.
        polynomial: a2, a1, a0 of Eq. 4.4 (metres).
        search: Thresholds and range.

    Raises:
        InputError: If there is no highlight, too little diffuse board, or the best distance is at a
            bound of the search, which means that the image does not determine it.
    """
    if intensity.shape != view.has_point.shape:
        raise InputError(f"light: image {intensity.shape} for a view of {view.has_point.shape} pixels")
    highlight, diffuse = split_regions(intensity, view.has_point, search)
    normal, offset = _board_plane(view.point[:, view.has_point].T)
    p = _centroid(highlight, camera, normal, offset)
    direction = reflect(-p / np.linalg.norm(p), normal)

    chosen = np.flatnonzero(diffuse)
    chosen = chosen[:: max(1, chosen.size // _MOST_SAMPLES)]
    points = view.point.reshape(3, -1)[:, chosen].T.astype(np.float64)
    samples = intensity.ravel()[chosen].astype(np.float64)

    def spread(distance: float) -> float:
        return relative_spread(diffuse_term(samples, points, normal, p + distance * direction, polynomial))

    distance = _least(spread, search.nearest_m, search.farthest_m)
    return LightPosition(p + distance * direction, p, direction, distance, spread(distance), diffuse)


def split_regions(
    intensity: Float32, usable: Bool, search: LightSearch = DEFAULT_SEARCH
) -> tuple[Bool, Bool]:
    """Returns the highlight and the diffuse region, (h, w) each (Eq. 4.5, 4.7).

    The highlight is the largest connected part above its threshold; a guard band around all that is
    above it, saturated and dark pixels belong to neither.

    Raises:
        InputError: If one of the two is missing.
    """
    bright = usable & (intensity > search.specular_above)
    count, label, stats, _ = cv2.connectedComponentsWithStats(bright.view(np.uint8), connectivity=8)
    if count < 2:
        raise InputError(
            f"light: no pixel of the board is above {search.specular_above:g} of full scale; the board must "
            "be semi-gloss and show the light's reflection"
        )
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    highlight: Bool = label == largest
    radius = np.sqrt(stats[largest, cv2.CC_STAT_AREA] / np.pi)
    away = cv2.distanceTransform((~bright).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    diffuse: Bool = usable & (intensity < search.diffuse_below) & (intensity > search.dark_below)
    diffuse &= (intensity < search.saturated_from) & (away > search.guard * radius)
    if diffuse.sum() < 100:
        raise InputError(
            f"light: {int(diffuse.sum())} pixels are diffuse, needed are 100 between {search.dark_below:g} "
            f"and {search.diffuse_below:g} of full scale, away from the highlight"
        )
    return highlight, diffuse


def reflect(towards_camera: Float64, normal: Float64) -> Float64:
    """Returns the direction to the light at the highlight: the view mirrored at the normal (Eq. 4.6)."""
    mirrored: Float64 = 2 * (normal @ towards_camera) * normal - towards_camera
    return mirrored


def diffuse_term(
    intensity: Float64,
    points: Float64,
    normal: Float64,
    light: Float64,
    polynomial: tuple[float, float, float],
) -> Float64:
    """Returns f of Eq. 4.9: what the diffuse reflectance of each sample (n,) is if the light is there.

    Args:
        intensity: (n,) fractions of full scale.
        points: (n, 3) on the board, m.
        normal: (3,) of the board.
        light: (3,) the light's assumed place, m, before the board.
        polynomial: a2, a1, a0 of Eq. 4.4.
    """
    away = light - points
    distance = np.linalg.norm(away, axis=1)
    term: Float64 = intensity * np.polyval(polynomial, distance) * distance / (away @ normal)
    return term


def relative_spread(term: Float64) -> float:
    """Returns standard deviation over mean, which the right distance makes least (Eq. 4.8, corrected).

    Printed is the argmax of the plain sum of squares. The right distance makes f constant, so its
    spread must be least; and f grows with the distance, so the plain spread prefers near lights.
    """
    mean = float(term.mean())
    return float(term.std()) / abs(mean) if mean else np.inf


def _board_plane(points: Float32) -> tuple[Float64, float]:
    """The plane of most points: fitted, then refitted without those far off it."""
    kept = points[:: max(1, len(points) // _MOST_SAMPLES)].astype(np.float64)
    for _ in range(_PLANE_ROUNDS):
        normal, offset = fit_plane(kept)
        away = np.abs(kept @ normal - offset)
        kept = kept[away <= 4 * np.median(away) + 1e-9]
    return fit_plane(kept)


def _centroid(highlight: Bool, camera: Camera, normal: Float64, offset: float) -> Float64:
    """Where the mean ray of the highlight's pixels meets the board."""
    ray = np.append(rays(camera)[:, highlight].mean(axis=1, dtype=np.float64), 1.0)
    met: Float64 = ray * (offset / (ray @ normal))
    return met


def _least(spread: Callable[[float], float], nearest: float, farthest: float) -> float:
    """The distance of least spread: the best of a grid, then golden sections around it."""
    grid = np.geomspace(nearest, farthest, _SEARCH)
    values = [spread(float(distance)) for distance in grid]
    best = int(np.argmin(values))
    if best in (0, _SEARCH - 1):
        raise InputError(
            f"light: the best distance is the search's bound {grid[best]:.3f} m, so this board does not "
            f"determine it between {nearest:g} and {farthest:g} m"
        )
    low, high = float(grid[best - 1]), float(grid[best + 1])
    for _ in range(_REFINEMENTS):
        left = high - _INVERSE_GOLDEN * (high - low)
        right = low + _INVERSE_GOLDEN * (high - low)
        if spread(left) < spread(right):
            high = right
        else:
            low = left
        if high - low < 1e-6:
            break
    return (low + high) / 2
