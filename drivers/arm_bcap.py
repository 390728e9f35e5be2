"""The joint angles of a Denso arm, read over b-CAP by a thread of its own; nothing here can move it."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np

from drivers.bcap.options import ArmBcapOptions
from drivers.bcap.session import ArmSession, Reading
from drivers.bcap.transport import Link, SerialLink, TcpLink, UdpLink
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

_CONNECT_TIMEOUT_S = 2.0
_HISTORY_S = 10.0  # longer than a capture can take from its colour frame on
_STALE_S = 0.5  # without a reading for so long, an idle arm is not well
_FAULTY_RUN = 5  # so many impossible readings in a row are no accident
_RETRY_PAUSE_S = 0.02
_SAME_STAMP_PAUSE_S = 0.001

_log = logging.getLogger("surfclass.arm")


def arm(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> BcapArm:
    """The factory of `drivers.backends`."""
    return BcapArm(name, validate(ArmBcapOptions, options, name))


class BcapArm:
    """An arm behind a Denso RC7M, RC8, RC8A or RC9 controller.

    A thread reads the joints `rate_hz` times a second, and at once when a reading is asked for. It ends
    with the connection; the driver is then to be closed and opened again.

    A single impossible reading (no number, beyond the limits, faster than any arm) is passed over and
    counted; five in a row are a fault. A reading with the time stamp of the one before is no reading:
    where the controller's clock stands still, calls raise DeviceTimeoutError.
    """

    def __init__(self, name: str, options: ArmBcapOptions) -> None:
        self._name, self._options = name, options
        capacity = max(16, math.ceil(_HISTORY_S * options.rate_hz))
        self._history = JointHistory(name, capacity=capacity, max_gap_s=options.max_gap_s)
        self._limits = JointLimits(options.limits_deg, options.limit_margin_deg, options.max_speed_deg_s)
        self._session: ArmSession | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._wanted = threading.Event()
        self._impossible = self._timeouts = self._faulty_run = 0
        self._round_trip_s = math.nan

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close(), whatever became of the controller."""
        return self._thread is not None

    def open(self) -> None:
        """Connects, finds out how this controller gives joints, and reads them once.

        Raises:
            DeviceNotFoundError: If no b-CAP controller answers, or it has no session left.
            DeviceFaultError: If it refuses, or its joints are impossible.
            DriverUnavailableError: If pyserial is missing.
        """
        if self._thread is not None:
            return
        link = self._link()
        link.open(_CONNECT_TIMEOUT_S)
        session = ArmSession(self._name, link, self._options)
        self._history.clear()
        self._limits.forget()
        self._impossible = self._timeouts = self._faulty_run = 0
        try:
            session.begin()
            self._first_reading(session)
        except BaseException as error:
            session.end()
            if isinstance(error, DeviceTimeoutError | DeviceLostError):
                message = str(error).removeprefix(f"{self._name}: ")
                raise DeviceNotFoundError(self._name, f"no usable controller: {message}") from error
            raise
        _log.info("%s: joints by %s, %s", self._name, session.command, session.clock_words())
        self._session = session
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, args=(session,), name=f"{self._name} reader")
        self._thread.start()

    def close(self) -> None:
        """Ends the reader and the session with the controller, within a second or so."""
        thread, session = self._thread, self._session
        if thread is None or session is None:
            return
        self._stopping.set()
        session.cancel()
        self._wanted.set()
        thread.join()
        session.end()
        self._thread = self._session = None
        self._history.clear()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def read_joints(self, timeout_s: float) -> JointState:
        """Returns a reading taken during the call.

        Its uncertainty is half of the call that fetched it, or less by the controller's time stamp.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If the controller is silent, busy, or its clock stands still.
            DeviceLostError: If the connection is gone or the session ended.
            DeviceFaultError: If the controller reports a fault, or impossible joints.
        """
        self._must_be_open()
        asked_ns = time.monotonic_ns()
        self._wanted.set()
        return self._history.since(asked_ns, timeout_s)

    def joints_at(self, t_ns: int, timeout_s: float) -> JointState:
        """Returns the joint angles at `t_ns`, linear between the readings around it.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If there are no readings around it, also not in time.
            DeviceLostError, DeviceFaultError: As `read_joints`.
        """
        self._must_be_open()
        return self._history.at(t_ns, timeout_s)

    def check(self) -> None:
        """Says what became of the reader; waits for nothing.

        Raises:
            DeviceTimeoutError: If there was no reading for half a second.
            DeviceLostError, DeviceFaultError: As `read_joints`.
        """
        self._must_be_open()
        latest = self._history.latest()
        age_s = math.inf if latest is None else (time.monotonic_ns() - latest.t_ns) / 1e9
        if age_s > _STALE_S:
            why = f"; {self._history.why}" if self._history.why else ""
            raise DeviceTimeoutError(self._name, f"no joint reading for {age_s:.1f} s{why}")

    def about(self) -> Mapping[str, str]:
        """Returns facts about the session and its readings."""
        session = self._session
        facts = {"library": "surfclass b-CAP"}
        if session is None:
            return facts
        return facts | {
            "model": f"Denso, provider {self._options.provider}",
            "address": session.link.address,
            "format": f"{session.command}, degrees",
            "settings": f"{self._options.rate_hz:g} Hz, {self._options.service or 'no service options'}",
            "clock": session.clock_words(),
            "status": self._status(session),
        }

    def _status(self, session: ArmSession) -> str:
        counts = {
            "readings": self._history.accepted,
            "impossible": self._impossible,
            "time-outs": self._timeouts,
            "repeated calls": session.client.repeated,
            "late replies": session.client.late,
            "busy": session.client.busy,
            "not understood": session.link.ignored,
        }
        words = [f"{count} {what}" for what, count in counts.items() if count]
        return ", ".join([*words, f"last round trip {self._round_trip_s * 1e3:.2f} ms"])

    def _must_be_open(self) -> None:
        if self._thread is None:
            raise DeviceLostError(self._name, "it is not open")

    def _link(self) -> Link:
        options = self._options
        if options.transport == "tcp":
            return TcpLink(self._name, options.host, options.port)
        if options.transport == "udp":
            return UdpLink(self._name, options.host, options.port)
        return SerialLink(self._name, options.port_path, options.baud)

    def _first_reading(self, session: ArmSession) -> None:
        """Reads until a reading is believed; open() promises that joints are there."""
        deadline_s = time.monotonic() + self._options.patience_s
        while not self._take(session.read()):
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(self._name, self._history.why or "no joint reading came")
            time.sleep(_RETRY_PAUSE_S)

    def _run(self, session: ArmSession) -> None:
        """Reads until closed or an error; who waits for a reading gets that error."""
        try:
            self._read_on(session)
        except DriverError as error:
            message = str(error).removeprefix(f"{self._name}: ")
            if not self._stopping.is_set():
                _log.warning("%s: the reader ends: %s", self._name, message)
            self._history.end(type(error), message)
        finally:
            self._history.end(DeviceLostError, "its reader has ended")

    def _read_on(self, session: ArmSession) -> None:
        period_s = 1 / self._options.rate_hz
        next_s = time.monotonic()
        in_vain = 0
        while not self._stopping.is_set():
            now_s = time.monotonic()
            # In step, unless it is behind, or readings that were asked for put it ahead.
            next_s = min(max(next_s + period_s, now_s), now_s + period_s)
            try:
                in_vain = 0 if self._take(session.read()) else in_vain + 1
            except DeviceTimeoutError as error:
                self._timeouts += 1
                self._history.why = str(error).removeprefix(f"{self._name}: ")
            # Two readings in the same ms of the controller's clock are one; the next ms brings another.
            pause_s = _SAME_STAMP_PAUSE_S if in_vain == 1 else next_s - time.monotonic()
            if self._wanted.wait(max(0.0, pause_s)):
                self._wanted.clear()

    def _take(self, reading: Reading) -> bool:
        """Keeps a reading that is new and possible; returns whether it did."""
        self._round_trip_s = (reading.came_ns - reading.sent_ns) / 1e9
        if reading.interval_ns is None:
            self._history.why = "the controller answers, and its clock stands still"
            return False
        begin_ns, end_ns = reading.interval_ns
        complaint = "no number"
        if all(math.isfinite(angle) for angle in reading.degrees):
            t_ns = (begin_ns + end_ns) // 2
            state = JointState(t_ns, end_ns - t_ns, np.radians(reading.degrees))
            complaint = self._limits.complaint(state)
            if not complaint:
                self._faulty_run, self._history.why = 0, ""
                return self._history.add(state)
        self._impossible += 1
        self._faulty_run += 1
        self._history.why = f"the controller gives impossible joints: {complaint}"
        if self._faulty_run >= _FAULTY_RUN:
            raise DeviceFaultError(self._name, f"{self._history.why}, {_FAULTY_RUN} times in a row")
        return False
