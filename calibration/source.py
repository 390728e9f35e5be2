"""What a commissioning step reads: the captures of a recording or of a data folder, and the rig so far."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.recordings import Recording
from drivers.recordings.folder import FolderSet, read_folder
from drivers.recordings.plate import Plate
from surfclass.frames import Capture
from surfclass.rig import DepthRig, SurfaceClasses

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

    @classmethod
    def open(cls, path: Path) -> Source:
        """Returns the captures of a recording (a file) or of a data folder.

        Raises:
            InputError, ConfigurationError: Naming the file and what is wrong with it.
        """
        found = read_folder(path) if path.is_dir() else Recording.open(path)
        return cls(path, found.depth_rig, found.plate, found.classes, found)

    def with_values(self, values: Mapping[str, Any]) -> Source:
        """Returns the same captures with some of the rig's keys set anew, nested as in `rig.toml`."""
        return replace(self, rig=self.rig.with_values(values))

    def captures(self, roles: str | Collection[str]) -> Iterator[Capture]:
        """Yields the captures of these roles in their order, one in memory at a time."""
        if isinstance(self._set, Recording):
            yield from self._set.captures(roles)
            return
        wanted = {roles} if isinstance(roles, str) else set(roles)
        for capture, _ in self._set.only(wanted).captures():
            yield capture

    def count(self, role: str) -> int:
        """Returns how many captures have this role."""
        if isinstance(self._set, FolderSet):
            return sum(row.role == role for row in self._set.rows)
        return sum(1 for _ in self._set.captures(role))

    def digests(self) -> dict[str, str]:
        """Returns the sha256 of every file that the captures came from, by name."""
        if not self.path.is_dir():
            return {self.path.name: _sha256(self.path)}
        files = sorted(path for path in self.path.rglob("*") if path.is_file())
        return {str(path.relative_to(self.path)): _sha256(path) for path in files}


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
