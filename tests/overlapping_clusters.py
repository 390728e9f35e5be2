"""Samples of overlapping classes in a space of three features, correlated as brightness is."""

import numpy as np
from numpy.typing import NDArray

CENTRES = np.array(
    [[0.35, 0.22, 0.15], [0.42, 0.36, 0.22], [0.55, 0.45, 0.30], [0.30, 0.30, 0.30], [0.60, 0.55, 0.50]]
)
SPREAD = np.array([0.055, 0.05, 0.06, 0.045, 0.06])


def clusters(n: int, seed: int, k: int = 4) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Returns features (n, 3), labels and places; each place shifts its samples a little."""
    random = np.random.default_rng(seed)
    label = np.arange(n) % k
    place = (np.arange(n) // k) % 20 * k + label
    noise = 0.6 * random.normal(size=(n, 1)) + 0.5 * random.normal(size=(n, 3))
    noise += 0.2 * random.normal(size=(20 * k, 3))[place]
    return CENTRES[label] + noise * SPREAD[label][:, None], label, place
