"""Calls a Denso controller: serial numbers, repeats, waiting while it executes, and what a refusal means."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from drivers.bcap import packet as bcap
from drivers.bcap.packet import Function, Packet
from drivers.bcap.result import Result, describe, failed, signed, unsigned
from drivers.bcap.transport import Link
from drivers.bcap.variant import PacketError, Variant, bstr, i4
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceTimeoutError, DriverError

# After these the session or its handles are of no use any more; a new one is.
_LOST = (
    Result.E_HANDLE,
    Result.E_INVALIDRCVPACKET,
    Result.E_INVALIDSNDPACKET,
    Result.E_NOT_CONNECTED,
    Result.E_MAX_CONNECT,
)

# Commands that only read. The functions that execute could do anything else as well: move the arm.
_DESCRIBE = "GetErrorDescription"
_COMMANDS = {
    Function.ROBOT_EXECUTE: ("HighCurJntEx", "CurJnt"),
    Function.CONTROLLER_EXECUTE: (_DESCRIBE,),
}

_SLICE_S = 0.1  # how soon a call that waits notices that it is cancelled
_BUSY_PAUSE_S = 0.02
_WORDS_WITHIN_S = 0.2


class CallRefusedError(Exception):
    """The controller refused a call; `result` is its HRESULT, 0…2³²−1."""

    def __init__(self, function: Function, result: int) -> None:
        super().__init__(f"{function.name}: {describe(result)}")
        self.function, self.result = function, result


@dataclass(frozen=True, slots=True)
class Answer:
    """What a call returned, and when.

    Attributes:
        value: Its result, or None where it has none.
        sent_ns: When its first attempt was sent, CLOCK_MONOTONIC: the controller may have executed that.
        came_ns: When its reply was there.
    """

    value: Variant | None
    sent_ns: int
    came_ns: int


class BcapClient:
    """One session with a controller over an open link; used by one thread at a time.

    Args:
        device: The name that errors carry.
        link: How packets travel.
        timeout_s: How long a controller may be silent in a call before it counts as mute.
        retries: How often a call is sent in that time where packets can be lost.
        patience_s: How long a call may take while the controller says that it is busy.

    Attributes:
        cancelled: Set from another thread: the call under way ends within 0.1 s.
        repeated: Attempts that were not the first.
        late: Replies to no call that is under way: duplicates, and those that came too late.
        busy: How often the controller said that it is busy.
        mute: Whether the last call got no answer.
    """

    def __init__(self, device: str, link: Link, *, timeout_s: float, retries: int, patience_s: float) -> None:
        self.cancelled = threading.Event()
        self.repeated = self.late = self.busy = 0
        self.mute = False
        self._device, self._link = device, link
        self._timeout_s, self._patience_s = timeout_s, patience_s
        self._attempts = retries if link.repeats else 1
        self._serial = 0

    def call(self, function: Function, *args: Variant, within_s: float | None = None) -> Answer:
        """Calls a function and waits for its result, also while the controller is busy.

        Args:
            function: What to call.
            args: Its arguments.
            within_s: No longer than this, whatever the controller says; None: its patience.

        Raises:
            CallRefusedError: If the controller refuses; `refusal` says what that means.
            DeviceTimeoutError: If it is silent, or busy for too long.
            DeviceLostError: If it went away.
            DeviceFaultError: If the arguments fit into no packet.
        """
        _must_only_read(function, args)
        deadline_ns = time.monotonic_ns() + _ns(self._patience_s if within_s is None else within_s)
        while True:
            answer = self._attempt(function, args, deadline_ns)
            if answer is not None:
                return answer
            # Called anew, not repeated: a repeated call is answered with what it was answered before.
            self.busy += 1
            if time.monotonic_ns() + _ns(_BUSY_PAUSE_S) > deadline_ns or self.cancelled.wait(_BUSY_PAUSE_S):
                raise self._timeout(f"{function.name}: {describe(Result.E_ROBOTISBUSY)} for too long")

    def handle(self, function: Function, *args: Variant) -> int:
        """Calls a function that returns a handle.

        Raises:
            DeviceFaultError: If it returned something else.
            CallRefusedError, DriverError: As `call`.
        """
        value = self.call(function, *args).value
        if value is None or not isinstance(value.value, int):
            raise DeviceFaultError(self._device, f"{function.name} returned {value!r:.80}, not a handle")
        return value.value

    def refusal(self, error: CallRefusedError, controller: int | None) -> DriverError:
        """Returns what a refusal means, with the controller's own words where it has any.

        Args:
            error: The refusal.
            controller: The handle to ask for words, or None.
        """
        if error.result == Result.E_TIMEOUT:
            return self._timeout(str(error))
        if error.result in _LOST:
            return DeviceLostError(self._device, str(error))
        words = "" if controller is None else self._words(controller, error.result)
        return DeviceFaultError(self._device, f"{error}{words}")

    def notify(self, function: Function) -> None:
        """Sends a call without arguments whose answer nobody waits for.

        Raises:
            DeviceLostError: If the link is gone.
        """
        self._serial = bcap.next_serial(self._serial)
        self._link.send(Packet(self._serial, self._serial if self._link.repeats else 0, function))

    def _words(self, controller: int, result: int) -> str:
        args = i4(controller), bstr(_DESCRIBE), i4(signed(result))
        try:
            value = self.call(Function.CONTROLLER_EXECUTE, *args, within_s=_WORDS_WITHIN_S).value
        except (CallRefusedError, DriverError):
            return ""  # it has no words for it; the number stands in the message
        text = None if value is None else value.value
        return f": {text.strip():.200}" if isinstance(text, str) and text.strip() else ""

    def _attempt(self, function: Function, args: tuple[Variant, ...], deadline_ns: int) -> Answer | None:
        """Sends a call until it is answered; None if the answer is that the robot is busy."""
        serials: set[int] = set()
        first = bcap.next_serial(self._serial) if self._link.repeats else 0
        sent_ns = time.monotonic_ns()
        for attempt in range(self._attempts):
            self._serial = bcap.next_serial(self._serial)
            serials.add(self._serial)
            self.repeated += attempt > 0
            try:
                self._link.send(Packet(self._serial, first, function, args))
            except PacketError as error:
                raise DeviceFaultError(self._device, f"{function.name} cannot be sent: {error}") from error
            reply = self._reply(serials, deadline_ns)
            if reply is None:
                continue
            self.mute = False
            came_ns, result = time.monotonic_ns(), unsigned(reply.code)
            if result == Result.E_ROBOTISBUSY:
                return None
            if failed(result):
                raise CallRefusedError(function, result)
            return Answer(reply.args[0] if reply.args else None, sent_ns, came_ns)
        if self._link.is_amid_packet():
            message = f"{self._link.address}: half a packet came, and no more for {self._timeout_s:g} s"
            raise DeviceLostError(self._device, message)
        self.mute = True
        raise self._timeout(f"no answer to {function.name} within {self._timeout_s:g} s")

    def _reply(self, serials: set[int], deadline_ns: int) -> Packet | None:
        """Returns the reply to this call, or None if the controller is silent for one attempt's time."""
        until_ns = time.monotonic_ns() + _ns(self._timeout_s / self._attempts)
        while True:
            now_ns = time.monotonic_ns()
            if now_ns >= deadline_ns:
                self.mute = True
                raise self._timeout("no answer in time")
            if now_ns >= until_ns:
                return None
            packet = self._link.receive(min((min(until_ns, deadline_ns) - now_ns) / 1e9, _SLICE_S))
            if self.cancelled.is_set():
                raise self._timeout("cancelled: the device is being closed")
            if packet is None:
                continue
            if packet.serial not in serials:
                self.late += 1
            elif unsigned(packet.code) in (Result.S_EXECUTING, Result.E_BUSY_PROC):
                self.busy += 1  # it has the call: sending it again is of no use for now
                until_ns = time.monotonic_ns() + _ns(self._timeout_s)
            else:
                return packet

    def _timeout(self, message: str) -> DeviceTimeoutError:
        return DeviceTimeoutError(self._device, f"{self._link.address}: {message}")


def _must_only_read(function: Function, args: tuple[Variant, ...]) -> None:
    if function not in _COMMANDS:
        return
    command = args[1].value if len(args) > 1 else None
    if command not in _COMMANDS[function]:
        raise ValueError(f"{function.name} {command!r}: allowed are {', '.join(_COMMANDS[function])}")


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
