"""Which samples a classifier is trained on, where there are more than it needs."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]
Selection = Literal["random", "even"]


def draw(
    features: NDArray[Any],
    label: Index,
    place: NDArray[Any],
    per_class: int,
    selection: Selection,
    seed: int,
) -> Index:
    """Returns the sorted rows of at most `per_class` samples of each class, drawn without replacement.

    "random" draws every sample of a class with one probability: the captures and places with most
    pixels rule. "even" gives every place of a class the same share (or what it has), and takes the
    share at equal steps through the place's samples in the order of their intensity, so that light
    and dark ones are there as the place has them and near-duplicates are passed over.

    Args:
        features: (n, d); their mean is taken for the intensity.
        label: (n,) class indices.
        place: (n,) anything that can be sorted.
        per_class: The most of each class.
        selection: As above.
        seed: Of the drawing.
    """
    random = np.random.default_rng(seed)
    intensity = features.mean(axis=1)
    group = np.unique(place, return_inverse=True)[1].reshape(-1)
    chosen = []
    for k in np.unique(label):
        rows = np.flatnonzero(label == k)
        if len(rows) <= per_class:
            chosen.append(rows)
        elif selection == "random":
            chosen.append(random.choice(rows, per_class, replace=False))
        else:
            chosen.extend(_evenly(rows, group[rows], intensity[rows], per_class, random))
    return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.intp)


def _evenly(
    rows: Index, group: Index, intensity: NDArray[Any], count: int, random: np.random.Generator
) -> list[Index]:
    order = np.lexsort((random.random(len(rows)), intensity, group))
    rows, group = rows[order], group[order]
    first = np.flatnonzero(np.diff(group, prepend=-1))
    size = np.diff(first, append=len(rows))
    share = shares(size, count, random)
    return [
        rows[start + ((np.arange(n) + random.random()) * (m / n)).astype(np.intp)]
        for start, m, n in zip(first, size, share, strict=True)
        if n
    ]


def shares(size: Index, count: int, random: np.random.Generator) -> Index:
    """Returns how many of `count` each group of `size` samples gives: as equal as their sizes allow.

    Args:
        size: (g,) samples of each group.
        count: At most `size.sum()`.
        random: Decides which groups give one more.
    """
    share = np.zeros_like(size)
    while (left := count - int(share.sum())) > 0:
        open_ = np.flatnonzero(share < size)
        if left < len(open_):
            share[random.permutation(open_)[:left]] += 1
            break
        share[open_] = np.minimum(size[open_], share[open_] + left // len(open_))
    return share
