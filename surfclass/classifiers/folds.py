"""Which training samples are held out together, and which are enough to train on."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

HeldOut = Literal["groups", "samples"]
Index = NDArray[np.intp]

_FEWEST_OF_A_CLASS = 200


def deal_folds(label: Index, groups: NDArray[Any], folds: int, seed: int) -> tuple[Index, HeldOut]:
    """Returns the fold of each sample, and whether whole groups were dealt.

    Samples of one group (a place, a view) resemble each other: a sigmoid fitted on samples whose
    group was trained on is over-confident. So groups are dealt whole, each to the fold that has
    fewest samples of its class, the classes with fewest groups first. Where that would leave a class
    in one fold only (it has a single group, or its groups are shared unfavourably), there is no such
    split: samples are then dealt, in turn within each class, and the answer says so.

    Args:
        label: (n,) class indices; every class from 0 to the largest has samples.
        groups: (n,) anything that can be sorted.
        folds: At least 2.
        seed: Decides among equals.
    """
    random = np.random.default_rng(seed)
    group = np.unique(groups, return_inverse=True)[1].reshape(-1)
    classes = int(label.max()) + 1
    held = np.zeros((classes, int(group.max()) + 1), dtype=np.intp)
    np.add.at(held, (label, group), 1)
    group_count = (held > 0).sum(axis=1)

    fold_of = np.full(held.shape[1], -1, dtype=np.intp)
    filled = np.zeros((folds, classes), dtype=np.intp)
    for k in np.argsort(group_count, kind="stable"):
        waiting = np.flatnonzero((held[k] > 0) & (fold_of < 0))
        waiting = random.permutation(waiting)
        for g in waiting[np.argsort(-held[k, waiting], kind="stable")]:
            fold_of[g] = np.lexsort((filled.sum(axis=1), filled[:, k]))[0]
            filled[fold_of[g]] += held[:, g]
    if ((filled > 0).sum(axis=0) >= 2).all():
        return fold_of[group], "groups"

    fold = np.empty(len(label), dtype=np.intp)
    for k in range(classes):
        of_class = random.permutation(np.flatnonzero(label == k))
        fold[of_class] = np.arange(len(of_class)) % folds
    return fold, "samples"


def thin_out(label: Index, groups: NDArray[Any], most: int, seed: int) -> Index:
    """Returns the sorted indices of at most about `most` samples that keep the shares of classes and groups.

    A class is not thinned below 200 samples, or what it has.
    """
    if len(label) <= most:
        return np.arange(len(label))
    random = np.random.default_rng(seed)
    group = np.unique(groups, return_inverse=True)[1].reshape(-1)
    chosen = []
    for k in range(int(label.max()) + 1):
        of_class = random.permutation(np.flatnonzero(label == k))
        of_class = of_class[np.argsort(group[of_class], kind="stable")]
        share = most * len(of_class) // len(label)
        count = min(len(of_class), max(share, _FEWEST_OF_A_CLASS))
        chosen.append(of_class[np.arange(count) * len(of_class) // count])
    return np.sort(np.concatenate(chosen))
