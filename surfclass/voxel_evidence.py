"""What one frame says about each voxel: the pixels' log-likelihoods summed or averaged by voxel."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float32, Int32, MapUpdate, Observation
from surfclass.voxel_index import VOXEL_LIMIT, Keys, pack, voxel_of

Update = Literal["frame", "independent"]

_EPOCH = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, slots=True, eq=False)
class VoxelEvidence:
    """What to add to the state of m voxels.

    Attributes:
        key: (m,) int64, sorted, as `voxel_index.pack` gives them.
        colour: (m, k) float32, log-likelihood; zero where `colour_count` is.
        texture: (m, k) float32, likewise.
        weight: (m,) float32, as much as `texture_count` observations have.
        colour_count: (m,) int32, observations.
        texture_count: (m,) int32, observations.
    """

    key: Keys
    colour: Float32
    texture: Float32
    weight: Float32
    colour_count: Int32
    texture_count: Int32


def voxel_evidence(observation: Observation, size_m: float, classes: int, update: Update) -> VoxelEvidence:
    """Returns a frame's evidence by voxel; voxels that neither route says anything about are left out.

    Neighbouring pixels mostly share a voxel, so the pixels are first summed over runs of equal
    voxels, and only the runs, some ten times fewer, are sorted.

    Args:
        observation: The frame.
        size_m: Side of a voxel.
        classes: k.
        update: "independent" sums over the pixels (Eq. 3.9); "frame" makes them one observation, the
            mean over the pixels, in which texture is multiplied by its weight first.

    Raises:
        InputError: If the observation is not as `Observation` says.
    """
    _check(observation, classes)
    groups = _Groups(pack(voxel_of(observation.point_base, size_m)))
    has_colour = observation.has_colour.astype(np.float32)
    has_texture = observation.has_texture.astype(np.float32)
    colour = groups.sum(observation.colour, has_colour)
    texture = groups.sum(observation.texture, observation.weight if update == "frame" else has_texture)
    # Looked for in the sums, where it is cheap: one number that is not finite spoils its sum.
    if not (np.isfinite(colour).all() and np.isfinite(texture).all()):
        raise InputError(
            "observation: a log-likelihood is not finite; clip evidence so that no class reaches 0"
        )
    weight = groups.sum(observation.weight)
    colour_count, texture_count = groups.sum(has_colour), groups.sum(has_texture)
    if update == "frame":
        pixels = np.maximum(texture_count, 1)
        colour /= np.maximum(colour_count, 1)[:, None]
        texture /= pixels[:, None]
        weight /= pixels
        colour_count, texture_count = np.minimum(colour_count, 1), np.minimum(texture_count, 1)
    said = np.flatnonzero((colour_count > 0) | (texture_count > 0))
    return VoxelEvidence(
        groups.key[said],
        colour[said],
        texture[said],
        weight[said],
        colour_count[said].astype(np.int32),
        texture_count[said].astype(np.int32),
    )


class _Groups:
    """Pixels grouped by voxel: runs of equal keys, then the runs of one voxel together.

    Sums are products with sparse matrices of ones or of factors, four times as fast here as
    `np.add.reduceat`, whose inner loop is only k numbers long.
    """

    def __init__(self, key: Keys) -> None:
        runs = _starts(key)
        of_run = key[runs]
        order = np.argsort(of_run, kind="stable")
        of_run = of_run[order]
        groups = _starts(of_run)
        self.key = of_run[groups]
        self._pixel = np.arange(len(key), dtype=np.int32)
        self._run_ends = np.append(runs, len(key)).astype(np.int32)
        self._run = order.astype(np.int32)
        self._group_ends = np.append(groups, len(order)).astype(np.int32)

    def sum(self, values: Float32, factor: Float32 | None = None) -> Float32:
        """Sums `values` (n, …) times `factor` (n,) by voxel: (m, …)."""
        from scipy.sparse import csr_array  # late: it takes longer to import than all else here

        ones = np.ones(len(self._pixel), np.float32)
        runs, groups = len(self._run), len(self.key)
        by_run = csr_array(
            (ones if factor is None else factor, self._pixel, self._run_ends), shape=(runs, len(ones))
        )
        by_voxel = csr_array((ones[:runs], self._run, self._group_ends), shape=(groups, runs))
        return np.asarray(by_voxel @ (by_run @ values), np.float32)


def _starts(key: Keys) -> NDArray[np.intp]:
    """Where a run of equal keys begins; nothing for no keys."""
    begins = np.ones(len(key), np.bool_)
    np.not_equal(key[1:], key[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def _check(observation: Observation, classes: int) -> None:
    n = len(observation.point_base)
    _shapes(
        "observation",
        observation,
        {
            "point_base": ((n, 3), np.floating),
            "colour": ((n, classes), np.float32),
            "texture": ((n, classes), np.float32),
            "has_colour": ((n,), np.bool_),
            "has_texture": ((n,), np.bool_),
            "weight": ((n,), np.float32),
        },
    )
    weight = observation.weight
    if n and not (weight.min() >= 0 and weight.max() <= 1):
        raise InputError("observation.weight: a value is outside [0, 1] or not a number")
    if weight[~observation.has_texture].any():
        raise InputError("observation.weight: not 0 where there is no texture")


def check_update(update: MapUpdate, classes: int) -> None:
    """Checks shapes, dtypes and ranges of an update that came from outside.

    Raises:
        InputError: Naming the field that is not as `MapUpdate` says.
    """
    n = len(update.index)
    if not _EPOCH.fullmatch(update.epoch):
        raise InputError(f"map update: epoch {update.epoch!r:.40} is not 32 hex digits")
    for name, number in (("sequence", update.sequence), ("t_ns", update.t_ns)):
        if not 0 <= number < 1 << 63:
            raise InputError(f"map update: {name} {number} is outside [0, 2^63)")
    _shapes(
        "map update",
        update,
        {
            "index": ((n, 3), np.int32),
            "colour": ((n, classes), np.float32),
            "texture": ((n, classes), np.float32),
            "weight": ((n,), np.float32),
            "colour_count": ((n,), np.int32),
            "texture_count": ((n,), np.int32),
        },
    )
    if n == 0:
        return
    if update.index.min() <= -VOXEL_LIMIT or update.index.max() >= VOXEL_LIMIT:
        raise InputError(f"map update: an index is outside ±{VOXEL_LIMIT - 1}")
    if not (np.isfinite(update.colour).all() and np.isfinite(update.texture).all()):
        raise InputError("map update: a log-likelihood is not finite")
    if not (np.isfinite(update.weight).all() and update.weight.min() >= 0):
        raise InputError("map update: a weight is negative or not finite")
    if update.colour_count.min() < 0 or update.texture_count.min() < 0:
        raise InputError("map update: a count is negative")


def _shapes(what: str, value: object, wanted: dict[str, tuple[tuple[int, ...], type[np.generic]]]) -> None:
    for name, (shape, kind) in wanted.items():
        array = getattr(value, name)
        if array.shape != shape or not np.issubdtype(array.dtype, kind):
            raise InputError(
                f"{what}.{name}: {array.dtype} of shape {array.shape}, needs {kind.__name__} of {shape}"
            )
