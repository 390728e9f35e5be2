"""Files that are whole or absent: written beside their place, synced, and moved there."""

from __future__ import annotations

import os
from pathlib import Path

from surfclass.errors import InputError


def write_atomically(path: Path, data: bytes) -> None:
    """Writes `data` to `path`, which afterwards is the old file or the new one, never a part.

    Raises:
        InputError: If the directory does not exist.
        OSError: If the disk refuses.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no directory {path.parent}")
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
