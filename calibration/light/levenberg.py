"""Robust non-linear least squares within bounds, for many residuals and few parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surfclass.types import Float64

Model = Callable[[Float64], tuple[Float64, Float64]]
"""Parameters (p,) to residuals (n,) and their derivatives (n, p)."""

_MOST_ROUNDS = 80
_ENOUGH = 1e-8  # relative gain of the cost at which it has converged
_MOST_DAMPING = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where the least squares ended.

    Attributes:
        parameters: (p,).
        information: (p, p) of the parameters, outliers weighted down.
        cost: Sum of `2 (√(1 + r²) − 1)`.
    """

    parameters: Float64
    information: Float64
    cost: float


def minimise(model: Model, start: Float64, low: Float64, high: Float64) -> Minimum:
    """Returns the least of Σ 2 (√(1 + r²) − 1) near `start` (Levenberg, Marquardt; weights of "soft L1").

    Solves the normal equations, scaled to a unit diagonal: with thousands of residuals for each parameter a
    decomposition of the whole matrix costs ten times as much.

    Args:
        model: Residuals in units of their standard deviations, with derivatives.
        start: (p,) where it begins, within the bounds.
        low: (p,) bounds, −∞ where there is none.
        high: (p,) likewise, ∞ where there is none.
    """
    parameters = np.clip(start, low, high)
    residual, jacobian = model(parameters)
    cost, damping = _cost(residual), 1e-3
    for _ in range(_MOST_ROUNDS):
        weight = 1 / np.sqrt(1 + residual**2)
        weighted = jacobian * weight[:, None]
        information, gradient = weighted.T @ jacobian, weighted.T @ residual
        # What a bound holds back takes no part in the step.
        free = ~(((parameters <= low) & (gradient > 0)) | ((parameters >= high) & (gradient < 0)))
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information / np.outer(scale, scale)
        gained = 0.0
        while damping < _MOST_DAMPING:
            step = np.zeros_like(parameters)
            damped = scaled[np.ix_(free, free)] + damping * np.eye(int(free.sum()))
            step[free] = -np.linalg.solve(damped, (gradient / scale)[free]) / scale[free]
            tried = np.clip(parameters + step, low, high)
            new_residual, new_jacobian = model(tried)
            new_cost = _cost(new_residual)
            if np.isfinite(new_cost) and new_cost <= cost:
                gained = cost - new_cost
                parameters, residual, jacobian, cost = tried, new_residual, new_jacobian, new_cost
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        if gained <= _ENOUGH * max(cost, 1e-12):
            break
        damping = min(damping, 1.0)
    weighted = jacobian / np.sqrt(1 + residual**2)[:, None]
    return Minimum(parameters, weighted.T @ jacobian, cost)


def _cost(residual: Float64) -> float:
    return float(2 * np.sum(np.sqrt(1 + residual**2) - 1))
