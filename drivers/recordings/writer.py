"""Writes captures and map updates into a recording."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from drivers.recordings.board import parse_board
from drivers.recordings.file import ACTIVE, RecordingFile
from drivers.recordings.format import BOARD, CLASSES, MAP, MAP_SCHEMA, PLATE, RIG, Entry, capture_entries
from drivers.recordings.plate import parse_plate
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture
from surfclass.rig import parse_classes, parse_depth_rig

_NO_METADATA: Mapping[str, str] = {}
_NO_IMAGES: Mapping[str, bytes] = {}
OFFSET = "unix_offset_ns"


def unix_offset_ns() -> int:
    """What to add to CLOCK_MONOTONIC to get Unix time, ns, as of now."""
    before = time.monotonic_ns()
    unix = time.time_ns()
    return unix - (before + time.monotonic_ns()) // 2


class RecordingWriter:
    """A recording that is being written, as PATH.active until it is closed.

    A kill loses at most the capture that was being written; `recover` makes a recording of the rest.
    The same captures, texts and offset give the same bytes. As a context manager it closes, and so
    keeps what was recorded, on an exception too.

    Args:
        path: Where the finished recording will be; one that is there is replaced at close().
        rig_text: `rig.toml`.
        classes_text: `classes.toml`, or None where the captures have no labels.
        metadata: Anything that should travel with it: robot, software version, source.
        plate_text: `plate.toml`, for hand-eye captures.
        board_text: `board.toml`, for board captures.
        unix_offset_ns: What takes the captures' times to Unix time; 0 leaves them, for imported sets.
        map_schema: The serialised FileDescriptorSet of `surfclass.v1.MapUpdate`; None: no updates.

    Raises:
        ConfigurationError: If a text is not valid.
        InputError: If the folder is missing, or another recording of this name is unfinished.
        OSError: If the disk refuses.
    """

    def __init__(
        self,
        path: str | Path,
        rig_text: str,
        classes_text: str | None,
        metadata: Mapping[str, str] = _NO_METADATA,
        *,
        plate_text: str | None = None,
        board_text: str | None = None,
        unix_offset_ns: int = 0,
        map_schema: bytes | None = None,
    ) -> None:
        self.path = Path(path)
        self._rig = parse_depth_rig(rig_text, f"{self.path}: {RIG}")
        texts = {RIG: rig_text}
        self._highest_label: int | None = None
        if classes_text is not None:
            self._highest_label = len(parse_classes(classes_text, f"{self.path}: {CLASSES}").names)
            texts[CLASSES] = classes_text
        if plate_text is not None:
            parse_plate(plate_text, f"{self.path}: {PLATE}")
            texts[PLATE] = plate_text
        if board_text is not None:
            parse_board(board_text, f"{self.path}: {BOARD}")
            texts[BOARD] = board_text
        for key in metadata:
            if key in (OFFSET, "schema") or key.startswith("sha256"):
                raise ConfigurationError(f"{self.path}: the metadata key {key!r} is the recording's own")
        self._offset = unix_offset_ns
        self._has_map_schema = map_schema is not None
        self._names: set[str] = set()
        self._updates = 0
        self._file = RecordingFile(
            self.path,
            self.path.with_name(self.path.name + ACTIVE),
            {**metadata, OFFSET: str(unix_offset_ns)},
            {name: text.encode() for name, text in texts.items()},
        )
        if map_schema is not None:
            self._file.add_schema(MAP_SCHEMA, "protobuf", map_schema)

    def __len__(self) -> int:
        return len(self._names)

    def write(self, capture: Capture, encoded: Mapping[str, bytes] | None = None) -> None:
        """Appends one capture.

        Args:
            capture: What was seen.
            encoded: PNG or JPEG bytes by kind ("colour", "dark", "depth", "ir", "label") that are kept
                as they are; other images are stored raw.

        Raises:
            InputError: If the capture does not fit the rig and the classes, its name was used, or
                `encoded` has other pixels. Nothing is written, and more can be.
            OSError: If the disk refuses; what was written stays, and nothing more can be written.
        """
        self._rig.check(capture)
        if capture.name in self._names:
            raise InputError(f"capture {capture.name}: {self.path} has one of that name")
        if capture.label is not None:
            self._check_label(capture.name, int(capture.label.max(initial=0)))
        sequence = len(self._names) + 1
        entries = capture_entries(capture, sequence, self._offset, encoded or _NO_IMAGES)
        self._file.append(entries)
        self._names.add(capture.name)

    def write_update(self, data: bytes, t_ns: int) -> None:
        """Appends one encoded `surfclass.v1.MapUpdate`, of the time `t_ns` (CLOCK_MONOTONIC).

        Raises:
            ConfigurationError: If the recording was begun without `map_schema`.
            OSError: As `write`.
        """
        if not self._has_map_schema:
            raise ConfigurationError(f"{self.path}: map updates need map_schema when the recording begins")
        entry = Entry(MAP, MAP_SCHEMA, t_ns + self._offset, self._updates + 1, data)
        self._file.append([entry])
        self._updates += 1

    def sync(self) -> None:
        """Waits until everything is on the disk; for when captures pause (a write syncs once a second)."""
        self._file.sync()

    def close(self) -> None:
        """Finishes the recording and gives it its name; after a disk error it only lets go of the file.

        Raises:
            OSError: If the disk refuses; what was written stays as PATH.active.
        """
        if self._file.is_open:
            self._file.finish()

    def discard(self) -> None:
        """Deletes what was written, as when an import fails halfway."""
        self._file.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check_label(self, name: str, highest: int) -> None:
        if self._highest_label is None:
            raise InputError(f"capture {name}: has a label image, but the recording has no {CLASSES}")
        if highest > self._highest_label:
            raise InputError(f"capture {name}: label {highest}, allowed are 0 to {self._highest_label}")
