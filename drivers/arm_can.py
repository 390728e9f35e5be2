"""The arm's joint angles from a CAN bus: a PLC's frames by a DBC file (listening only), or CiA objects."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np

from drivers.canbus.bus import CanBus
from drivers.canbus.dbc import DbcJoints
from drivers.canbus.joints import JointSet, SetCounts
from drivers.canbus.layout import DbcOptions, Layout
from drivers.canbus.nodes import CanopenOptions
from drivers.canbus.objects import CanopenJoints
from drivers.canbus.options import ReaderOptions
from drivers.canbus.source import JointSource
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)
from drivers.interfaces import Clock
from drivers.joint_history import JointHistory
from drivers.joint_limits import JointLimits
from surfclass.frames import JointState
from surfclass.schema import validate

_HISTORY_S = 10.0  # longer than a capture can take from its colour frame on
_SILENT_PERIODS = 10
_SILENT_S = 0.2
_JOIN_S = 2.0
_FAULTY_RUN = 5  # so many impossible sets in a row are no accident


class CanArm:
    """An `Arm` whose angles come over CAN.

    A thread reads the bus, and keeps the sets of the last ten seconds. A set's time is that of its
    SYNC, or the middle between its first and its last frame, less the latency.

    Args:
        name: How messages call it.
        clock: Of the host; stamps and sets are on its CLOCK_MONOTONIC.
        options: Which bus, and how often sets come.
        source: What makes sets of frames.
    """

    def __init__(self, name: str, clock: Clock, options: ReaderOptions, source: JointSource) -> None:
        self.name = name
        self._clock = clock
        self._options = options
        self._source = source
        period_s = options.period_ms / 1e3
        self._history = JointHistory(
            name,
            capacity=max(64, math.ceil(_HISTORY_S / period_s)),
            max_gap_s=options.max_gap_s,
        )
        self._silent_ns = round(max(_SILENT_S, _SILENT_PERIODS * period_s) * 1e9)
        self._limits = JointLimits(options.limits_deg, options.limit_margin_deg, options.max_speed_deg_s)
        self._bus: CanBus | None = None
        self._reader: threading.Thread | None = None
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._faulty_run = 0
        self._faulty = self._gone = self._open = False

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._open

    def open(self) -> None:
        """Opens the bus and waits for the first set.

        Raises:
            ConfigurationError: If the interface knows no such channel or bitrate.
            DeviceNotFoundError: If there is no such bus, or no set comes.
            DeviceFaultError: If what comes is impossible, or a node reports a fault.
            DriverUnavailableError: If the interface needs a library or kernel that is not here.
        """
        if self._open:
            return
        self._history.clear()
        self._limits.forget()
        self._faulty_run = 0
        self._faulty = self._gone = False
        self._stop = threading.Event()  # its own for each reader: one that hangs must not come back to life
        before = replace(self._source.counts)
        bus = CanBus(self.name, self._options, wanted=self._source.wanted, may_send=self._source.may_send)
        bus.open()
        try:
            began_ns = self._clock.now_ns()
            self._bus = bus
            self._reader = threading.Thread(
                target=self._read, args=(bus, self._stop), name=f"{self.name}: CAN", daemon=True
            )
            self._reader.start()
            self._source.begin(bus, self)
            self._history.since(began_ns, self._options.open_timeout_s)
        except (DeviceTimeoutError, DeviceLostError) as error:
            reason = f"{self._bare(error)}; {self._came(bus, 0, before)}"
            self.close()
            raise DeviceNotFoundError(self.name, f"{bus.address}: {reason}") from error
        except BaseException:
            self.close()
            raise
        self._open = True

    def close(self) -> None:
        """Releases the bus; never raises, may be called twice."""
        self._open = False
        self._source.end()
        self._stop.set()
        if self._reader is not None:
            self._reader.join(_JOIN_S)
            self._reader = None
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def check(self) -> None:
        """Says what became of the bus; waits for nothing.

        Raises:
            DeviceLostError: If it went away, or is bus-off.
            DeviceFaultError: If what came last was impossible, or a node reports a fault.
            DeviceTimeoutError: If no set came for ten periods.
        """
        bus = self._must_be_open()
        latest = self._history.latest()
        if latest is None or self._clock.now_ns() - latest.t_ns > self._silent_ns:
            raise DeviceTimeoutError(
                self.name,
                f"no set of joint angles for {self._silent_ns / 1e9:g} s; since it was opened "
                f"{self._came(bus, 0, SetCounts())}",
            )

    def about(self) -> Mapping[str, str]:
        """Returns facts about the reader: the libraries, the bus, the frames, their counts."""
        bus = self._must_be_open()
        arrivals = bus.arrivals
        source = dict(self._source.about())
        clock = "arrivals by the host's clock"
        if bus.stamped:
            clock = (
                f"stamps of the wall clock, which was set {arrivals.steps} times; {arrivals.refused} not used"
            )
        return {
            "library": f"{bus.library}, {source.pop('library')}",
            "address": bus.address,
            **source,
            "clock": clock,
            "status": f"{bus.describe()}; sets: {self._source.counts.describe()}",
        }

    def read_joints(self, timeout_s: float) -> JointState:
        """Returns the first set all of which arrived since the call began.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If none came in time; the message says what did come.
            DeviceLostError, DeviceFaultError: As `check`.
        """
        return self._asked(self._history.since, self._clock.now_ns(), timeout_s)

    def joints_at(self, t_ns: int, timeout_s: float) -> JointState:
        """Returns the joint angles at `t_ns`, interpolated between the sets around it.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If the sets around it did not come in time or are too far apart.
            DeviceLostError, DeviceFaultError: As `check`.
        """
        return self._asked(self._history.at, t_ns, timeout_s)

    def heard(self, joints: JointSet) -> None:
        """Keeps a set; after a fault the angles from before it are forgotten."""
        span = joints.span
        state = JointState(
            (span.begin_ns + span.end_ns) // 2 - round(self._options.latency_ms * 1e6),
            (span.end_ns - span.begin_ns + 1) // 2 + round(self._options.latency_sd_ms * 1e6),
            np.array(joints.angles),
        )
        with self._lock:
            if complaint := self._limits.complaint(state):
                self._pass_over(complaint)
                return
            self._faulty_run = 0
            if self._gone:
                return
            if self._faulty:
                self._history.clear()
                self._faulty = False
            self._history.add(state)

    def impossible(self, reason: str) -> None:
        """Passes over what is no angle; five in a row, without a good set in between, are a fault."""
        with self._lock:
            self._pass_over(reason)

    def failed(self, reason: str) -> None:
        """Answers every question with the fault, until a good set comes."""
        with self._lock:
            self._fail(reason)

    def lost(self, reason: str) -> None:
        """Answers every question with the loss, until it is opened again."""
        with self._lock:
            if not self._gone:
                self._gone = True
                self._history.clear()
                self._history.end(DeviceLostError, reason)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read(self, bus: CanBus, stop: threading.Event) -> None:
        reason = "the thread that reads the bus ended"
        try:
            while not stop.is_set():
                frame = bus.receive()
                if frame is not None:
                    self._source.add(frame)
        except DeviceLostError as error:
            reason = self._bare(error)
        finally:
            if not stop.is_set():
                self.lost(reason)

    def _pass_over(self, reason: str) -> None:
        self._source.counts.impossible += 1
        self._faulty_run += 1
        if self._faulty_run >= _FAULTY_RUN:
            self._fail(f"impossible joints {_FAULTY_RUN} times in a row: {reason}")

    def _fail(self, reason: str) -> None:
        if not self._gone and not self._faulty:
            self._faulty = True
            self._history.end(DeviceFaultError, reason)

    def _asked(self, ask: Callable[[int, float], JointState], t_ns: int, timeout_s: float) -> JointState:
        bus = self._must_be_open()
        frames, before = bus.frames, replace(self._source.counts)
        try:
            return ask(t_ns, timeout_s)
        except DeviceTimeoutError as error:
            came = self._came(bus, frames, before)
            raise DeviceTimeoutError(self.name, f"{self._bare(error)}; {came}") from error

    def _came(self, bus: CanBus, frames: int, before: SetCounts) -> str:
        """Says what did come since `frames` and `before` were counted, where no set did."""
        return f"{bus.frames - frames} frames came, sets: {self._source.counts.since(before).describe()}"

    def _bare(self, error: DriverError) -> str:
        return str(error).removeprefix(f"{self.name}: ")

    def _must_be_open(self) -> CanBus:
        if self._bus is None or not self._open:
            raise DeviceLostError(self.name, "it is not open")
        return self._bus


def dbc(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> CanArm:
    """Returns the reader of frames that a DBC file describes, closed.

    Raises:
        ConfigurationError: For options, a DBC file or a table that do not fit.
        DriverUnavailableError: If python-can or cantools is not installed.
    """
    table = validate(DbcOptions, options, name)
    return CanArm(name, clock, table, DbcJoints(Layout(name, table), table))


def canopen(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> CanArm:
    """Returns the reader of CiA 406 encoders and CiA 402 drives, closed.

    Raises:
        ConfigurationError: For options that do not fit.
        DriverUnavailableError: If python-can or canopen is not installed.
    """
    table = validate(CanopenOptions, options, name)
    return CanArm(name, clock, table, CanopenJoints(name, table))
