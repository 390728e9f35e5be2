"""Guides the capture of boards for the light: a highlight in view, enough matte board, and turned anew."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.guide import Look
from calibration.light.samples import Plane, board_plane, on_board
from calibration.light.thresholds import thresholds
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.reflectance import OVER_EXPOSED, UNDER_EXPOSED
from surfclass.rig import DepthRig
from surfclass.types import Bool, Float64

VIEWS = 8
_NEW_TILT_RAD = np.radians(4.0)
_NEW_DISTANCE = 0.12  # of the distance
_MOST_SATURATED = 0.25
_MOST_DARK = 0.10
_LEAST_BOARD = 0.6  # of the image
_LEAST_MATTE = 0.35  # of the board
_BORDER = 0.04  # of the image's width: the highlight's centroid must be known
_SMALL_PX = 480  # height at which an image is judged
_COLUMNS, _ROWS = 4, 3
_GREEN, _RED, _BLUE = (60, 200, 60), (230, 60, 60), (80, 140, 255)

_PLAN = (
    (
        "put the semi-gloss board straight before the camera, 0.6 m away, so that it fills the image and "
        "mirrors the light into it"
    ),
    "turn the board by 8° about the vertical, 0.7 m away; the highlight moves to one side of the image",
    "turn the board by 8° the other way, 0.8 m away; the highlight moves to the other side",
    "turn the board by 8° about the horizontal, 0.8 m away; the highlight moves up or down",
    "turn the board by 8° the other way about the horizontal, 0.9 m away",
    "put the board 1.1 m away, turned by a few degrees",
    "turn the board by 6° about both, 0.65 m away",
    "turn the board by 6° about both the other way, 1.0 m away",
)


class LightGuide:
    """Of the light's calibration, with a semi-gloss board.

    Args:
        rig: Cameras and `rgb_T_depth`.
        views: How many are wanted.

    Raises:
        MissingCalibrationError: If the rig has no colour camera or no `rgb_T_depth`.
    """

    role = "light"

    def __init__(self, rig: DepthRig, views: int = VIEWS) -> None:
        self._rig = rig.whole()
        self._views = views
        self._planes: list[Plane] = []
        self._grid = np.zeros((_ROWS, _COLUMNS), np.int64)

    def next_step(self) -> str:
        """Returns what to do now, the next of a plan that turns the board about both axes."""
        count = len(self._planes)
        if count >= self._views:
            return (
                "there are enough views; a grey card at 0.6 to 1.3 m (role 'response') makes the result "
                "better"
            )
        return _PLAN[count % len(_PLAN)]

    def look(self, capture: Capture) -> Look:
        """Judges a view; one that is accepted is remembered."""
        if capture.colour is None:
            return Look(False, ("there is no colour image",), np.zeros((*self._rig.rgb.shape, 3), np.uint8))
        picture = picture_of(capture.colour.rgb)
        try:
            plane = board_plane(capture, self._rig)
        except InputError as error:
            return Look(False, (str(error),), picture)
        board = on_board(capture, self._rig, plane)
        step = max(1, board.shape[0] // _SMALL_PX)
        small, board = capture.colour.rgb[::step, ::step], board[::step, ::step]
        fraction = np.asarray(small.transpose(2, 0, 1) / np.iinfo(small.dtype).max, np.float32)
        reasons = self._exposure(fraction, board)
        reasons += self._too_like(plane)
        highlight = np.zeros_like(board)
        matte = board
        try:
            grey = fraction.mean(axis=0)
            search = thresholds(grey, board)
            highlight = board & (grey > search.specular_above)
            matte = board & (grey < search.diffuse_below) & (grey > search.dark_below)
        except InputError as error:
            reasons.append(str(error).removeprefix("light: "))
        else:
            reasons += _highlight_faults(highlight, matte, board)
        if not reasons:
            self._planes.append(plane)
            v, u = (int(np.mean(places)) for places in np.nonzero(highlight))
            self._grid[v * _ROWS // board.shape[0], u * _COLUMNS // board.shape[1]] += 1
        return Look(not reasons, tuple(reasons), _drawn(picture, highlight, matte, step, not reasons))

    def progress(self) -> tuple[int, int]:
        """Returns how many views are there, and how many are wanted."""
        return len(self._planes), self._views

    def coverage(self) -> dict[str, Any]:
        """Returns where in the image highlights were, and how far the boards were turned apart."""
        shares = [0.0, 0.0]
        if len(self._planes) > 1:
            normals = np.stack([plane.normal for plane in self._planes])
            shares = [float(min(1.0, np.ptp(normals[:, axis]) / np.sin(np.radians(14)))) for axis in (0, 1)]
        names = ("turned about the vertical", "turned about the horizontal")
        return {"highlights": self._grid.tolist(), **dict(zip(names, shares, strict=True))}

    def _exposure(self, fraction: NDArray[Any], board: Bool) -> list[str]:
        if board.mean() < _LEAST_BOARD:
            return [f"the board fills {board.mean():.0%} of the image only: go nearer, or use a larger one"]
        saturated = float((fraction.max(axis=0) >= OVER_EXPOSED)[board].mean())
        dark = float((fraction.min(axis=0) <= UNDER_EXPOSED)[board].mean())
        if saturated > _MOST_SATURATED:
            return [f"{saturated:.0%} of the board is saturated: shorten the exposure, or go further away"]
        if dark > _MOST_DARK:
            return [f"{dark:.0%} of the board is too dark: lengthen the exposure, or go nearer"]
        return []

    def _too_like(self, plane: Plane) -> list[str]:
        for number, other in enumerate(self._planes, start=1):
            turned = float(np.arccos(np.clip(plane.normal @ other.normal, -1, 1)))
            moved = abs(plane.offset / other.offset - 1)
            if turned < _NEW_TILT_RAD and moved < _NEW_DISTANCE:
                fault = (
                    f"too like view {number}: turned by {np.degrees(turned):.1f}° and {moved:.0%} nearer or "
                    f"further; turn the board by {np.degrees(_NEW_TILT_RAD):.0f}° or more"
                )
                return [fault]
        return []


def picture_of(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns a camera's image (h, w, 3) with 8 bits, to draw on; deep, linear ones are made brighter."""
    if image.dtype == np.uint8:
        return image.copy()
    fraction = image.astype(np.float32) / np.iinfo(image.dtype).max
    return np.asarray(255 * np.sqrt(fraction), np.uint8)


def _highlight_faults(highlight: Bool, matte: Bool, board: Bool) -> list[str]:
    reasons = []
    v, u = np.nonzero(highlight)
    margin = _BORDER * board.shape[1]
    places: Float64 = np.array([u, v], np.float64)
    low, high = places.min(axis=1), places.max(axis=1)
    size = np.array(board.shape[::-1]) - 1
    if (low < margin).any() or (high > size - margin).any():
        reasons.append("the highlight touches the image's border: turn the board so that it moves inwards")
    share = float(matte.sum() / max(1, board.sum()))
    if share < _LEAST_MATTE:
        reasons.append(
            f"only {share:.0%} of the board is matte, needed are {_LEAST_MATTE:.0%}: go nearer, or use a "
            "less glossy board"
        )
    return reasons


def _drawn(
    picture: NDArray[np.uint8], highlight: Bool, matte: Bool, step: int, good: bool
) -> NDArray[np.uint8]:
    width = max(1, picture.shape[1] // 400)
    for region, colour in ((highlight, _GREEN if good else _RED), (matte, _BLUE)):
        lines, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        scaled = [line * step for line in lines if len(line) > 10]
        cv2.drawContours(picture, scaled, -1, colour, width, cv2.LINE_AA)
    return picture
