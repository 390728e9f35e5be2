"""Uncertainty from the data themselves: formal covariances are several times too small on real ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float64


def jackknife_covariance(estimates: NDArray[Any]) -> Float64:
    """Returns the covariance of an estimate from those that leave out one block of data each (Tukey 1958).

    What is correlated within a block (all points of a pose) then counts as it should.

    Args:
        estimates: (n, p) one row for each block left out.

    Returns:
        (p, p).

    Raises:
        InputError: If there are fewer than two.
    """
    values = np.asarray(estimates, np.float64)
    if values.ndim != 2 or len(values) < 2:
        raise InputError(f"jackknife: estimates {values.shape}, needed are 2 or more rows")
    away = values - values.mean(axis=0)
    covariance: Float64 = (len(values) - 1) / len(values) * (away.T @ away)
    return covariance
