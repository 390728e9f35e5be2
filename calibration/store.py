"""Results of commissioning on disk: numbered, never changed, and the newest that passed is in use."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.outcome import Kind, Outcome, plain
from surfclass.errors import InputError
from surfclass.fingerprint import fingerprints
from surfclass.rig import DepthRig, merged

SCHEMA = 1
KINDS: tuple[Kind, ...] = ("cameras", "hand-eye", "response", "light", "limits")
_REQUIRED = {"schema": int, "kind": str, "verdict": str, "written": str, "rig": dict, "made_with": dict}


@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """One result file.

    Attributes:
        path: The file, `<directory>/<kind>/<number>.json`.
        kind: Which step.
        number: 1, 2, … of its kind.
        told: What it holds.
    """

    path: Path
    kind: Kind
    number: int
    told: Mapping[str, Any]

    @property
    def passed(self) -> bool:
        """Whether every limit was kept."""
        return bool(self.told["verdict"] == "pass")

    @property
    def written(self) -> str:
        """When, UTC, as ISO 8601."""
        return str(self.told["written"])

    @property
    def devices(self) -> Mapping[str, str]:
        """Serial numbers that the captures came from, by what the recording calls them."""
        return dict(self.told.get("devices") or {})


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a result comes from.

    Attributes:
        source: The recording, data folder or file.
        digests: The sha256 of every input file by name.
        options: How the step was called.
        gates: The limits that it was judged by.
        devices: Serial numbers, as the recording's metadata has them.
    """

    source: str
    digests: Mapping[str, str]
    options: Mapping[str, Any]
    gates: Mapping[str, Any]
    devices: Mapping[str, str]


def described(outcome: Outcome, provenance: Provenance, rig: DepthRig | None) -> dict[str, Any]:
    """Returns everything that is to be known of a result: what is written to its file, and to `--json`.

    Args:
        outcome: The step's end.
        provenance: Where it comes from.
        rig: The rig that the step began with and what it found; None where it had none.
    """
    told = {
        **outcome.result,
        "kind": outcome.kind,
        "verdict": outcome.verdict,
        "reasons": list(outcome.reasons),
        "sentence": outcome.sentence,
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds"),
        "version": importlib.metadata.version("surfclass"),
        "source": provenance.source,
        "inputs": dict(provenance.digests),
        "options": dict(provenance.options),
        "gates": dict(provenance.gates),
        "devices": dict(provenance.devices),
        "made_with": {} if rig is None else fingerprints(rig),
        "rig": dict(outcome.rig),
    }
    return {key: plain(value) for key, value in told.items()}


class Store:
    """The results under one directory, which need not be there yet.

    A result file appears whole or not at all, and is never written again: whatever kills a command,
    what was in use stays in use. To go back to an older result, move the newer files away.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def results(self, kind: Kind) -> list[Stored]:
        """Returns every result of a kind, the oldest first.

        Raises:
            InputError: Naming a file that is no result.
        """
        folder = self.directory / kind
        numbered = [path for path in folder.glob("*.json") if path.stem.isdecimal()]
        return [_read(path, kind) for path in sorted(numbered, key=lambda path: int(path.stem))]

    def current(self, kind: Kind) -> Stored | None:
        """Returns the result in use: the newest that passed.

        Raises:
            InputError: Naming a file that is no result.
        """
        return next((one for one in reversed(self.results(kind)) if one.passed), None)

    def values(self) -> dict[str, Any]:
        """Returns the rig's keys that the results in use set; where two set the same, the newer holds.

        Raises:
            InputError: Naming a file that is no result.
        """
        in_use = [one for kind in KINDS if (one := self.current(kind)) is not None]
        values: dict[str, Any] = {}
        for one in sorted(in_use, key=lambda one: one.written):
            values = merged(values, one.told["rig"])
        return values

    def fingerprints(self) -> dict[str, str]:
        """Returns the fingerprints of the parts of a rig that the results in use have found.

        Raises:
            InputError: Naming a file that is no result.
        """
        in_use = {kind: self.current(kind) for kind in KINDS}
        return {
            kind: one.told["made_with"][kind]
            for kind, one in in_use.items()
            if one is not None and kind in one.told["made_with"]
        }

    def add(self, kind: Kind, told: Mapping[str, Any]) -> Path:
        """Writes a result as the next of its kind and returns its file.

        Raises:
            InputError: If the directory cannot be made.
            OSError: If the disk refuses.
        """
        folder = self.directory / kind
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
        text = json.dumps(told, indent=1, allow_nan=False) + "\n"
        part = folder / f".{os.getpid()}.part"
        try:
            with part.open("w") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            return _placed(part, folder)
        finally:
            part.unlink(missing_ok=True)


def _placed(part: Path, folder: Path) -> Path:
    """Gives the written file the next number; a link refuses one that another command has just taken."""
    number = 1 + max((int(path.stem) for path in folder.glob("*.json") if path.stem.isdecimal()), default=0)
    while True:
        path = folder / f"{number:04d}.json"
        try:
            path.hardlink_to(part)
        except FileExistsError:
            number += 1
            continue
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        return path


def _read(path: Path, kind: Kind) -> Stored:
    try:
        told = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: not a result of commissioning: {error}") from None
    wrong = isinstance(told, dict) and [
        key for key, kind_ in _REQUIRED.items() if type(told.get(key)) is not kind_
    ]
    if not isinstance(told, dict) or wrong:
        raise InputError(f"{path}: not a result of commissioning: lacks {', '.join(wrong or _REQUIRED)}")
    if (told["schema"], told["kind"]) != (SCHEMA, kind):
        found = f"schema {told['schema']}, kind {told['kind']!r}"
        raise InputError(f"{path}: {found}; allowed here is schema {SCHEMA}, {kind!r}")
    return Stored(path, kind, int(path.stem), told)
