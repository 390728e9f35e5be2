"""The guided capture on a terminal; in a log or a pipe the same, a line for each thing that happened."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.status import Status

from calibration.live.ui import Command, Judged, Situation, thin

_MARKS = {
    "accepted": "[green]taken[/green]",
    "refused": "[yellow]refused[/yellow]",
    "rejected": "[red]again[/red]",
}
_SAID: dict[str, Command] = {"": "capture", "c": "capture", "d": "done", "done": "done", "q": "abort"}
_SHADES = " ░▒▓█"
_READ = 1024
_HELP = "Enter takes a view now, d and Enter ends with what there is, q and Enter aborts"


class TerminalUi:
    """A line for each view and each new step; commands are lines typed at it.

    Args:
        console: Where it prints.
        typed: Where commands are typed; None where nobody is: then there are none.
    """

    def __init__(self, console: Console, typed: TextIO | None = None) -> None:
        self._console, self._typed = console, typed
        self._printed = 0
        self._step = self._notice = ""
        self._title: str | None = None
        self._rest = ""  # of a line whose end has not been typed yet
        self._status: Status | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._status = self._console.status("")
            self._status.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._status is not None:
            self._status.stop()
            self._status = None

    def show(self, situation: Situation) -> None:
        """Prints what is new."""
        if situation.title != self._title:
            self._title = situation.title
            self._line(f"[bold]{escape(situation.title)}[/bold]" + (f": {_HELP}" if self._typed else ""))
        if len(situation.judged) < self._printed:  # another guide's
            self._printed = 0
        fresh = situation.judged[self._printed :]
        self._printed = len(situation.judged)
        for one in fresh:
            stands = f" ({situation.taken}/{situation.needed})" if one is fresh[-1] else ""
            self._line(_judged(one, stands))
        if any(one.verdict == "accepted" for one in fresh):
            self._show_shares(situation.coverage)
        if situation.doing in ("done", "ended"):
            self._show_grids(situation.coverage)
        if situation.next_step and situation.next_step != self._step:
            self._line(f"  next: [bold]{escape(situation.next_step)}[/bold]")
        if situation.notice and situation.notice != self._notice:
            self._line(f"  {escape(situation.notice)}")
        self._step, self._notice = situation.next_step, situation.notice
        if self._status is not None:
            doing = "capturing" if situation.doing == "capturing" else situation.next_step
            self._status.update(f"{situation.taken}/{situation.needed} {escape(doing)}")

    def command(self) -> Command | None:
        """Returns what the next whole line says; one that says nothing known is explained."""
        if self._typed is None:
            return None
        while "\n" not in self._rest:
            if not select.select([self._typed], [], [], 0)[0]:
                return None
            more = os.read(self._typed.fileno(), _READ).decode(errors="replace")
            if not more:  # its end: nobody will say anything any more
                self._typed = None
                return None
            self._rest += more
        line, _, self._rest = self._rest.partition("\n")
        said = _SAID.get(line.strip().lower())
        if said is None:
            self._line(f"  {_HELP}")
        return said

    def _show_shares(self, coverage: Mapping[str, Any]) -> None:
        shares = {name: value for name, value in coverage.items() if isinstance(value, int | float)}
        lacking = thin(shares)
        if shares:
            self._line(f"  still thin: {escape('; '.join(lacking))}" if lacking else "  all is covered")

    def _show_grids(self, coverage: Mapping[str, Any]) -> None:
        for name, value in coverage.items():
            if not isinstance(value, int | float):
                for number, row in enumerate(shaded(value)):
                    self._line(f"  {escape(name) if number == 0 else ' ' * len(name)} |{row}|")

    def _line(self, text: str) -> None:
        self._console.print(text, highlight=False)


def terminal_ui(console: Console, *, interactive: bool) -> TerminalUi:
    """Returns the terminal's; commands are typed at standard input where that is a terminal."""
    return TerminalUi(console, sys.stdin if interactive and sys.stdin.isatty() else None)


def shaded(grid: Sequence[Sequence[float]]) -> list[str]:
    """Returns a line of text for each row of a grid of counts, darker for more; two characters a cell."""
    counts = np.atleast_2d(np.asarray(grid, np.float64))
    most = counts.max(initial=0.0)
    if most <= 0:
        return [_SHADES[0] * 2 * counts.shape[1]] * counts.shape[0]
    level = np.ceil(np.clip(counts / most, 0, 1) * (len(_SHADES) - 1)).astype(int)
    return ["".join(_SHADES[cell] * 2 for cell in row) for row in level]


def _judged(one: Judged, stands: str) -> str:
    reasons = escape("; ".join(one.reasons))
    name = f" {escape(one.name)}{stands}" if one.name else ""
    return f"{one.number:3d} {_MARKS[one.verdict]}{name}" + (f": {reasons}" if reasons else "")
