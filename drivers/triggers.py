"""When live captures are due: on request only, at an interval, or where the arm has come to rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from surfclass.errors import ConfigurationError
from surfclass.frames import Capture, JointState
from surfclass.types import Float64

ReadJoints = Callable[[], JointState | None]


class Trigger(Protocol):
    """Says when a capture is due."""

    def due(self, now_ns: int, read_joints: ReadJoints) -> bool:
        """Whether one is due at `now_ns`."""

    def wait_s(self, now_ns: int) -> float:
        """For how long asking again is no use."""

    def taken(self, capture: Capture) -> None:
        """Tells that a capture was taken, due or on request."""

    def rejected(self, now_ns: int) -> None:
        """Tells that the capture that was due was rejected."""


class RequestTrigger:
    """Never fires: captures are taken on request only."""

    def due(self, now_ns: int, read_joints: ReadJoints) -> bool:
        """Never."""
        return False

    def wait_s(self, now_ns: int) -> float:
        """For ever."""
        return math.inf

    def taken(self, capture: Capture) -> None:
        """Changes nothing."""

    def rejected(self, now_ns: int) -> None:
        """Changes nothing."""


class IntervalTrigger:
    """Fires at once and then at every tick; ticks that pass during a capture are left out, not saved up."""

    def __init__(self, interval_s: float) -> None:
        if not 0 < interval_s < math.inf:
            raise ConfigurationError(f"interval_s {interval_s}, allowed is above 0 and finite")
        self._interval_ns = round(interval_s * 1e9)
        self._due_ns: int | None = None

    def due(self, now_ns: int, read_joints: ReadJoints) -> bool:
        """Whether a tick has come since the last time it was true."""
        if self._due_ns is None:
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            return False
        self._due_ns += (1 + (now_ns - self._due_ns) // self._interval_ns) * self._interval_ns
        return True

    def wait_s(self, now_ns: int) -> float:
        """Until the next tick."""
        return 0.0 if self._due_ns is None else (self._due_ns - now_ns) / 1e9

    def taken(self, capture: Capture) -> None:
        """Changes nothing."""

    def rejected(self, now_ns: int) -> None:
        """Changes nothing: the next tick is the next try."""


class RestTrigger:
    """Fires once at each place where the arm comes to rest.

    Args:
        rest_s: So long no joint may have moved.
        still_rad: Up to here a joint has not moved: encoder noise, vibration.
        moved_rad: A joint must be this far from where the last capture was taken.
        poll_s: How often the joints are read.
    """

    def __init__(
        self, rest_s: float = 0.5, still_rad: float = 0.001, moved_rad: float = 0.01, poll_s: float = 0.05
    ) -> None:
        if not (0 < rest_s < math.inf and 0 < still_rad < moved_rad < math.inf and poll_s > 0):
            raise ConfigurationError(
                f"rest_s {rest_s}, still_rad {still_rad}, moved_rad {moved_rad}, poll_s {poll_s}: allowed "
                "are rest_s and poll_s above 0, and 0 < still_rad < moved_rad"
            )
        self._rest_ns, self._still, self._moved = round(rest_s * 1e9), still_rad, moved_rad
        self._poll_s = poll_s
        self._place: JointState | None = None  # where it has stood still since
        self._captured: Float64 | None = None

    def due(self, now_ns: int, read_joints: ReadJoints) -> bool:
        """Whether the arm has stood long enough at a place that was not captured."""
        joints = read_joints()
        if joints is None:
            raise ConfigurationError("the rest trigger needs an arm")
        if self._place is None or _distance(joints.q, self._place.q) > self._still:
            self._place = joints
        if joints.t_ns - self._place.t_ns < self._rest_ns:
            return False
        return self._captured is None or _distance(joints.q, self._captured) > self._moved

    def wait_s(self, now_ns: int) -> float:
        """Until the next reading."""
        return self._poll_s

    def taken(self, capture: Capture) -> None:
        """Remembers the place."""
        if capture.joints is not None:
            self._captured = capture.joints.q

    def rejected(self, now_ns: int) -> None:
        """Waits for another rest."""
        self._place = None


def _distance(q: Float64, other: Float64) -> float:
    return float(np.abs(q - other).max())
