"""A flat board's image as light: linear irradiance at places of it, and where on the board they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.geometry import corrected_depth, depth_to_points, fit_plane, rays, register
from surfclass.reflectance import OVER_EXPOSED, least_fraction
from surfclass.rig import Rig
from surfclass.types import Bool, Float64

Kind = Literal["board", "lambertian"]
KIND_OF_ROLE: dict[str, Kind] = {"light": "board", "response": "lambertian", "exposure": "lambertian"}

_EDGE = 0.008  # of the image's width
_ROWS = 24  # of places in an image
_PLANE_ROUNDS = 5
_MOST_POINTS = 30_000
_LEAST_PLANE_SHARE = 0.2  # of the readings must lie on the board's plane
_LEAST_ON_BOARD = 0.6  # of a place's pixels
_LEAST_PLACES = 24
_BADLY_EXPOSED = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A board's plane in `rgb`: `normal · p = offset`, the normal turned to the camera.

    Attributes:
        normal: (3,) unit.
        offset: m, not positive.
        thickness_m: Standard deviation of the readings about it.
        share: Of the readings that lie on it.
    """

    normal: Float64
    offset: float
    thickness_m: float
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class BoardSamples:
    """One view of a flat board, n places of the image.

    Attributes:
        name: Of the capture.
        kind: "board" is semi-gloss, "lambertian" has no highlight.
        plane: Of the board.
        ray: (n, 2) x/z and y/z of each place's centre.
        level: (n, 3) mean intensity, fractions of full scale.
        light: (n, 3) mean linear irradiance for the reference exposure, 1 at full scale.
        sd: (n, 3) of `light`, from the pixels' scatter.
        saturated: (m, 2) rays of the places of the board in which a pixel is saturated.
        saturated_share: Of the board's pixels.
        dark_share: Of the board's pixels that are too dark.
    """

    name: str
    kind: Kind
    plane: Plane
    ray: Float64
    level: Float64
    light: Float64
    sd: Float64
    saturated: Float64
    saturated_share: float
    dark_share: float

    @property
    def point(self) -> Float64:
        """(n, 3) m, where each place's ray meets the plane."""
        return on_plane(self.ray, self.plane)

    def of(self, chosen: Bool) -> BoardSamples:
        """Returns the places where `chosen` (n,) is True."""
        return replace(
            self,
            ray=self.ray[chosen],
            level=self.level[chosen],
            light=self.light[chosen],
            sd=self.sd[chosen],
        )


def on_plane(ray: Float64, plane: Plane) -> Float64:
    """Returns where rays (n, 2) of x/z, y/z meet the plane, (n, 3) m."""
    whole = np.column_stack([ray, np.ones(len(ray))])
    return np.asarray(whole * (plane.offset / (whole @ plane.normal))[:, None])


