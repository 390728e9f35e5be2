"""An emulated PLC that writes the arm's joint words onto a CAN bus, and fails when it is told to."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from math import degrees
from types import TracebackType
from typing import Literal, Protocol, Self

from drivers.canbus.bus import CanBus, CanFrame
from drivers.canbus.options import BusOptions
from drivers.errors import DriverError
from surfclass.types import Float64

SYNC_ID = 0x80
JOINT_IDS = (0x181, 0x182, 0x183)
COUNTS_PER_DEGREE = 10_000
_NOT_AVAILABLE = -(1 << 23)
_LATEST_FRAMES = 1000
_JOIN_S = 2.0

# missing: the last frame of each set. late: it comes `late_s` after the others. mixed: it carries
# another counter. duplicated: each frame comes twice. frozen: the counter stands still. short: frames lack
# their last bytes. garbage: frames of other ids and of no sense. mute: nothing, no SYNC either.
# impossible: joint 2 is 400°. unavailable: joint 5 says that it has no value.
BridgeFault = Literal[
    "missing",
    "late",
    "mixed",
    "duplicated",
    "frozen",
    "short",
    "garbage",
    "mute",
    "impossible",
    "unavailable",
]


class Jointed(Protocol):
    """The part of `drivers.sim.cell.Cell` that an arm needs."""

    def joints(self, t_ns: int) -> Float64:
        """Returns the true joint angles (6,), rad, at a time of the host's CLOCK_MONOTONIC."""


class CanBridge:
    """The PLC; sends in a thread between start() and stop().

    A cycle reads all joints at one time, then sends a SYNC (id 0x80) and three frames (0x181 to 0x183)
    with two joints each: 24 bits, little endian, signed, 1e-4 degrees; byte 6 is 0, byte 7 the cycle's
    counter. `systemd/can_joints.dbc` says the same.

    Args:
        cell: Whose joints.
        send: Puts a standard frame on the bus: id and data. What it raises ends no cycle but its own.
        period_s: From cycle to cycle.
        late_s: How late the fault "late" is.

    Attributes:
        cycles: How many have been sent.
        undelivered: Frames that the bus did not take.
    """

    def __init__(
        self,
        cell: Jointed,
        send: Callable[[int, bytes], None],
        *,
        period_s: float = 0.01,
        late_s: float = 0.05,
    ) -> None:
        self.cycles = self.undelivered = 0
        self._cell, self._send = cell, send
        self._period_s, self._late_s = period_s, late_s
        self._faults: frozenset[BridgeFault] = frozenset()
        self._cycling = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def faults(self) -> frozenset[BridgeFault]:
        """What fails; may be set at any time, and holds for all that is sent after that."""
        return self._faults

    @faults.setter
    def faults(self, faults: Collection[BridgeFault]) -> None:
        with self._cycling:
            self._faults = frozenset(faults)

    def start(self) -> None:
        """Begins to send."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="emulated PLC")
        self._thread.start()

    def stop(self) -> None:
        """Sends no more; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + self._period_s, time.monotonic())
            try:
                with self._cycling:
                    self._cycle(self._faults)
            except DriverError:  # unplugged: a PLC goes on all the same
                self.undelivered += 1

    def _cycle(self, faults: frozenset[BridgeFault]) -> None:
        if "mute" in faults:
            return
        if "frozen" not in faults:
            self.cycles += 1
        frames = joint_frames(self._cell.joints(time.monotonic_ns()), self.cycles, faults)
        self._send(SYNC_ID, b"")
        for number, (can_id, data) in enumerate(frames):
            if number == 2 and "missing" in faults:
                break
            if number == 2 and "late" in faults and self._stop.wait(self._late_s):
                break
            for _ in range(2 if "duplicated" in faults else 1):
                self._send(can_id, data)


def joint_frames(q: Float64, counter: int, faults: Collection[str] = ()) -> list[tuple[int, bytes]]:
    """Returns the three frames, id and data, of joint angles q (6,) rad.

    Args:
        q: The angles.
        counter: The cycle's, of which the frames carry the lowest eight bits.
        faults: Of `BridgeFault`, those that change what is in a frame.
    """
    words = [round(degrees(angle) * COUNTS_PER_DEGREE) for angle in q]
    if "impossible" in faults:
        words[1] = 400 * COUNTS_PER_DEGREE
    if "unavailable" in faults:
        words[4] = _NOT_AVAILABLE
    frames = []
    for number, can_id in enumerate(JOINT_IDS):
        pair = b"".join(
            word.to_bytes(3, "little", signed=True) for word in words[2 * number : 2 * number + 2]
        )
        ahead = 100 if number == 2 and "mixed" in faults else 0
        frames.append((can_id, pair + bytes([0, (counter + ahead) % 256])))
    if "short" in faults:
        frames = [(can_id, data[:5]) for can_id, data in frames]
    if "garbage" in faults:
        frames = [(can_id ^ 0x555, data[::-1]) for can_id, data in frames]
    return frames


class BusEnd:
    """An emulated device's end of a bus that python-can knows; listens in a thread of its own.

    Args:
        options: Which bus.
        received: Told each frame.

    Attributes:
        heard: The latest frames of others on the bus, the oldest first.
    """

    def __init__(self, options: BusOptions, received: Callable[[CanFrame], None] | None = None) -> None:
        self.heard: deque[CanFrame] = deque(maxlen=_LATEST_FRAMES)
        self.received = received
        self._bus = CanBus("emulated CAN device", options, may_send=True)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Joins the bus.

        Raises:
            DeviceNotFoundError, DriverUnavailableError: As `drivers.canbus.bus.CanBus.open`.
        """
        self._bus.open()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="emulated CAN device")
        self._thread.start()

    def stop(self) -> None:
        """Leaves the bus; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        self._bus.close()

    def send(self, can_id: int, data: bytes, extended: bool = False) -> None:
        """Puts a frame on the bus."""
        self._bus.send(can_id, data, extended)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                frame = self._bus.receive()
            except DriverError:  # down for a while: vcan comes up again
                self._stop.wait(0.1)
                continue
            if frame is not None:
                self.heard.append(frame)
                if self.received is not None:
                    self.received(frame)
