"""An SVM's C and gamma by cross-validation over places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from surfclass.classifiers import svm
from surfclass.classifiers.folds import Index
from surfclass.types import Float64

_LEAST_PROBABILITY = 1e-12


@dataclass(frozen=True, slots=True)
class Trial:
    """One pair of hyper-parameters.

    Attributes:
        C: Price of a sample on the wrong side.
        gamma: Width of the RBF kernel.
        nll: Mean over the places of the negative log-likelihood of their samples, held out; nats.
        sd: Its standard error, from the scatter between places.
    """

    C: float
    gamma: float
    nll: float
    sd: float


def search(
    x: Float64,
    label: Index,
    groups: Index,
    kernel: svm.Kernel,
    C: Sequence[float],
    gamma: Sequence[float],
    folds: int,
    seed: int,
) -> tuple[Trial, list[Trial]]:
    """Returns the smoothest machine that is as good as the best, and every trial.

    "As good" is a likelihood on held-out places within one standard error of the best one's (the
    one-standard-error rule of Breiman et al., 1984): what the places cannot tell apart is settled by
    smoothness, for other distances and lights are farther away than other places are.

    Args:
        x: (n, d) features.
        label: (n,) class indices from 0.
        groups: (n,) places.
        kernel: "rbf" or "linear", which takes the first gamma alone.
        C: Allowed values.
        gamma: Likewise.
        folds: Of the hold-out.
        seed: Of the folds.

    Raises:
        InputError: As `svm.cross_fit`.
    """
    pairs = list(product(sorted(gamma)[:1] if kernel == "linear" else sorted(gamma), sorted(C)))
    trials = []
    for one_gamma, one_C in pairs:
        found = svm.cross_fit(
            x, label, groups, kernel=kernel, C=one_C, gamma=one_gamma, folds=folds, seed=seed
        )
        loss = place_losses(found.posterior, label[found.rows], groups[found.rows])
        trials.append(Trial(one_C, one_gamma, float(loss.mean()), _standard_error(loss)))
    best = min(trials, key=lambda trial: trial.nll)
    allowed = best.nll + best.sd
    return next(trial for trial in trials if trial.nll <= allowed), trials  # the smoothest is tried first


def place_losses(posterior: Float64, label: Index, groups: Index) -> Float64:
    """Returns (places,) the mean negative log-likelihood of each place's samples, nats."""
    loss = -np.log(np.maximum(posterior[np.arange(len(label)), label], _LEAST_PROBABILITY))
    group = np.unique(groups, return_inverse=True)[1].reshape(-1)
    return np.asarray(np.bincount(group, loss) / np.bincount(group))


def _standard_error(values: Float64) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
