"""Signals as notes for the main loop: a handler may not touch a lock, so it only leaves a word."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Self


class SignalNotes:
    """While entered, SIGTERM and SIGINT set `stop` to their name, and SIGHUP sets `reload`.

    Outside the main thread, which alone is given signals, entering does nothing.
    """

    def __init__(self) -> None:
        self.stop: str | None = None
        self.reload = False
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                self._before[number] = signal.signal(number, self._leave)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # what signal.signal returned
        self._before.clear()

    def _leave(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            self.reload = True
        else:
            self.stop = signal.Signals(number).name
