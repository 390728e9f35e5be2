"""Small maps and observations for the tests of the map, its wire format, its file and its publisher."""

from __future__ import annotations

import numpy as np

from surfclass.rig import SurfaceClasses
from surfclass.types import MapUpdate, Observation

CLASSES = SurfaceClasses(
    names=("rusted", "painted", "timber", "blasted", "concrete"),
    colours=("#b7410e", "#3060a0", "#a07040", "#909090", "#c0c0b0"),
)
K = len(CLASSES.names)
SIZE_M = 0.01
COLUMNS = ("index", "colour", "texture", "weight", "colour_count", "texture_count")


def observe(points: int, seed: int, extent_m: float = 0.1, missing: float = 0.2) -> Observation:
    """A frame of random evidence at points round the origin, some seen by one route or by none."""
    random = np.random.default_rng(seed)
    has_colour, has_texture = random.random((2, points)) >= missing
    colour, texture = np.log(random.dirichlet(np.full(K, 0.5), (2, points)) + 1e-3).astype(np.float32)
    return Observation(
        point_base=random.uniform(-extent_m, extent_m, (points, 3)).astype(np.float32),
        colour=colour * has_colour[:, None],
        texture=texture * has_texture[:, None],
        has_colour=has_colour,
        has_texture=has_texture,
        weight=random.random(points, np.float32) * has_texture,
    )


def one_voxel(colour: object = None, texture: object = None, weight: object = 0.0) -> Observation:
    """Pixels of one voxel: (n, k) log-likelihoods of either route or of both."""
    n = len(np.asarray(colour if colour is not None else texture))
    nothing = np.zeros((n, K), np.float32)
    return Observation(
        point_base=np.full((n, 3), 0.005, np.float32),
        colour=nothing if colour is None else np.asarray(colour, np.float32),
        texture=nothing if texture is None else np.asarray(texture, np.float32),
        has_colour=np.full(n, colour is not None),
        has_texture=np.full(n, texture is not None),
        weight=np.broadcast_to(np.float32(weight), n) * np.float32(texture is not None),
    )


def assert_same(left: MapUpdate, right: MapUpdate) -> None:
    """Bit for bit, the numbers and the arrays."""
    assert (left.epoch, left.sequence, left.t_ns) == (right.epoch, right.sequence, right.t_ns)
    for name in COLUMNS:
        a, b = getattr(left, name), getattr(right, name)
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes(), name
