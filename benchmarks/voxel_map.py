"""Times a frame of 1.1 million pixels into maps of 10⁴ to 10⁶ voxels, and what a console does with it.

Run it from the project's folder: `python -m benchmarks.voxel_map`. The alternative is what numpy offers for
summing by voxel: `np.unique` over all pixels, then `np.add.at`.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from surfclass.rig import SurfaceClasses
from surfclass.types import Observation
from surfclass.voxel_map import VoxelMap, voxel_of
from surfclass.wire import decode_update, encode_update

SIZE_M = 0.01
CLASSES = SurfaceClasses(names=("a", "b", "c", "d", "e"), colours=("#808080",) * 5)
K = len(CLASSES.names)


def best_ms(call: Callable[[], object], repeats: int = 7) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def frame(height: int = 960, width: int = 1152) -> Observation:
    """A wavy wall at 0.9 m with a millimetre of noise, both routes nearly everywhere."""
    random = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    z = 0.9 + 0.05 * np.sin(u / 300) + random.normal(0, 0.001, u.shape)
    point = np.stack([(u - width / 2) / 1100 * z, (v - height / 2) / 1100 * z, z], axis=-1).reshape(-1, 3)
    n = len(point)
    has = random.random(n) > 0.05
    colour, texture = random.normal(size=(2, n, K)).astype(np.float32) * has[:, None]
    return Observation(
        point.astype(np.float32), colour, texture, has, has, random.random(n, np.float32) * has
    )


def wall(voxels: int) -> Observation:
    """One point in each of about `voxels` voxels of a surface."""
    side = np.arange(int(voxels**0.5))
    x, y = np.meshgrid(side, side)
    point = (np.stack([x, y, 80 + 3 * np.sin(x / 40)], axis=-1).reshape(-1, 3) + 0.5) * SIZE_M
    n = len(point)
    nothing, yes = np.zeros((n, K), np.float32), np.ones(n, bool)
    return Observation(point.astype(np.float32), nothing, nothing, yes, ~yes, np.zeros(n, np.float32))


def by_unique(observation: Observation) -> None:
    index = voxel_of(observation.point_base, SIZE_M)
    found, inverse = np.unique(index, axis=0, return_inverse=True)
    for values in (observation.colour, observation.texture * observation.weight[:, None]):
        np.add.at(np.zeros((len(found), K), np.float32), inverse, values)


def main() -> None:
    one = frame()
    literal = best_ms(lambda: by_unique(one), 2)
    print(f"{len(one.point_base):,} pixels, {K} classes, two layers; unique + add.at alone: {literal:.0f} ms")
    for size in (10**4, 10**5, 10**6):
        voxels = VoxelMap(SIZE_M, CLASSES)
        voxels.add(wall(size), 0)
        add = best_ms(lambda voxels=voxels: voxels.add(one, 1))
        snapshot = voxels.snapshot()
        data = encode_update(snapshot)
        take = best_ms(lambda voxels=voxels: voxels.snapshot())
        encode = best_ms(lambda snapshot=snapshot: encode_update(snapshot))
        decode = best_ms(lambda data=data: decode_update(data, K))
        apply = best_ms(lambda snapshot=snapshot: VoxelMap(SIZE_M, CLASSES).apply(snapshot))
        fused = best_ms(lambda voxels=voxels: voxels.fused(), 3)
        print(
            f"{len(voxels):>9,} voxels: add {add:.0f} ms (1/{literal / add:.0f}), snapshot {take:.1f}, "
            f"encode {encode:.1f}, decode {decode:.1f}, apply {apply:.1f}, fuse {fused:.0f} ms"
        )


if __name__ == "__main__":
    main()
