"""A joint reader's session with a Denso controller: how it begins, what one read is, how it ends."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

from drivers.bcap.client import Answer, BcapClient, CallRefusedError
from drivers.bcap.options import ArmBcapOptions
from drivers.bcap.packet import Function
from drivers.bcap.result import Result
from drivers.bcap.stamps import ReplyClock, Stamp
from drivers.bcap.transport import Link
from drivers.bcap.variant import EMPTY, Variant, bstr, i4
from drivers.errors import DeviceFaultError, DeviceTimeoutError, DriverError

JOINTS = 6
_STAMPED = "HighCurJntEx"
_ANGLES = "@CURRENT_ANGLE"
# A controller that knows no HighCurJntEx says one of these.
_UNKNOWN = (Result.E_INVALIDCOMMAND, Result.E_NOTIMPL, Result.E_INVALIDARG)
_TRIAL_S = 0.1
_TRIAL_PAUSE_S = 0.008
_END_S = 0.5  # all that taking leave may last


@dataclass(frozen=True, slots=True)
class Reading:
    """What one read gave.

    Attributes:
        degrees: Six joint angles.
        interval_ns: From when to when, host, they can have been read; None: those of the last reading.
        sent_ns: When the call was sent.
        came_ns: When its reply was there.
    """

    degrees: tuple[float, ...]
    interval_ns: tuple[int, int] | None
    sent_ns: int
    came_ns: int


class ArmSession:
    """From Service_Start to Service_Stop over an open link, which it closes at its end.

    Attributes:
        link: How packets travel.
        client: Who calls.
        command: What gives the joints: "HighCurJntEx", or "@CURRENT_ANGLE" where there is none.
    """

    def __init__(self, device: str, link: Link, options: ArmBcapOptions) -> None:
        self.link = link
        self.client = BcapClient(
            device,
            link,
            timeout_s=options.timeout_s,
            retries=options.retries,
            patience_s=options.patience_s,
        )
        self.command = _STAMPED
        self._device, self._options = device, options
        self._clock = ReplyClock(())
        self._controller = self._robot = self._variable = 0
        self._ends: list[tuple[Function, tuple[Variant, ...]]] = []  # calls that release what there is

    def begin(self) -> None:
        """Starts the service, gets the arm's handle, and finds out how the joints are read.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        options, client = self._options, self.client
        try:
            client.call(Function.SERVICE_START, *([bstr(options.service)] if options.service else []))
            names = (options.controller, options.provider, options.machine, options.option)
            self._controller = client.handle(Function.CONTROLLER_CONNECT, *map(bstr, names))
            self._ends.append((Function.CONTROLLER_DISCONNECT, (i4(self._controller),)))
            arm = i4(self._controller), bstr(options.robot), bstr("")
            self._robot = client.handle(Function.CONTROLLER_GET_ROBOT, *arm)
            self._ends.append((Function.ROBOT_RELEASE, (i4(self._robot),)))
            if not self._has_stamps():
                variable = i4(self._robot), bstr(_ANGLES), bstr("")
                self._variable = client.handle(Function.ROBOT_GET_VARIABLE, *variable)
                self._ends.append((Function.VARIABLE_RELEASE, (i4(self._variable),)))
                self.command = _ANGLES
        except CallRefusedError as error:
            raise client.refusal(error, self._controller or None) from error
        if self.command == _STAMPED and options.use_controller_clock:
            self._try_clock()

    def read(self) -> Reading:
        """Reads the joints once.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        answer, values = self._values()
        interval_ns: tuple[int, int] | None = answer.sent_ns, answer.came_ns
        if self.command == _STAMPED:
            interval_ns = self._clock.interval(Stamp(values[0], answer.sent_ns, answer.came_ns))
            values = values[1:]
        return Reading(values[:JOINTS], interval_ns, answer.sent_ns, answer.came_ns)

    def cancel(self) -> None:
        """Ends a call that another thread is in."""
        self.client.cancelled.set()

    def clock_words(self) -> str:
        """Returns for people what readings are stamped by."""
        return self._clock.describe()

    def end(self) -> None:
        """Releases what the controller holds for us, if it answers, and closes the link; never raises."""
        self.client.cancelled.clear()
        deadline_s = time.monotonic() + _END_S
        with contextlib.suppress(DriverError):
            for function, args in [*reversed(self._ends), (Function.SERVICE_STOP, ())]:
                if self.client.mute:
                    break
                with contextlib.suppress(CallRefusedError):
                    self.client.call(function, *args, within_s=deadline_s - time.monotonic())
        if self.client.mute:  # it may hear what it does not answer; over UDP the session would linger
            with contextlib.suppress(DriverError):
                self.client.notify(Function.SERVICE_STOP)
        self.link.close()

    def _has_stamps(self) -> bool:
        try:
            self._stamped()
        except CallRefusedError as error:
            if error.result in _UNKNOWN:
                return False
            raise
        return True

    def _stamped(self) -> Answer:
        return self.client.call(Function.ROBOT_EXECUTE, i4(self._robot), bstr(_STAMPED), EMPTY)

    def _try_clock(self) -> None:
        trial: list[Stamp] = []
        until_s = time.monotonic() + _TRIAL_S
        while time.monotonic() < until_s or len(trial) < 3:
            answer, values = self._values()
            trial.append(Stamp(values[0], answer.sent_ns, answer.came_ns))
            time.sleep(_TRIAL_PAUSE_S)
        self._clock = ReplyClock(trial)
        if self._clock.stands:
            raise DeviceTimeoutError(
                self._device,
                f"the first value of {_STAMPED}, a time in ms, stands still at {trial[0].ms:g}: the "
                "controller hangs; or it has no such clock, then set use_controller_clock = false",
            )

    def _values(self) -> tuple[Answer, tuple[float, ...]]:
        try:
            if self.command == _STAMPED:
                answer = self._stamped()
            else:
                answer = self.client.call(Function.VARIABLE_GET_VALUE, i4(self._variable))
        except CallRefusedError as error:
            raise self.client.refusal(error, self._controller) from error
        values = _numbers(answer.value)
        least = JOINTS + (self.command == _STAMPED)
        if len(values) < least:
            found = f"{answer.value!r:.80}"
            raise DeviceFaultError(self._device, f"{self.command} gave {found}, needed are {least} numbers")
        return answer, values


def _numbers(value: Variant | None) -> tuple[float, ...]:
    """The numbers of an array of numbers or of variants; () for anything else."""
    items = value.value if value is not None and isinstance(value.value, tuple) else ()
    plain = [item.value if isinstance(item, Variant) else item for item in items]
    if not all(isinstance(item, int | float) and not isinstance(item, bool) for item in plain):
        return ()
    return tuple(float(item) for item in plain if isinstance(item, int | float))
