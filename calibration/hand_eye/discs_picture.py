"""What was found in an IR image, drawn into it: discs with their numbers, and blobs that are none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.discs_seen import Sighting

_FOUND = (60, 220, 90)
_REJECTED = (255, 130, 60)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # bits of a sub-pixel place in OpenCV's drawing
_BRIGHTEST = 0.995  # quantile that is drawn white


def draw_discs(
    ir: NDArray[Any], sighting: Sighting, numbers: Sequence[int | None] | None = None
) -> NDArray[np.uint8]:
    """Returns (h, w, 3) uint8 RGB: the IR image, brightened, with what was found in it.

    Args:
        ir: (h, w) uint8 or uint16.
        sighting: Of this image.
        numbers: For each disc the number of its position, counted from 1, or None where it lies on none;
            left out: the discs are numbered as they were found.
    """
    white = max(1.0, float(np.quantile(ir, _BRIGHTEST)))
    # The root lifts what is dark: the plate's edge shows whether it is in view.
    grey = (255 * np.sqrt(np.clip(ir / white, 0, 1)) * 0.8).astype(np.uint8)
    picture = np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))
    for rejected in sighting.rejected:
        _outline(picture, rejected.outline, _REJECTED)
        short = rejected.reason.split(":")[0].split(",")[0]
        _text(
            picture, short, float(rejected.outline[:, 0].min()), _below(picture, rejected.outline), _REJECTED
        )
    labels = range(1, len(sighting.discs) + 1) if numbers is None else numbers
    for disc, number in zip(sighting.discs, labels, strict=True):
        _outline(picture, disc.outline, _FOUND)
        x, y = np.round(disc.pixel * 2**_SHIFT).astype(int).tolist()
        arm = 3 << _SHIFT
        for ends in (((x - arm, y), (x + arm, y)), ((x, y - arm), (x, y + arm))):
            cv2.line(picture, *ends, (255, 40, 40), 1, cv2.LINE_AA, _SHIFT)
        text = "?" if number is None else str(number)
        _text(picture, text, float(disc.outline[:, 0].max()) + 2, float(disc.outline[:, 1].max()), _FOUND)
    return picture


def _outline(picture: NDArray[np.uint8], outline: NDArray[Any], colour: tuple[int, int, int]) -> None:
    points = np.round(outline * 2**_SHIFT).astype(np.int32)
    cv2.polylines(picture, [points], isClosed=True, color=colour, lineType=cv2.LINE_AA, shift=_SHIFT)


def _below(picture: NDArray[np.uint8], outline: NDArray[Any]) -> float:
    """The row of a text's foot below an outline, or above it where there is no room."""
    line = float(picture.shape[1]) / 60
    top, lowest = float(outline[:, 1].min()), float(outline[:, 1].max()) + line
    return lowest if lowest < picture.shape[0] - 2 else top - line / 3


def _text(
    picture: NDArray[np.uint8], text: str, left: float, foot: float, colour: tuple[int, int, int]
) -> None:
    scale = picture.shape[1] / 1600
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    x = int(np.clip(left, 0, max(0, picture.shape[1] - width - 1)))
    y = int(np.clip(foot, height, picture.shape[0] - 2))
    cv2.putText(picture, text, (x, y), _FONT, scale, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), _FONT, scale, colour, 1, cv2.LINE_AA)
