"""Maximum likelihood of the probability map's parameters (Eq. 5.16–5.19)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.limits.cells import Cells
from surfclass.rig import TextureLimits
from surfclass.types import Float64

NAMES = ("near_m", "far_m", "slope_per_m", "angle_rad", "slope_per_rad", "plateau")
"""Parameters of a fit; slopes are fitted as logarithms, the plateau as a logit."""

LEAST_GAP_M = 0.03
"""Between the near and the far limit."""
# How far beyond the data a limit may lie. Near, the sensor ends soon anyway; and as both limits have one
# slope, a soft far one needs room there, or it would cut what was seen to be right.
_MARGIN_NEAR_M, _MARGIN_FAR_M, _MARGIN_RAD = 0.15, 0.05, np.radians(5.0)
_SLOPES = (np.log([3.0, 500.0]), np.log([3.0, 200.0]))  # per metre and per radian
_SLOPE_PRIOR = (np.log(40.0), np.log(20.0), 1.0)  # 10 to 90 % within 0.11 m and 13°; standard deviation
_PLATEAU_PRIOR = (1.0, 1.5)  # logit and standard deviation
_CERTAIN = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Span:
    """From where to where windows were seen.

    Attributes:
        distance_m: Nearest and farthest.
        angle_rad: Most direct and most oblique.
    """

    distance_m: tuple[float, float]
    angle_rad: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Gaussian on the parameters: what holds them where the data say nothing.

    Attributes:
        mean: (6,) in the order of NAMES, slopes as logarithms, the plateau as a logit.
        sd: (6,).
    """

    mean: Float64
    sd: Float64


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Parameters that were found.

    Attributes:
        x: (6,) in the order of NAMES, slopes as logarithms, the plateau as a logit.
        chance: Share that is right where texture says nothing.
        dispersion: By how much the counts scatter more than independent windows would.
    """

    x: Float64
    chance: float
    dispersion: float

    @property
    def limits(self) -> TextureLimits:
        """The probability map's parameters."""
        near, far, slope, angle, slope_angle, _ = self.x
        return TextureLimits(
            near_m=float(near),
            far_m=float(far),
            angle_rad=float(angle),
            slope_per_m=float(np.exp(slope)),
            slope_per_rad=float(np.exp(slope_angle)),
        )

    @property
    def plateau(self) -> float:
        """Share that is right where texture is seen as it was trained."""
        return _plateau(float(self.x[5]), self.chance)

    def probability(self, distance_m: NDArray[Any], angle_rad: NDArray[Any]) -> Float64:
        """Returns the probability that windows seen so are right."""
        return _model(self.x, np.asarray(distance_m), np.asarray(angle_rad), self.chance)[0]


def span_of(cells: Cells) -> Span:
    """Returns the middle 98 % of what the cells cover."""
    order_d, order_a = np.argsort(cells.distance_m), np.argsort(cells.angle_rad)
    ends = []
    for values, order in ((cells.distance_m, order_d), (cells.angle_rad, order_a)):
        share = np.cumsum(cells.total[order]) / cells.total.sum()
        low = values[order][np.searchsorted(share, 0.01)]
        high = values[order][min(len(order) - 1, int(np.searchsorted(share, 0.99)))]
        ends.append((float(low), float(high)))
    return Span(*ends)


def weak_prior(span: Span) -> Prior:
    """Returns a prior that holds the limits near the ends of what was seen."""
    low, high = span.distance_m
    width = max(high - low, LEAST_GAP_M)
    slope, slope_angle, sd = _SLOPE_PRIOR
    mean = [low, high, slope, span.angle_rad[1], slope_angle, _PLATEAU_PRIOR[0]]
    return Prior(np.array(mean), np.array([width, width, sd, 0.5, sd, _PLATEAU_PRIOR[1]]))


def pooled_prior(pooled: Fit, span: Span) -> Prior:
    """Returns a prior around what all classes have together, for the classes one by one."""
    width = max(span.distance_m[1] - span.distance_m[0], LEAST_GAP_M)
    sd = np.array([width / 2, width / 2, 0.7, 0.25, 0.7, _PLATEAU_PRIOR[1]])
    return Prior(np.asarray(pooled.x), sd)


def fit(cells: Cells, prior: Prior, span: Span, chance: float, around: Fit | None = None) -> Fit:
    """Returns the most probable parameters.

    The model is `chance + (plateau − chance) · P`, P being the probability map's product of sigmoids: a
    window that is seen badly is still right by chance, and even the best are not always right. Windows of
    one capture resemble each other; the likelihood is divided by how much more captures scatter than
    independent windows would (McCullagh and Nelder 1989, ch. 4.5), so that the prior keeps its share. The
    prior keeps every number finite where the data are separable, and no limit goes farther beyond the data
    than a margin.

    Args:
        cells: The counts.
        prior: See `weak_prior` and `pooled_prior`.
        span: What was seen; limits stay within it and a margin.
        chance: Share that is right where texture says nothing.
        around: A fit to much the same cells, whose dispersion is taken and where the search begins; None: the
            best of a grid.
    """
    if around is not None:
        return replace(around, x=_maximised(cells, prior, span, chance, around.x, around.dispersion))
    first = _maximised(cells, prior, span, chance, None, 1.0)
    p = _model(first, cells.distance_m, cells.angle_rad, chance)[0]
    dispersion = _dispersion(cells, p)
    return Fit(_maximised(cells, prior, span, chance, first, dispersion), chance, dispersion)


def _dispersion(cells: Cells, p: Float64) -> float:
    """By how much whole captures miss their expected counts more than independent windows would."""
    _, capture = np.unique(cells.capture, return_inverse=True)
    missed = np.bincount(capture, cells.right - cells.total * p)
    expected = np.bincount(capture, cells.total * p * (1 - p))
    return max(1.0, float((missed**2 / expected).sum() / max(1, len(missed) - len(NAMES))))


