"""What the person at a guided capture sees, and what they can say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

Command = Literal["capture", "done", "abort"]
Doing = Literal["waiting", "capturing", "done", "ended"]
Verdict = Literal["accepted", "refused", "rejected"]


@dataclass(frozen=True, slots=True)
class Judged:
    """A view that was judged, or a capture that came to nothing.

    Attributes:
        number: Counts all of them, from 1.
        name: Of the capture in the recording; empty where it is not in there.
        verdict: "accepted" and written, "refused" by the guide, or "rejected": the arm moved, or the
            frames do not belong together.
        reasons: Of the guide or the sensors, a sentence each.
    """

    number: int
    name: str
    verdict: Verdict
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """How a guided capture stands.

    Attributes:
        title: What is captured.
        doing: "waiting" for the arm or the person, "capturing", "done": there is enough, or "ended".
        next_step: What to do now.
        taken: Views that the guide has.
        needed: How many it wants.
        judged: Everything so far, in order.
        coverage: The guide's: names to shares of 1, or to grids of counts (rows).
        picture: The last view with what was found in it, (h, w, 3) uint8 RGB; None before the first.
        notice: What the person should know besides, such as what is still thin.
    """

    title: str
    doing: Doing
    next_step: str
    taken: int
    needed: int
    judged: tuple[Judged, ...]
    coverage: Mapping[str, Any]
    picture: NDArray[np.uint8] | None
    notice: str = ""

    def count(self, verdict: Verdict) -> int:
        """Returns how many were judged so."""
        return sum(one.verdict == verdict for one in self.judged)


def thin(coverage: Mapping[str, Any]) -> tuple[str, ...]:
    """Returns what a guide's coverage still lacks: shares below 1, and grids with empty cells."""
    found = []
    for name, value in coverage.items():
        if isinstance(value, int | float):
            if value < 1:
                found.append(f"{name} {value:.0%}")
        else:
            cells = np.asarray(value, np.float64).ravel()
            if cells.size and (cells == 0).any():
                found.append(f"{name}: {int((cells == 0).sum())} of {cells.size} cells empty")
    return tuple(found)


class Ui(Protocol):
    """Shows, and takes what is said; used from one thread, and neither call waits."""

    def show(self, situation: Situation) -> None:
        """Shows how things stand; called whenever that has changed."""

    def command(self) -> Command | None:
        """Returns what was said first of what was not asked for yet, or None."""


class ScopedUi(Ui, Protocol):
    """One that is there while it is entered."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Several:
    """Several of them at once, such as the page and the terminal."""

    def __init__(self, uis: Sequence[Ui]) -> None:
        self._uis = tuple(uis)

    def show(self, situation: Situation) -> None:
        """Shows it on each."""
        for ui in self._uis:
            ui.show(situation)

    def command(self) -> Command | None:
        """Returns what was said at the first where something was."""
        for ui in self._uis:
            said = ui.command()
            if said is not None:
                return said
        return None
