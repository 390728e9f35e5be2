"""An MCAP file that is whole, or has another name: written as PATH.active, synced, and then renamed."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from mcap.writer import CompressionType, Writer

from drivers.recordings.format import METADATA, RIG, SCHEMA, Entry, schemas
from surfclass.errors import InputError

ACTIVE = ".active"
LIBRARY = "surfclass"
SYNC_S = 1.0
_CHUNK = 4 << 20
_DIGEST = "sha256 of "


class RecordingFile:
    """Messages appended in groups; what `append` has returned from survives a kill of the process.

    Each group ends a chunk, so the file's bytes depend on what is written and never on when.

    Args:
        path: Where the finished file will be; one that is there is replaced when this one is finished.
        active: Where it is meanwhile.
        metadata: The record that says what the file is.
        attachments: Text files by name.

    Raises:
        InputError: If the folder is missing, or `active` exists: it may hold what a crash left.
        OSError: If the disk refuses.
    """

    def __init__(
        self,
        path: Path,
        active: Path,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
    ) -> None:
        self.path, self.active = path, active
        self._schemas = dict(schemas())
        self._schema_ids: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}")
        try:
            # The file is closed by finish(), release() or discard(), whichever comes first.
            self._file = active.open("xb")
        except FileExistsError:
            raise InputError(
                f"{active}: already there: it is being written, or a crash left it; run "
                f"`surfclass recover {active}`, or delete it"
            ) from None
        self._failed = False
        self._synced_s = 0.0
        with self._surfacing():
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._writer = Writer(self._file, chunk_size=_CHUNK, compression=CompressionType.LZ4)
            # The library leaves these two without types.
            self._flush: Callable[[], None] = self._writer.flush
            self._finish: Callable[[], None] = self._writer.finish
            self._writer.start(library=LIBRARY)
            self._writer.add_metadata(METADATA, described(metadata, attachments))
            for name, data in attachments.items():
                self._writer.add_attachment(0, 0, name, "text/plain", data)
            self.append(())
            self._sync()
            _sync_folder(active.parent)

    @property
    def is_open(self) -> bool:
        """Whether more can be appended."""
        return not self._file.closed and not self._failed

    def add_schema(self, name: str, encoding: str, definition: bytes) -> None:
        """Makes a message type known besides those of captures."""
        self._schemas.setdefault(name, (encoding, definition))

    def append(self, entries: Iterable[Entry]) -> None:
        """Writes messages that belong together and hands them to the system, at most 1 s later to the disk.

        Raises:
            OSError: If the disk refuses; nothing more can be written then.
        """
        with self._surfacing():
            for entry in entries:
                self._writer.add_message(
                    self._channel(entry), entry.time_ns, entry.data, entry.time_ns, entry.sequence
                )
            self._flush()
            if time.monotonic() - self._synced_s >= SYNC_S:
                self._sync()

    def sync(self) -> None:
        """Waits until everything that was appended is on the disk."""
        with self._surfacing():
            self._sync()

    def finish(self) -> None:
        """Ends the file, waits for the disk, and gives the file its name."""
        with self._surfacing():
            self._finish()
            self._file.flush()
            self._sync()
            self.active.replace(self.path)
            _sync_folder(self.path.parent)
            self._file.close()

    def release(self) -> None:
        """Closes the file and leaves it under its active name."""
        with contextlib.suppress(OSError):
            self._file.close()

    def discard(self) -> None:
        """Deletes what was written."""
        self.release()
        self.active.unlink(missing_ok=True)

    def _channel(self, entry: Entry) -> int:
        key = (entry.topic, entry.schema)
        if key not in self._channels:
            encoding, definition = self._schemas[entry.schema]
            if entry.schema not in self._schema_ids:
                schema = self._writer.register_schema(entry.schema, encoding, definition)
                self._schema_ids[entry.schema] = schema
            message_encoding = "json" if encoding == "jsonschema" else encoding
            self._channels[key] = self._writer.register_channel(
                entry.topic, message_encoding, self._schema_ids[entry.schema]
            )
        return self._channels[key]

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced_s = time.monotonic()

    @contextlib.contextmanager
    def _surfacing(self) -> Iterator[None]:
        if not self.is_open:
            raise ValueError(f"{self.path}: the recording is closed")
        try:
            yield
        except OSError as error:
            self._failed = True
            self.release()
            reason = f"recording stopped ({error.strerror}); run `surfclass recover` on what was written"
            raise OSError(error.errno, reason, str(self.active)) from error
        except BaseException:
            self._failed = True
            self.release()
            raise


def described(metadata: Mapping[str, str], attachments: Mapping[str, bytes]) -> dict[str, str]:
    """The metadata record: the caller's keys, the schema, and the attachments' digests."""
    digests = {_DIGEST + name: hashlib.sha256(data).hexdigest() for name, data in attachments.items()}
    return dict(sorted({**metadata, **digests, "schema": SCHEMA}.items()))


def check_digests(record: Mapping[str, str], attachments: Mapping[str, bytes], source: str) -> None:
    """Raises InputError where an attachment, the rig above all, is missing or is not what was written."""
    digests = {key.removeprefix(_DIGEST): value for key, value in record.items() if key.startswith(_DIGEST)}
    for name in (RIG, *digests):
        if name not in attachments:
            raise InputError(f"{source}: damaged: its {name} is missing")
        if hashlib.sha256(attachments[name]).hexdigest() != digests.get(name):
            raise InputError(f"{source}: damaged: its {name} is not what was written")


def own_keys(record: Mapping[str, str]) -> dict[str, str]:
    """The caller's keys of a metadata record."""
    return {key: value for key, value in record.items() if not key.startswith(_DIGEST) and key != "schema"}


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
