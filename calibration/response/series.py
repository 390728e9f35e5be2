"""An exposure series as numbers: what each place of a scene gave at each exposure, or why it is useless."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.outcome import RefusedError
from calibration.response.curve import Readings
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.reflectance import OVER_EXPOSED
from surfclass.types import Bool, Float64

LEAST_EXPOSURES = 3
USABLE_SHARE = 0.05
"""An exposure is of use from this share of well exposed places on."""

_ROWS = 30  # of places in an image
_MOST_PLACES = 400
_ABOVE_NOISE = 4.0  # a place is not lost in the dark from so many standard deviations of a pixel on
_QUANTISED_SD = 0.05  # least sd of a place's mean, in steps of the converter
_LEAST_CHANGE = 0.05  # of ln intensity for each ln exposure: less, and the camera has made up for it
_MOVED = 0.005  # of the depth
_MOVED_M = 0.001
_ZONES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """One image in square places that fill it; R rows and C columns of them.

    Attributes:
        pixels: (R·C, side², 3) the image's own integers.
        side_px: Of a place.
        full: The integer at full scale.
        grid: R, C.
    """

    pixels: NDArray[Any]
    side_px: int
    full: int
    grid: tuple[int, int]

    @classmethod
    def of(cls, image: NDArray[Any]) -> Places:
        """Cuts an (h, w, 3) image; what does not fill a place at its right and lower edge is left out."""
        side = max(4, image.shape[0] // _ROWS)
        rows, columns = image.shape[0] // side, image.shape[1] // side
        cut = image[: rows * side, : columns * side].reshape(rows, side, columns, side, 3)
        pixels = cut.transpose(0, 2, 1, 3, 4).reshape(rows * columns, side * side, 3)
        return cls(pixels, side, int(np.iinfo(image.dtype).max), (rows, columns))

    @property
    def mean(self) -> Float64:
        """(R·C, 3) fractions of full scale."""
        return np.asarray(self.pixels.mean(axis=1, dtype=np.float64) / self.full)

    @property
    def pixel_sd(self) -> Float64:
        """(R·C, 3) noise of one pixel, fractions of full scale: from neighbours, for no place is even."""
        rows = self.pixels.reshape(-1, self.side_px, self.side_px, 3).astype(np.float32) / self.full
        steps = rows[:, :, 2:] - 2 * rows[:, :, 1:-1] + rows[:, :, :-2]
        return np.asarray(np.sqrt(np.mean(np.square(steps), axis=(1, 2), dtype=np.float64) / 6))

    @property
    def saturated(self) -> Bool:
        """(R·C, 3) whether any pixel of the place is."""
        return np.asarray(self.pixels.max(axis=1) >= OVER_EXPOSED * self.full)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Exposures of one scene that does not move, by rising exposure time.

    Attributes:
        names: (J) of the captures.
        exposure_s: (J,).
        level: (J, B, 3) mean intensities of B places, fractions of full scale.
        sd: (J, B, 3) of those means.
        pixel_sd: (J, B, 3) of one pixel, with what does not change from exposure to exposure.
        use: (J, B, 3) bool.
        images: (J) the captures' images in places, for what is asked of single pixels.
        chosen: (B,) which of the images' places these are.
        dark: (J, 3) median of the unlit frames, NaN where there is none.
        left_out: Why exposures are of no use, a sentence each.
    """

    names: tuple[str, ...]
    exposure_s: Float64
    level: Float64
    sd: Float64
    pixel_sd: Float64
    use: Bool
    images: tuple[Places, ...]
    chosen: NDArray[np.intp]
    dark: Float64
    left_out: tuple[str, ...]

    @property
    def step(self) -> float:
        """Of the converter, as a fraction of full scale."""
        return 1 / self.images[0].full

    def readings(self, channel: int) -> Readings:
        """Returns one channel's readings."""
        return Readings(
            self.level[..., channel], self.sd[..., channel], self.use[..., channel], self.exposure_s
        )


