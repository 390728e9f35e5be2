"""When the joints of a b-CAP reply were read: by the call around it, and by the controller's own stamps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.device_clock import DeviceClock

_TICK_S = 1e-6  # stamps are milliseconds, of which a controller may give fractions
_TICKS_PER_MS = 1000
_RATE_ERROR = 0.3  # of a clock over the short time of the trial, where steps are large


@dataclass(frozen=True, slots=True)
class Stamp:
    """A controller's time stamp, and the call that fetched it.

    Attributes:
        ms: As the controller gave it.
        sent_ns: When the call was sent, host.
        came_ns: When its reply was there, host.
    """

    ms: float
    sent_ns: int
    came_ns: int


class ReplyClock:
    """Says in which interval of the host's clock a reply's joints were read.

    That is from sending the call to its reply. The controller's stamp narrows it, since a reply that was
    slow to come does not make the joints it brings uncertain; and a stamp that says that they were read
    before the call was sent is believed. A stamp that is impossible is not.

    Args:
        trial: The first stamps of a session, over 0.1 s or more. Whether they are milliseconds of a clock
            is told from them.

    Attributes:
        trusted: Whether they are; else only the calls' times are used.
        stands: Whether all of the trial have the same stamp: a clock that stands, or none at all.
        older: Joints that had been read before they were asked for.
        refuted: Stamps after their own arrival.
    """

    def __init__(self, trial: Sequence[Stamp]) -> None:
        self.older = self.refuted = 0
        self.trusted = _is_clock(trial)
        self.stands = len(trial) > 1 and all(stamp.ms == trial[0].ms for stamp in trial)
        # The latency that is known: the fastest reply's stamp was taken somewhere within its call.
        half_s = min((stamp.came_ns - stamp.sent_ns for stamp in trial), default=0) / 2e9
        self._clock = DeviceClock(_TICK_S, latency_s=half_s, latency_sd_s=half_s)
        self._step_ns = 1_000_000 if all(stamp.ms.is_integer() for stamp in trial) else 0
        self._last_ms = math.nan
        if self.trusted:
            for stamp in trial:
                self.interval(stamp)

    @property
    def jumps(self) -> int:
        """How often the controller's clock jumped."""
        return self._clock.jumps

    def interval(self, stamp: Stamp) -> tuple[int, int] | None:
        """Returns from when to when, host ns, the joints can have been read; None for those of before."""
        call = stamp.sent_ns, stamp.came_ns
        if not self.trusted:
            return call
        if stamp.ms == self._last_ms:
            return None
        if not math.isfinite(stamp.ms) or abs(stamp.ms) > 1e15:
            self.refuted += 1
            return call
        self._last_ms = stamp.ms
        ticks = round(stamp.ms * _TICKS_PER_MS)
        self._clock.observe(ticks, stamp.came_ns)
        t_ns, half_ns = self._clock.to_host(ticks)
        begin_ns, end_ns = t_ns - half_ns, t_ns + half_ns + self._step_ns
        if begin_ns > stamp.came_ns:
            self.refuted += 1
            return call
        if end_ns < stamp.sent_ns:
            self.older += 1
            return begin_ns, end_ns
        return max(begin_ns, stamp.sent_ns), min(end_ns, stamp.came_ns)

    def describe(self) -> str:
        """Returns for people which clock readings are stamped by, and how well."""
        if not self.trusted:
            return "host, between call and reply"
        words = f"controller's, {self._clock.describe()}"
        return f"{words}, {self.older} readings older than their call" if self.older else words


def _is_clock(trial: Sequence[Stamp]) -> bool:
    """Whether stamps never go back and count about as many ms as the host does."""
    if len(trial) < 2 or not all(math.isfinite(stamp.ms) for stamp in trial):
        return False
    if any(after.ms < before.ms for before, after in itertools.pairwise(trial)):
        return False
    first, last = trial[0], trial[-1]
    counted_ns = (last.ms - first.ms) * 1e6
    least_ns, most_ns = last.sent_ns - first.came_ns, last.came_ns - first.sent_ns
    return least_ns * (1 - _RATE_ERROR) <= counted_ns <= most_ns * (1 + _RATE_ERROR) and counted_ns > 0
