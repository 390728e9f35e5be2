"""Files that are whole or absent: written beside their place, synced, and moved there."""

from __future__ import annotations

import os
from pathlib import Path

from surfclass.errors import InputError


def check_output(*paths: Path | str | None) -> None:
    """Says before the work, and not after it, that a result cannot be written.

    Args:
        paths: Where results will go; None and "-", which is standard output, are no files.

    Raises:
        InputError: If a directory does not exist or cannot be written to, or a path is a directory.
    """
    for path in (Path(path) for path in paths if path is not None and path != "-"):
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no directory {path.parent}")
        if path.is_dir():
            raise InputError(f"{path}: is a directory, and a file is to be written")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise InputError(f"{path}: the directory {path.parent} cannot be written to")


def write_atomically(path: Path, data: bytes) -> None:
    """Writes `data` to `path`, which afterwards is the old file or the new one, never a part.

    Raises:
        InputError: As `check_output`.
        OSError: If the disk refuses.
    """
    check_output(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read_file(path: Path, what: str) -> bytes:
    """Returns the bytes of a file.

    Args:
        path: The file.
        what: What it should be, for the message.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what}: {error.strerror}") from None
