"""What a device's own process prints: read so that it never has to wait, logged, and its end remembered."""

from __future__ import annotations

import logging
import os
import select
import threading
from collections import deque

_LINES = 3  # of the last ones that a message quotes
_LINE_LIMIT = 200  # bytes of a line
_CHUNK = 4096
_CRASH = "Fatal Python error"  # faulthandler's first line; what follows is for the log only
_log = logging.getLogger("surfclass.isolation")


class ChildOutput:
    """Reads a process's standard output and error in a thread until the process is gone.

    Lines go to the log at level debug, the report of a crash at level error. What is longer than a
    line may be is cut; what cannot be printed is replaced.

    Args:
        name: The device's, for the log.

    Raises:
        OSError: If the system gives no pipe.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._crashed = False
        self._last: deque[str] = deque(maxlen=_LINES)
        self._reading, self.writing_end = os.pipe()
        os.set_blocking(self._reading, False)
        self._stop, self._stopping = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"{name} output", daemon=True)

    def start(self) -> None:
        """Begins to read; call when the process has its own copy of `writing_end`."""
        os.close(self.writing_end)
        self.writing_end = -1
        self._thread.start()

    def close(self) -> None:
        """Reads what is there and ends; call when the process is gone, though its children may live on."""
        os.close(self._stopping)
        if self._thread.ident is not None:
            self._thread.join()
        for descriptor in (self._reading, self._stop, self.writing_end):
            if descriptor >= 0:
                os.close(descriptor)

    def last_words(self) -> str:
        """Returns the last lines, for a message."""
        return " | ".join(self._last)

    def _run(self) -> None:
        poll = select.poll()
        poll.register(self._reading, select.POLLIN)
        poll.register(self._stop, select.POLLIN)
        rest, left = b"", 16  # chunks are still read after the end: what a pipe holds
        while left:
            ended = any(descriptor == self._stop for descriptor, _ in poll.poll())
            left -= ended
            try:
                chunk = os.read(self._reading, _CHUNK)
            except BlockingIOError:
                if ended:
                    break
                continue
            if not chunk:
                break
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._note(line)
            if len(rest) > _LINE_LIMIT:
                self._note(rest)
                rest = b""
        if rest:
            self._note(rest)

    def _note(self, line: bytes) -> None:
        text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in _text(line))
        if not text:
            return
        self._crashed = self._crashed or text.startswith(_CRASH)
        _log.log(logging.ERROR if self._crashed else logging.DEBUG, "%s: %s", self._name, text)
        if not self._crashed:
            self._last.append(text)


def _text(line: bytes) -> str:
    return line[:_LINE_LIMIT].decode("utf-8", "replace").strip()
