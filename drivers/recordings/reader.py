"""Reads recordings, one capture in memory at a time; whatever is wrong with a file is an InputError."""

from __future__ import annotations

import contextlib
import errno
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from drivers.recordings.board import Board, parse_board
from drivers.recordings.file import ACTIVE, check_digests, own_keys
from drivers.recordings.format import (
    BOARD,
    CAPTURE,
    CAPTURE_SCHEMA,
    CLASSES,
    COMPRESSED,
    IMAGES,
    JOINT_STATES,
    JOINTS,
    MAP,
    MAP_SCHEMA,
    METADATA,
    PLATE,
    RAW,
    RIG,
    SCHEMA,
    Entry,
    capture_from,
    parse_record,
)
from drivers.recordings.plate import Plate, parse_plate
from drivers.recordings.writer import OFFSET
from surfclass.errors import InputError
from surfclass.frames import ROLES, Capture
from surfclass.rig import DepthRig, Rig, SurfaceClasses, parse_classes, parse_depth_rig

RECORD_LIMIT = 1 << 30
_RECORD_HEAD = 1 + 8  # opcode and length
_IMAGE_TOPICS = tuple(f"/{kind}" for kind in IMAGES)
_ALLOWED = {
    **dict.fromkeys(_IMAGE_TOPICS, (RAW, COMPRESSED)),
    JOINTS: (JOINT_STATES,),
    CAPTURE: (CAPTURE_SCHEMA,),
    MAP: (MAP_SCHEMA,),
}


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A finished recording; open it with `Recording.open`. It keeps no file open between calls.

    Attributes:
        path: The file.
        rig_text: `rig.toml` as it was.
        depth_rig: What it says; a `Rig` unless it leaves out the colour camera or where that is.
        classes_text: `classes.toml` as it was, or None.
        classes: What it says, or None.
        plate_text: `plate.toml` as it was, or None.
        plate: What it says, or None.
        board_text: `board.toml` as it was, or None.
        board: What it says, or None.
        metadata: The writer's keys.
        unix_offset_ns: What takes the captures' times to Unix time.
        count: Number of captures.
    """

    path: Path
    rig_text: str
    depth_rig: DepthRig
    classes_text: str | None
    classes: SurfaceClasses | None
    plate_text: str | None
    plate: Plate | None
    board_text: str | None
    board: Board | None
    metadata: Mapping[str, str]
    unix_offset_ns: int
    count: int

    @classmethod
    def open(cls, path: str | Path) -> Recording:
        """Returns the recording after checking everything but the captures themselves.

        Raises:
            InputError: If there is no such file, or it is empty, unfinished, cut off, damaged, not MCAP,
                of another program, or of an unknown schema; the message says which and what to do.
        """
        path = Path(path)
        with reading(path) as file:
            check_is_finished(path, file)
            reader = _reader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise InputError(f"{path}: has no index; run `surfclass recover {path}`")
            records = {record.name: record.metadata for record in reader.iter_metadata()}
            topics = {channel.topic for channel in summary.channels.values()}
            record = check_record(records, topics, path)
            attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
            check_digests(record, attachments, str(path))
            schemas = {number: schema.name for number, schema in summary.schemas.items()}
            _check_channels(path, summary.channels.values(), schemas)
            counts = summary.statistics.channel_message_counts
            closing = [number for number, channel in summary.channels.items() if channel.topic == CAPTURE]
            texts = {
                name: attachments[name].decode()
                for name in (RIG, CLASSES, PLATE, BOARD)
                if name in attachments
            }
            classes, plate, board = (texts.get(name) for name in (CLASSES, PLATE, BOARD))
            return cls(
                path=path,
                rig_text=texts[RIG],
                depth_rig=parse_depth_rig(texts[RIG], f"{path}: {RIG}"),
                classes_text=classes,
                classes=None if classes is None else parse_classes(classes, f"{path}: {CLASSES}"),
                plate_text=plate,
                plate=None if plate is None else parse_plate(plate, f"{path}: {PLATE}"),
                board_text=board,
                board=None if board is None else parse_board(board, f"{path}: {BOARD}"),
                metadata={key: value for key, value in own_keys(record).items() if key != OFFSET},
                unix_offset_ns=int(record.get(OFFSET, "0")),
                count=sum(counts.get(number, 0) for number in closing),
            )

    @property
    def rig(self) -> Rig:
        """The whole sensor package.

        Raises:
            MissingCalibrationError: Where it leaves out the colour camera or where that is.
        """
        return self.depth_rig.whole()

    def __len__(self) -> int:
        return self.count

    def captures(self, role: str | Collection[str] | None = None) -> Iterator[Capture]:
        """Yields the captures in the order in which they were written.

        Args:
            role: Only captures of this role, or of these; None: all.

        Raises:
            InputError: For an unknown role, and where the file turns out to be damaged.
        """
        roles = ROLES if role is None else (role,) if isinstance(role, str) else tuple(role)
        for unknown in set(roles) - set(ROLES):
            raise InputError(f"{self.path}: role {unknown!r}, allowed: {', '.join(ROLES)}")
        return self._captures(roles)

    def roles(self) -> Counter[str]:
        """Returns how many captures of each role there are; no image is decoded.

        Raises:
            InputError: Where the file turns out to be damaged.
        """
        entries = self._entries((CAPTURE,))
        found = Counter(parse_record(entry.data, str(self.path)).role for entry in entries)
        self._must_be_all(found.total())
        return found

    def updates(self) -> Iterator[bytes]:
        """Yields the encoded map updates in the order in which they were written.

        Raises:
            InputError: Where the file turns out to be damaged.
        """
        return (entry.data for entry in self._entries((MAP,)))

    def _captures(self, roles: Collection[str]) -> Iterator[Capture]:
        parts: dict[str, Entry] = {}
        seen = 0
        for entry in self._entries((*_IMAGE_TOPICS, JOINTS, CAPTURE)):
            if entry.topic != CAPTURE:
                parts[entry.topic] = entry
                continue
            seen += 1
            record = parse_record(entry.data, str(self.path))
            if record.role in roles:
                own = {topic: part for topic, part in parts.items() if part.sequence == entry.sequence}
                capture = capture_from(record, own, str(self.path))
                self.depth_rig.check(capture)
                yield capture
            parts = {}
        self._must_be_all(seen)

    def _must_be_all(self, seen: int) -> None:
        """Raises InputError where the index, which says what to read, hides captures."""
        if seen != self.count:
            raise InputError(
                f"{self.path}: damaged: its index leads to {seen} captures, {self.count} were written; "
                f"`surfclass recover {self.path}` saves those that are whole"
            )

    def _entries(self, topics: Collection[str]) -> Iterator[Entry]:
        # The library's reader would unpack the whole file before it gives the first message.
        with reading(self.path) as file:
            summary = _reader(file).get_summary()
            assert summary is not None  # open() has seen it
            wanted = {number for number, channel in summary.channels.items() if channel.topic in topics}
            for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
                if wanted.isdisjoint(index.message_index_offsets):
                    continue
                file.seek(index.chunk_start_offset + _RECORD_HEAD)
                chunk = Chunk.read(ReadDataStream(file))
                for record in breakup_chunk(chunk, validate_crc=True):
                    if isinstance(record, Message) and record.channel_id in wanted:
                        channel = summary.channels[record.channel_id]
                        schema = summary.schemas[channel.schema_id].name
                        yield Entry(channel.topic, schema, record.log_time, record.sequence, record.data)


@contextlib.contextmanager
def reading(path: Path) -> Iterator[IO[bytes]]:
    """Opens the file; whatever goes wrong while it is read becomes an InputError that says what to do."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        active = path.with_name(path.name + ACTIVE)
        hint = f"; its writer did not finish: run `surfclass recover {active}`" if active.exists() else ""
        raise InputError(f"{path}: no such file{hint}") from None
    except IsADirectoryError:
        raise InputError(f"{path}: a folder; turn it into a recording with `surfclass import`") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        with file:
            yield file
    except InputError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # EINVAL: a seek to before the file
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        # The parsers below raise anything from struct.error to RuntimeError on damaged bytes.
        raise InputError(
            f"{path}: damaged ({type(error).__name__}: {error}); `surfclass recover {path}` saves the "
            "captures that are whole"
        ) from error


