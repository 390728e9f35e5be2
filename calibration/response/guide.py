"""Guides the capture of a grey card for the response: exposures of one pose, or distances."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.guide import Look
from calibration.light.guide import picture_of
from calibration.light.samples import board_plane
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.reflectance import OVER_EXPOSED, UNDER_EXPOSED
from surfclass.rig import DepthRig

EXPOSURES = 7
DISTANCES = 8
_NEAR_M, _FAR_M = 0.60, 1.30
_MOST_SATURATED = 0.5  # of an exposure's pixels
_MOST_SATURATED_CARD = 0.10
_MOST_DARK = 0.5
_NEW_EXPOSURE = 1.3
_NEW_DISTANCE = 0.05
_BINS = 8  # of the intensities
_GREEN, _RED = (60, 200, 60), (230, 60, 60)


class ResponseGuide:
    """Of the response's calibration, with a grey card.

    Args:
        rig: The cameras; distances need the colour camera and `rgb_T_depth`.
        series: "exposure": one pose and several exposures; "distance": one exposure and several distances.
        views: How many are wanted; by default 7 exposures or 8 distances.
    """

    def __init__(
        self, rig: DepthRig, series: Literal["exposure", "distance"] = "exposure", views: int | None = None
    ) -> None:
        self.role = "exposure" if series == "exposure" else "response"
        self._rig = rig if series == "exposure" else rig.whole()
        self._views = views or (EXPOSURES if series == "exposure" else DISTANCES)
        self._taken: list[float] = []  # exposures in s, or distances in m
        self._seen = np.zeros(_BINS, np.int64)

    def next_step(self) -> str:
        """Returns what to do now: which exposure, or which distance."""
        if len(self._taken) >= self._views:
            return "there are enough views; more of them make the result better"
        if self.role == "response":
            wanted = np.linspace(_NEAR_M, _FAR_M, self._views)
            free = [one for one in wanted if all(abs(one / taken - 1) > 0.04 for taken in self._taken)]
            return f"put the grey card straight before the camera, {(free or [_FAR_M])[0]:.2f} m away"
        if not self._taken:
            return (
                "put the grey card before the camera so that it fills the image, touch nothing from then "
                "on, and take it at an exposure at which its middle has about half of full scale"
            )
        wanted_s = 2 * max(self._taken)
        if not self._seen[:2].any():
            wanted_s = min(self._taken) / 2
        elif self._seen[-1]:  # longer ones would be saturated: fill the widest gap
            taken = np.sort(self._taken)
            gap = int(np.argmax(taken[1:] / taken[:-1])) if len(taken) > 1 else 0
            wanted_s = float(np.sqrt(taken[gap] * taken[gap + 1])) if len(taken) > 1 else taken[0] / 2
        return f"set the exposure to {1e3 * wanted_s:.3g} ms; card, camera and light stay as they are"

    def look(self, capture: Capture) -> Look:
        """Judges a view; one that is accepted is remembered."""
        if capture.colour is None:
            black = np.zeros((*capture.depth.depth_mm.shape, 3), np.uint8)
            return Look(False, ("there is no colour image",), black)
        image = capture.colour.rgb
        picture = picture_of(image)
        full = np.iinfo(image.dtype).max
        small = image[::4, ::4]
        burnt = small.max(axis=2) >= OVER_EXPOSED * full
        least = UNDER_EXPOSED if image.dtype == np.uint8 else UNDER_EXPOSED / 10
        dark = small.min(axis=2) <= least * full
        reasons = self._exposure_faults(float(burnt.mean()), float(dark.mean()))
        place, fault = self._place(capture)
        if fault:
            reasons.append(fault)
        if not reasons and place is not None:
            self._taken.append(place)
            level = small[~burnt & ~dark].mean(axis=1) / full
            self._seen[np.unique(np.clip((level * _BINS).astype(int), 0, _BINS - 1))] += 1
        return Look(not reasons, tuple(reasons), _drawn(picture, burnt | dark, not reasons))

    def progress(self) -> tuple[int, int]:
        """Returns how many views are there, and how many are wanted."""
        return len(self._taken), self._views

    def coverage(self) -> dict[str, Any]:
        """Returns how often each eighth of the intensities was seen, and the span of what was varied."""
        span = max(self._taken) / min(self._taken) if self._taken else 1.0
        wanted = 32.0 if self.role == "exposure" else _FAR_M / _NEAR_M
        name = "span of exposures" if self.role == "exposure" else "span of distances"
        share = float(min(1.0, np.log(span) / np.log(wanted)))
        return {"intensities": [self._seen.tolist()], name: share}

    def _exposure_faults(self, burnt: float, dark: float) -> list[str]:
        most = _MOST_SATURATED if self.role == "exposure" else _MOST_SATURATED_CARD
        if burnt > most:
            return [
                f"the grey card is overexposed: {burnt:.0%} of the image is saturated; shorten the exposure"
            ]
        if dark > _MOST_DARK:
            return [f"the grey card is underexposed: {dark:.0%} of the image is dark; lengthen the exposure"]
        return []

    def _place(self, capture: Capture) -> tuple[float | None, str]:
        """The exposure or the distance of a view, or what is wrong with it."""
        if self.role == "exposure":
            exposure_s = None if capture.colour is None else capture.colour.exposure_s
            if not exposure_s:
                return None, "the camera does not tell its exposure time; set it in the configuration"
            if any(1 / _NEW_EXPOSURE < exposure_s / taken < _NEW_EXPOSURE for taken in self._taken):
                return None, (
                    f"an exposure of {1e3 * exposure_s:.3g} ms has been taken; change it by half or more"
                )
            return exposure_s, ""
        try:
            plane = board_plane(capture, self._rig.whole())
        except InputError as error:
            return None, str(error)
        distance = abs(plane.offset)
        if any(abs(distance / taken - 1) < _NEW_DISTANCE for taken in self._taken):
            return None, (
                f"a card {distance:.2f} m away has been taken; go {_NEW_DISTANCE:.0%} nearer or further"
            )
        return distance, ""


def _drawn(picture: NDArray[np.uint8], bad: NDArray[np.bool_], good: bool) -> NDArray[np.uint8]:
    """Badly exposed places are outlined, and the whole view framed by the verdict's colour."""
    width = max(2, picture.shape[1] // 200)
    lines, _ = cv2.findContours(bad.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(picture, [line * 4 for line in lines if len(line) > 10], -1, _RED, width // 2 + 1)
    corner = (picture.shape[1] - 1, picture.shape[0] - 1)
    cv2.rectangle(picture, (0, 0), corner, _GREEN if good else _RED, width)
    return picture