def fit_plateau(cells: Cells, limits: TextureLimits, chance: float) -> Fit:
    """Returns given limits with the plateau that the cells have under them: what a fit is compared with."""
    x = np.array(
        [
            limits.near_m, limits.far_m, np.log(limits.slope_per_m),
            limits.angle_rad, np.log(limits.slope_per_rad), 0.0,
        ]
    )  # fmt: skip
    logits = np.linspace(-6, 6, 121)
    loss = [
        -log_likelihood(replace(_AT_CHANCE, x=np.append(x[:5], z), chance=chance), cells)
        + 0.5 * ((z - _PLATEAU_PRIOR[0]) / _PLATEAU_PRIOR[1]) ** 2
        for z in logits
    ]
    return Fit(np.append(x[:5], logits[int(np.argmin(loss))]), chance, 1.0)


_AT_CHANCE = Fit(np.zeros(6), 0.5, 1.0)


def log_likelihood(found: Fit, cells: Cells) -> float:
    """Returns the log-likelihood of the counts, nats; not divided by the dispersion."""
    p = found.probability(cells.distance_m, cells.angle_rad)
    return float((cells.right * np.log(p) + (cells.total - cells.right) * np.log1p(-p)).sum())


def bounds_of(span: Span) -> Float64:
    """Returns (6, 2) the least and the greatest value of each parameter."""
    low, high = span.distance_m
    return np.array(
        [
            [max(0.0, low - _MARGIN_NEAR_M), high],
            [low, high + _MARGIN_FAR_M],
            _SLOPES[0],
            [np.radians(2.0), min(np.pi / 2, span.angle_rad[1] + _MARGIN_RAD)],
            _SLOPES[1],
            [-6.0, 6.0],
        ]
    )


def _maximised(
    cells: Cells, prior: Prior, span: Span, chance: float, start: Float64 | None, dispersion: float
) -> Float64:
    from scipy.optimize import minimize

    bounds = bounds_of(span)

    def loss(x: Float64) -> tuple[float, Float64]:
        p, slopes = _model(x, cells.distance_m, cells.angle_rad, chance)
        away = (x - prior.mean) / prior.sd
        value = -(cells.right * np.log(p) + (cells.total - cells.right) * np.log1p(-p)).sum() / dispersion
        by_p = -(cells.right / p - (cells.total - cells.right) / (1 - p)) / dispersion
        return float(value + 0.5 * away @ away), slopes @ by_p + away / prior.sd

    starts = [start] if start is not None else _starts(bounds, prior)
    x = min((np.clip(s, bounds[:, 0], bounds[:, 1]) for s in starts), key=lambda s: loss(s)[0])
    middle = (x[0] + x[1]) / 2  # keeps the near limit below the far one
    bounds[0, 1] = max(bounds[0, 0], min(bounds[0, 1], middle - LEAST_GAP_M / 2))
    bounds[1, 0] = min(bounds[1, 1], max(bounds[1, 0], middle + LEAST_GAP_M / 2))
    scale = np.array([0.1, 0.1, 1.0, 0.1, 1.0, 1.0])

    def scaled(z: Float64) -> tuple[float, Float64]:
        value, slope = loss(z * scale)
        return value, slope * scale

    found = minimize(
        scaled, np.clip(x, bounds[:, 0], bounds[:, 1]) / scale, jac=True, method="L-BFGS-B",
        bounds=bounds / scale[:, None], options={"maxiter": 200},
    )  # fmt: skip
    return np.asarray(np.clip(found.x * scale, bounds[:, 0], bounds[:, 1]))


def _starts(bounds: Float64, prior: Prior) -> list[Float64]:
    """A grid over where the limits may lie."""
    low, high = bounds[0, 0], bounds[1, 1]
    places = np.linspace(low, high, 8)
    angles = np.linspace(bounds[3, 0], bounds[3, 1], 5)
    return [
        np.array([near, far, prior.mean[2], angle, prior.mean[4], prior.mean[5]])
        for near in places[:-1]
        for far in places[places > near + LEAST_GAP_M]
        for angle in angles
    ]


def _model(x: Float64, d: Float64, angle: Float64, chance: float) -> tuple[Float64, Float64]:
    """(m,) probabilities that a window is right, and (6, m) their slopes by the parameters."""
    near, far, log_slope, limit, log_slope_angle, z = x
    slope, slope_angle = np.exp(log_slope), np.exp(log_slope_angle)
    after_near, after_far = _sigmoid(slope * (d - near)), _sigmoid(slope * (d - far))
    between = after_near - after_far
    within = _sigmoid(slope_angle * (limit - angle))
    height = _plateau(float(z), chance) - chance
    g_near, g_far = after_near * (1 - after_near), after_far * (1 - after_far)
    g_angle = within * (1 - within)
    share = height / (1 - chance)
    p = chance + height * between * within
    slopes = np.stack(
        [
            -height * within * slope * g_near,
            height * within * slope * g_far,
            height * within * slope * (g_near * (d - near) - g_far * (d - far)),
            height * between * slope_angle * g_angle,
            height * between * slope_angle * g_angle * (limit - angle),
            (1 - chance) * share * (1 - share) * between * within,
        ]
    )
    return np.clip(p, _CERTAIN, 1 - _CERTAIN), slopes


def _plateau(z: float, chance: float) -> float:
    return chance + (1 - chance) / (1 + float(np.exp(-z)))


def _sigmoid(z: Float64) -> Float64:
    return np.asarray((1 + np.tanh(z / 2)) / 2)
