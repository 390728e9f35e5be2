"""Which voxel a point lies in, and which row is its: a directory that does not slow down as it grows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import ConfigurationError, InputError
from surfclass.types import Float64, Int32

VOXEL_LIMIT = 1 << 20  # |index| stays below it, so that three indices fit one 64-bit key

_FIELD = 21  # bits of one biased index inside a key
_MASK = (1 << _FIELD) - 1
_BRICK = 2  # bits: bricks of 4³ cells; 8³ ones are mostly air round a surface and take twice the memory
_CELLS = 1 << (3 * _BRICK)
_LOW = (1 << _BRICK) - 1
_LOW_BITS = (_LOW << (2 * _FIELD)) | (_LOW << _FIELD) | _LOW

Keys = NDArray[np.int64]
Slots = NDArray[np.int32]


def voxel_of(point: NDArray[Any], size_m: float) -> Int32:
    """Returns the voxels that points lie in, `floor(p / mu)` (Eq. 3.9; its printed example is wrong).

    Args:
        point: (…, 3), m, in the map's frame.
        size_m: Side of a voxel, mu.

    Returns:
        (…, 3) int32.

    Raises:
        ConfigurationError: If `size_m` is not a positive number.
        InputError: If a point is not finite or lies `VOXEL_LIMIT` voxels or more from the origin.
    """
    size_m = check_size(size_m)
    point = np.asarray(point)
    if point.ndim == 0 or point.shape[-1] != 3:
        raise InputError(f"points: shape {point.shape}, needs (…, 3)")
    cell: Float64 = np.divide(point, size_m, dtype=np.float64)
    np.floor(cell, out=cell)
    # Written so that a NaN fails as well; the index -VOXEL_LIMIT is left out for symmetry.
    if cell.size and not (cell.min() > -VOXEL_LIMIT and cell.max() < VOXEL_LIMIT):
        raise InputError(
            f"points: a coordinate is not finite or lies beyond ±{VOXEL_LIMIT * size_m:g} m "
            f"(2^20 voxels of {size_m:g} m)"
        )
    index: Int32 = cell.astype(np.int32)
    return index


def centre_of(index: NDArray[Any], size_m: float) -> Float64:
    """Returns the centres of voxels, `(index + 0.5) * mu`: (…, 3) m, of indices (…, 3).

    Raises:
        ConfigurationError: If `size_m` is not a positive number.
    """
    centre: Float64 = (np.asarray(index, dtype=np.float64) + 0.5) * check_size(size_m)
    return centre


def check_size(size_m: float) -> float:
    """Returns `size_m` if a voxel can have that side.

    Raises:
        ConfigurationError: If it is not a positive finite number.
    """
    if not (np.isfinite(size_m) and size_m > 0):
        raise ConfigurationError(f"voxel_size_m: must be a positive number of metres, got {size_m!r}")
    return float(size_m)


def pack(index: Int32) -> Keys:
    """Returns one key for each voxel, (n,) int64; keys sort as (x, y, z) does. Indices must be in range."""
    key = index[:, 0].astype(np.int64)
    key += VOXEL_LIMIT
    for axis in (1, 2):
        key <<= _FIELD
        key += index[:, axis]
        key += VOXEL_LIMIT
    return key


def unpack(key: Keys) -> Int32:
    """Returns the voxels of `key`, (n, 3) int32."""
    index = np.empty((len(key), 3), np.int32)
    for axis in range(3):
        index[:, axis] = ((key >> ((2 - axis) * _FIELD)) & _MASK) - VOXEL_LIMIT
    return index


class BrickDirectory:
    """Numbers voxels 0, 1, 2 … in the order in which they are first seen.

    A dictionary finds the brick, an array inside the brick the voxel. So a look-up costs the same in
    a map of 10^5 voxels and of 10^7, and nothing is ever moved (a sorted array would be, at 0.9 s a
    frame for 10^7 voxels).
    """

    def __init__(self) -> None:
        self._row: dict[int, int] = {}
        self._cell = np.empty((16, _CELLS), np.int32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def find(self, key: Keys) -> Slots:
        """Returns the number of each voxel, (n,) int32, -1 where it was never added."""
        brick, inverse = np.unique(key & ~_LOW_BITS, return_inverse=True)
        row = np.array([self._row.get(name, -1) for name in brick.tolist()], np.int64)[inverse]
        return np.where(row < 0, np.int32(-1), self._cell[row, _cell_of(key)])

    def find_or_add(self, key: Keys) -> Slots:
        """Returns the number of each voxel, (n,) int32; those not seen yet get the next numbers in order.

        `key` must not hold a voxel twice.
        """
        brick, inverse = np.unique(key & ~_LOW_BITS, return_inverse=True)
        known = len(self._row)
        row_of_brick = [self._row.setdefault(name, len(self._row)) for name in brick.tolist()]
        self._reserve(len(self._row))
        self._cell[known : len(self._row)] = -1
        row, cell = np.array(row_of_brick, np.int64)[inverse], _cell_of(key)
        slot = self._cell[row, cell]
        new = np.flatnonzero(slot < 0)
        slot[new] = np.arange(self._count, self._count + len(new), dtype=np.int32)
        self._cell[row[new], cell[new]] = slot[new]
        self._count += len(new)
        return slot

    def _reserve(self, rows: int) -> None:
        if rows > len(self._cell):
            grown = np.empty((max(rows, 2 * len(self._cell)), _CELLS), np.int32)
            grown[: len(self._cell)] = self._cell
            self._cell = grown


def _cell_of(key: Keys) -> Keys:
    x, y, z = (key >> (2 * _FIELD)) & _LOW, (key >> _FIELD) & _LOW, key & _LOW
    cell: Keys = (((x << _BRICK) | y) << _BRICK) | z
    return cell
