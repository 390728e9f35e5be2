"""Labelled captures become samples of both routes, each with its place: what is held out together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from surfclass.classifiers.selection import Index, Selection, draw
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.kinematics import depth_pose
from surfclass.pipeline import lit_image, naming
from surfclass.rig import ColourFeature, Rig
from surfclass.routes import Image, ReflectanceMode, colour_features, exposure_ratio, texture_features
from surfclass.types import Bool, Float32, Float64, SurfaceView
from surfclass.viewing import view_surface

Note = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of one route.

    Attributes:
        values: (n, d) features.
        label: (n,) class indices from 0.
        place: (n,) number of the place: samples of one place resemble each other.
        capture: (n,) number of the capture.
        distance_m: (n,) viewing distance (Eq. 3.8); NaN where it is not known.
        angle_rad: (n,) viewing angle (Eq. 3.7), likewise.
    """

    values: Float64
    label: Index
    place: Index
    capture: Index
    distance_m: Float64
    angle_rad: Float64

    def at(self, rows: NDArray[np.integer]) -> Samples:
        """Returns some of the samples."""
        return Samples(*(getattr(self, column.name)[rows] for column in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Samples]) -> Samples:
        """Returns all samples of one or more parts."""
        return cls(*(np.concatenate([getattr(p, column.name) for p in parts]) for column in fields(cls)))

    def drawn(self, per_class: int, selection: Selection, seed: int) -> Samples:
        """Returns at most `per_class` samples of each class, as `selection.draw` chooses them."""
        return self.at(draw(self.values, self.label, self.place, per_class, selection, seed))


