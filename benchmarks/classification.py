"""Times the classifiers and texture features on one 1280 × 960 image beside the usual library calls.

Run it from the project's folder: `python -m benchmarks.classification`.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import cv2
import numpy as np

from surfclass import quality, texture
from surfclass.classifiers import svm
from surfclass.classifiers.table import PosteriorTable
from surfclass.rig import TextureLimits
from surfclass.types import SurfaceView
from tests.overlapping_clusters import clusters

PIXELS = 1280 * 960


def best(call: Callable[[], object], repeats: int = 7) -> float:
    """Least seconds of several calls."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def row(what: str, ours: float, theirs: float, alternative: str) -> None:
    times = f"{1e3 * ours:10.1f} ms   {1e3 * theirs:12.1f} ms   {theirs / ours:10.1f} ×"
    print(f"{what:<34} {times}   {alternative}")


def posteriors() -> None:
    x, y, place = clusters(16_000, 0)
    start = time.perf_counter()
    machine = svm.train(x, y, place)
    trained = time.perf_counter() - start
    from sklearn.svm import SVC

    z = (x - machine.mean) / machine.scale
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        start = time.perf_counter()
        theirs = SVC(C=10, gamma=1, probability=True, random_state=0).fit(z, y)
        row(
            f"train ({len(machine.support)} vectors)",
            trained,
            time.perf_counter() - start,
            "SVC(probability=True)",
        )
        slow = best(lambda: theirs.predict_proba(z[:2000]), 2) * PIXELS / 2000

    low, high = x.min(axis=0), x.max(axis=0)
    margin = (high - low) / 4
    low, high = low - margin, high + margin
    start = time.perf_counter()
    table = PosteriorTable.build(machine.posterior_on_grid, low, high)
    built = time.perf_counter() - start
    nodes = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    exact = best(lambda: machine.posterior(nodes), 2) * table.probability[..., 0].size / len(nodes)
    row("build the 128³ table", built, exact, "exact posteriors, sample by sample (scaled)")

    image = np.ascontiguousarray(clusters(PIXELS, 1)[0].T, dtype=np.float32)
    row(
        "posteriors, pixels in random order",
        best(lambda: table.lookup(image)),
        slow,
        "predict_proba (scaled)",
    )
    test = np.clip(clusters(100_000, 2)[0], low, high)
    exact_p = machine.posterior(test)
    found = table.lookup(np.ascontiguousarray(test.T, dtype=np.float32))
    agree = 100 * (exact_p.argmax(axis=1) == found.argmax(axis=1)).mean()
    print(f"    label agreement {agree:.3f} %, mean |ΔP| {np.abs(exact_p - found).mean():.1e}")


def textures() -> None:
    from skimage.feature import graycomatrix, graycoprops, local_binary_pattern

    noise = np.random.default_rng(0).integers(0, 256, (960, 1280)).astype(np.uint8)
    grey = cv2.GaussianBlur(noise, (0, 0), 1.5)
    tiles = [grey[r : r + 20, c : c + 20] for r in range(0, 960, 20) for c in range(0, 1280, 20)]

    def lbp() -> None:
        for tile in tiles[::8]:
            np.bincount(local_binary_pattern(tile, 8, 1, "nri_uniform").astype(int).reshape(-1), minlength=59)

    def glcm() -> None:
        for tile in tiles[::8]:
            matrix = graycomatrix(tile // 32, [1], [0], 8, symmetric=True, normed=True)
            for name in ("contrast", "correlation", "ASM", "homogeneity"):
                graycoprops(matrix, name)

    row(
        "LBP-59 histograms, 20 px windows",
        best(lambda: texture.lbp_histograms(grey)),
        8 * best(lbp, 2),
        "skimage by window",
    )
    row(
        "GLCM features, 20 px windows",
        best(lambda: texture.glcm_features(grey)),
        8 * best(glcm, 2),
        "skimage by window",
    )


def probability() -> None:
    random = np.random.default_rng(0)
    distance, cosine, z = random.uniform(0.4, 1, (3, 960, 1280)).astype(np.float32)
    everywhere = np.ones(z.shape, bool)
    point = np.stack([z, z, z])
    view = SurfaceView(point, point, distance, cosine, None, None, everywhere, everywhere)
    label = random.integers(1, 5, z.shape).astype(np.uint8)
    limits = [TextureLimits(near_m=0.5 + 0.01 * k) for k in range(4)]

    def literal() -> None:
        d, angle = distance.astype(float), np.arccos(cosine.astype(float))
        with np.errstate(over="ignore"):
            for k, one in enumerate(limits):
                p = 1 / (1 + np.exp(1000 * (one.near_m - d))) - 1 / (1 + np.exp(1000 * (one.far_m - d)))
                np.where(label == k + 1, p * (1 - 1 / (1 + np.exp(57.3 * (one.angle_rad - angle)))), 0)

    row(
        "probability map",
        best(lambda: quality.probability_map(view, limits, label)),
        best(literal, 2),
        "numpy, as printed",
    )


if __name__ == "__main__":
    print(f"{'1280 × 960':<34} {'here':>13}   {'alternative':>15}   {'ratio':>12}")
    posteriors()
    textures()
    probability()
