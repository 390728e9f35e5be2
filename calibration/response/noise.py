"""Noise against signal: read noise and the share of photons, from an exposure series (photon transfer)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.response.curve import ResponseCurve
from calibration.response.series import Series
from surfclass.types import Float64

_LEAST_PLACES = 20
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Noise:
    """Of one pixel and channel: variance `read² + gain · signal`, in fractions of the full-scale irradiance.

    Attributes:
        read: Standard deviation without light.
        gain: What one electron adds: variance over signal where photons rule.
    """

    read: float
    gain: float

    @property
    def full_well_e(self) -> float | None:
        """Electrons at full scale; None where the noise does not grow with the signal."""
        return 1 / self.gain if self.gain > 0 else None

    def intensity_sd(self, level: NDArray[Any], curve: ResponseCurve, step: float) -> Float64:
        """Returns the standard deviation of intensities at `level`, the converter's steps included."""
        irradiance = curve.irradiance(level)
        slope = np.maximum(irradiance * curve.slope(level), 1e-9)
        variance = (self.read**2 + self.gain * irradiance) / slope**2 + step**2 / 12
        return np.asarray(np.sqrt(variance))


def photon_transfer(series: Series, curve: ResponseCurve, channel: int) -> Noise | None:
    """Returns one channel's noise, or None where no two exposures see the same places well.

    From the differences between neighbouring exposures, pixel by pixel and each divided by its time: the
    pattern of the target and of the sensor is the same in both and drops out.
    """
    table = curve.irradiance(np.linspace(0, 1, series.images[0].full + 1))
    used = [index for index in range(len(series.names)) if series.use[index, :, channel].any()]
    equations, variances = [], []
    for one, other in pairwise(used):
        both = series.use[one, :, channel] & series.use[other, :, channel]
        if both.sum() < _LEAST_PLACES:
            continue
        times = series.exposure_s[[one, other]]
        pixels = [series.images[index].pixels[series.chosen[both], :, channel] for index in (one, other)]
        linear = [table[image] / time for image, time in zip(pixels, times, strict=True)]
        variance = np.var(linear[1] - linear[0], axis=1, ddof=1)
        level = series.level[[one, other]][:, both, channel]
        signal = curve.irradiance(level)
        steps = series.step * signal * curve.slope(level)
        squared = times[:, None] ** 2
        variances.append(variance - (steps**2 / 12 / squared).sum(axis=0))
        equations.append(np.stack([np.full(both.sum(), (1 / times**2).sum()), (signal / squared).sum(0)], 1))
    if not equations:
        return None
    return _solve(np.concatenate(equations), np.concatenate(variances))


def _solve(equations: Float64, variances: Float64) -> Noise:
    from scipy.optimize import nnls  # late: it costs a third of a second

    expected = np.maximum(np.abs(variances), np.median(np.abs(variances)))
    found = np.zeros(2)
    for _ in range(_ROUNDS):  # an estimated variance is uncertain in proportion to itself
        found, _ = nnls(equations / expected[:, None], variances / expected)
        expected = np.maximum(equations @ found, 1e-3 * np.median(expected))
    return Noise(float(np.sqrt(found[0])), float(found[1]))
