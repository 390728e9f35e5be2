"""Texture windows that are right or wrong by known sigmoids."""

import numpy as np

from calibration.limits.windows import Windows

TRUE = {"near_m": 0.50, "far_m": 0.95, "slope_per_m": 40.0, "angle_rad": 0.70, "slope_per_rad": 20.0}
PLATEAU = 0.92


def probability(distance, angle, classes, limits=TRUE, plateau=PLATEAU):
    """Of being right, written down anew from Eq. 5.17-5.19 with chance below and a plateau above."""
    between = 1 / (1 + np.exp(-limits["slope_per_m"] * (distance - limits["near_m"])))
    between -= 1 / (1 + np.exp(-limits["slope_per_m"] * (distance - limits["far_m"])))
    within = 1 / (1 + np.exp(-limits["slope_per_rad"] * (limits["angle_rad"] - angle)))
    return 1 / classes + (plateau - 1 / classes) * between * within


def windows(seed, captures=40, each=200, classes=4, limits=TRUE, distances=(0.40, 1.30), angles=(0.0, 1.1)):
    """Each capture has its own distance and angle, and windows about them."""
    random = np.random.default_rng(seed)
    distance = np.clip(
        random.uniform(*distances, captures)[:, None] + random.normal(0, 0.02, (captures, each)), 0.3, 2
    )
    angle = np.clip(
        random.uniform(*angles, captures)[:, None] + random.normal(0, 0.03, (captures, each)), 0, 1.5
    )
    number = np.repeat(np.arange(captures), each)
    result = random.integers(classes, size=captures * each)
    right = random.random(captures * each) < probability(distance.ravel(), angle.ravel(), classes, limits)
    truth = np.where(right, result, (result + random.integers(1, classes, captures * each)) % classes)
    names = tuple(f"view_{k:03d}" for k in range(captures))
    return Windows(distance.ravel(), angle.ravel(), result, truth, number, names)
