"""What every classifier asks of features and training samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float64


def check_features(x: NDArray[np.floating], d: int) -> Float64:
    """Returns x as float64.

    Raises:
        InputError: If x is not (n, d) or holds a number that is not finite.
    """
    features = np.asarray(x, dtype=np.float64)
    if features.ndim != 2 or features.shape[1] != d:
        raise InputError(f"features: shape {features.shape}, must be (n, {d})")
    if not np.isfinite(features).all():
        raise InputError("features: a number is not finite")
    return features


def check_samples(
    x: NDArray[np.floating], label: NDArray[np.integer], names: Sequence[str] | None
) -> tuple[Float64, NDArray[np.intp]]:
    """Returns features (n, d) and labels (n,) that cover every class from 0 to k − 1.

    Args:
        x: (n, d) features.
        label: (n,) class indices.
        names: The k classes' names; None: k is the largest label + 1.

    Raises:
        InputError: If the shapes differ, a feature is not finite, a label is out of range, or a class
            has fewer than two samples; the message names the class.
    """
    features = check_features(x, np.shape(x)[-1] if np.ndim(x) else 0)
    y, n = np.asarray(label), len(features)
    if y.shape != (n,) or not features.size:
        raise InputError(
            f"training set: features {features.shape}, labels {y.shape}; must be (n, d) and (n,)"
        )
    if not np.issubdtype(y.dtype, np.integer) or y.min() < 0 or (names and y.max() >= len(names)):
        raise InputError(f"training set: labels of {y.dtype} from {y.min()} to {y.max()}, must count from 0")
    count = np.bincount(y, minlength=len(names) if names else 2)
    for k in np.flatnonzero(count < 2).tolist():
        raise InputError(
            f"training set: class {names[k] if names else k} has {count[k]} samples, needs at least 2"
        )
    return features, y.astype(np.intp)
