"""Keeps every capture on disk, in parts of bounded size, before anybody hears of it."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from google.protobuf.descriptor_pb2 import FileDescriptorSet

from daemon.config import Config
from daemon.logs import log
from drivers.files import read_file
from drivers.recordings import RecordingWriter, unix_offset_ns
from surfclass import map_pb2
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture
from surfclass.rig import SurfaceClasses

_log = logging.getLogger("surfclass.recording")


class Writer(Protocol):
    """What `drivers.recordings.RecordingWriter` provides."""

    def write(self, capture: Capture, encoded: Mapping[str, bytes] | None = None) -> None:
        """Keeps one capture."""

    def write_update(self, data: bytes, t_ns: int) -> None:
        """Keeps one encoded map update."""

    def sync(self) -> None:
        """Brings what was written onto the disk."""

    def close(self) -> None:
        """Finishes the file and gives it its name."""


class RecordingSink:
    """One recording a run, split into parts.

    Args:
        directory: Where the parts go.
        stem: Their name without the number, such as "robot1-20260301T120000Z".
        open_writer: Begins a part at a path; the argument after it is the number of the part.
        part_bytes: A part that is larger is finished after the capture that made it so.
        min_free_bytes: So much space must stay free.
    """

    def __init__(
        self,
        directory: Path,
        stem: str,
        open_writer: Callable[[Path, int], Writer],
        part_bytes: int,
        min_free_bytes: int,
    ) -> None:
        self._directory, self._stem = directory, stem
        self._open_writer = open_writer
        self._part_bytes, self._min_free = part_bytes, min_free_bytes
        self._writer: Writer | None = None
        self._part = 0
        self._written = 0
        self._synced = 0
        self.path: Path | None = None

    def write(self, capture: Capture) -> None:
        """Keeps a capture.

        Raises:
            OSError: If the disk is full or refuses; the part is then finished as far as it goes, and
                the next call begins another.
            InputError: If the capture does not fit the rig; more can be written.
        """
        free = shutil.disk_usage(self._directory).free
        if free < self._min_free:
            raise OSError(f"{self._directory}: {free >> 20} MB free, {self._min_free >> 20} must stay")
        if self._writer is not None and self._written >= self._part_bytes:
            self.close()
        try:
            if self._writer is None:
                self._begin()
            assert self._writer is not None
            self._writer.write(capture)
        except OSError:
            self._abandon()
            raise
        images = [capture.depth.depth_mm, capture.depth.ir, capture.label]
        images += [frame.rgb for frame in (capture.colour, capture.dark) if frame is not None]
        self._written += sum(image.nbytes for image in images if image is not None)

    def write_update(self, data: bytes, t_ns: int) -> None:
        """Keeps an encoded map update beside its capture.

        Raises:
            OSError: As `write`.
        """
        if self._writer is None:
            return
        try:
            self._writer.write_update(data, t_ns)
        except OSError:
            self._abandon()
            raise
        self._written += len(data)

    def sync(self) -> None:
        """Brings everything onto the disk; raises OSError as `write`."""
        if self._writer is not None and self._synced != self._written:
            self._writer.sync()
            self._synced = self._written

    def close(self) -> None:
        """Finishes the part that is being written.

        Raises:
            OSError: If that fails; the unfinished part stays, and can be recovered.
        """
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
            log(_log, logging.INFO, "recording finished", path=self.path)

    def _begin(self) -> None:
        self._part += 1
        self._written = self._synced = 0
        self.path = self._directory / f"{self._stem}-{self._part:03d}.mcap"
        try:
            self._writer = self._open_writer(self.path, self._part)
        except InputError as error:  # the folder is gone, or its file is taken: nothing about the capture
            raise OSError(str(error)) from error
        log(_log, logging.INFO, "recording begun", path=self.path)

    def _abandon(self) -> None:
        try:
            self.close()
        except OSError as error:
            log(_log, logging.ERROR, "recording left unfinished", path=self.path, error=error)


def run_stem(robot: str) -> str:
    """Returns the name of a run that begins now: the robot and the time, UTC, to the second."""
    return f"{robot}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"


def open_sink(config: Config, rig_text: str, classes: SurfaceClasses, epoch: str) -> RecordingSink | None:
    """Returns where captures are kept, as configured; None where they are not.

    Raises:
        ConfigurationError: If the folder cannot be made.
    """
    if config.recording is None:
        return None
    told, stem = config.recording, run_stem(config.robot)
    try:
        told.directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"recording.directory {told.directory}: {error.strerror}") from None
    for path in sorted(told.directory.glob("*.active")):
        log(_log, logging.WARNING, "an earlier recording was cut off", mend=f"surfclass recover {path}")
    metadata = {
        "robot": config.robot,
        "run": stem,
        "epoch": epoch,
        "software": f"surfclass {_version()}",
        "model_sha256": hashlib.sha256(read_file(config.model, "model")).hexdigest(),
    }
    schema = FileDescriptorSet()
    map_pb2.DESCRIPTOR.CopyToProto(schema.file.add())

    def begin(path: Path, part: int) -> RecordingWriter:
        return RecordingWriter(
            path,
            rig_text,
            classes_toml(classes),
            {**metadata, "part": str(part)},
            # A simulated clock's times are nobody's Unix times.
            unix_offset_ns=0 if config.simulated else unix_offset_ns(),
            map_schema=schema.SerializeToString(deterministic=True),
        )

    return RecordingSink(told.directory, stem, begin, told.part_mb << 20, told.min_free_mb << 20)


def classes_toml(classes: SurfaceClasses) -> str:
    """Returns the classes as the text of a `classes.toml`."""
    # TOML's basic strings have JSON's escapes.
    names, colours = (json.dumps(list(values)) for values in (classes.names, classes.colours))
    return f"names = {names}\ncolours = {colours}\n"


def _version() -> str:
    try:
        return importlib.metadata.version("surfclass")
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"
