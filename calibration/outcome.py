"""What a commissioning step hands back: numbers for the rig, figures for people, one verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surfclass.errors import InputError

SCHEMA = 1
Kind = Literal["cameras", "hand-eye", "response", "light", "limits", "train", "verify"]
Verdict = Literal["pass", "fail", "refused"]
Note = Callable[[str], None]
"""Is called with a sentence at each step of long work."""


@dataclass(frozen=True, slots=True)
class Figures:
    """A table for people.

    Attributes:
        title: Of the table.
        columns: Headings; the first column is text, the others are numbers with their units in the heading.
        rows: Cells as text, as they are to be read.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of one step, good or bad.

    Attributes:
        kind: Which step.
        verdict: "pass" if every limit is kept, "fail" if one is not; "refused" if there is no result at all.
        reasons: Why it did not pass, a sentence each, with the figure and what is allowed.
        sentence: The verdict's line without the verdict: the figures that decide, with units.
        result: What `--json` writes, but for the provenance: plain numbers, lists, dicts, text, None.
        rig: The keys of `rig.toml` that the result sets, nested as there; empty unless it may be used.
        figures: Tables for people.
        pictures: By file name without suffix: each draws itself into a PNG file.
    """

    kind: Kind
    verdict: Verdict
    reasons: tuple[str, ...]
    sentence: str
    result: Mapping[str, Any]
    rig: Mapping[str, Any] = field(default_factory=dict)
    figures: tuple[Figures, ...] = ()
    pictures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)


class RefusedError(InputError):
    """The data cannot determine the result; nothing that is in use is touched.

    Attributes:
        reasons: A sentence each: what is wrong, where, and what is needed instead.
        result: What of a result there is for `--json`, such as the poses that do not fit.
    """

    def __init__(self, *reasons: str, result: Mapping[str, Any] | None = None) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons
        self.result = result or {}


def plain(value: Any) -> Any:
    """Returns a result's value as what JSON knows: NumPy's numbers and arrays become Python's.

    Raises:
        ValueError: If a number is not finite: None says that there is none.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(below) for key, below in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(below) for below in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"a result holds {value}")
    return value


def refused(kind: Kind, error: RefusedError) -> Outcome:
    """Returns the outcome of a step that refused."""
    result = {"schema": SCHEMA, "verdict": "refused", "reasons": list(error.reasons), **error.result}
    return Outcome(kind, "refused", error.reasons, "; ".join(error.reasons), result)
