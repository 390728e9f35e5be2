"""The camera's response curve from exposures of one scene: g⁻¹ up to its scale, smooth and strictly rising.

With `y = g(E t)` the logarithm `F(y) = ln g⁻¹(y)` is the sum of what a place sends, `ln E`, and of the
exposure's `ln t` (Debevec, Malik 1997). Every `ln E` is free and leaves the normal equations. What remains is
linear in `F = ln(y − dark) + S(y)` with S a spline whose bends are penalised (Eilers, Marx 1996): S = 0 is a
linear camera, and a power law is all but straight in the spline's argument. How stiff S is, and whether it is
needed at all, is decided by predicting exposures that were left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.outcome import RefusedError
from surfclass.types import Bool, Float64

SAMPLES = 256
_SEGMENTS = 14
_DEGREE = 3
_TOE = 0.05  # bends the spline's argument: fine steps in the dark, where responses bend
_ROUNDS = 3  # of the weights, which depend on the curve's slope
_PRELIMINARY = 1e-3  # stiffness of the curve that the weights are found with
_STIFFNESSES = (np.inf, *(10.0**power for power in range(1, -8, -1)))
_MOST_PEDESTAL = 0.25
_LINEAR_IS_ENOUGH = 1.10  # of the best held-out error: a linear camera is to come out linear
_FINE = 2048
_TABLE_STEPS = 8001
_LEAST_STEP = 1e-9  # between samples: below the dark level nothing is known, and the curve must still rise


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """One channel's intensities of B places at J exposures, fractions of full scale.

    Attributes:
        level: (J, B) mean intensity of each place.
        sd: (J, B) of that mean.
        use: (J, B) bool, neither saturated nor lost in the dark.
        exposure: (J,) times of exposure, any unit.
    """

    level: Float64
    sd: Float64
    use: Bool
    exposure: Float64

    @property
    def used(self) -> list[int]:
        """The exposures of which something is used."""
        return [int(index) for index in np.flatnonzero(self.use.any(axis=1))]

    def without(self, index: int) -> Readings:
        """Returns the readings with one exposure left out."""
        use = self.use.copy()
        use[index] = False
        return replace(self, use=use)


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCurve:
    """g⁻¹ of one channel.

    Attributes:
        dark: Intensity without light, fraction of full scale.
        bend: Coefficients of S; None where the camera is linear.
        stiffness: The penalty that they were found with; None where the camera is linear.
        low: The least and `high` the greatest intensity that was seen; beyond, S goes on straight.
    """

    dark: float
    bend: Float64 | None
    stiffness: float | None
    low: float
    high: float

    def log_irradiance(self, level: NDArray[Any]) -> Float64:
        """Returns ln g⁻¹, up to a constant, of intensities above the dark level."""
        y = np.asarray(level, np.float64)
        above = np.log(np.maximum(y - self.dark, 1e-12))
        return above if self.bend is None else above + self._spline(y, self.bend, 0)

    def slope(self, level: NDArray[Any]) -> Float64:
        """Returns the derivative of `log_irradiance`."""
        y = np.asarray(level, np.float64)
        own = 1 / np.maximum(y - self.dark, 1e-6)
        return own if self.bend is None else own + self._spline(y, self.bend, 1)

    def irradiance(self, level: NDArray[Any]) -> Float64:
        """Returns g⁻¹ of intensities, 1 at full scale and 0 at the dark level and below."""
        y = np.asarray(level, np.float64)
        found = np.exp(self.log_irradiance(y) - self.log_irradiance(np.array(1.0)))
        return np.where(y > self.dark, found, 0.0)

    def intensity(self, irradiance: NDArray[Any]) -> Float64:
        """Returns g: the intensities of irradiances, at most full scale."""
        levels = np.linspace(self.dark, 1, _FINE)
        return np.asarray(np.interp(irradiance, np.maximum.accumulate(self.irradiance(levels)), levels))

    def samples(self) -> Float64:
        """Returns g⁻¹ at 256 even intensities, rising strictly from 0 to 1."""
        curve = self.irradiance(np.linspace(0, 1, SAMPLES))
        curve[0] = 0.0
        ramp = _LEAST_STEP * np.arange(SAMPLES)
        rising: Float64 = np.maximum(curve, ramp)
        return np.asarray(rising / rising[-1])

    @property
    def rises(self) -> bool:
        """Whether it does so at every intensity above the dark level."""
        levels = np.linspace(self.dark, 1, _FINE)[1:]
        return bool((np.diff(self.log_irradiance(levels)) > 0).all())

    def _spline(self, level: Float64, bend: Float64, order: int) -> Float64:
        """S, or its derivative by the intensity; straight on where nothing was seen.

        Straight in the argument above, and in the intensity below: sensors start with a finite slope.
        """
        inside = np.clip(level, self.low, self.high)
        slope = _sum(inside, bend, 1) * spline_argument_slope(inside)
        above = level > self.high
        if order == 1:
            share = np.where(above, spline_argument_slope(level) / spline_argument_slope(inside), 1.0)
            return np.asarray(slope * share)
        ahead = (spline_argument(level) - spline_argument(inside)) / spline_argument_slope(inside)
        value = _sum(inside, bend, 0)
        return np.asarray(value + slope * np.where(above, ahead, level - inside))


def fit(readings: Readings, dark: float | None) -> ResponseCurve:
    """Returns the curve whose stiffness predicts left-out exposures best; a linear one if that does as well.

    Args:
        readings: Three exposures at least, overlapping in what they see.
        dark: Intensity without light; None: not measured. It is then 0, unless the camera is linear but
            for a pedestal.

    Raises:
        RefusedError: If no stiffness gives a curve that rises.
    """
    weight = weights(readings, fit_with(readings, dark or 0.0, _PRELIMINARY))
    best, least = None, np.inf
    for stiffness in _STIFFNESSES:
        curve = fit_with(readings, dark or 0.0, stiffness, weight)
        error = cross_validated(readings, curve, weight) if curve.rises else np.inf
        if error < least:
            best, least = curve, error
    for pedestal in (dark or 0.0,) if dark is not None else (0.0, _pedestal(readings)):
        linear = fit_with(readings, pedestal, None, weight)
        error = cross_validated(readings, linear, weight)
        if error <= _LINEAR_IS_ENOUGH * least:
            return linear
    if best is None:
        raise RefusedError("no smooth curve that rises fits the exposures: they contradict each other")
    return best


def fit_with(
    readings: Readings, dark: float, stiffness: float | None, weight: Float64 | None = None
) -> ResponseCurve:
    """Returns the curve for one stiffness; None is a linear camera, infinite a power law of the argument.

    Args:
        readings: As in `fit`.
        dark: Intensity without light.
        stiffness: Of S.
        weight: (J, B) of each reading of ln g⁻¹; found together with the curve by default.
    """
    seen = readings.level[readings.use]
    low, high = float(seen.min()), float(seen.max())
    curve = ResponseCurve(dark, None, None, low, high)
    if stiffness is None:
        return curve
    for _ in range(_ROUNDS if weight is None else 1):
        each = weights(readings, curve) if weight is None else weight
        bend = _solve(readings, np.where(readings.use, each, 0.0), dark, stiffness)
        curve = ResponseCurve(dark, bend, stiffness, low, high)
    return curve


def weights(readings: Readings, curve: ResponseCurve) -> Float64:
    """Returns (J, B) 1 / variance of ln g⁻¹ of each reading."""
    sd = readings.sd * np.maximum(curve.slope(readings.level), 1e-3)
    return np.asarray(1 / np.maximum(sd, 1e-5) ** 2)


def predicted(readings: Readings, curve: ResponseCurve, weight: Float64, index: int) -> tuple[Float64, Bool]:
    """Returns the intensities (B,) of one exposure as the others have them, and where they can."""
    others = np.where(readings.without(index).use, weight, 0.0)
    total = others.sum(axis=0)
    seen = total > 0
    each = curve.log_irradiance(readings.level) - np.log(readings.exposure)[:, None]
    mean = np.divide((others * each).sum(axis=0), total, out=np.zeros_like(total), where=seen)
    both: Bool = seen & readings.use[index]
    scale = curve.log_irradiance(np.array(1.0))
    return curve.intensity(np.exp(mean + np.log(readings.exposure[index]) - scale)), both


def held_out_error(readings: Readings, curve: ResponseCurve, weight: Float64, index: int) -> float:
    """Returns the rms error, of full scale, of predicting an exposure from the others alone."""
    without = fit_with(readings.without(index), curve.dark, curve.stiffness, weight)
    if not without.rises:
        return 1.0
    expected, both = predicted(readings, without, weight, index)
    if not both.any():
        return 0.0
    away = expected[both] - readings.level[index, both]
    return float(np.sqrt(np.mean(away**2)))


def cross_validated(readings: Readings, curve: ResponseCurve, weight: Float64) -> float:
    """Returns the rms of `held_out_error` over the exposures."""
    errors = [held_out_error(readings, curve, weight, index) for index in readings.used]
    return float(np.sqrt(np.mean(np.square(errors))))


def _pedestal(readings: Readings) -> float:
    """The intensity without light of a linear camera: least squares of `y = b + k t`, k free everywhere."""
    weight = np.where(readings.use, 1 / readings.sd**2, 0.0)
    t = readings.exposure[:, None]
    lit = (weight * t * t).sum(axis=0)
    share = np.divide((weight * t).sum(axis=0), lit, out=np.zeros_like(lit), where=lit > 0)
    rest = 1 - t * share  # of a constant, what k does not take
    moment = float((weight * rest * readings.level).sum())
    total = float((weight * rest * rest).sum())
    return float(np.clip(moment / total if total > 0 else 0.0, 0.0, _MOST_PEDESTAL))


def _solve(readings: Readings, weight: Float64, dark: float, stiffness: float) -> Float64:
    """Least squares for S with every place's ln E eliminated."""
    exposures, places = weight.shape
    design = _design(readings.level.ravel()).reshape(exposures, places, -1)
    target = np.log(readings.exposure)[:, None] - np.log(np.maximum(readings.level - dark, 1e-9))
    total = np.maximum(weight.sum(axis=0), 1e-300)
    design = design - np.einsum("jb,jbk->bk", weight, design) / total[:, None]
    target = target - (weight * target).sum(axis=0) / total
    root = np.sqrt(weight / weight.sum())
    rows = (root[..., None] * design).reshape(-1, design.shape[-1])
    right = (root * target).ravel()
    normal, moment = rows.T @ rows, rows.T @ right
    size = normal.shape[0]
    # One constant is free, for the scale of E is: the least coefficients fix it.
    if np.isinf(stiffness):
        straight = np.stack([np.ones(size), np.arange(size) / size], axis=1)
        reduced = straight.T @ normal @ straight + 1e-12 * np.eye(2)
        return np.asarray(straight @ np.linalg.solve(reduced, straight.T @ moment))
    bends = np.diff(np.eye(size), 2, axis=0)
    penalty = stiffness * bends.T @ bends + 1e-12 * np.eye(size)
    return np.linalg.solve(normal + penalty, moment)


