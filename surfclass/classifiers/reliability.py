"""Whether posteriors mean what they say: reliability diagram and expected calibration error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.types import Bool, Float64

CALIBRATION_BINS = 15


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Confidence beside accuracy, in equal bins of confidence from 0 to 1.

    Attributes:
        count: (bins,) samples.
        confidence: (bins,) mean of the most probable class's probability; 0 in an empty bin.
        accuracy: (bins,) share whose most probable class is the true one; 0 in an empty bin.
    """

    count: NDArray[np.intp]
    confidence: Float64
    accuracy: Float64

    @property
    def error(self) -> float:
        """The expected calibration error: the gap between the two, weighted by the bins' shares."""
        total = self.count.sum()
        if not total:
            return float(np.nan)
        return float((self.count * np.abs(self.confidence - self.accuracy)).sum() / total)

    def to_json(self) -> dict[str, Any]:
        """As a model card holds it."""
        return {
            "count": self.count.tolist(),
            "confidence": self.confidence.tolist(),
            "accuracy": self.accuracy.tolist(),
        }


def reliability(confidence: NDArray[Any], right: Bool, bins: int = CALIBRATION_BINS) -> Reliability:
    """Returns the reliability diagram of samples.

    Args:
        confidence: (n,) probability of the class that was chosen.
        right: (n,) whether it is the true one.
        bins: Equal parts of 0…1.
    """
    place = np.minimum((np.asarray(confidence) * bins).astype(np.intp), bins - 1)
    count = np.bincount(place, minlength=bins)
    each = np.maximum(count, 1)
    return Reliability(
        count,
        np.bincount(place, confidence, bins) / each,
        np.bincount(place, right, bins) / each,
    )


def calibration_error(confidence: NDArray[Any], right: Bool) -> float:
    """Returns the expected calibration error in CALIBRATION_BINS equal bins; NaN without samples."""
    return reliability(confidence, right).error
