"""One robust least squares over all poses, weighted by the noise that the data themselves show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.hand_eye.adjustment_columns import Free, Layout, State, layout, moved
from calibration.hand_eye.normal_equations import Noise, Normal, inverse_of, system_of
from calibration.hand_eye.problem import Problem
from surfclass.types import Bool, Float64

_MOST_STEPS = 60
_STEP = 1e-10  # rad and m: a step of the hand-eye transform below this ends the iteration
_COST = 1e-9  # relative and absolute: what the cost may rise by rounding
_HALVINGS = 8
_OWN_STEPS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What the least squares found.

    Attributes:
        state: The parameters.
        free: Which of them were estimated.
        places: Where they stand.
        noise: What the measurements were weighted by.
        keep: (n,) the poses that were used.
        pixel_weight: (n,) robust weights of the pixels, 0…1; `position_weight` likewise.
        reduced: (g, g) the normal matrix of the global parameters, the deviations eliminated.
        covariance: (g, g) formal; of what is determined.
        probed_share: (g, g) the part of it that comes from the probed points, which no resampling of
            poses can show.
        cost: Weighted robust sum of squares.
        groups: Normal equations by group, of unit noise.
        squares: Weighted sums of squared residuals and numbers of rows by group.
    """

    state: State
    free: Free
    places: Layout
    noise: Noise
    keep: Bool
    pixel_weight: Float64
    position_weight: Float64
    reduced: Float64
    covariance: Float64
    probed_share: Float64
    cost: float
    groups: dict[str, Normal]
    squares: dict[str, tuple[float, float]]


def adjust(problem: Problem, start: State, free: Free, noise: Noise, keep: Bool) -> Fit:
    """Returns the least squares of the kept poses by Gauss–Newton with step halving.

    Args:
        problem: The observations.
        start: Where to begin.
        free: What to estimate.
        noise: What to weight by.
        keep: (n,) poses to use.
    """
    places = layout(problem, free)
    deviation = np.where(keep[:, None], start.deviation, 0.0) if free.deviations else 0 * start.deviation
    state = replace(start, deviation=deviation)
    system = system_of(problem, state, free, places, noise, keep)
    for _ in range(_MOST_STEPS):
        step, deviations = system.step()
        factor = 1.0
        for _ in range(_HALVINGS):
            ahead = moved(state, free, places, factor * step, state.deviation + factor * deviations)
            trial = system_of(problem, ahead, free, places, noise, keep)
            if trial.cost <= system.cost * (1 + _COST) + _COST:
                break
            factor /= 2
        else:
            break
        state, system = ahead, trial
        if np.abs(factor * step[places.x]).max() < _STEP:
            break
    inverse = inverse_of(system.reduced)
    share = inverse @ system.groups["probed"].global_ @ inverse / noise.probed**2
    return Fit(
        state,
        free,
        places,
        noise,
        keep,
        system.pixel_weight,
        system.position_weight,
        system.reduced,
        inverse,
        share,
        system.cost,
        system.groups,
        system.squares,
    )


def deviations_of(problem: Problem, state: State, noise: Noise, weights: tuple[Float64, Float64]) -> Float64:
    """Returns (n, 6) the deviation that each pose's own points ask for, everything else held.

    Args:
        problem: The observations.
        state: What is held.
        noise: What to weight by.
        weights: Of the pixels and of the positions; they are taken as they are.
    """
    free, keep = Free(), np.ones(problem.poses, np.bool_)
    places = layout(problem, free)
    held = replace(state, deviation=0 * state.deviation)
    for _ in range(_OWN_STEPS):
        system = system_of(problem, held, free, places, noise, keep, weights)
        step = np.einsum("nij,nj->ni", system.inner, system.total.right_deviation)
        held = replace(held, deviation=held.deviation + step)
    return held.deviation
