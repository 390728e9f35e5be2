"""`surfclass verify`: the whole chain once more, with captures that no calibration has seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.gates import VerifyGates
from calibration.outcome import SCHEMA, Figures, Note, Outcome, RefusedError
from calibration.source import Source
from calibration.verify import boards, cameras, card, discs
from calibration.verify.part import Part
from drivers.recordings.board import Board
from surfclass.errors import ConfigurationError, InputError

PARTS = {one.KEY: one.TITLE for one in (cameras, discs, card, boards)}


@dataclass(frozen=True, slots=True)
class VerifyOptions:
    """What is to be checked.

    Attributes:
        model: The model that labelled captures are classified with; None leaves them out.
        board: What `board` captures look at; None: what the recording says.
        require: Parts that have to be checked, out of PARTS: one that cannot be is a failure. What else
            the captures allow is checked too.
    """

    model: Path | None = None
    board: Board | None = None
    require: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for unknown in set(self.require) - set(PARTS):
            raise ConfigurationError(f"verify: part {unknown!r}, allowed: {', '.join(PARTS)}")


def verify(source: Source, options: VerifyOptions, gates: VerifyGates, note: Note) -> Outcome:
    """Checks every link that the captures allow, and says of the others why it could not.

    | role | what is checked |
    | --- | --- |
    | `board`, with board.toml | both cameras, what is between them, depth |
    | `hand_eye`, with plate.toml | hand-eye, arm and depth: discs in the base frame |
    | `response` | light, response and vignetting: K_d of a grey card |
    | `test`, `train`, with a model | the whole method: labelled pixels |

    Args:
        source: Fresh captures, with the calibrations in use on top of its rig.
        options: What is to be checked.
        gates: The limits.
        note: Is told what is done and left out.

    Raises:
        RefusedError: If nothing at all can be checked.
    """
    checks: dict[str, Callable[[], Part]] = {
        cameras.KEY: lambda: cameras.check_cameras(source, options.board or source.board, gates, note),
        discs.KEY: lambda: discs.check_discs(source, gates, note),
        card.KEY: lambda: card.check_card(source, gates, note),
        boards.KEY: lambda: boards.check_boards(source, options.model, gates, note),
    }
    parts = [_checked(key, check, note) for key, check in checks.items()]
    if all(part.not_checked for part in parts):
        raise RefusedError(*(f"{part.title}: {part.not_checked}" for part in parts))
    return outcome_of(parts, options.require)


def outcome_of(parts: list[Part], require: tuple[str, ...] = ()) -> Outcome:
    """Returns the verdict on all parts: "fail" if one fails, or is required and was not checked."""
    reasons = [reason for part in parts for reason in part.reasons]
    reasons += [
        f"{part.title}: could not be checked: {part.not_checked}"
        for part in parts
        if part.not_checked and part.key in require
    ]
    verdict = "fail" if reasons else "pass"
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "verdict": verdict,
        "reasons": reasons,
        "parts": {part.key: part.described() for part in parts},
    }
    return Outcome(
        "verify",
        "fail" if reasons else "pass",
        tuple(reasons),
        "; ".join(_sentence(part) for part in parts),
        result,
        figures=(summary(parts), *(figures for part in parts for figures in part.figures)),
        pictures={name: draw for part in parts for name, draw in part.pictures.items()},
    )


def summary(parts: list[Part]) -> Figures:
    """Returns the one table that decides: what, figure, limit, verdict."""
    rows: list[tuple[str, str, str, str]] = []
    for part in parts:
        if part.not_checked:
            rows.append((f"{part.title}: {part.not_checked}", "–", "–", "not checked"))
        for one in part.findings:
            verdict = "–" if one.limit is None else "pass" if one.kept else "fail"
            rows.append((f"{part.title}: {one.name}", one.told, one.allowed, verdict))
    return Figures("Verification", ("what", "figure", "limit", "verdict"), rows)


def _checked(key: str, check: Callable[[], Part], note: Note) -> Part:
    note(f"checking: {PARTS[key]}")
    try:
        return check()
    except InputError as error:
        return Part(key, PARTS[key], not_checked=str(error))


def _sentence(part: Part) -> str:
    if part.not_checked:
        return f"{part.title} not checked"
    first = part.findings[0]
    return f"{part.title} {first.told} ({first.allowed})"
