"""Where captures come from: one interface for live sensors and for recordings."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from drivers.errors import CaptureRejectedError, DeviceLostError, DeviceTimeoutError
from drivers.interfaces import Clock
from drivers.sensor_package import SensorPackage
from drivers.triggers import IntervalTrigger, RequestTrigger, RestTrigger, Trigger
from surfclass.frames import Capture

__all__ = [
    "CaptureRequest",
    "CaptureSource",
    "IntervalTrigger",
    "LiveSource",
    "RequestTrigger",
    "RestTrigger",
    "Trigger",
]

_CHECK_NS = 500_000_000  # so that an operator reads of a loss within two seconds


@dataclass(frozen=True, slots=True)
class CaptureRequest:
    """A capture that somebody wants now.

    Attributes:
        name: Of the capture; None: it is numbered.
        role: Its role.
        with_dark: Whether an unlit frame is wanted too.
    """

    name: str | None = None
    role: str = "map"
    with_dark: bool = False


class CaptureSource(Protocol):
    """Gives captures, one after the other; used from one thread, also as a context manager."""

    @property
    def name(self) -> str:
        """How messages call it."""

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""

    @property
    def finished(self) -> bool:
        """Whether no capture will ever come again."""

    def open(self) -> None:
        """Leaves nothing open when it raises a DriverError (live) or an InputError (a recording)."""

    def close(self) -> None:
        """Releases everything; never raises, may be called twice."""

    def release(self, device: str) -> None:
        """Releases the device of that name, so that open() starts it anew; never raises."""

    def next(self, timeout_s: float, request: CaptureRequest | None = None) -> Capture | None:
        """Returns the next capture, or None if none was due within `timeout_s`.

        A request is served at once. A recording answers it with its next capture, which keeps its
        own name, role and times.

        Raises:
            DriverError: The class says what to do.
            CaptureRejectedError: The devices are fine; it may be tried again.
            InputError: The recording is damaged.
        """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class LiveSource:
    """Captures of the sensors, due when the trigger says so, or on request.

    Args:
        package: The sensors.
        trigger: When to capture.
        clock: The sensors' clock.
        role: Of captures that nobody asked for.
        with_dark: Whether those get an unlit frame.
        first_number: Of captures without a name.
    """

    finished = False

    def __init__(
        self,
        package: SensorPackage,
        trigger: Trigger,
        clock: Clock,
        *,
        role: str = "map",
        with_dark: bool = False,
        first_number: int = 1,
    ) -> None:
        self._package, self._trigger, self._clock = package, trigger, clock
        self._default = CaptureRequest(None, role, with_dark)
        self._number = first_number
        self._check_due_ns = 0

    @property
    def name(self) -> str:
        """As the package."""
        return self._package.name

    @property
    def is_open(self) -> bool:
        """As the package."""
        return self._package.is_open

    def open(self) -> None:
        """Opens the sensors; raises as `SensorPackage.open`."""
        self._package.open()

    def close(self) -> None:
        """Turns the light off and releases the sensors."""
        self._package.close()

    def release(self, device: str) -> None:
        """As `SensorPackage.release`."""
        self._package.release(device)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def next(self, timeout_s: float, request: CaptureRequest | None = None) -> Capture | None:
        """As `CaptureSource.next`."""
        if request is not None:
            return self._take(request)
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            now_ns = self._clock.now_ns()
            if now_ns >= self._check_due_ns:
                self._check()
            if self._trigger.due(now_ns, self._package.read_joints):
                return self._take(self._default)
            left_s = (deadline_ns - self._clock.now_ns()) / 1e9
            if left_s <= 0:
                return None
            self._clock.sleep(max(0.0, min(left_s, self._trigger.wait_s(self._clock.now_ns()))))

    def _check(self) -> None:
        """Notices now, and not with the next capture, that a device went away or has nothing to say.

        Raises:
            DeviceLostError: Also for a device that is silent twice.
            DeviceFaultError: As `SensorPackage.check`.
        """
        try:
            self._package.check()
        except DeviceTimeoutError:
            try:
                self._package.check()
            except DeviceTimeoutError as error:
                raise DeviceLostError(error.device, f"silent twice: {error}") from error
        self._check_due_ns = self._clock.now_ns() + _CHECK_NS

    def _take(self, request: CaptureRequest) -> Capture:
        name = request.name or f"{self._number:06d}"
        try:
            capture = self._package.capture(name, request.role, request.with_dark)
        except CaptureRejectedError:
            self._trigger.rejected(self._clock.now_ns())
            raise
        self._check_due_ns = self._clock.now_ns() + _CHECK_NS
        self._number += request.name is None
        self._trigger.taken(capture)
        return capture
