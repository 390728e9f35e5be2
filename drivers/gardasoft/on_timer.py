"""A thread that does something when its time has come, unless it is put off before."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class OnTimer:
    """One thread between open() and close(), which sleeps until it is due.

    Args:
        name: Of the thread.
        expire: Called in the thread when due. Returns after how many seconds it is due again, or None.
            It must not raise, and must end soon: close() waits for it.
    """

    def __init__(self, name: str, expire: Callable[[], float | None]) -> None:
        self._name, self._expire = name, expire
        self._changed = threading.Condition()
        self._due: float | None = None
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Starts the thread, due at no time."""
        self._due = None
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread; may be called twice, but not from `expire`."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._changed.notify()
        if thread is not None:
            thread.join()

    def set(self, seconds: float | None) -> None:
        """Makes it due after `seconds`, or at no time; what was set before no longer counts."""
        with self._changed:
            self._due = None if seconds is None else time.monotonic() + seconds
            self._changed.notify()

    def _run(self) -> None:
        while self._waited():
            seconds = self._expire()
            with self._changed:
                if self._due is None and seconds is not None:
                    self._due = time.monotonic() + seconds

    def _waited(self) -> bool:
        """Returns True when it is due, False when it is closed."""
        mine = threading.current_thread()
        with self._changed:
            while self._thread is mine:
                left = None if self._due is None else self._due - time.monotonic()
                if left is not None and left <= 0:
                    self._due = None
                    return True
                self._changed.wait(left)
        return False
