"""Map updates as bytes, whole or in parts, for the network and for recordings (`map.proto`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from surfclass import map_pb2
from surfclass.errors import InputError
from surfclass.types import MapUpdate
from surfclass.voxel_evidence import check_update

ENCODING = "application/protobuf;surfclass.v1.MapUpdate"
PART_BYTES = 64_000  # the transport drops by batches of 64 KiB; a part that fits one is lost or comes whole

_COLUMNS = {
    "index": np.dtype("<i4"),
    "colour": np.dtype("<f4"),
    "texture": np.dtype("<f4"),
    "weight": np.dtype("<f4"),
    "colour_count": np.dtype("<i4"),
    "texture_count": np.dtype("<i4"),
}


def voxels_per_part(classes: int) -> int:
    """Returns how many voxels of `classes` classes fit `PART_BYTES`."""
    return max(1, PART_BYTES // (24 + 8 * classes))


def encode_update(update: MapUpdate, part: int = 0, parts: int = 1) -> bytes:
    """Returns the update as a `surfclass.v1.MapUpdate`, by itself or as part `part` of `parts`."""
    columns = {
        name: np.ascontiguousarray(getattr(update, name), kind).tobytes() for name, kind in _COLUMNS.items()
    }
    message = map_pb2.MapUpdate(
        epoch=update.epoch,
        sequence=update.sequence,
        t_ns=update.t_ns,
        part=part,
        parts=parts,
        classes=update.colour.shape[1],
        voxels=len(update.index),
        **columns,
    )
    return message.SerializeToString(deterministic=True)


def encode_parts(update: MapUpdate) -> list[bytes]:
    """Returns the update as messages of at most about `PART_BYTES`."""
    pieces = split(update, voxels_per_part(update.colour.shape[1]))
    return [encode_update(piece, part, len(pieces)) for part, piece in enumerate(pieces)]


def decode_update(data: bytes, class_count: int) -> MapUpdate:
    """Returns the update that `encode_update` made these bytes of.

    Raises:
        InputError: If they are not a map update, or one of another number of classes, or a part of one.
    """
    update, part, parts = _decode(data, class_count)
    if parts != 1:
        raise InputError(f"map update {update.sequence}: part {part} of {parts}, needs the whole")
    return update


def split(update: MapUpdate, max_voxels: int) -> list[MapUpdate]:
    """Returns the update in pieces of at most `max_voxels` voxels, at least one.

    All pieces carry the update's own sequence number: a map's number then always counts its deltas,
    and a snapshot with number s contains every part of the deltas up to s, however they were split.
    """
    if max_voxels < 1:
        raise ValueError(f"max_voxels: {max_voxels}, needs at least 1")
    starts = range(0, max(len(update.index), 1), max_voxels)
    return [
        replace(update, **{name: getattr(update, name)[at : at + max_voxels] for name in _COLUMNS})
        for at in starts
    ]


def join(pieces: Sequence[MapUpdate]) -> MapUpdate:
    """Returns the update that `split` made the pieces of."""
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in _COLUMNS
    }
    return replace(pieces[0], **columns)


class Assembler:
    """Puts the messages of one sender together: in goes each message, out comes each whole update.

    The parts of an update may come in any order and more than once, but not mixed with another
    update's: the first message of another one drops what was incomplete. That loss shows as a missing
    sequence number.
    """

    def __init__(self, class_count: int) -> None:
        self._classes = class_count
        self._of: tuple[str, int, int] | None = None
        self._pieces: dict[int, MapUpdate] = {}

    def take(self, data: bytes) -> MapUpdate | None:
        """Returns the update that this message completes, or None.

        Raises:
            InputError: If the message is not a map update, or one of another number of classes.
        """
        update, part, parts = _decode(data, self._classes)
        of = (update.epoch, update.sequence, parts)
        if of != self._of:
            self._of, self._pieces = of, {}
        self._pieces[part] = update
        if len(self._pieces) < parts:
            return None
        whole = join([self._pieces[number] for number in range(parts)])
        self._of, self._pieces = None, {}
        return whole


def _decode(data: bytes, class_count: int) -> tuple[MapUpdate, int, int]:
    message = map_pb2.MapUpdate()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise InputError(f"map update: not a surfclass.v1.MapUpdate: {error}") from None
    if message.classes != class_count:
        raise InputError(f"map update: of {message.classes} classes, needs {class_count}")
    if message.part >= message.parts:
        raise InputError(f"map update: part {message.part} of {message.parts}")
    n = message.voxels
    shapes = {"index": (n, 3), "colour": (n, class_count), "texture": (n, class_count)}
    columns: dict[str, Any] = {}
    for name, kind in _COLUMNS.items():
        column, shape = getattr(message, name), shapes.get(name, (n,))
        if len(column) != math.prod(shape) * kind.itemsize:
            raise InputError(f"map update: {name} has {len(column)} bytes, which are not {n} voxels")
        columns[name] = np.frombuffer(column, kind).reshape(shape).astype(kind.newbyteorder("="), copy=False)
    update = MapUpdate(message.epoch, message.sequence, message.t_ns, **columns)
    check_update(update, class_count)
    return update, message.part, message.parts
