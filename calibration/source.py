"""What a commissioning step reads: the captures of a recording or of a data folder, and the rig so far."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.recordings import Recording
from drivers.recordings.board import Board
from drivers.recordings.folder import FolderSet, read_folder
from drivers.recordings.plate import Plate
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.rig import DepthRig, SurfaceClasses

SERIAL = "serial of "
"""Keys of a recording's metadata that begin so hold a device's serial number."""
_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Captures, and what is known of the package that took them.

    Attributes:
        path: The recording or the data folder.
        rig: What was known when they were taken, with the results in use on top (`with_values`).
        plate: The reflector discs, or None.
        classes: What labels mean, or None.
    """

    path: Path
    rig: DepthRig
    plate: Plate | None
    classes: SurfaceClasses | None
    _set: Recording | FolderSet
    _more: tuple[Source, ...] = ()

    @classmethod
    def open(cls, path: Path, *more: Path) -> Source:
        """Returns the captures of a recording (a file) or of a data folder.

        Args:
            path: It gives the rig, the plate and the classes.
            more: Others of the same package, whose captures come after its own.

        Raises:
            InputError, ConfigurationError: Naming the file and what is wrong with it.
        """
        found = read_folder(path) if path.is_dir() else Recording.open(path)
        others = tuple(cls.open(other) for other in more)
        for other in others:
            if _images(other.rig) != _images(found.depth_rig):
                raise InputError(f"{other.path}: its images have not the size of those of {path}")
        plate = next((one for one in (found.plate, *(other.plate for other in others)) if one), None)
        classes = next((one for one in (found.classes, *(other.classes for other in others)) if one), None)
        return cls(path, found.depth_rig, plate, classes, found, others)

    def with_values(self, values: Mapping[str, Any]) -> Source:
        """Returns the same captures with some of the rig's keys set anew, nested as in `rig.toml`."""
        return replace(self, rig=self.rig.with_values(values))

    def captures(self, roles: str | Collection[str]) -> Iterator[Capture]:
        """Yields the captures of these roles in their order, one in memory at a time."""
        wanted = {roles} if isinstance(roles, str) else set(roles)
        if isinstance(self._set, Recording):
            yield from self._set.captures(wanted)
        else:
            for capture, _ in self._set.only(wanted).captures():
                yield capture
        for other in self._more:
            yield from other.captures(wanted)

    @property
    def devices(self) -> dict[str, str]:
        """Serial numbers of the devices, by what they are, where the recording tells."""
        if not isinstance(self._set, Recording):
            return {}
        found = self._set.metadata.items()
        return {key.removeprefix(SERIAL): value for key, value in found if key.startswith(SERIAL)}

    @property
    def board(self) -> Board | None:
        """The calibration board that the captures look at, or None."""
        own = self._set.board
        return own or next((other.board for other in self._more if other.board), None)

    def count(self, role: str) -> int:
        """Returns how many captures have this role."""
        if isinstance(self._set, FolderSet):
            own = sum(row.role == role for row in self._set.rows)
        else:
            own = self._set.roles()[role]
        return own + sum(other.count(role) for other in self._more)

    def digests(self) -> dict[str, str]:
        """Returns the sha256 of every file that the captures came from, by its name from their folder on."""
        files = sorted(path for path in self.path.rglob("*") if path.is_file()) if self.path.is_dir() else []
        folder = self.path.resolve().parent
        found = {str(path.resolve().relative_to(folder)): sha256(path) for path in files or [self.path]}
        return found | {name: digest for other in self._more for name, digest in other.digests().items()}


def _images(rig: DepthRig) -> tuple[Any, Any]:
    return rig.depth.size, None if rig.rgb is None else rig.rgb.size


def sha256(path: Path) -> str:
    """Returns the digest of a file, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