def spline_argument(level: NDArray[Any]) -> Float64:
    """Returns the spline's argument 0…1 of intensities 0…1; it is finer in the dark."""
    return np.asarray(np.log1p(np.maximum(level, 0) / _TOE) / np.log1p(1 / _TOE), np.float64)


def spline_argument_slope(level: NDArray[Any]) -> Float64:
    """Returns the derivative of `spline_argument`."""
    return np.asarray(1 / ((np.maximum(level, 0) + _TOE) * np.log1p(1 / _TOE)), np.float64)


def _sum(level: Float64, bend: Float64, order: int) -> Float64:
    """The spline of these coefficients (or its derivative by the argument) at intensities (…,)."""
    table = _tables()[order]
    return np.interp(spline_argument(level), np.linspace(0, 1, len(table)), table @ bend)


def _design(level: Float64) -> Float64:
    """(…, k) the splines at intensities (…,)."""
    table = _tables()[0]
    place = np.clip(spline_argument(level), 0, 1) * (len(table) - 1)
    below = np.minimum(place.astype(np.intp), len(table) - 2)
    share = (place - below)[..., None]
    return np.asarray(table[below] * (1 - share) + table[below + 1] * share)


@cache
def _tables() -> tuple[Float64, Float64]:
    """(steps, k) each: the splines and their first derivatives at even arguments from 0 to 1.

    So fine that lines in between are as good as the splines, and many times faster.
    """
    from scipy.interpolate import BSpline  # late: it costs a third of a second

    knots = np.arange(-_DEGREE, _SEGMENTS + _DEGREE + 1) / _SEGMENTS
    basis = BSpline(knots, np.eye(_SEGMENTS + _DEGREE), _DEGREE)
    argument = np.linspace(0, 1, _TABLE_STEPS)
    return np.asarray(basis(argument)), np.asarray(basis(argument, nu=1))