def board_plane(capture: Capture, rig: Rig) -> Plane:
    """Returns the plane of most of the capture's depth readings, in `rgb`.

    Raises:
        InputError: If there is no plane that a fifth of the readings lie on.
    """
    points = depth_to_points(corrected_depth(capture.depth.depth_mm, rig), rig.depth).reshape(3, -1)
    seen = points[:, points[2] > 0]
    if seen.shape[1] < 1000:
        raise InputError(f"capture {capture.name}: only {seen.shape[1]} depth readings, needed are 1000")
    chosen = seen[:, :: max(1, seen.shape[1] // _MOST_POINTS)].T.astype(np.float64)
    normal, offset, near = _most_common_plane(chosen)
    share = float(near.mean())
    if share < _LEAST_PLANE_SHARE:
        raise InputError(
            f"capture {capture.name}: only {share:.0%} of the depth readings lie on one plane; the board "
            "must be flat and fill most of the image"
        )
    thickness = float(np.std(chosen[near] @ normal - offset))
    turned = rig.rgb_T_depth.rotation @ normal
    return Plane(turned, offset + float(turned @ rig.rgb_T_depth.translation), thickness, share)


def _most_common_plane(points: Float64) -> tuple[Float64, float, Bool]:
    """The plane that most points are near, by random samples; refitted to those near it."""
    rng = np.random.default_rng(0)
    tolerance = 0.004 + 0.004 * float(np.median(points[:, 2])) ** 2
    some = points[:: max(1, len(points) // 3000)]
    best: Bool = np.zeros(len(some), bool)
    for _ in range(60):
        a, b, c = some[rng.choice(len(some), 3, replace=False)]
        across = np.cross(b - a, c - a)
        length = float(np.linalg.norm(across))
        if length < 1e-4:
            continue
        near = np.abs((some - a) @ across) < 1.5 * tolerance * length
        if near.sum() > best.sum():
            best = near
    kept = some[best]
    if len(kept) < 100:
        return np.array([0.0, 0.0, -1.0]), 0.0, np.zeros(len(points), bool)
    for _ in range(_PLANE_ROUNDS):
        normal, offset = fit_plane(kept)
        away = np.abs(points @ normal - offset)
        near = away <= min(tolerance, 4 * 1.4826 * float(np.median(away[away <= tolerance])) + 1e-4)
        kept = points[near]
    return normal, offset, near


def sample_board(
    capture: Capture, rig: Rig, inverse: Float64, reference_s: float | None = None
) -> BoardSamples:
    """Returns the light that each place of a board's image received.

    Pixels are made linear first and averaged after. A place with a saturated pixel, with one in the dark,
    or not wholly on the board is left out.

    Args:
        capture: With a colour image; its unlit frame is taken off, if there is one.
        rig: Cameras and `rgb_T_depth`.
        inverse: (3, s) g⁻¹ at even intensities.
        reference_s: The exposure that irradiances are scaled to; the capture's own by default.

    Raises:
        InputError: If there is no board to be seen.
    """
    if capture.colour is None:
        raise InputError(f"capture {capture.name}: has no colour image")
    plane = board_plane(capture, rig)
    image = capture.colour.rgb
    full = float(np.iinfo(image.dtype).max)
    shown = on_board(capture, rig, plane)
    side = max(4, image.shape[0] // _ROWS)
    linear = linearised(image, inverse)
    saturated = image.max(axis=2) >= OVER_EXPOSED * full
    dark = image.min(axis=2) <= _darkest(rig, inverse, image.dtype) * full
    if capture.dark is not None:
        linear = linear - linearised(capture.dark.rgb, inverse)
    if reference_s and capture.colour.exposure_s:
        linear = linear * (reference_s / capture.colour.exposure_s)
    x, y = rays(rig.rgb).astype(np.float64)
    share = _places(shown[..., None].astype(np.float32), side).mean(axis=1)[:, 0]
    burnt = _places(saturated[..., None], side)[..., 0].any(axis=1)
    lost = _places(dark[..., None], side)[..., 0].mean(axis=1) > 0.05
    pixels = _places(linear, side)
    level = _places(image, side).mean(axis=1, dtype=np.float64) / full
    centre = np.stack([_places(plane_of[..., None], side).mean(axis=1)[:, 0] for plane_of in (x, y)], axis=1)
    board = share >= _LEAST_ON_BOARD
    good = board & ~burnt & ~lost
    steps = pixels.reshape(len(pixels), side, side, 3)
    noise = np.sqrt(
        np.mean((steps[:, :, 2:] - 2 * steps[:, :, 1:-1] + steps[:, :, :-2]) ** 2, axis=(1, 2)) / 6
    )
    total = max(1, int(shown.sum()))
    return BoardSamples(
        capture.name,
        KIND_OF_ROLE[capture.role],
        plane,
        centre[good],
        level[good],
        pixels.mean(axis=1, dtype=np.float64)[good],
        np.asarray(noise[good] / side, np.float64),
        centre[board & burnt],
        float((saturated & shown).sum() / total),
        float((dark & shown).sum() / total),
    )


def linearised(image: NDArray[Any], inverse: Float64) -> NDArray[np.float32]:
    """Returns g⁻¹ of an (h, w, 3) image of integers, float32."""
    levels = np.linspace(0, 1, int(np.iinfo(image.dtype).max) + 1)
    places = np.linspace(0, 1, inverse.shape[1])
    tables = [np.interp(levels, places, curve).astype(np.float32) for curve in inverse]
    return np.stack([table[image[..., channel]] for channel, table in enumerate(tables)], axis=-1)


def enough(samples: Iterable[BoardSamples]) -> list[BoardSamples]:
    """Returns the views in which enough of the board is well exposed."""
    return [one for one in samples if len(one.ray) >= _LEAST_PLACES]


def too_bright(samples: Iterable[BoardSamples]) -> str:
    """Returns which views are badly exposed and by how much, as text; empty if none is."""
    bad = []
    for one in samples:
        if one.saturated_share > _BADLY_EXPOSED:
            bad.append(f"{one.name} is overexposed in {one.saturated_share:.0%} of the board")
        elif one.dark_share > _BADLY_EXPOSED:
            bad.append(f"{one.name} is underexposed in {one.dark_share:.0%} of the board")
    return "; ".join(bad)


def on_board(capture: Capture, rig: Rig, plane: Plane) -> Bool:
    """Returns (h, w) which colour pixels show the plane; small holes in the depth image are closed."""
    registered = register(capture.depth.depth_mm, rig)
    away = np.abs(np.tensordot(plane.normal.astype(np.float32), registered.point, axes=1) - plane.offset)
    near = registered.has_point & (away < 5 * plane.thickness_m + 0.003)
    # Single holes are the depth camera's; at the board's edge colour and depth may be a little apart.
    side = 2 * max(1, round(_EDGE * near.shape[1])) + 1
    filled = cv2.morphologyEx(near.view(np.uint8), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
    inner = cv2.erode(filled, np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(inner > 0)


def _darkest(rig: Rig, inverse: Float64, kind: np.dtype[Any]) -> float:
    from surfclass.rig import Response

    curves = tuple(tuple(float(value) for value in curve) for curve in inverse)
    known = Response.model_validate({"inverse": curves})
    return least_fraction(known, 8 * kind.itemsize)


def _places(planes: NDArray[Any], side: int) -> NDArray[Any]:
    """(h, w, c) to (places, side², c)."""
    rows, columns = planes.shape[0] // side, planes.shape[1] // side
    cut = planes[: rows * side, : columns * side].reshape(rows, side, columns, side, -1)
    return cut.transpose(0, 2, 1, 3, 4).reshape(rows * columns, side * side, -1)
