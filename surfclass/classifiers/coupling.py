"""Pairwise coupling: from the probabilities of pairs to one distribution over all classes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float64

_CHUNK = 8192  # samples whose k × k systems stay in the cache


def couple(r: NDArray[np.floating]) -> Float64:
    """Returns the distributions that agree best with pairwise probabilities.

    The second method of Wu, Lin and Weng, "Probability estimates for multi-class classification by
    pairwise coupling", 2004: p minimises Σᵢ Σⱼ≠ᵢ (rⱼᵢ pᵢ − rᵢⱼ pⱼ)² with Σ p = 1. That is p ∝ x with
    (Q + 1·1ᵀ) x = 1, where Qᵢᵢ = Σⱼ rⱼᵢ² and Qᵢⱼ = −rⱼᵢ rᵢⱼ: adding 1·1ᵀ does not move the minimum on
    Σ p = 1, and makes the system positive definite also where Q is singular, as it is for two classes
    and for any r that a p explains exactly.

    Args:
        r: (n, k, k); `r[:, i, j]` is P(class i | class i or j), in (0, 1), with
            `r[:, j, i] = 1 − r[:, i, j]`. The diagonal is not read.

    Returns:
        (n, k), each row positive and summing to 1.

    Raises:
        InputError: If the shape is not (n, k, k) with k ≥ 2.
    """
    if r.ndim != 3 or r.shape[1] != r.shape[2] or r.shape[1] < 2:
        raise InputError(f"pairwise coupling: shape {r.shape}, allowed is (n, k, k) with k of at least 2")
    return couple_planes(np.moveaxis(r, 0, 2)).T


def couple_planes(r: NDArray[np.floating]) -> Float64:
    """Returns (k, n) for (k, k, n): `couple` for callers that hold one plane for each pair."""
    k, _, n = r.shape
    p = np.empty((k, n))
    for start in range(0, n, _CHUNK):
        chunk = slice(start, start + _CHUNK)
        p[:, chunk] = _solve(np.asarray(r[:, :, chunk], dtype=np.float64))
    return p


def _solve(r: Float64) -> Float64:
    """Gaussian elimination of all n systems at once; positive definite, so without pivoting."""
    k, _, n = r.shape
    system = 1 - r * r.swapaxes(0, 1)
    for i in range(k):
        system[i, i] = 1 + sum(r[j, i] ** 2 for j in range(k) if j != i)
    p = np.ones((k, n))
    for i in range(k):
        for j in range(i + 1, k):
            factor = system[j, i] / system[i, i]
            system[j, i + 1 :] -= factor * system[i, i + 1 :]
            p[j] -= factor * p[i]
    for i in reversed(range(k)):
        for j in range(i + 1, k):
            p[i] -= system[i, j] * p[j]
        p[i] /= system[i, i]
    # The exact minimum is positive (their theorem 1); rounding must not make it −1e-17.
    np.maximum(p, np.finfo(np.float64).tiny, out=p)
    p /= p.sum(axis=0)
    return p
