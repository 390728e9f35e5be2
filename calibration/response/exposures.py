"""The response from an exposure series: curve, dark level, noise, and how far each can be trusted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibration.outcome import RefusedError
from calibration.resampling import jackknife_covariance
from calibration.response import curve as curves
from calibration.response.curve import SAMPLES, Readings, ResponseCurve
from calibration.response.noise import Noise, photon_transfer
from calibration.response.series import LEAST_EXPOSURES, Series, read_series
from surfclass.frames import Capture
from surfclass.types import Float64

_STEADY = 0.3  # of the dark level: it may change so much over exposures that are 1 : 4 and more apart
_MISFIT = 0.02  # of full scale: a place that is so far off does not show what it showed in the others
_MOST_MISFITS = 0.10
_SAME = 0.03  # ln of exposures that jackknife and hold-out count as one


@dataclass(frozen=True, slots=True, eq=False)
class ExposureResponse:
    """What an exposure series tells.

    Attributes:
        series: It.
        curves: g⁻¹ of R, G, B.
        noise: Of R, G, B; None where no two exposures overlap.
        rms: Of all intensities about the fitted curves, fraction of full scale.
        held_out: By name of the exposure: rms error of predicting it from the others, or None where it shows
            nothing that others show.
        relative_sd: (3, 256) of g⁻¹ at even intensities, relative to g⁻¹ in the middle of what was seen, by
            the jackknife over exposures.
        dark_from: "dark frames", "intercept" of a linear camera, or "assumed" (0).
    """

    series: Series
    curves: tuple[ResponseCurve, ...]
    noise: tuple[Noise | None, ...]
    rms: float
    held_out: dict[str, float | None]
    relative_sd: Float64
    dark_from: str

    @property
    def inverse(self) -> Float64:
        """(3, 256) g⁻¹ at even intensities, rising strictly from 0 to 1."""
        return np.stack([curve.samples() for curve in self.curves])

    @property
    def seen(self) -> tuple[float, float]:
        """The intensities between which every channel was seen."""
        return max(curve.low for curve in self.curves), min(curve.high for curve in self.curves)

    @property
    def curve_sd(self) -> float:
        """The rms relative standard deviation of g⁻¹ between the intensities that were seen."""
        low, high = self.seen
        level = np.linspace(0, 1, SAMPLES)
        between = self.relative_sd[:, (level >= low) & (level <= high)]
        return float(np.sqrt(np.mean(between**2)))

    @property
    def held_out_rms(self) -> float:
        """Over the exposures that can be predicted."""
        known = [error for error in self.held_out.values() if error is not None]
        return float(np.sqrt(np.mean(np.square(known))))


def response_of(captures: Iterable[Capture]) -> ExposureResponse:
    """Returns the response that `exposure` captures show.

    Raises:
        RefusedError: As `read_series`; or if the exposures contradict each other.
    """
    series = read_series(captures)
    dark, dark_from = _dark(series)
    found = []
    for channel in range(3):
        known = None if dark is None else float(dark[channel])
        found.append(curves.fit(series.readings(channel), known))
    if dark is None and any(curve.dark > 0 for curve in found):
        dark_from = "intercept"
    rms, held_out = _residuals(series, found)
    return ExposureResponse(
        series,
        tuple(found),
        tuple(photon_transfer(series, curve, channel) for channel, curve in enumerate(found)),
        rms,
        held_out,
        np.stack([_relative_sd(series.readings(channel), curve) for channel, curve in enumerate(found)]),
        dark_from,
    )


def _dark(series: Series) -> tuple[Float64 | None, str]:
    """The intensity without light, if unlit frames tell it.

    What grows with the exposure is light from elsewhere: it belongs to the scene, and then nothing is known.
    """
    there = np.isfinite(series.dark).all(axis=1)
    if not there.any():
        return None, "assumed"
    levels, times = series.dark[there], series.exposure_s[there]
    least = levels.min(axis=0)
    spread = levels.max(axis=0) - least
    steady = spread <= np.maximum(_STEADY * least, 1.5 * series.step)
    if steady.all() and (there.sum() > 1 and times.max() >= 4 * times.min()):
        return np.median(levels, axis=0), "dark frames"
    if (levels <= 1.5 * series.step).all():
        return np.zeros(3), "dark frames"
    return None, "assumed"


def _residuals(series: Series, found: list[ResponseCurve]) -> tuple[float, dict[str, float | None]]:
    squares, misfits, number = 0.0, np.zeros(len(series.names)), 0
    held_out: dict[str, list[float]] = {name: [] for name in series.names}
    for channel, curve in enumerate(found):
        readings = series.readings(channel)
        weight = curves.weights(readings, curve)
        for index in readings.used:
            expected, both = curves.predicted(readings, curve, weight, index)
            if not both.any():
                continue
            away = expected[both] - readings.level[index, both]
            squares, number = squares + float(np.sum(away**2)), number + int(both.sum())
            misfits[index] = max(misfits[index], float(np.mean(np.abs(away) > _MISFIT)))
            held_out[series.names[index]].append(curves.held_out_error(readings, curve, weight, index))
    if number == 0:
        raise RefusedError(
            "exposure series: no part of the scene is well exposed in two exposures; take them closer "
            "together, each about twice the one before"
        )
    _must_agree(series, misfits)
    errors = {
        name: float(np.sqrt(np.mean(np.square(each)))) if each else None for name, each in held_out.items()
    }
    return float(np.sqrt(squares / number)), {name: errors[name] for name in series.names}


def _must_agree(series: Series, misfits: Float64) -> None:
    bad = [
        f"{name} ({share:.0%} of the image)"
        for name, share in zip(series.names, misfits, strict=True)
        if share > _MOST_MISFITS
    ]
    if bad:
        raise RefusedError(
            f"exposure series: {', '.join(bad)} cannot be told from the other exposures by any response: the "
            "target moved, the light changed, or an exposure time is wrong",
        )


def _relative_sd(readings: Readings, curve: ResponseCurve) -> Float64:
    """Relative sd of g⁻¹ at 256 intensities: exposures are left out in turn, those of one time together."""
    weight = curves.weights(readings, curve)
    level = np.linspace(0, 1, SAMPLES)
    middle = np.sqrt(curve.low * curve.high)
    whole = curve.log_irradiance(np.maximum(level, curve.dark + 1e-6))
    rows = []
    for block in _blocks(readings):
        use = readings.use.copy()
        use[block] = False
        if not use.any():
            continue
        rest = Readings(readings.level, readings.sd, use, readings.exposure)
        part = curves.fit_with(rest, curve.dark, curve.stiffness, weight)
        log = part.log_irradiance(np.maximum(level, curve.dark + 1e-6))
        rows.append(log - part.log_irradiance(np.array(middle)))
    if len(rows) < LEAST_EXPOSURES - 1:
        return np.full_like(whole, np.inf)
    return np.sqrt(np.diag(jackknife_covariance(np.array(rows))))


def _blocks(readings: Readings) -> list[list[int]]:
    blocks: list[list[int]] = []
    for index in readings.used:
        if blocks and np.log(readings.exposure[index] / readings.exposure[blocks[-1][0]]) < _SAME:
            blocks[-1].append(index)
        else:
            blocks.append([index])
    return blocks