def read_series(captures: Iterable[Capture]) -> Series:
    """Returns the series of `exposure` captures.

    Raises:
        RefusedError: If an exposure time is not known, fewer than three are of use (naming which are over-
            or under-exposed, and by how much), they do not change the image, or the scene moved.
    """
    taken = sorted(captures, key=lambda capture: (_exposure(capture) or 0.0, capture.name))
    unknown = [capture.name for capture in taken if not _exposure(capture)]
    if unknown:
        raise RefusedError(
            f"exposure series: the exposure time of {', '.join(unknown)} is not known; give every capture "
            "its exposure_s"
        )
    if len({_exposure(capture) for capture in taken}) < LEAST_EXPOSURES:
        raise RefusedError(
            f"exposure series: {len(taken)} captures at {len({_exposure(c) for c in taken})} exposure times, "
            f"needed are {LEAST_EXPOSURES} or more, each about twice the one before"
        )
    images = [_places(capture) for capture in taken]
    if len({(image.full, image.grid) for image in images}) > 1:
        raise InputError("exposure series: the images differ in size or in bits")
    times = np.array([_exposure(capture) for capture in taken], np.float64)
    level = np.stack([image.mean for image in images])
    pixel_sd = np.stack([image.pixel_sd for image in images])
    sd = np.maximum(pixel_sd / images[0].side_px, _QUANTISED_SD / images[0].full)
    saturated = np.stack([image.saturated for image in images])
    lost = level <= np.maximum(_ABOVE_NOISE * pixel_sd, 2.0 / images[0].full)
    use = ~saturated & ~lost
    share = use.all(axis=2).mean(axis=1)
    left_out = tuple(
        _of_no_use(capture.name, images[index], float(lost[index].any(axis=1).mean()))
        for index, capture in enumerate(taken)
        if share[index] < USABLE_SHARE
    )
    usable = share >= USABLE_SHARE
    if len(np.unique(times[usable])) < LEAST_EXPOSURES:
        raise RefusedError(
            f"exposure series: {len(np.unique(times[usable]))} exposures are of use, needed are "
            f"{LEAST_EXPOSURES}: " + "; ".join(left_out)
        )
    use &= usable[:, None, None]
    _must_change(level, use, times, [capture.name for capture in taken])
    _must_not_move(taken)
    enough = np.flatnonzero((use.all(axis=2).sum(axis=0)) >= 2)
    chosen = _spread(enough, level[int(np.argmax(share)), :, 1])
    return Series(
        tuple(capture.name for capture in taken),
        times,
        level[:, chosen],
        sd[:, chosen],
        pixel_sd[:, chosen],
        use[:, chosen],
        tuple(images),
        chosen,
        np.stack([_dark(capture) for capture in taken]),
        left_out,
    )


def _places(capture: Capture) -> Places:
    if capture.colour is None:
        raise InputError(f"capture {capture.name}: has no colour image")
    return Places.of(capture.colour.rgb)


def _exposure(capture: Capture) -> float | None:
    return None if capture.colour is None else capture.colour.exposure_s


def _dark(capture: Capture) -> Float64:
    if capture.dark is None:
        return np.full(3, np.nan)
    image = capture.dark.rgb
    return np.asarray(np.median(image.reshape(-1, 3), axis=0) / np.iinfo(image.dtype).max)


def _of_no_use(name: str, image: Places, lost: float) -> str:
    over = float((image.pixels.max(axis=2) >= OVER_EXPOSED * image.full).mean())
    if over >= lost:
        return f"{name} is overexposed in {over:.0%} of its pixels"
    return f"{name} is underexposed in {lost:.0%} of its area"


def _must_change(level: Float64, use: Bool, times: Float64, names: Sequence[str]) -> None:
    """Refuses a series whose brightness does not rise with the exposure from one to the next."""
    order = [index for index in range(len(times)) if use[index].any()]
    still = []
    for one, other in pairwise(order):
        both = (use[one] & use[other]).all(axis=1)
        if times[other] < 1.05 * times[one] or both.sum() < 4:
            continue
        gained = float(np.median(np.log(level[other, both] / level[one, both])))
        if gained < _LEAST_CHANGE * np.log(times[other] / times[one]):
            still.append(
                f"{names[one]} ({1e3 * times[one]:g} ms) and {names[other]} ({1e3 * times[other]:g} ms)"
            )
    if still:
        raise RefusedError(
            f"exposure series: the image does not become brighter between {', '.join(still)}; turn the "
            "camera's automatic exposure and gain off, and check the exposure times"
        )


def _must_not_move(captures: Sequence[Capture]) -> None:
    """Refuses a series in which the depth image, or the pose, says that something moved."""
    reference = captures[len(captures) // 2]
    zones = _zone_depths(reference.depth.depth_mm)
    moved = []
    for capture in captures:
        with np.errstate(invalid="ignore"):
            away = np.abs(_zone_depths(capture.depth.depth_mm) - zones)
            far = float(np.nanmax(np.append(away - _MOVED * zones, 0.0)))
        if far > 1e3 * _MOVED_M or _pose_moved(capture, reference):
            moved.append(capture.name)
    if moved:
        raise RefusedError(
            f"exposure series: the target or the camera moved between {reference.name} and "
            f"{', '.join(moved)}; take all exposures of one pose, with nothing touched in between"
        )


def _zone_depths(depth_mm: NDArray[Any]) -> Float64:
    """(9,) mean depth of the image's zones, mm; NaN where little returned."""
    zones = []
    for row in np.array_split(depth_mm, _ZONES, axis=0):
        for zone in np.array_split(row, _ZONES, axis=1):
            seen = zone[zone > 0]
            zones.append(float(seen.mean()) if seen.size > 0.5 * zone.size else np.nan)
    return np.array(zones)


def _pose_moved(capture: Capture, reference: Capture) -> bool:
    if capture.joints is not None and reference.joints is not None:
        return bool(np.abs(capture.joints.q - reference.joints.q).max() > 2e-3)
    if capture.base_T_depth is not None and reference.base_T_depth is not None:
        away = capture.base_T_depth.matrix - reference.base_T_depth.matrix
        return bool(np.abs(away[:3]).max() > 2e-3)
    return False


def _spread(places: NDArray[np.intp], brightness: Float64) -> NDArray[np.intp]:
    """At most `_MOST_PLACES` of the places, even in the order of their brightness."""
    ordered = places[np.argsort(brightness[places], kind="stable")]
    if len(ordered) <= _MOST_PLACES:
        return ordered
    return np.asarray(ordered[np.linspace(0, len(ordered) - 1, _MOST_PLACES).astype(np.intp)])
