"""Windows that were seen alike are counted together: what the fit of the limits works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.limits.windows import Windows
from surfclass.types import Float64

_DISTANCE_STEP_M = 0.01
_ANGLE_STEP_RAD = np.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Windows of one capture and from nearly one distance and angle.

    Attributes:
        distance_m: (m,) their mean viewing distance.
        angle_rad: (m,) their mean viewing angle.
        right: (m,) how many of them were right; weighted, see `cells_of`.
        total: (m,) how many there are, likewise.
        capture: (m,) number of the capture.
    """

    distance_m: Float64
    angle_rad: Float64
    right: Float64
    total: Float64
    capture: NDArray[np.intp]

    def weighted(self, of_capture: Float64) -> Cells:
        """Returns the cells with each capture counted so many times, (captures,); 0 leaves it out."""
        factor = of_capture[self.capture]
        kept = factor > 0
        return Cells(
            self.distance_m[kept],
            self.angle_rad[kept],
            (self.right * factor)[kept],
            (self.total * factor)[kept],
            self.capture[kept],
        )


def cells_of(windows: Windows, weight: Float64, given: int | None) -> Cells:
    """Counts the windows that were given one class, or all of them.

    Args:
        windows: All.
        weight: (n,) of each window; those of a class that is labelled often count less.
        given: The class that the classifier gave; None: any.
    """
    chosen = np.flatnonzero((windows.result == given) if given is not None else np.isfinite(weight))
    distance, angle = windows.distance_m[chosen], windows.angle_rad[chosen]
    capture, w = windows.capture[chosen], weight[chosen]
    key = np.stack(
        [
            capture,
            np.floor(distance / _DISTANCE_STEP_M).astype(np.intp),
            np.floor(angle / _ANGLE_STEP_RAD).astype(np.intp),
        ]
    )
    if not len(chosen):
        empty = np.zeros(0)
        return Cells(empty, empty, empty, empty, np.zeros(0, np.intp))
    found, place = np.unique(key, axis=1, return_inverse=True)
    place = place.reshape(-1)
    total = np.bincount(place, w)
    return Cells(
        np.bincount(place, w * distance) / total,
        np.bincount(place, w * angle) / total,
        np.asarray(np.bincount(place, w * windows.right[chosen]), np.float64),
        np.asarray(total, np.float64),
        found[0],
    )


def balance(windows: Windows, classes: int) -> Float64:
    """Returns (n,) weights with mean 1 by which every true class counts alike.

    The map divides posteriors by the training prior; so should what its weights are found from.
    """
    count = np.bincount(windows.truth, minlength=classes)
    present = np.count_nonzero(count)
    each = len(windows.truth) / (present * np.maximum(count, 1))
    return np.asarray(each[windows.truth])
