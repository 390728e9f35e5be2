"""Platt's sigmoid: from decision values to the probability of the positive class."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Bool, Float64

_ITERATIONS = 100
_RIDGE = 1e-12
_SMALLEST_STEP = 1e-10
_GRADIENT_PER_SAMPLE = 1e-10


def fit_sigmoid(f: Float64, positive: Bool) -> tuple[float, float]:
    """Returns A and B of `P(positive | f) = 1 / (1 + exp(A f + B))`.

    Newton's method with backtracking on the cross-entropy against softened targets, after Lin, Lin
    and Weng, "A note on Platt's probabilistic outputs for support vector machines", 2007. The targets
    (n₊ + 1) / (n₊ + 2) and 1 / (n₋ + 2) keep the answer finite where the classes are separable.

    Args:
        f: (n,) decision values, from samples that the machine was not trained on.
        positive: (n,) bool.

    Raises:
        InputError: If the shapes differ, a value is not finite, or one of the two classes is missing.
    """
    f = np.asarray(f, dtype=np.float64)
    positive = np.asarray(positive, dtype=np.bool_)
    if f.ndim != 1 or f.shape != positive.shape:
        raise InputError(f"sigmoid fit: {f.shape} decision values and {positive.shape} labels, must be (n,)")
    if not np.isfinite(f).all():
        raise InputError("sigmoid fit: a decision value is not finite")
    positives = int(positive.sum())
    negatives = len(f) - positives
    if not positives or not negatives:
        raise InputError(f"sigmoid fit: {positives} positive and {negatives} negative samples, needs both")

    # Unit-sized values keep the 2 × 2 Hessian well conditioned whatever C and the kernel are.
    unit = float(np.abs(f).max()) or 1.0
    f = f / unit
    target = np.where(positive, (positives + 1) / (positives + 2), 1 / (negatives + 2))
    a, b = 0.0, float(np.log((negatives + 1) / (positives + 1)))
    loss = _cross_entropy(a * f + b, target)
    for _ in range(_ITERATIONS):
        probability = sigmoid(-(a * f + b))
        slope = target - probability
        g_a, g_b = float(slope @ f), float(slope.sum())
        if max(abs(g_a), abs(g_b)) < _GRADIENT_PER_SAMPLE * len(f):
            break
        curvature = probability * (1 - probability)
        h_aa = float(curvature @ (f * f)) + _RIDGE
        h_ab = float(curvature @ f)
        h_bb = float(curvature.sum()) + _RIDGE
        determinant = h_aa * h_bb - h_ab * h_ab
        d_a = -(h_bb * g_a - h_ab * g_b) / determinant
        d_b = -(h_aa * g_b - h_ab * g_a) / determinant
        descent = g_a * d_a + g_b * d_b
        step = 1.0
        while step >= _SMALLEST_STEP:
            tried = _cross_entropy((a + step * d_a) * f + b + step * d_b, target)
            if tried < loss + 1e-4 * step * descent:
                break
            step /= 2
        else:
            # The loss cannot tell these two points apart any more; the gradient still can.
            a, b = a + d_a, b + d_b
            break
        a, b, loss = a + step * d_a, b + step * d_b, tried
    return a / unit, b


def sigmoid(z: NDArray[np.floating]) -> NDArray[np.floating]:
    """Returns 1 / (1 + exp(−z)) elementwise, of z's dtype, without overflow at any z."""
    half = z.dtype.type(0.5)
    probability: NDArray[np.floating] = half + half * np.tanh(half * z)
    return probability


def _cross_entropy(z: Float64, target: Float64) -> float:
    return float((np.logaddexp(0, z) - (1 - target) * z).sum())
