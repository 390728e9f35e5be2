"""The map: two layers of class evidence in voxels, updated frame by frame and fused when read."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import ConfigurationError, InputError
from surfclass.pooling import Pool, fuse, is_known, softmax
from surfclass.rig import SurfaceClasses
from surfclass.types import Float32, Int32, MapUpdate, Observation
from surfclass.voxel_evidence import Update, check_update, voxel_evidence
from surfclass.voxel_index import BrickDirectory, Keys, Slots, centre_of, check_size, pack, unpack, voxel_of

__all__ = ["MapLayers", "Pool", "Update", "VoxelMap", "centre_of", "fuse", "softmax", "voxel_of"]


@dataclass(frozen=True, slots=True, eq=False)
class MapLayers:
    """The class distributions of n voxels of k classes, as read from the map.

    Attributes:
        index: (n, 3) int32.
        p_colour: (n, k) float32, the colour layer; uniform where it has no observation.
        p_texture: (n, k) float32, the texture layer; uniform where it has no observation.
        p: (n, k) float32, both fused; a voxel seen by one route alone keeps that route's.
        weight: (n,) float32, mean value of the probability map; 0 where there is no texture.
        count: (n,) int32, observations (frames or pixels, as the map's update counts) of the layer
            that has more of them; 0 where the voxel was never seen.
    """

    index: Int32
    p_colour: Float32
    p_texture: Float32
    p: Float32
    weight: Float32
    count: Int32

    def label(self) -> NDArray[np.uint8]:
        """(n,): 1 + the index of the most probable class (Eq. 3.10), 0 where nothing is known."""
        best = self.p.argmax(axis=1).astype(np.uint8) + np.uint8(1)
        return np.where(is_known(self.p), best, np.uint8(0))


class VoxelMap:
    """The one mutable object; every method may be called from any thread.

    Both layers hold accumulated log-likelihoods (Eq. 3.9 in log space), shifted so that each row's
    best class is at 0: a constant a row cancels when the row is normalised (Eq. 3.10), and small
    numbers keep float32 exact where it matters.

    With update "frame" a voxel gets one observation a frame: the mean log-likelihood of its pixels in
    the colour layer, and in the texture layer the mean of weight times log-likelihood, so that the
    weight tempers the evidence. With "independent" every pixel counts by itself and texture is not
    weighted, which is Eq. 3.9 to the letter.

    Args:
        size_m: Side of a voxel.
        classes: The surface classes, in the order of the observations' columns.
        update: As above.
        epoch: Id of this life of the map, 32 hex digits; random if not given.
        made_with: Fingerprints of the rig (`surfclass.fingerprint`), by which a stale map is known.

    Raises:
        ConfigurationError: If the size or the kind of update cannot be.
    """

    def __init__(
        self,
        size_m: float,
        classes: SurfaceClasses,
        update: Update = "frame",
        *,
        epoch: str | None = None,
        made_with: Mapping[str, str] | None = None,
    ) -> None:
        if update not in get_args(Update):
            raise ConfigurationError(f"update: {update!r}, known are {', '.join(get_args(Update))}")
        self.size_m = check_size(size_m)
        self.classes = classes
        self.update: Update = update
        self.made_with = dict(made_with or {})
        self._lock = threading.RLock()
        self._start(uuid.uuid4().hex if epoch is None else epoch)

    def _start(self, epoch: str) -> None:
        self._epoch = epoch
        self._sequence = 0
        self._t_ns = 0
        self._directory = BrickDirectory()
        self._rows = _Rows.empty(64, len(self.classes.names))

    @property
    def epoch(self) -> str:
        """Id of this life of the map."""
        return self._epoch

    @property
    def sequence(self) -> int:
        """Number of the last delta in the map; 0 at first."""
        return self._sequence

    def __len__(self) -> int:
        return len(self._directory)

    def add(self, observation: Observation, t_ns: int) -> MapUpdate:
        """Adds what one frame says (Eq. 3.9) and returns the delta: the new state of the voxels it touched.

        Raises:
            InputError: If the observation is not as `Observation` says; the map is then as before.
        """
        evidence = voxel_evidence(observation, self.size_m, len(self.classes.names), self.update)
        with self._lock:
            slot = self._directory.find_or_add(evidence.key)
            self._rows = rows = self._rows.with_room(len(self._directory))
            rows.key[slot] = evidence.key
            for layer, extra in ((rows.colour, evidence.colour), (rows.texture, evidence.texture)):
                total = layer[slot] + extra
                layer[slot] = total - total.max(axis=1, keepdims=True)
            rows.weight[slot] += evidence.weight
            rows.colour_count[slot] += evidence.colour_count
            rows.texture_count[slot] += evidence.texture_count
            self._sequence += 1
            self._t_ns = max(self._t_ns, t_ns)
            return self._state(slot, t_ns)

    def apply(self, update: MapUpdate) -> bool:
        """Takes over the state of voxels from another map of the same size and classes.

        An update of another epoch starts the map from nothing; one that is older than the map's
        sequence number is contained in it already and is ignored. (Equal is not older: the parts of a
        split update share one number.) Whether a delta is missing in between is for the caller to
        watch.

        Returns:
            Whether the update was taken.

        Raises:
            InputError: If the update is not as `MapUpdate` says; the map is then as before.
        """
        check_update(update, len(self.classes.names))
        key = pack(update.index)
        if not (key[1:] > key[:-1]).all() and len(np.unique(key)) != len(key):
            raise InputError(f"map update {update.sequence}: holds a voxel twice")
        with self._lock:
            if update.epoch != self._epoch:
                self._start(update.epoch)
            elif update.sequence < self._sequence:
                return False
            slot = self._directory.find_or_add(key)
            self._rows = rows = self._rows.with_room(len(self._directory))
            rows.key[slot] = key
            rows.colour[slot] = update.colour
            rows.texture[slot] = update.texture
            rows.weight[slot] = update.weight
            rows.colour_count[slot] = update.colour_count
            rows.texture_count[slot] = update.texture_count
            self._sequence = update.sequence
            self._t_ns = max(self._t_ns, update.t_ns)
            return True

    def snapshot(self) -> MapUpdate:
        """Returns the state of all voxels, sorted by index: the same map gives the same arrays."""
        with self._lock:
            return self._state(np.argsort(self._rows.key[: len(self)]).astype(np.int32), self._t_ns)

    def _state(self, slot: Slots, t_ns: int) -> MapUpdate:
        rows = self._rows
        return MapUpdate(
            epoch=self._epoch,
            sequence=self._sequence,
            t_ns=t_ns,
            index=unpack(rows.key[slot]),
            colour=rows.colour[slot],
            texture=rows.texture[slot],
            weight=rows.weight[slot],
            colour_count=rows.colour_count[slot],
            texture_count=rows.texture_count[slot],
        )

    def fused(self, pool: Pool = "log-linear") -> MapLayers:
        """Returns both layers and the fused map of all voxels, sorted by index.

        For the pools see `pooling.fuse`. The weight is the voxel's mean; with update "frame" it is in
        the texture layer's evidence already, and "log-linear" does not apply it again.

        Raises:
            ConfigurationError: If there is no such pool.
        """
        return self._layers(self.snapshot(), pool)

    def at(self, index: NDArray[np.integer], pool: Pool = "log-linear") -> MapLayers:
        """Returns the layers of the voxels asked for, in that order; uniform where nothing was seen.

        Args:
            index: (n, 3) voxels, as `voxel_of` gives them.
            pool: As for `fused`.

        Raises:
            ConfigurationError: If there is no such pool.
            InputError: If an index is out of range.
        """
        # Through voxel_of, so that range and shape are checked in one place.
        asked = voxel_of(np.asarray(index, dtype=np.float64), 1.0).reshape(-1, 3)
        with self._lock:
            slot = self._directory.find(pack(asked))
            seen = slot >= 0
            state = self._state(slot[seen], self._t_ns)
        whole = _Rows.empty(len(asked), len(self.classes.names))
        for name in ("colour", "texture", "weight", "colour_count", "texture_count"):
            getattr(whole, name)[seen] = getattr(state, name)
        return self._layers(
            MapUpdate(
                state.epoch,
                state.sequence,
                state.t_ns,
                asked,
                whole.colour,
                whole.texture,
                whole.weight,
                whole.colour_count,
                whole.texture_count,
            ),
            pool,
        )

    def _layers(self, state: MapUpdate, pool: Pool) -> MapLayers:
        weight = np.divide(state.weight, np.maximum(state.texture_count, 1), dtype=np.float32)
        p = fuse(
            state.colour,
            state.texture,
            state.colour_count > 0,
            state.texture_count > 0,
            weight,
            pool,
            texture_is_weighted=self.update == "frame",
        )
        count = np.maximum(state.colour_count, state.texture_count)
        return MapLayers(state.index, softmax(state.colour), softmax(state.texture), p, weight, count)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The voxels' state in columns with room to grow; which row is whose, the directory knows."""

    key: Keys
    colour: Float32
    texture: Float32
    weight: Float32
    colour_count: Int32
    texture_count: Int32

    @classmethod
    def empty(cls, rows: int, classes: int) -> _Rows:
        return cls(
            key=np.zeros(rows, np.int64),
            colour=np.zeros((rows, classes), np.float32),
            texture=np.zeros((rows, classes), np.float32),
            weight=np.zeros(rows, np.float32),
            colour_count=np.zeros(rows, np.int32),
            texture_count=np.zeros(rows, np.int32),
        )

    def with_room(self, rows: int) -> _Rows:
        """Returns itself, or a copy at least twice as long whose new rows are zero."""
        if rows <= len(self.key):
            return self
        grown = _Rows.empty(max(rows, 2 * len(self.key)), self.colour.shape[1])
        for name in self.__slots__:
            getattr(grown, name)[: len(self.key)] = getattr(self, name)
        return grown
