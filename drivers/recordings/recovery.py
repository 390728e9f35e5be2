"""Makes a whole recording of one that was never finished, was cut off or is damaged."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from drivers.recordings.file import ACTIVE, RecordingFile, check_digests, own_keys
from drivers.recordings.format import CAPTURE, IMAGES, JOINTS, MAP, MAP_SCHEMA, Entry, parse_record
from drivers.recordings.reader import RECORD_LIMIT, Recording, check_is_mcap, check_record, reading
from surfclass.errors import InputError

_PARTS = {JOINTS, *(f"/{kind}" for kind in IMAGES)}


def recover(path: str | Path) -> Path:
    """Saves every capture and map update that is whole, and returns the new recording's path.

    `X.mcap.active` becomes `X.mcap` and is deleted then; any other `X.mcap` is left alone and becomes
    `X.recovered.mcap`.

    Raises:
        InputError: If the file is still being written, is no recording, broke off before its rig was
            written, or the new recording's name is taken.
        OSError: If the disk refuses.
    """
    path = Path(path)
    is_active = path.suffix == ACTIVE
    target = path.with_suffix("") if is_active else path.with_suffix(f".recovered{path.suffix}")
    if target.exists():
        raise InputError(f"{target}: already there; move it away, then recover {path} again")
    with reading(path) as file:
        _refuse_if_written(path, file)
        check_is_mcap(path, file)
        file.seek(0)
        salvage = _Salvage(path, target)
        try:
            for record in _records(file):
                salvage.take(record)
            salvage.finish()
        except BaseException:
            salvage.discard()
            raise
    Recording.open(target)
    if is_active:
        path.unlink()
    return target


def _refuse_if_written(path: Path, file: IO[bytes]) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"{path}: is being written; stop its writer first") from None


class _Salvage:
    """What has been read so far, and the file that whole captures go to."""

    def __init__(self, path: Path, target: Path) -> None:
        self._path, self._target = path, target
        self._records: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, bytes] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._parts: list[Entry] = []
        self._out: RecordingFile | None = None

    def take(self, record: McapRecord) -> None:
        """Uses one record of the damaged file, in its order."""
        if isinstance(record, Metadata):
            self._records[record.name] = record.metadata
        elif isinstance(record, Attachment):
            self._attachments[record.name] = record.data
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message) and record.channel_id in self._channels:
            channel = self._channels[record.channel_id]
            schema = self._schemas.get(channel.schema_id)
            if schema is not None:
                self._message(channel.topic, schema, record)

    def finish(self) -> None:
        """Completes the new file."""
        self._begun().finish()

    def discard(self) -> None:
        """Leaves nothing of the new file."""
        if self._out is not None:
            self._out.discard()

    def _message(self, topic: str, schema: Schema, message: Message) -> None:
        entry = Entry(topic, schema.name, message.log_time, message.sequence, message.data)
        if topic in _PARTS:
            self._parts.append(entry)
        elif topic == MAP and schema.name == MAP_SCHEMA:
            out = self._begun()
            out.add_schema(MAP_SCHEMA, schema.encoding, schema.data)
            out.append([entry])
        elif topic == CAPTURE:
            own = [part for part in self._parts if part.sequence == entry.sequence]
            if _is_whole(entry, own, str(self._path)):
                self._begun().append([*own, entry])
            self._parts = []

    def _begun(self) -> RecordingFile:
        if self._out is None:
            record = check_record(self._records, (), self._path)
            check_digests(record, self._attachments, str(self._path))
            partial = self._target.with_name(self._target.name + ".recovering")
            partial.unlink(missing_ok=True)  # of a recovery that was killed
            self._out = RecordingFile(self._target, partial, own_keys(record), self._attachments)
        return self._out


def _is_whole(closing: Entry, parts: list[Entry], source: str) -> bool:
    try:
        record = parse_record(closing.data, source)
    except InputError:
        return False
    needed = {f"/{kind}" for kind in record.images} | ({JOINTS} if record.joints is not None else set())
    return needed == {part.topic for part in parts}


def _records(file: IO[bytes]) -> Iterator[McapRecord]:
    """The records up to where the file breaks off; a chunk that is damaged is left out.

    The parsers raise anything from struct.error to RuntimeError on damaged bytes, and each of them
    means the same here.
    """
    with contextlib.suppress(Exception):
        for record in StreamReader(file, emit_chunks=True, record_size_limit=RECORD_LIMIT).records:
            if not isinstance(record, Chunk):
                yield record
                continue
            inside: list[McapRecord] = []
            with contextlib.suppress(Exception):
                inside = breakup_chunk(record, validate_crc=True)
            yield from inside
