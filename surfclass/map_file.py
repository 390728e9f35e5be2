"""The map file: what a `.npz` of a fused map holds, as bytes that are the same for the same map."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.pooling import Pool
from surfclass.types import Float32, Int32
from surfclass.voxel_map import MapLayers, VoxelMap

_DATE = (1980, 1, 1, 0, 0, 0)  # the earliest a zip can hold; a file's date must not change its bytes
# What numpy and zipfile raise on bytes that are no such file, or a damaged, encrypted or pickled one.
_DAMAGED = (
    ValueError,
    OSError,
    EOFError,
    KeyError,
    RuntimeError,
    SyntaxError,
    MemoryError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
_ARRAYS = ("voxel_size_m", "classes", "index", "p_colour", "p_texture", "p", "weight", "count")


@dataclass(frozen=True, slots=True, eq=False)
class MapFile:
    """A map as read from its file.

    Attributes:
        voxel_size_m: Side of a voxel.
        classes: The class names in the order of the layers' columns.
        colours: What each is drawn in, `#rrggbb`; None where the file does not say.
        made_with: Fingerprints of the rig that it was made with, by part; empty where the file does not say.
        layers: The voxels, sorted by index.
    """

    voxel_size_m: float
    classes: tuple[str, ...]
    layers: MapLayers
    colours: tuple[str, ...] | None = None
    made_with: Mapping[str, str] = field(default_factory=dict)

    def at(self, index: Int32) -> MapLayers:
        """Returns the layers of the voxels asked for, (n, 3), in that order; uniform where there is none."""
        rows = {voxel: row for row, voxel in enumerate(map(tuple, self.layers.index.tolist()))}
        found = np.array([rows.get(voxel, -1) for voxel in map(tuple, index.tolist())], np.intp)
        seen = found >= 0

        def of(values: NDArray[Any], absent: float) -> NDArray[Any]:
            picked = np.full((len(index), *values.shape[1:]), absent, values.dtype)
            picked[seen] = values[found[seen]]
            return picked

        nothing, layers = 1 / len(self.classes), self.layers
        return MapLayers(
            index=index,
            p_colour=of(layers.p_colour, nothing),
            p_texture=of(layers.p_texture, nothing),
            p=of(layers.p, nothing),
            weight=of(layers.weight, 0),
            count=of(layers.count, 0),
        )


def to_npz_bytes(voxels: VoxelMap, pool: Pool = "log-linear") -> bytes:
    """Returns the map as an `.npz` without pickles; the same map gives the same bytes.

    Its arrays are `voxel_size_m` (), `classes` and `colours` (k,) text, `index` (n, 3) int32, `p_colour`,
    `p_texture`, `p` (n, k) float32, `weight` (n,) float32, `count` (n,) int32, and `made_with` (m, 2) text:
    parts of the rig and their fingerprints.

    Raises:
        ConfigurationError: If there is no such pool.
    """
    layers = voxels.fused(pool)
    arrays: dict[str, NDArray[Any]] = {
        "voxel_size_m": np.array(voxels.size_m),
        "classes": np.array(voxels.classes.names),
        "colours": np.array(voxels.classes.colours),
        "made_with": np.array(sorted(voxels.made_with.items()), np.str_).reshape(-1, 2),
        **{name: getattr(layers, name) for name in _ARRAYS[2:]},
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=_DATE)
            entry.create_system = 3  # else it is the writing machine's
            entry.external_attr = 0o644 << 16
            with archive.open(entry, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return file.getvalue()


def from_npz_bytes(data: bytes, source: str) -> MapFile:
    """Returns the map that an `.npz` file's bytes hold.

    Args:
        data: The file.
        source: What to call it in a message, usually its path.

    Raises:
        InputError: If it is not such a file, naming the array that is missing or wrong.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise InputError(f"{source}: not a map file (a single array)")
            arrays = {name: archive[name] for name in (*_ARRAYS, "colours", "made_with") if name in archive}
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(f"{source}: not a map file: {error}") from None
    missing = [name for name in _ARRAYS if name not in arrays]
    if missing:
        raise InputError(f"{source}: not a map file: lacks {', '.join(missing)}")
    names, index = arrays["classes"], arrays["index"]
    n, k = len(index) if index.ndim else 0, len(names) if names.ndim else 0
    wanted: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
        "voxel_size_m": ((), np.floating),
        "classes": ((k,), np.str_),
        "index": ((n, 3), np.int32),
        "p_colour": ((n, k), np.float32),
        "p_texture": ((n, k), np.float32),
        "p": ((n, k), np.float32),
        "weight": ((n,), np.float32),
        "count": ((n,), np.int32),
    }
    for name, (shape, kind) in wanted.items():
        array = arrays[name]
        if array.shape != shape or not np.issubdtype(array.dtype, kind):
            raise InputError(
                f"{source}: {name} is {array.dtype} of shape {array.shape}, needs {kind.__name__} of {shape}"
            )
    size_m = float(arrays["voxel_size_m"])
    if not (np.isfinite(size_m) and size_m > 0 and k):
        raise InputError(
            f"{source}: voxel_size_m is {size_m:g} and there are {k} classes; both must be positive"
        )
    colours = arrays.get("colours")
    if colours is not None and (colours.shape != (k,) or not np.issubdtype(colours.dtype, np.str_)):
        raise InputError(
            f"{source}: colours is {colours.dtype} of shape {colours.shape}, needs str_ of ({k},)"
        )
    made_with = arrays.get("made_with", np.empty((0, 2), np.str_))
    if made_with.ndim != 2 or made_with.shape[1] != 2 or not np.issubdtype(made_with.dtype, np.str_):
        raise InputError(
            f"{source}: made_with is {made_with.dtype} of shape {made_with.shape}, needs str_ of (m, 2)"
        )
    layers: dict[str, Float32] = {name: arrays[name] for name in ("p_colour", "p_texture", "p", "weight")}
    return MapFile(
        size_m,
        tuple(str(name) for name in names),
        MapLayers(index=index, count=arrays["count"], **layers),
        None if colours is None else tuple(str(colour) for colour in colours),
        {str(part): str(digest) for part, digest in made_with},
    )
