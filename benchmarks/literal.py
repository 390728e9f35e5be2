"""The method as its equations read, pixel by pixel: the alternative that the benchmarks compare with.

Each function runs on a part of the frame and returns the seconds that the whole frame would take.
"""

from __future__ import annotations

import time
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.feature import local_binary_pattern

from surfclass.frames import Capture
from surfclass.geometry import depth_to_points
from surfclass.model import Model
from surfclass.rig import Rig

RADIUS_M, TAU_ALPHA, TAU_KAPPA_M = 0.015, 4.0, 0.004
WINDOW = 20


def literal_normals(depth_mm: NDArray[np.uint16], rig: Rig, points: int = 1000) -> float:
    """Eq. 3.6: a ball around each point, an eigenproblem, and three tests."""
    cloud = depth_to_points(depth_mm, rig.depth).reshape(3, -1).T
    cloud = cloud[cloud[:, 2] > 0].astype(np.float64)
    tree = cKDTree(cloud)
    chosen = np.random.default_rng(0).choice(len(cloud), points, replace=False)
    start = time.perf_counter()
    for point in cloud[chosen]:
        near = cloud[tree.query_ball_point(point, RADIUS_M)]
        if len(near) < 4:
            continue
        centred = near - near.mean(axis=0)
        value, vector = np.linalg.eigh(centred.T @ centred / len(near))
        if value[0] < value[1] / TAU_ALPHA:
            np.mean(np.abs(centred @ vector[:, 0]) <= TAU_KAPPA_M)
    return (time.perf_counter() - start) * len(cloud) / points


def literal_K_d(capture: Capture, rig: Rig, pixels: int = 20_000) -> float:
    """Algorithm 1: a distance, an angle and three reflectances for each pixel (geometry given)."""
    light = np.array(rig.light.position_rgb_m)
    rng = np.random.default_rng(0)
    point = rng.uniform(0.4, 1.2, (pixels, 3))
    normal = np.tile([0.0, 0.0, -1.0], (pixels, 1))
    intensity = capture.colour.rgb.reshape(-1, 3)[:pixels] / 255
    K_d = np.empty((pixels, 3))
    start = time.perf_counter()
    for i in range(pixels):
        to_light = light - point[i]
        distance = np.sqrt(to_light @ to_light)
        angle = np.arccos(to_light @ normal[i] / distance)
        for channel in range(3):
            polynomial = 1.0 * distance**2 + 0.5 * distance + 0.1
            K_d[i, channel] = intensity[i, channel] * polynomial / np.cos(angle)
    return (time.perf_counter() - start) * capture.colour.rgb[..., 0].size / pixels


def literal_posteriors(capture: Capture, model: Model, pixels: int = 2000) -> float:
    """A kernel sum for every pixel and pair of classes, coupled: the exact classifier."""
    classifier = model.colour["K_d"].classifier
    x = np.random.default_rng(0).normal(classifier.mean, classifier.scale, (pixels, 3))
    start = time.perf_counter()
    classifier.posterior(x)
    return (time.perf_counter() - start) * capture.colour.rgb[..., 0].size / pixels


def literal_histograms(capture: Capture) -> float:
    """A library's LBP and a histogram for each window of 20 × 20."""
    grey = capture.colour.rgb.mean(axis=2).astype(np.uint8)
    rows, cols = grey.shape[0] // WINDOW, grey.shape[1] // WINDOW
    start = time.perf_counter()
    for row in range(rows // 8):
        for col in range(cols):
            window = grey[row * WINDOW : (row + 1) * WINDOW, col * WINDOW : (col + 1) * WINDOW]
            code = local_binary_pattern(window, 8, 1, "nri_uniform")
            np.histogram(code, bins=59, range=(0, 59))
    return (time.perf_counter() - start) * rows / (rows // 8)


def literal_bayes(capture: Capture, classes: int, pixels: int = 20_000) -> float:
    """Eq. 3.9 for each pixel, in a dictionary of voxels, normalised each time; both routes."""
    rng = np.random.default_rng(0)
    point = rng.uniform(0, 0.3, (pixels, 3))
    posterior = rng.dirichlet(np.ones(classes), pixels)
    voxels: dict[tuple[int, ...], NDArray[np.float64]] = defaultdict(lambda: np.full(classes, 1 / classes))
    start = time.perf_counter()
    for place, likelihood in zip(point, posterior, strict=True):
        key = tuple(np.floor(place / 0.01).astype(int))
        product = voxels[key] * likelihood
        voxels[key] = product / product.sum()
    return 2 * (time.perf_counter() - start) * capture.colour.rgb[..., 0].size / pixels
