"""Guides captures of one board of one surface: to train a classifier, or to find a texture's limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.guide import Look
from surfclass.frames import Capture
from surfclass.geometry import fit_plane, register
from surfclass.rig import Rig
from surfclass.types import Bool, Float64

_WINDOW = 0.25  # of the image's width and height: where the board must be
_FOUND, _FLAT = 0.7, 0.8  # of the window: pixels with depth, and of those on the plane
_NOISE_M, _NOISE_PER_M2 = 0.006, 0.012  # four standard deviations of a structured-light sensor, and its steps
_FITS = 4
_MARGIN_PX = 0.004  # of the image's width: the ragged edge of depth
_LEAST_SHARE = 0.02  # of the image, that is labelled


@dataclass(frozen=True, slots=True)
class Stand:
    """From where a board is wanted.

    Attributes:
        distance_m: From and to, along the line of sight.
        angle_deg: From and to, between the line of sight and the normal.
        count: How many views.
    """

    distance_m: tuple[float, float]
    angle_deg: tuple[float, float]
    count: int = 1

    def holds(self, distance_m: float, angle_deg: float) -> bool:
        """Whether a view is from there."""
        return (
            self.distance_m[0] <= distance_m < self.distance_m[1]
            and self.angle_deg[0] <= angle_deg < self.angle_deg[1]
        )

    def __str__(self) -> str:
        near, far = self.distance_m
        low, high = self.angle_deg
        return f"{near:g}–{far:g} m, {low:g}–{high:g}° oblique"


TRAIN_STANDS = (Stand((0.5, 0.8), (0.0, 20.0), 5),)
"""For training (5.1): near, and face on; the classifier is told of the rest by augmentation."""

LIMITS_STANDS = (
    *(Stand(distances, (0.0, 15.0)) for distances in ((0.45, 0.58), (0.58, 0.72), (0.72, 0.85))),
    *(Stand(distances, (0.0, 15.0)) for distances in ((0.85, 1.0), (1.0, 1.15), (1.15, 1.35))),
    *(Stand((0.5, 0.9), angles) for angles in ((15.0, 25.0), (25.0, 35.0), (35.0, 45.0), (45.0, 70.0))),
)
"""For the limits of texture (5.3): from near to far face on, and from face on to grazing at one distance."""


@dataclass(frozen=True, slots=True, eq=False)
class _Board:
    """The board in the middle of an image."""

    distance_m: float
    angle_deg: float
    mask: Bool


class LabelledGuide:
    """Wants views of one flat board from given distances and angles; labels what of an image is on it.

    Args:
        role: Of the captures: "train" or "test".
        surface: The class, for people.
        label: Its number, from 1.
        rig: The calibrated sensor package.
        stands: From where views are wanted.
    """

    def __init__(
        self, role: str, surface: str, label: int, rig: Rig, stands: Sequence[Stand] = TRAIN_STANDS
    ) -> None:
        self.role = role
        self._surface, self._label, self._rig = surface, label, rig
        self._stands = tuple(stands)
        self._taken = [0] * len(self._stands)
        self._last: tuple[str, Bool] | None = None

    def next_step(self) -> str:
        """Names the first stand that lacks views."""
        lacking = self._lacking()
        if not lacking:
            return f"all views of {self._surface} are there"
        return f"show the board of {self._surface} in the middle of the image: {lacking[0]}"

    def look(self, capture: Capture) -> Look:
        """Accepts a view of a flat board from a stand that lacks one."""
        picture = _rgb8(capture)
        board = self._board(capture)
        if isinstance(board, str):
            _frame(picture, (220, 80, 40))
            return Look(False, (board,), picture)
        outline, _ = cv2.findContours(board.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, list(outline), -1, (80, 220, 80), max(1, picture.shape[1] // 400))
        _write(picture, f"{board.distance_m:.2f} m  {board.angle_deg:.0f} deg")
        where = f"{board.distance_m:.2f} m, {board.angle_deg:.0f}° oblique"
        if not self._lacking():
            return Look(False, ("there are enough views",), picture)
        for number, stand in enumerate(self._stands):
            if self._taken[number] < stand.count and stand.holds(board.distance_m, board.angle_deg):
                self._taken[number] += 1
                self._last = (capture.name, board.mask)
                return Look(True, (where,), picture)
        wanted = self._nearest(board)
        return Look(False, (f"no view is wanted from {where}; the nearest that is: {wanted}",), picture)

    def labelled(self, capture: Capture) -> Capture:
        """Returns the view that was accepted last with its label image: the board, and 0 elsewhere."""
        if self._last is None:
            raise ValueError("no view has been accepted yet")
        return replace(capture, label=np.where(self._last[1], self._label, 0).astype(np.uint8))

    def progress(self) -> tuple[int, int]:
        """Returns how many views are there, and how many are needed."""
        return sum(self._taken), sum(stand.count for stand in self._stands)

    def coverage(self) -> dict[str, Any]:
        """Returns for each stand the share of its views."""
        return {
            str(stand): taken / stand.count for stand, taken in zip(self._stands, self._taken, strict=True)
        }

    def _lacking(self) -> list[Stand]:
        return [stand for stand, taken in zip(self._stands, self._taken, strict=True) if taken < stand.count]

    def _nearest(self, board: _Board) -> Stand:
        """Returns the stand that lacks views and is the fewest steps of 0.1 m and 10° away."""

        def steps(stand: Stand) -> float:
            away_m = max(stand.distance_m[0] - board.distance_m, board.distance_m - stand.distance_m[1], 0.0)
            turned = max(stand.angle_deg[0] - board.angle_deg, board.angle_deg - stand.angle_deg[1], 0.0)
            return away_m / 0.1 + turned / 10.0

        return min(self._lacking(), key=steps)

    def _board(self, capture: Capture) -> _Board | str:
        """Returns the board in the middle of the colour image, or why there is none."""
        registered = register(capture.depth.depth_mm, self._rig)
        height, width = registered.has_point.shape
        middle = np.zeros((height, width), bool)
        rows, columns = round(height * _WINDOW / 2), round(width * _WINDOW / 2)
        middle[height // 2 - rows : height // 2 + rows, width // 2 - columns : width // 2 + columns] = True
        seen = middle & registered.has_point
        found = seen.sum() / middle.sum()
        if found < _FOUND:
            return (
                f"only {found:.0%} of the middle of the image has depth: is the board there, not too oblique?"
            )
        points = registered.point[:, seen].T.astype(np.float64)
        normal, offset, flat = _plane(points)
        if flat < _FLAT:
            return f"only {flat:.0%} of the middle of the image lie on one plane: let one board fill it"
        away = np.abs(np.tensordot(normal, registered.point, axes=1) - offset)
        on_plane = registered.has_point & (away <= _noise_m(registered.point[2]))
        mask = _piece_in_the_middle(on_plane)
        if mask.mean() < _LEAST_SHARE:
            return "hardly anything of the image lies on the board"
        normal, offset, _ = _plane(registered.point[:, mask & on_plane].T.astype(np.float64))
        ray = np.array([(width / 2 - self._rig.rgb.cx) / self._rig.rgb.fx, 0.0, 1.0])
        ray[1] = (height / 2 - self._rig.rgb.cy) / self._rig.rgb.fy
        length = float(np.linalg.norm(ray))
        distance_m = offset / float(normal @ ray) * length
        angle = np.degrees(np.arccos(np.clip(-(normal @ ray) / length, -1, 1)))
        return _Board(distance_m, float(angle), mask)


def _plane(points: Float64) -> tuple[Float64, float, float]:
    """Returns a plane fitted to most of the points, and the share of them on it."""
    on = np.ones(len(points), bool)
    normal, offset = fit_plane(points)
    for _ in range(_FITS):
        away = np.abs(points @ normal - offset)
        on = away <= max(float(np.median(away)) * 3.0, 0.002)
        normal, offset = fit_plane(points[on])
    away = np.abs(points @ normal - offset)
    return normal, offset, float(np.mean(away <= _noise_m(points[:, 2])))


def _noise_m(z: NDArray[Any]) -> NDArray[Any]:
    """Returns how far a reading at depth `z` m may lie off the surface that it is of."""
    return np.asarray(_NOISE_M + _NOISE_PER_M2 * z * z)


def _piece_in_the_middle(mask: Bool) -> Bool:
    """Returns the connected piece of a mask that most of the image's middle belongs to, without its edge."""
    height, width = mask.shape
    margin = max(1, round(_MARGIN_PX * width))
    ragged = mask.astype(np.uint8)
    closed = cv2.morphologyEx(ragged, cv2.MORPH_CLOSE, np.ones((2 * margin + 1,) * 2, np.uint8))
    _, pieces = cv2.connectedComponents(closed)
    rows, columns = round(height * _WINDOW / 2), round(width * _WINDOW / 2)
    window = pieces[height // 2 - rows : height // 2 + rows, width // 2 - columns : width // 2 + columns]
    counts = np.bincount(window.ravel())
    counts[0] = 0
    piece = (pieces == int(counts.argmax())) & (closed > 0)
    # The image's own border is no edge of the board.
    kept = cv2.erode(piece.astype(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8), borderValue=1)
    return np.asarray(kept > 0)


def _rgb8(capture: Capture) -> NDArray[np.uint8]:
    assert capture.colour is not None  # views of the sensors have colour
    rgb = capture.colour.rgb
    return np.array(rgb if rgb.dtype == np.uint8 else rgb >> 8, dtype=np.uint8)


def _frame(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> None:
    """Draws where the board must be."""
    height, width = picture.shape[:2]
    rows, columns = round(height * _WINDOW / 2), round(width * _WINDOW / 2)
    corner, other = (width // 2 - columns, height // 2 - rows), (width // 2 + columns, height // 2 + rows)
    cv2.rectangle(picture, corner, other, colour, max(1, width // 320))


def _write(picture: NDArray[np.uint8], text: str) -> None:
    scale = picture.shape[1] / 900
    place = (round(10 * scale), round(40 * scale))
    for colour, thickness in (((0, 0, 0), 5), ((255, 255, 255), 2)):
        cv2.putText(
            picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, max(1, round(thickness * scale))
        )