class Places:
    """Numbers the places of captures: squares of pixels, the same number where they show the same spot.

    A square whose centre is known in `base` has the number of a cell of space there, so that two views
    of one spot are held out together; the cells are as wide as the squares of the first capture see.
    """

    def __init__(self, side_px: int) -> None:
        self.side_px = side_px
        self._cell_m: float | None = None
        self._number: dict[tuple[int, ...], int] = {}

    def of(self, capture: Capture, view: SurfaceView, rig: Rig) -> NDArray[np.intp]:
        """Returns the (rows, cols) numbers of a capture's squares; those at the border may be cut off."""
        side = self.side_px
        h, w = view.has_point.shape
        known = capture.base_T_depth is not None or (
            capture.joints is not None and rig.transforms.flange_T_depth is not None
        )
        base_T_rgb = depth_pose(capture, rig) @ rig.rgb_T_depth.inverse if known else None
        if self._cell_m is None and view.has_point.any():
            self._cell_m = side * float(np.median(view.point[2][view.has_point])) / rig.rgb.fx
        number = np.empty((-(-h // side), -(-w // side)), np.intp)
        for row, col in np.ndindex(number.shape):
            square = slice(row * side, (row + 1) * side), slice(col * side, (col + 1) * side)
            seen = view.has_point[square]
            key: tuple[int, ...] = (len(self._number), -1)  # by itself
            if base_T_rgb is not None and self._cell_m is not None and seen.any():
                centre = base_T_rgb @ np.median(view.point[:, *square][:, seen], axis=1)
                key = tuple(np.floor(centre / self._cell_m).astype(int).tolist())
            number[row, col] = self._number.setdefault(key, len(self._number))
        return number


@dataclass(frozen=True, slots=True, eq=False)
class Gathered:
    """What one pass over labelled captures leaves.

    Attributes:
        colour: Samples for each colour feature.
        texture: Samples of windows.
        names: Of the captures, by their number.
        exposure_s: Of the first capture.
    """

    colour: dict[ColourFeature, Samples]
    texture: Samples
    names: list[str]
    exposure_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One labelled capture."""

    image: Image
    label: NDArray[np.uint8]
    view: SurfaceView
    place: NDArray[np.intp]
    number: int


@dataclass(frozen=True, slots=True)
class Sampling:
    """How samples are taken from captures.

    Attributes:
        features: Colour features.
        mode: How K_d is computed.
        class_count: Number of classes.
        pixels: The most colour samples of a class and capture; more are thinned out at random.
        window_px: Side of a texture window; windows start every half of it.
        place_px: Side of the square of pixels that is one place.
        seed: Of the thinning.
    """

    features: Sequence[ColourFeature]
    mode: ReflectanceMode
    class_count: int
    pixels: int
    window_px: int
    place_px: int
    seed: int

    def gather(self, captures: Iterable[Capture], rig: Rig, note: Note = lambda _: None) -> Gathered:
        """Returns the samples of labelled captures; one capture at a time is held in memory.

        Raises:
            InputError: If a capture has no label or colour image, or none has anything labelled.
            MissingCalibrationError: If the rig lacks what a feature needs.
        """
        random = np.random.default_rng(self.seed)
        places = Places(self.place_px)
        colour: dict[ColourFeature, list[Samples]] = {feature: [] for feature in self.features}
        texture: list[Samples] = []
        names: list[str] = []
        exposure_s: float | None = None
        for capture in captures:
            rig.check(capture)
            if capture.label is None or capture.colour is None:
                raise InputError(
                    f"capture {capture.name}: role {capture.role!r}, but it has no labelled colour image"
                )
            if not capture.label.any():
                note(f"capture {capture.name}: nothing in it is labelled, so nothing is learnt from it")
                continue
            if not names:
                exposure_s = capture.colour.exposure_s
            with naming(capture):
                view, image = view_surface(capture.depth.depth_mm, rig), lit_image(capture, rig)
                ratio = exposure_ratio(exposure_s, capture.colour.exposure_s)
                seen = _Seen(image, capture.label, view, places.of(capture, view, rig), len(names))
                for feature, parts in colour.items():
                    values, valid = colour_features(feature, image, view, rig, self.mode, ratio)
                    parts.extend(self._pixels(values, valid, seen, random))
                texture.extend(self._windows(texture_features_of(image, rig, self.window_px), seen))
            names.append(capture.name)
        if not names:
            raise InputError("there is no capture of role 'train' with a label to train from")
        return Gathered(
            {feature: Samples.joined(parts) for feature, parts in colour.items()},
            Samples.joined(texture),
            names,
            exposure_s,
        )

    def _pixels(
        self, values: Float32, valid: Bool, seen: _Seen, random: np.random.Generator
    ) -> Iterator[Samples]:
        for k in range(self.class_count):
            pixels = np.argwhere(valid & (seen.label == k + 1))
            if len(pixels) > self.pixels:
                pixels = pixels[random.choice(len(pixels), self.pixels, replace=False)]
            row, col = pixels.T
            yield self._samples(values[:, row, col].T, k, row, col, seen)

    def _windows(self, values: Float32, seen: _Seen) -> Iterator[Samples]:
        side, stride, place = self.window_px, self.window_px // 2, self.place_px
        pure = pure_windows(seen.label, side, stride)
        if side < place:  # windows overlap: one that lies across two places would be in both
            row_fits, col_fits = (
                first // place == (first + side - 1) // place
                for first in (np.arange(count) * stride for count in pure.shape)
            )
            pure = np.where(row_fits[:, None] & col_fits, pure, np.uint8(0))
        for k in range(self.class_count):
            chosen = pure == k + 1
            row, col = (index * stride + side // 2 for index in np.nonzero(chosen))
            yield self._samples(values[chosen], k, row, col, seen)

    def _samples(
        self, values: Float32, k: int, row: NDArray[np.intp], col: NDArray[np.intp], seen: _Seen
    ) -> Samples:
        distance, angle = seen_from(seen.view, row, col)
        return Samples(
            values.astype(np.float64),
            np.full(len(row), k, np.intp),
            seen.place[row // self.place_px, col // self.place_px],
            np.full(len(row), seen.number, np.intp),
            distance,
            angle,
        )


def texture_features_of(image: Image, rig: Rig, window_px: int) -> Float32:
    """Returns (rows, cols, d) texture features of windows that start every half of their side."""
    return texture_features(rig.features.texture, image, window_px, window_px // 2)


def pure_windows(label: NDArray[np.uint8], side: int, stride: int) -> NDArray[np.uint8]:
    """Returns (rows, cols) the label of every window that has but one, 0 for the others."""
    windows = np.lib.stride_tricks.sliding_window_view(label, (side, side))[::stride, ::stride]
    low, high = windows.min(axis=(2, 3)), windows.max(axis=(2, 3))
    pure: NDArray[np.uint8] = np.where(low == high, low, np.uint8(0))
    return pure


def seen_from(
    view: SurfaceView, row: NDArray[np.integer], col: NDArray[np.integer]
) -> tuple[Float64, Float64]:
    """Returns viewing distance (m) and angle (rad) of pixels, (n,) each, NaN where they are not known."""
    distance: Float32 = np.where(view.has_point[row, col], view.viewing_distance_m[row, col], np.nan)
    cosine: Float32 = np.where(view.has_normal[row, col], view.viewing_cosine[row, col], np.nan)
    angle: Float64 = np.arccos(np.clip(cosine, -1, 1)).astype(np.float64)
    return np.asarray(distance, np.float64), angle
