"""Light and lens from all boards together: least squares of the near-light model, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.light import near_light
from calibration.light.levenberg import minimise
from calibration.light.near_light import EXPONENT, GLOBAL, POSITION, VIGNETTING, Observed
from calibration.light.samples import BoardSamples
from calibration.resampling import jackknife_covariance
from surfclass.types import Float64

_MODEL_ERROR = 0.001  # of the irradiance: no board is quite even, no curve quite right
LOBE_ERROR = (
    0.05  # of the specular part: no lobe has quite this shape, so near the highlight all counts little
)
_UNEVEN = 0.0001  # of the irradiance: what is smooth over a view and not known, at the least
_START_ERROR = 0.02  # of the irradiance, while the lobe is not known
_TIGHTNESS = (300.0, 10.0, 1.0)  # of what is thought beforehand: first only position and lobes move
_WEAK = np.array([0.5, 0.5, 0.5, 0.3, 0.3, 2.0, 5.0, 20.0, 60.0, 0.5])
"""Standard deviations of what is thought of light and lens beforehand, so wide that it only bounds what the
data leave open: within half a metre, 17°, exponents of 1 ± 2."""


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """Light and lens.

    Attributes:
        parameters: (p,) of the near-light model.
        observed: What they were fitted to.
        residual: (n,) measured over modelled irradiance, less 1.
        weight_sd: (n,) the standard deviation that each place counted with, of its irradiance.
        uneven: (10, 10) covariance of light and lens by what is smooth over a view and no model knows:
            boards that are not quite even, depth that is slightly bent.
        known: What was known of the position beforehand.
    """

    parameters: Float64
    observed: Observed
    residual: Float64
    weight_sd: Float64
    uneven: Float64
    known: PositionPrior | None

    @property
    def position(self) -> Float64:
        """(3,) m, in `rgb`."""
        return self.parameters[POSITION]

    @property
    def axis(self) -> Float64:
        """(3,) unit."""
        return near_light.unit_axis(self.parameters)

    @property
    def exponent(self) -> float:
        """The power of the cosine."""
        return float(self.parameters[EXPONENT])

    @property
    def vignetting(self) -> Float64:
        """(3,) v2, v4, v6."""
        return self.parameters[VIGNETTING]


@dataclass(frozen=True, slots=True, eq=False)
class PositionPrior:
    """A position that is known already: (3,) m in `rgb`, and its standard deviation, m."""

    position: Float64
    sd_m: float


def fit_light(views: Sequence[BoardSamples], start: Float64, known: PositionPrior | None = None) -> LightFit:
    """Returns light and lens for views of boards.

    Args:
        views: Boards and Lambertian targets.
        start: (3,) position to begin with, m.
        known: What is known of the position.
    """
    observed = Observed.of(views)
    parameters = near_light.starting_point(observed, start)
    sd = _standard_deviation(observed, _START_ERROR * observed.light)
    for tightness in _TIGHTNESS:
        problem = _Problem(observed, sd, np.ones(len(sd)), tightness, known)
        parameters = minimise(problem, parameters, *near_light.bounds(observed)).parameters
        _, specular = near_light.emitted(parameters, observed)
        sd = _standard_deviation(observed, LOBE_ERROR * specular)
    problem = _Problem(observed, sd, np.ones(len(sd)), 1.0, known)
    found = minimise(problem, parameters, *near_light.bounds(observed))
    diffuse, specular, matrix = near_light.with_jacobian(found.parameters, observed)
    residual = observed.light / (diffuse + specular) - 1
    gain = np.linalg.pinv(found.information, hermitian=True)[:GLOBAL] @ (matrix / sd[:, None] ** 2).T
    return LightFit(found.parameters, observed, residual, sd, _uneven(gain, observed, residual), known)


def refit(found: LightFit, views: Sequence[BoardSamples]) -> Float64:
    """Returns the parameters (p,) for the same views with their boards elsewhere, as weighted before."""
    observed = Observed.of(views)
    problem = _Problem(observed, found.weight_sd, np.ones(len(found.weight_sd)), 1.0, found.known)
    return minimise(problem, found.parameters, *near_light.bounds(observed)).parameters


def leave_out(whole: LightFit) -> Float64:
    """Returns all parameters (v, p) with each view left out in turn; what only it shows stays as it is."""
    observed = whole.observed
    rows = []
    for view in range(len(observed.names)):
        share = (observed.view != view).astype(np.float64)
        problem = _Problem(observed, whole.weight_sd, share, 1.0, whole.known)
        rows.append(minimise(problem, whole.parameters, *near_light.bounds(observed)).parameters)
    return np.array(rows)


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Residuals and derivatives of the model, each place by its share, and of what is thought before."""

    observed: Observed
    sd: Float64
    share: Float64
    tightness: float
    known: PositionPrior | None

    def __call__(self, parameters: Float64) -> tuple[Float64, Float64]:
        diffuse, specular, matrix = near_light.with_jacobian(parameters, self.observed)
        weight = self.share / self.sd
        expected, spread = near_light.EXPECTED.copy(), _WEAK / self.tightness
        if self.known is not None:
            expected[POSITION], spread[POSITION] = self.known.position, self.known.sd_m
        prior = np.zeros((GLOBAL, len(parameters)))
        prior[:, :GLOBAL] = np.diag(1 / spread)
        residual = (diffuse + specular - self.observed.light) * weight
        thought = (parameters[:GLOBAL] - expected) / spread
        return np.append(residual, thought), np.concatenate([matrix * weight[:, None], prior])


def _uneven(gain: Float64, observed: Observed, residual: Float64) -> Float64:
    """Covariance by errors that are a bent surface over each view, as large as the residuals show."""
    total = np.zeros((GLOBAL, GLOBAL))
    for view in range(len(observed.names)):
        places = np.flatnonzero(observed.view == view)
        x, y = (observed.ray[places] - observed.ray[places].mean(axis=0)).T
        shapes = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        basis, _ = np.linalg.qr(shapes)
        basis *= np.sqrt(len(places))  # each of rms 1 over the view
        left = basis.T @ np.clip(residual[places], -0.02, 0.02) / len(places)
        error = np.sqrt(_UNEVEN**2 + np.mean(left**2))
        moved = gain[:, places] @ (basis * observed.light[places][:, None]) * error
        total += moved @ moved.T
    return total


def covariance(whole: LightFit, estimates: Float64) -> Float64:
    """Returns (10, 10) of light and lens: the jackknife over views, and what no view is free of.

    Args:
        whole: The fit.
        estimates: (v, p) of `leave_out`.
    """
    return jackknife_covariance(estimates[:, :GLOBAL]) + whole.uneven


def _standard_deviation(observed: Observed, unsure: Float64) -> Float64:
    return np.sqrt(observed.sd**2 + (_MODEL_ERROR * observed.light) ** 2 + unsure**2)
