"""How noisy each kind of measurement is, from its own residuals (variance components)."""

from __future__ import annotations

from dataclasses import replace
from math import gamma
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.adjustment import Fit, adjust
from calibration.hand_eye.adjustment_columns import Free, State, layout, pixel_rows, position_rows
from calibration.hand_eye.normal_equations import Noise
from calibration.hand_eye.problem import Problem
from surfclass.types import Bool

_ROUNDS = 25
_CHANGE = 2e-3
_PRIOR_ROWS = 1.0  # of belief in the usual noise, for what few poses show
_USUAL = Noise()
_WITHIN = 0.05  # residuals within poses, in those between them
_SHAPED = 20  # poses from which on the deviations' distribution can be told from a Gaussian one
_FLOOR = Noise(1e-4, 1e-7, 1e-7, 0.05, 1e-7, 1e-7)


def adjust_weighted(problem: Problem, start: State, free: Free, keep: Bool, noise: Noise = _USUAL) -> Fit:
    """Returns the least squares whose weights agree with its own residuals.

    Each group's variance is its sum of squares over its redundancy, the share of its rows that the
    parameters do not absorb (Förstner 1979), iterated.

    Args:
        problem: The observations.
        start: Where to begin.
        free: What to estimate.
        keep: (n,) poses to use.
        noise: Where the noise begins.
    """
    fit = adjust(problem, start, free, noise, keep)
    for _ in range(_ROUNDS):
        found = components(problem, fit)
        change = max(abs(np.log(getattr(found, name) / getattr(fit.noise, name))) for name in Noise.__slots__)
        fit = adjust(problem, fit.state, free, found, keep)
        if change < _CHANGE:
            break
    if keep.sum() >= _SHAPED and _only_poses_scatter(problem, fit):
        shape = shape_of(fit.state.deviation[keep])
        fit = adjust(problem, fit.state, free, replace(fit.noise, shape=shape), keep)
    return fit


def shape_of(deviations: NDArray[Any]) -> float:
    """Returns the exponent of the distribution exp(−|v|^p) of deviations (n, 6), by their kurtosis.

    Never below 2: heavy tails are what outliers look like, and those are found one by one.
    """
    squares = np.mean(deviations**2, axis=0)
    kurtosis = float(np.mean(np.mean(deviations**4, axis=0) / np.maximum(squares**2, 1e-300)))
    low, high = 2.0, 4.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if _kurtosis(middle) > kurtosis else (low, middle)
    return low


def _only_poses_scatter(problem: Problem, fit: Fit) -> bool:
    """Whether each pose's points fit each other so well that the poses themselves are what is measured."""
    free, places = Free(), layout(problem, Free())
    as_read = replace(fit.state, deviation=0 * fit.state.deviation)
    for seen, rows_of in ((problem.pixels, pixel_rows), (problem.positions, position_rows)):
        used = fit.keep[seen.pose]
        if used.any():
            within, between = (
                float(np.mean(rows_of(problem, state, free, places).residual[used] ** 2))
                for state in (fit.state, as_read)
            )
            if within > _WITHIN**2 * between:
                return False
    return True


def _kurtosis(shape: float) -> float:
    return gamma(5 / shape) * gamma(1 / shape) / gamma(3 / shape) ** 2


def components(problem: Problem, fit: Fit) -> Noise:
    """Returns the noise that a fit's residuals show."""
    noise, poses = fit.noise, problem.poses
    joints = problem.jacobian is not None
    sd = noise.deviation(joints)
    scales = {"pixel": noise.pixel, "across": noise.across, "along": noise.along, "probed": noise.probed}
    deviation = np.zeros((poses, 6, 6))
    cross = np.zeros((poses, fit.places.size, 6))
    if fit.free.deviations:
        deviation = sum(
            (group.deviation / scales[name] ** 2 for name, group in fit.groups.items()), deviation
        )
        cross = sum((group.cross / scales[name] ** 2 for name, group in fit.groups.items()), cross)
    own = np.linalg.inv(deviation + np.diag(1 / sd**2))
    mixed = -np.einsum("gh,nhi,nij->ngj", fit.covariance, cross, own)
    own_all = own - np.einsum("nij,ngj,ngk->nik", own, cross, mixed)
    found: dict[str, float] = {}
    for name, group in fit.groups.items():
        square, rows = fit.squares[name]
        absorbed = np.sum(fit.covariance * group.global_)
        if fit.free.deviations:
            absorbed += 2 * np.sum(mixed * group.cross) + np.sum(own_all * group.deviation)
        redundancy = max(rows - float(absorbed) / scales[name] ** 2, 0.0)
        found[name] = _variance(square, redundancy, name)
    if fit.free.deviations:
        inside = [own_all[fit.keep][:, k, k].sum() / sd[k] ** 2 for k in range(6)]
        count = float(fit.keep.sum())
        squares = np.sum(fit.state.deviation[fit.keep] ** 2, axis=0)
        for name, part in (("turn", range(6 if joints else 3)), ("shift", range(3, 6))):
            left = sum(max(count - float(inside[k]), 0.0) for k in part)
            found[name] = _variance(float(sum(squares[k] for k in part)), left, name)
    return replace(noise, **found)


def _variance(square: float, redundancy: float, name: str) -> float:
    variance = (square + _PRIOR_ROWS * getattr(_USUAL, name) ** 2) / (redundancy + _PRIOR_ROWS)
    return float(max(np.sqrt(variance), getattr(_FLOOR, name)))
