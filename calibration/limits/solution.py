"""The limits of all classes together and of each, their uncertainty, and how well they predict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.limits.cells import Cells, balance, cells_of
from calibration.limits.likelihood import (
    NAMES,
    Fit,
    Prior,
    Span,
    fit,
    fit_plateau,
    log_likelihood,
    pooled_prior,
    span_of,
    weak_prior,
)
from calibration.limits.windows import Windows
from surfclass.rig import TextureLimits
from surfclass.types import Float64

_FEWEST_WINDOWS, _FEWEST_CAPTURES = 30, 3
_MOST_FOLDS = 10
_AT_THE_END = 0.005  # m and rad: a limit there or beyond is where the data end, not where texture does


@dataclass(frozen=True, slots=True, eq=False)
class ClassLimits:
    """One class's, or all classes'.

    Attributes:
        fit: The parameters.
        sd: (6,) standard deviations in the order of NAMES, of the slopes and the plateau themselves.
        span: From where to where its windows were seen.
        windows: How many there are.
        captures: How many captures they are from.
        ends: Which of near_m, far_m and angle_rad are where the captures end, not where texture does.
    """

    fit: Fit
    sd: Float64
    span: Span
    windows: int
    captures: int
    ends: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How well limits predict which windows of other captures are right.

    Attributes:
        found: Mean log-likelihood of a window under the limits found from the other captures, nats.
        default: The same under the limits that were in use.
        gain: The difference, positive where the new ones are better.
        gain_sd: Its standard error, from the scatter between captures.
        folds: How often captures were left out.
    """

    found: float
    default: float
    gain: float
    gain_sd: float
    folds: int


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Everything that was found.

    Attributes:
        pooled: All classes together.
        classes: By class number; a class with too few windows is missing.
        held_out: See there.
    """

    pooled: ClassLimits
    classes: dict[int, ClassLimits]
    held_out: HeldOut


def solve(
    windows: Windows, class_count: int, default: tuple[TextureLimits, ...], resamples: int, seed: int
) -> Solution:
    """Finds the limits of all classes together, then of each class around those.

    Limits of a class are those of the windows that the classifier GAVE this class, for that is how the
    map looks them up: where a class is what everything far away is taken for, its accuracy on itself is
    perfect, and worth nothing.

    Args:
        windows: Classified windows.
        class_count: Number of classes.
        default: The limits in use, by class; what the new ones are compared with.
        resamples: Of captures, for the uncertainties.
        seed: Of the resampling.
    """
    weight = balance(windows, class_count)
    chance = 1 / class_count
    every = cells_of(windows, weight, None)
    of_class = {k: cells_of(windows, weight, k) for k in range(class_count)}
    span = span_of(every)
    pooled = fit(every, weak_prior(span), span, chance)
    told = [k for k, cells in of_class.items() if _tells(cells)]
    prior = pooled_prior(pooled, span)
    found = {k: fit(of_class[k], prior, span_of(of_class[k]), chance) for k in told}

    random = np.random.default_rng(seed)
    captures = len(windows.names)
    draws: dict[int | None, list[Float64]] = {None: [], **{k: [] for k in told}}
    for _ in range(resamples):
        times = np.bincount(random.integers(captures, size=captures), minlength=captures).astype(float)
        draws[None].append(_again(every.weighted(times), weak_prior(span), span, pooled))
        for k in told:
            cells = of_class[k].weighted(times)
            if len(cells.total):
                draws[k].append(_again(cells, prior, span_of(of_class[k]), found[k]))
    return Solution(
        _described(pooled, draws[None], span, every),
        {k: _described(found[k], draws[k], span_of(of_class[k]), of_class[k]) for k in told},
        _held_out(windows, every, of_class, default, chance),
    )


def _tells(cells: Cells) -> bool:
    return cells.total.sum() >= _FEWEST_WINDOWS and len(np.unique(cells.capture)) >= _FEWEST_CAPTURES


def _again(cells: Cells, prior: Prior, span: Span, around: Fit) -> Float64:
    return _natural(fit(cells, prior, span, around.chance, around))


def _natural(found: Fit) -> Float64:
    x = np.array(found.x)
    x[[2, 4]] = np.exp(x[[2, 4]])
    x[5] = found.plateau
    return x


def _described(found: Fit, draws: list[Float64], span: Span, cells: Cells) -> ClassLimits:
    sd = np.std(np.array(draws), axis=0, ddof=1) if len(draws) > 1 else np.full(len(NAMES), np.nan)
    beyond = {
        "near_m": found.x[0] < span.distance_m[0] + _AT_THE_END,
        "far_m": found.x[1] > span.distance_m[1] - _AT_THE_END,
        "angle_rad": found.x[3] > span.angle_rad[1] - _AT_THE_END,
    }
    ends = tuple(name for name, there in beyond.items() if there)
    captures = len(np.unique(cells.capture))
    return ClassLimits(found, sd, span, round(float(cells.total.sum())), captures, ends)


def _held_out(
    windows: Windows,
    every: Cells,
    of_class: dict[int, Cells],
    default: tuple[TextureLimits, ...],
    chance: float,
) -> HeldOut:
    """Leaves out captures in turn; finds the limits, and the plateaus under the default ones, without."""
    captures = len(windows.names)
    folds = min(_MOST_FOLDS, captures)
    fold = np.arange(captures) % folds
    found, known, count = (np.zeros(captures) for _ in range(3))
    for part in range(folds):
        inside, outside = (fold == part).astype(float), (fold != part).astype(float)
        without = every.weighted(outside)
        if not len(without.total) or not len(every.weighted(inside).total):
            continue
        span = span_of(without)
        pooled = fit(without, weak_prior(span), span, chance)
        prior = pooled_prior(pooled, span)
        for k, cells in of_class.items():
            seen, unseen = cells.weighted(outside), cells.weighted(inside)
            if not len(unseen.total):
                continue
            new = fit(seen, prior, span_of(seen), chance) if _tells(seen) else pooled
            old = fit_plateau(seen if _tells(seen) else without, default[k], chance)
            for number in np.unique(unseen.capture):
                one = unseen.weighted((np.arange(captures) == number).astype(float))
                found[number] += log_likelihood(new, one)
                known[number] += log_likelihood(old, one)
                count[number] += one.total.sum()
    seen_at_all = count > 0
    gain = (found - known)[seen_at_all]
    total = count.sum()
    scatter = gain - gain.sum() / total * count[seen_at_all]
    n = len(gain)
    sd = float(np.sqrt(n / max(1, n - 1) * (scatter**2).sum()) / total)
    return HeldOut(
        float(found.sum() / total), float(known.sum() / total), float(gain.sum() / total), sd, folds
    )
