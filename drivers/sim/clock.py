"""The simulated host clock: it jumps instead of sleeping, or keeps pace with real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

START_NS = 1_000_000_000


class SimClock:
    """A clock that all devices of one world share; it never runs backwards.

    Args:
        realtime: False: time passes only where something waits, and then at once, so that a run
            repeats byte for byte. True: it runs with the host's clock, except while the world
            computes an image: a slow computer must not make the simulated arm look fast.
        start_ns: The first reading.
        of_host: The host's CLOCK_MONOTONIC itself, which no computing stops: for devices in other
            processes, which share that clock and no other.
    """

    def __init__(self, realtime: bool = False, start_ns: int = START_NS, *, of_host: bool = False) -> None:
        self.realtime = realtime or of_host
        self._of_host = of_host
        self._lock = threading.Lock()
        self._now_ns = 0 if of_host else start_ns
        self._offset_ns = 0 if of_host else start_ns - time.monotonic_ns()
        self._held_at_ns = 0
        self._holders = 0

    def now_ns(self) -> int:
        """This clock's time, ns."""
        with self._lock:
            return self._read()

    def sleep(self, seconds: float) -> None:
        """Returns after `seconds` of this clock; not at all for a negative number."""
        self.sleep_until(self.now_ns() + round(seconds * 1e9))

    def sleep_until(self, t_ns: int) -> None:
        """Returns when the clock has reached `t_ns`."""
        if not self.realtime:
            with self._lock:
                self._now_ns = max(self._now_ns, t_ns)
            return
        while (left_ns := t_ns - self.now_ns()) > 0:
            time.sleep(min(left_ns / 1e9, 0.05))

    @contextmanager
    def held(self) -> Iterator[None]:
        """Stops the clock for the block: the computing time is not the world's time."""
        if self._of_host:
            yield
            return
        with self._lock:
            if self._holders == 0:
                self._held_at_ns = time.monotonic_ns()
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._offset_ns -= time.monotonic_ns() - self._held_at_ns

    def _read(self) -> int:
        if self.realtime:
            host_ns = self._held_at_ns if self._holders else time.monotonic_ns()
            self._now_ns = max(self._now_ns, host_ns + self._offset_ns)
        return self._now_ns
