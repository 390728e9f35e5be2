"""One link of the chain, checked: figures against limits, or the reason why it could not be checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from calibration.outcome import Figures

PartVerdict = Literal["pass", "fail", "not checked"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One figure and what it has to be.

    Attributes:
        key: Its name in the result.
        name: What it is, for people.
        value: In SI units.
        limit: Likewise; None is a figure that decides nothing.
        unit: That people read it in, such as "mm".
        per_unit: How many of that unit are one SI unit.
        at_least: Whether the limit is the least that is allowed; else it is the most.
    """

    key: str
    name: str
    value: float
    limit: float | None
    unit: str
    per_unit: float = 1.0
    at_least: bool = False

    @property
    def kept(self) -> bool:
        """Whether the limit is kept; a value that is no number keeps none."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    @property
    def told(self) -> str:
        """The value as people read it."""
        return self._in_unit(self.value)

    @property
    def allowed(self) -> str:
        """The limit as people read it."""
        if self.limit is None:
            return "–"
        return f"{'≥' if self.at_least else '≤'} {self._in_unit(self.limit)}"

    def _in_unit(self, value: float) -> str:
        return f"{value * self.per_unit:.3g} {self.unit}".strip()


@dataclass(frozen=True, slots=True)
class Part:
    """What became of one link.

    Attributes:
        key: Its name in the result: "discs", "grey_card", "boards" or "cameras".
        title: For people.
        findings: Its figures; none where it was not checked.
        suspect: What a figure outside its limit points at, and what to do.
        not_checked: Why it could not be checked, a sentence; empty where it was.
        result: More of it, for the result file.
        figures: More of it, for people.
        pictures: By file name without suffix: each draws itself into a PNG file.
    """

    key: str
    title: str
    findings: tuple[Finding, ...] = ()
    suspect: str = ""
    not_checked: str = ""
    result: Mapping[str, Any] = field(default_factory=dict)
    figures: tuple[Figures, ...] = ()
    pictures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)

    @property
    def verdict(self) -> PartVerdict:
        """Whether every limit is kept."""
        if self.not_checked:
            return "not checked"
        return "pass" if all(finding.kept for finding in self.findings) else "fail"

    @property
    def reasons(self) -> tuple[str, ...]:
        """A sentence for each figure outside its limit."""
        return tuple(
            f"{self.title}: {one.name} is {one.told}, allowed is {one.allowed}; {self.suspect}"
            for one in self.findings
            if not one.kept
        )

    def described(self) -> dict[str, Any]:
        """Returns what the result file says of it."""
        return {
            "verdict": self.verdict,
            "not_checked": self.not_checked or None,
            **{finding.key: finding.value for finding in self.findings},
            "limits": {finding.key: finding.limit for finding in self.findings if finding.limit is not None},
            **self.result,
        }
