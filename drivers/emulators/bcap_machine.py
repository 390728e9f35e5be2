"""The emulated Denso controller behind its connections: joints, clock, and what can go wrong with it."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from surfclass.types import Float64

# What a six-axis arm leaves in the places of the joints that it has not; as read from a controller.
_NO_JOINT = (4.390625, -1.4916681462400413e-154)

WireFault = Literal["", "garbage", "half", "huge", "fin", "rst"]


class Joints(Protocol):
    """What the controller asks of the simulated world."""

    def joints(self, t_ns: int) -> Float64:
        """(6,) rad at a time of CLOCK_MONOTONIC, ns."""


@dataclass
class BcapFaults:
    """What goes wrong from now on; set from any thread while the controller runs.

    Attributes:
        mute: Nothing is answered any more, though requests are taken.
        delay_s: How much longer a call that reads joints takes.
        executing: So many S_EXECUTING come before each reply, whatever the WDT.
        busy: So many reads from now on are answered with E_ROBOTISBUSY.
        result: What reads are answered with, an HRESULT; 0: as usual.
        wire: What is sent instead of a reply: bytes that are no packet, half a packet, a packet said to
            have 4 GiB; or what happens to the connection: it is closed, or reset.
        lose_requests: Each so-many-th request on UDP and RS-232 is lost on the way; 0: none.
        lose_replies: The same for replies.
        duplicate: Each reply on UDP and RS-232 comes twice.
        frozen: The controller's clock and joint values stand still.
        jump_ms: Added to the controller's clock.
        degrees: What is read instead of the joints' angles.
    """

    mute: bool = False
    delay_s: float = 0.0
    executing: int = 0
    busy: int = 0
    result: int = 0
    wire: WireFault = ""
    lose_requests: int = 0
    lose_replies: int = 0
    duplicate: bool = False
    frozen: bool = False
    jump_ms: float = 0.0
    degrees: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Call:
    """What was asked: the function, and the command or name that came with it."""

    function: int
    text: str


class Machine:
    """The controller behind all its connections.

    Args:
        cell: Whose arm it moves.
        model: "RC8" has HighCurJntEx; "RC7" has not.
        drift_ppm: How much faster than the host's its clock goes.
        clock_ms: The step of its time stamps.

    Attributes:
        calls: What was asked of it so far, the last 100 000 of it.
    """

    def __init__(
        self,
        cell: Joints,
        model: Literal["RC7", "RC8"] = "RC8",
        *,
        drift_ppm: float = 20.0,
        clock_ms: float = 1.0,
    ) -> None:
        self.faults = BcapFaults()
        self.model = model
        self.calls: deque[Call] = deque(maxlen=100_000)
        self._cell, self._rate, self._clock_ms = cell, 1 + drift_ppm * 1e-6, clock_ms
        self._booted_ns = time.monotonic_ns()
        self._frozen_ns: int | None = None
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """The time whose joints a read gives: now, unless it is frozen."""
        with self._lock:
            if not self.faults.frozen:
                self._frozen_ns = None
            elif self._frozen_ns is None:
                self._frozen_ns = time.monotonic_ns()
            return self._frozen_ns or time.monotonic_ns()

    def takes_busy(self) -> bool:
        """Whether this read is one of those that find the robot busy."""
        with self._lock:
            busy = self.faults.busy > 0
            self.faults.busy -= busy
            return busy

    def degrees(self, t_ns: int) -> tuple[float, ...]:
        """The eight joint values; of the last two a six-axis arm knows nothing."""
        if self.faults.degrees is not None:
            return self.faults.degrees
        return (*np.degrees(self._cell.joints(t_ns)).tolist(), *_NO_JOINT)

    def stamp_ms(self, t_ns: int) -> float:
        """The controller's own clock at a host time."""
        ms = (t_ns - self._booted_ns) / 1e6 * self._rate + self.faults.jump_ms
        return math.floor(ms / self._clock_ms) * self._clock_ms
