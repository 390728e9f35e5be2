"""How the emulated controller answers one peer: once for each call, while it works, and wrongly on demand."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from drivers.bcap import packet as bcap
from drivers.bcap.packet import Packet
from drivers.bcap.result import Result, signed
from drivers.bcap.variant import PacketError, Variant
from drivers.emulators.bcap_machine import Machine
from drivers.emulators.bcap_session import Session

_GARBAGE = bytes(range(2, 60))


class HangUpError(Exception):
    """The connection ends here; `reset` is how."""

    def __init__(self, reset: bool = False) -> None:
        super().__init__("hung up")
        self.reset = reset


class Peer:
    """A session with whoever is at the other end of a connection.

    Args:
        machine: What answers.
        send: Sends bytes to the other end.
        stopping: Set when the controller goes away.
        has_room: Says whether one more session may start.
        transport: How packets travel; over UDP and RS-232 they can be lost and repeated.

    Attributes:
        session: What was asked for so far.
        heard_s: When the other end was heard of last, monotonic.
    """

    def __init__(
        self,
        machine: Machine,
        send: Callable[[bytes], None],
        stopping: threading.Event,
        has_room: Callable[[], bool],
        transport: Literal["tcp", "udp", "serial"],
    ) -> None:
        self.session = Session(machine)
        self.heard_s = time.monotonic()
        self._machine, self._put, self._stopping, self._has_room = machine, send, stopping, has_room
        self._crc, self._repeats = transport == "serial", transport != "tcp"
        self._answered: int | None = None
        self._last: Packet | None = None
        self._counts = {"request": 0, "reply": 0}

    def take(self, buffer: bytearray) -> None:
        """Answers the whole requests at the beginning of a stream, and takes them out of it.

        Raises:
            HangUpError: If that is no request, or the faults say so.
        """
        try:
            while (length := bcap.expected_length(buffer)) is not None and len(buffer) >= length:
                request = bcap.decode(bytes(buffer[:length]))
                del buffer[:length]
                self.answer(request)
        except PacketError:
            self._put(bcap.encode(Packet(0, 0, signed(Result.E_INVALIDRCVPACKET))))
            raise HangUpError from None

    def take_serial(self, buffer: bytearray) -> None:
        """The same on a line with noise: what is no request is passed over."""
        while (at := buffer.find(1)) >= 0:
            del buffer[:at]
            try:
                length = bcap.expected_length(buffer)
                if length is None or len(buffer) < length <= bcap.MAX_DATAGRAM:
                    return
                request = bcap.decode(bytes(buffer[:length]), crc=True)
            except PacketError:
                del buffer[0]
                continue
            del buffer[:length]
            self.answer(request)

    def take_datagram(self, data: bytes) -> None:
        """Answers a request; what is none is passed over."""
        try:
            request = bcap.decode(data)
        except PacketError:
            return
        self.answer(request)

    def answer(self, request: Packet) -> None:
        """Answers a request, or fails to as the faults say.

        Raises:
            HangUpError: If they say so.
        """
        self.heard_s = time.monotonic()
        faults, first = self._machine.faults, request.reserved or request.serial
        if faults.mute or (self._repeats and self._is_lost("request", faults.lose_requests)):
            return
        if self._repeats and self._last is not None and self._answered == first:
            self._send(replace(self._last, serial=request.serial))
            return
        for _ in range(faults.executing):
            self._send(Packet(request.serial, 0, Result.S_EXECUTING))
        code, args = self._result(request)
        self._answered, self._last = first, Packet(request.serial, 0, code, args)
        self._send(self._last)

    def _result(self, request: Packet) -> tuple[int, tuple[Variant, ...]]:
        if not self.session.started and not self._has_room():
            return signed(Result.E_MAX_CONNECT), ()
        if self.session.reads_joints(request) and not self._works_on(request):
            return signed(Result.E_TIMEOUT), ()
        return self.session.answer(request)

    def _works_on(self, request: Packet) -> bool:
        """Takes as long as the faults say, with a sign of life every WDT; whether within InvokeTimeout."""
        begin_s = time.monotonic()
        end_s = begin_s + self._machine.faults.delay_s
        while (now_s := time.monotonic()) < end_s:
            if now_s - begin_s > self.session.invoke_timeout_s:
                return False
            if self._stopping.wait(min(end_s - now_s, self.session.wdt_s or self.session.invoke_timeout_s)):
                return True
            if self.session.wdt_s is not None and time.monotonic() < end_s:
                self._send(Packet(request.serial, 0, Result.S_EXECUTING))
        return True

    def _send(self, reply: Packet) -> None:
        faults = self._machine.faults
        if self._repeats and self._is_lost("reply", faults.lose_replies):
            return
        data = bcap.encode(reply, self._crc)
        if self._repeats and len(data) > bcap.MAX_DATAGRAM:
            data = bcap.encode(replace(reply, code=signed(Result.E_TOO_MUCH_DATA), args=()), self._crc)
        if faults.wire in ("fin", "rst") and not self._repeats:
            raise HangUpError(reset=faults.wire == "rst")
        if faults.wire == "garbage":
            data = _GARBAGE
        elif faults.wire == "half":
            data = data[: len(data) // 2]
        elif faults.wire == "huge":
            data = data[:1] + b"\xff\xff\xff\xff" + data[5:]
        for _ in range(2 if faults.duplicate and self._repeats else 1):
            self._put(data)

    def _is_lost(self, what: str, every: int) -> bool:
        self._counts[what] += every > 0
        return every > 0 and self._counts[what] % every == 0
