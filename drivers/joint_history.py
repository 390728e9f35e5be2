"""The joint readings of the last seconds, written by a reader thread, asked by time from another."""

from __future__ import annotations

import threading
import time
from collections import deque

from drivers.errors import DeviceTimeoutError, DriverError
from surfclass.errors import InputError
from surfclass.frames import JointState

_AHEAD_NS = 60_000_000_000  # a time further ahead is no time of this clock


class JointHistory:
    """A bounded ring of joint readings: one thread adds, others ask, on the host's CLOCK_MONOTONIC.

    The oldest reading makes room for a new one. Between two readings the angles are linear; for a gap
    of 8 ms and 10 rad/s² that is wrong by at most 1e-4 rad.

    Args:
        device: Whose readings they are; its errors name it.
        capacity: Readings that are kept, 2 or more.
        max_gap_s: Two neighbours further apart say nothing of the time between them.

    Attributes:
        accepted: Readings added since the history was made.
        dropped: Readings refused because they were not later than the one before.
        stale: Questions refused because readings were too old, too far apart or not there in time.
        why: What the writer knows of a silence; the errors' messages end with it.
    """

    def __init__(self, device: str, *, capacity: int = 512, max_gap_s: float = 0.1) -> None:
        if capacity < 2 or not 0 < max_gap_s < float("inf"):
            raise InputError(
                f"{device}: joint history of {capacity} readings with gaps to {max_gap_s} s, allowed are "
                "2 readings or more and gaps above 0"
            )
        self.device = device
        self.accepted = self.dropped = self.stale = 0
        self.why = ""
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._ring: deque[JointState] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._ended: tuple[type[DriverError], str] | None = None

    def add(self, state: JointState) -> bool:
        """Appends a reading and wakes who waits for it; returns whether it was later than the last."""
        with self._changed:
            if self._ring and state.t_ns <= self._ring[-1].t_ns:
                self.dropped += 1
                return False
            self._ring.append(state)
            self.accepted += 1
            self._changed.notify_all()
            return True

    def clear(self) -> None:
        """Forgets all readings and the end: after a loss nothing from before it is used."""
        with self._changed:
            self._ring.clear()
            self._ended, self.why = None, ""
            self._changed.notify_all()

    def end(self, error: type[DriverError], message: str) -> None:
        """No reading will come any more: every question, also one that waits, raises `error`."""
        with self._changed:
            self._ended = self._ended or (error, message)
            self._changed.notify_all()

    def latest(self) -> JointState | None:
        """Returns the last reading, or None if there is none.

        Raises:
            DriverError: The one that the writer ended with.
        """
        with self._changed:
            self._raise_the_end()
            return self._ring[-1] if self._ring else None

    def since(self, not_before_ns: int, timeout_s: float) -> JointState:
        """Returns the first reading that was certainly taken at or after `not_before_ns`; waits for it.

        Raises:
            DeviceTimeoutError: If none came within `timeout_s` of that time or of now.
            DriverError: The one that the writer ended with.
        """
        with self._changed:
            index = self._wait_for(not_before_ns, timeout_s, certainly=True)
            return self._ring[index]

    def at(self, t_ns: int, timeout_s: float) -> JointState:
        """Returns the angles at `t_ns`, linear between the readings around it; waits for the one after.

        Its `t_sd_ns` is that of its neighbours, each by its share: how far the time at which these
        angles held can be from `t_ns`.

        Raises:
            DeviceTimeoutError: If no reading after `t_ns` came within `timeout_s` of that time or of
                now, the readings around it are too far apart, or all are younger.
            DriverError: The one that the writer ended with.
        """
        with self._changed:
            index = self._wait_for(t_ns, timeout_s, certainly=False)
            after = self._ring[index]
            if after.t_ns == t_ns:
                return after
            if index == 0:
                raise self._refused(
                    f"the joints of {_ms(after.t_ns - t_ns)} before the oldest reading are not known"
                )
            before = self._ring[index - 1]
        gap_ns = after.t_ns - before.t_ns
        if gap_ns > self._max_gap_ns:
            raise self._refused(
                f"no reading for {_ms(gap_ns)} around the time asked for, allowed are {_ms(self._max_gap_ns)}"
            )
        part = (t_ns - before.t_ns) / gap_ns
        t_sd_ns = round((1 - part) * before.t_sd_ns + part * after.t_sd_ns)
        return JointState(t_ns, t_sd_ns, before.q + part * (after.q - before.q))

    def _wait_for(self, t_ns: int, timeout_s: float, certainly: bool) -> int:
        """Returns the index of the first reading at or after `t_ns`, or `certainly` so; holds the lock."""
        if not 0 < timeout_s < float("inf"):
            raise InputError(f"{self.device}: timeout {timeout_s} s, allowed is above 0")
        now_ns = time.monotonic_ns()
        if t_ns > now_ns + _AHEAD_NS:
            raise InputError(f"{self.device}: {t_ns} ns is {_ms(t_ns - now_ns)} ahead of the host's clock")
        deadline_ns = max(now_ns, t_ns) + round(timeout_s * 1e9)
        while True:
            self._raise_the_end()
            index = self._first_at(t_ns, certainly)
            if index is not None:
                return index
            left_ns = deadline_ns - time.monotonic_ns()
            if left_ns <= 0:
                raise self._refused(f"no joint reading came within {timeout_s:g} s")
            self._changed.wait(left_ns / 1e9)

    def _first_at(self, t_ns: int, certainly: bool) -> int | None:
        """Looks from the newest back: what is asked for is almost always among the last few."""
        found = None
        for index in range(len(self._ring) - 1, -1, -1):
            reading = self._ring[index]
            if reading.t_ns < t_ns:
                break
            if not certainly or reading.t_ns - reading.t_sd_ns >= t_ns:
                found = index
        return found

    def _raise_the_end(self) -> None:
        if self._ended is not None:
            error, message = self._ended
            raise error(self.device, message)

    def _refused(self, message: str) -> DeviceTimeoutError:
        self.stale += 1
        return DeviceTimeoutError(self.device, f"{message}; {self.why}" if self.why else message)


def _ms(ns: int) -> str:
    return f"{ns / 1e6:.1f} ms"
