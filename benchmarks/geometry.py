"""Compares normals and K_d with the equations taken literally, pixel by pixel, in one run.

The literal forms (PCA of the neighbours within a radius, Algorithm 1) run on a sample of pixels,
scaled to the frame; the project's run on the whole frame. Prints times, their ratio and both errors.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from surfclass.colour import as_fraction
from surfclass.geometry import depth_to_points, rays, register
from surfclass.normals import estimate_normals
from surfclass.reflectance import diffuse_reflectance
from surfclass.rig import parse_rig
from surfclass.viewing import view_surface

RADIUS_M = 0.015
TAU_ALPHA = 4.0
TAU_KAPPA_M = 0.004
TILT = np.radians(30)
DISTANCE_M = 0.8
RIG = """
schema = 1
name = "benchmark"
voxel_size_m = 0.01
rgb = {size = [1280, 960], fx = 1624.7, fy = 1624.7, cx = 639.5, cy = 479.5}
depth = {size = [640, 480], fx = 585.0, fy = 585.0, cx = 319.5, cy = 239.5}
transforms = {rgb_T_depth = [[1, 0, 0, 0.0035], [0, 1, 0, 0.0774], [0, 0, 1, 0.0014], [0, 0, 0, 1]]}
light = {position_rgb_m = [-0.084, 0.037, -0.006]}
response = {a2_a1_a0 = [[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]}
"""


def best_ms(call: Callable[[], Any], rounds: int = 5) -> float:
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def noisy_plane(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """A tilted plane with the noise and the steps of a structured-light camera, and its normal."""
    normal = np.array([np.sin(TILT), 0, -np.cos(TILT)])
    x, y = rays(camera).astype(np.float64)
    z = -np.cos(TILT) * DISTANCE_M / (normal[0] * x + normal[1] * y + normal[2])
    disparity = 585 * 0.075 / z + np.random.default_rng(0).normal(0, 0.11, z.shape)
    return (1e3 * 585 * 0.075 / (np.rint(disparity * 8) / 8)).astype(np.uint16), normal


def literal_normal(tree: cKDTree, cloud: np.ndarray, point: np.ndarray) -> np.ndarray | None:
    """Eq. 3.6 and the two tests around it, for one point."""
    near = cloud[tree.query_ball_point(point, RADIUS_M)]
    if len(near) < 4:
        return None
    values, vectors = np.linalg.eigh(np.cov(near.T))
    if not values[0] < values[1] / TAU_ALPHA:
        return None
    normal = vectors[:, 0] * (-1 if vectors[:, 0] @ point > 0 else 1)
    within = np.abs((near - near.mean(axis=0)) @ normal) <= TAU_KAPPA_M
    return normal if within.mean() > 0.5 else None


def compare_normals(rig: Any, samples: int) -> None:
    depth_mm, truth = noisy_plane(rig.depth)
    cloud = depth_to_points(depth_mm, rig.depth).reshape(3, -1).T.astype(np.float64)
    chosen = np.random.default_rng(1).choice(len(cloud), samples, replace=False)
    start = time.perf_counter()
    tree = cKDTree(cloud)
    built = time.perf_counter() - start
    start = time.perf_counter()
    literal = [literal_normal(tree, cloud, cloud[index]) for index in chosen]
    literal_ms = 1e3 * (built + (time.perf_counter() - start) * len(cloud) / samples)
    ours = estimate_normals(depth_mm, rig.depth)
    ours_ms = best_ms(lambda: estimate_normals(depth_mm, rig.depth))
    errors = [np.degrees(np.arccos(np.clip(n @ truth, -1, 1))) for n in literal if n is not None]
    cosine = np.tensordot(truth, ours.normal, axes=1)[ours.valid]
    own = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    print(f"normals, 640 × 480: literal {literal_ms:,.0f} ms (scaled), median error {np.median(errors):.2f}°")
    print(f"                    ours {ours_ms:.1f} ms, median error {np.median(own):.2f}°")
    print(f"                    ratio {literal_ms / ours_ms:,.0f}")


def literal_k_d(fraction: np.ndarray, view: Any, rig: Any, rows: range) -> np.ndarray:
    """Algorithm 1: Eq. 4.14, 4.13 and 4.12 for one pixel after the other."""
    light = np.array(rig.light.position_rgb_m)
    k_d = np.full((3, len(rows), fraction.shape[2]), np.nan)
    for i, row in enumerate(rows):
        for column in range(fraction.shape[2]):
            if not view.has_normal[row, column]:
                continue
            away = light - view.point[:, row, column]
            distance = np.sqrt((away**2).sum())
            normal = view.normal[:, row, column]
            theta = np.arccos(away @ normal / (np.linalg.norm(away) * np.linalg.norm(normal)))
            for channel, (a2, a1, a0) in enumerate(rig.response.a2_a1_a0):
                factor = a2 * distance**2 + a1 * distance + a0
                k_d[channel, i, column] = fraction[channel, row, column] * factor / np.cos(theta)
    return k_d


def compare_k_d(rig: Any, row_count: int) -> None:
    depth_mm, _ = noisy_plane(rig.depth)
    view = view_surface(depth_mm, rig)
    image = np.random.default_rng(2).integers(40, 200, (*rig.rgb.shape, 3)).astype(np.uint8)
    fraction = as_fraction(image)
    rows = range(480, 480 + row_count)
    start = time.perf_counter()
    literal = literal_k_d(fraction, view, rig, rows)
    literal_ms = 1e3 * (time.perf_counter() - start) * rig.rgb.shape[0] / row_count
    ours, valid = diffuse_reflectance(fraction, view, rig, "thesis")
    ours_ms = best_ms(lambda: diffuse_reflectance(fraction, view, rig, "thesis"))
    both = valid[rows.start : rows.stop]
    deviation = np.abs(ours[:, rows.start : rows.stop] / literal - 1)[:, both].max()
    print(f"K_d, 1280 × 960:    literal {literal_ms:,.0f} ms (scaled), ours {ours_ms:.1f} ms")
    print(f"                    ratio {literal_ms / ours_ms:,.0f}, greatest deviation {deviation:.1e}")
    print(f"register:           {best_ms(lambda: register(depth_mm, rig)):.1f} ms")
    print(f"view_surface:       {best_ms(lambda: view_surface(depth_mm, rig)):.1f} ms")


if __name__ == "__main__":
    scale = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    known = parse_rig(RIG, "benchmark rig")
    compare_normals(known, max(100, int(3000 * scale)))
    compare_k_d(known, max(1, int(8 * scale)))
