"""A Gaussian naive Bayes classifier that can say "none of these" (appendix C.1), as plain arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.classifiers.samples import check_features, check_samples
from surfclass.errors import InputError
from surfclass.types import Bool, Float64, freeze

# A feature that hardly varies within a class (a pattern that it never shows) must not decide alone.
_LEAST_DEVIATION = 0.01  # of the feature's mean deviation within classes
_LEAST_SHRINKAGE = 1e-4  # towards independent features: histograms sum to 1, their covariance is singular


@dataclass(frozen=True, slots=True, eq=False)
class NaiveBayes:
    """An independent Gaussian for each class and feature, and an ellipsoid around each class.

    Attributes:
        mean: (k, d).
        variance: (k, d).
        whitening: (k, d, d) maps x − mean to a vector whose length is the Mahalanobis distance.
        prior: (k,) prior probability of each class, which the posteriors have built in.
        reject_distance: Beyond this Mahalanobis distance from every class a sample is none of them.
    """

    mean: Float64
    variance: Float64
    whitening: Float64
    prior: Float64
    reject_distance: float

    def __post_init__(self) -> None:
        for name in ("mean", "variance", "whitening", "prior"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if not np.isfinite(array).all():
                raise InputError(f"naive Bayes: {name} holds a number that is not finite")
            object.__setattr__(self, name, freeze(array))
        if self.mean.ndim != 2 or 0 in self.mean.shape:
            raise InputError(f"naive Bayes: mean is {self.mean.shape}, must be (k, d)")
        k, d = self.mean.shape
        wanted = {"variance": (k, d), "whitening": (k, d, d), "prior": (k,)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"naive Bayes: {name} is {getattr(self, name).shape}, must be {shape}")
        if self.variance.min() <= 0 or self.prior.min() <= 0 or not self.reject_distance > 0:
            raise InputError("naive Bayes: variances, priors and the reject distance must be positive")

    def posterior(self, x: NDArray[np.floating]) -> Float64:
        """Returns (n, k) class distributions of (n, d) features (Eq. C.3, the prior entering once).

        Raises:
            InputError: If x has another shape or holds a number that is not finite.
        """
        features = check_features(x, self.mean.shape[1])
        log_p = np.empty((len(features), len(self.prior)))
        for k, (mean, variance) in enumerate(zip(self.mean, self.variance, strict=True)):
            log_p[:, k] = -0.5 * ((features - mean) ** 2 @ (1 / variance) + np.log(variance).sum())
        log_p += np.log(self.prior)
        log_p -= log_p.max(axis=1, keepdims=True)
        p = np.exp(log_p)
        return np.asarray(p / p.sum(axis=1, keepdims=True))

    def distance(self, x: NDArray[np.floating]) -> Float64:
        """Returns (n, k) Mahalanobis distances of (n, d) features from each class.

        Raises:
            InputError: As `posterior`.
        """
        features = check_features(x, self.mean.shape[1])
        away = np.empty((len(features), len(self.prior)))
        for k, (mean, whitening) in enumerate(zip(self.mean, self.whitening, strict=True)):
            away[:, k] = np.sqrt((((features - mean) @ whitening.T) ** 2).sum(axis=1))
        return away

    def rejects(self, x: NDArray[np.floating]) -> Bool:
        """Returns (n,) bool: where (n, d) features are far from every class.

        Raises:
            InputError: As `posterior`.
        """
        return np.asarray(self.distance(x).min(axis=1) > self.reject_distance)

    def label(self, x: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Returns (n,): 1 + the index of the most probable class (Eq. C.4, an argmax), 0 where rejected.

        Raises:
            InputError: As `posterior`.
        """
        best = self.posterior(x).argmax(axis=1).astype(np.uint8) + np.uint8(1)
        return np.where(self.rejects(x), np.uint8(0), best)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Returns everything as named arrays, for a file without pickle."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> NaiveBayes:
        """Returns the classifier that `to_arrays` wrote.

        Raises:
            InputError: If an array is missing or has a shape or value that does not fit.
        """
        names = [field.name for field in fields(cls)]
        missing = [name for name in names if name not in arrays]
        if missing:
            raise InputError(f"naive Bayes: {', '.join(missing)} missing")
        try:
            values: dict[str, Any] = {name: np.array(arrays[name], np.float64) for name in names}
            return cls(**(values | {"reject_distance": float(values["reject_distance"])}))
        except (TypeError, ValueError) as error:
            raise InputError(f"naive Bayes: {error}") from None


def train(
    x: NDArray[np.floating],
    label: NDArray[np.integer],
    *,
    names: Sequence[str] | None = None,
    rejected_share: float = 0.001,
) -> NaiveBayes:
    """Returns the classifier of samples, with equal priors as the thesis has them.

    Args:
        x: (n, d) features.
        label: (n,) class indices from 0.
        names: The classes' names; without them k is the largest label + 1.
        rejected_share: Share of a Gaussian class's own samples that are rejected; the distance
            follows as a quantile of the chi-square distribution with d degrees of freedom.

    Raises:
        InputError: If the shapes differ, a feature is not finite, a label is out of range, a class has
            fewer than two samples, or the share is not between 0 and 1.
    """
    from scipy.stats import chi2

    features, y = check_samples(x, label, names)
    if not 0 < rejected_share < 1:
        raise InputError(f"naive Bayes: rejected share {rejected_share}, must be between 0 and 1")
    classes, d = int(y.max()) + 1, features.shape[1]
    mean = np.stack([features[y == k].mean(axis=0) for k in range(classes)])
    variance = np.stack([features[y == k].var(axis=0) for k in range(classes)])
    variance = np.maximum(variance, _least_variance(features, variance))
    whitening = np.empty((classes, d, d))
    for k in range(classes):
        centred = features[y == k] - mean[k]
        shrinkage = _LEAST_SHRINKAGE + d / (d + len(centred))  # few samples do not know a covariance
        covariance = (1 - shrinkage) * centred.T @ centred / len(centred)
        np.fill_diagonal(covariance, variance[k])
        whitening[k] = np.linalg.inv(np.linalg.cholesky(covariance))
    prior = np.full(classes, 1 / classes)
    return NaiveBayes(mean, variance, whitening, prior, math.sqrt(chi2.ppf(1 - rejected_share, d)))


def _least_variance(features: Float64, variance: Float64) -> Float64:
    """(d,): a share of what varies within classes, or else between them; 1 where nothing varies."""
    typical = variance.mean(axis=0)
    typical = np.where(typical > 0, typical, features.var(axis=0))
    return np.where(typical > 0, _LEAST_DEVIATION**2 * typical, 1.0)