def check_is_finished(path: Path, file: IO[bytes]) -> None:
    """Raises InputError where the file is empty, not MCAP, or does not end as a finished one."""
    check_is_mcap(path, file)
    file.seek(-len(MCAP0_MAGIC), 2)
    if file.read() != MCAP0_MAGIC:
        raise InputError(
            f"{path}: unfinished: it is still being written, its writer was killed, or it was cut off; "
            f"run `surfclass recover {path}` to save the captures that are whole"
        )


def check_is_mcap(path: Path, file: IO[bytes]) -> None:
    """Raises InputError where the file is empty or does not begin as an MCAP file."""
    head = file.read(len(MCAP0_MAGIC))
    if not head:
        raise InputError(f"{path}: an empty file; there is nothing to recover, make the recording again")
    if head != MCAP0_MAGIC:
        raise InputError(f"{path}: not an MCAP file (it begins with {head!r})")


def check_record(
    records: Mapping[str, Mapping[str, str]], topics: Collection[str], path: Path
) -> Mapping[str, str]:
    """Returns the record that says what the file is, or raises InputError where it is none of ours."""
    if METADATA not in records:
        listed = ", ".join(sorted(topics)[:8]) or "none"
        raise InputError(
            f"{path}: an MCAP file, but not a surfclass recording: no metadata {METADATA!r}, topics {listed}"
        )
    schema = records[METADATA].get("schema")
    if schema != SCHEMA:
        raise InputError(
            f"{path}: recording schema {schema!r}, allowed is {SCHEMA!r}; another surfclass wrote it"
        )
    return records[METADATA]


def _reader(file: IO[bytes]) -> SeekingReader:
    file.seek(0)
    return SeekingReader(file, validate_crcs=True, record_size_limit=RECORD_LIMIT)


def _check_channels(path: Path, channels: Collection[Channel], schemas: Mapping[int, str]) -> None:
    for channel in channels:
        allowed, found = _ALLOWED.get(channel.topic), schemas.get(channel.schema_id, "")
        if allowed is not None and found not in allowed:
            raise InputError(
                f"{path}: topic {channel.topic} holds {found or 'no schema'}, allowed: {', '.join(allowed)}"
            )
