"""Asks a Gardasoft controller, over one of three transports, and knows which answer is to which question."""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import time
from typing import Protocol

from drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceTimeoutError, DriverError
from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.protocol import Event, GardasoftError, Reply, ReplyReader, Version

_CHUNK = 4096
_MOST_EVENTS = 100  # kept while nobody asks; older ones are dropped
_MOST_VERSIONS = 9  # a handshake's answer stays far below gardasoft.MAX_REPLY_BYTES


class Transport(Protocol):
    """Carries bytes; raises the errors of `drivers.errors` only. `drivers.serial_port.SerialPort` is one."""

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""

    def open(self) -> None:
        """Raises DeviceNotFoundError, DeviceFaultError or DriverUnavailableError."""

    def close(self) -> None:
        """Never raises."""

    def write(self, data: bytes) -> None:
        """Raises DeviceTimeoutError or DeviceLostError."""

    def read(self, limit: int, timeout_s: float) -> bytes:
        """Returns what has come, or b"" if nothing came in time; raises DeviceLostError."""


class NetworkPort:
    """A controller's Ethernet port, by TCP or UDP.

    Args:
        name: The device's, which errors name.
        host: Its IPv4 address.
        port: Where it listens; 30313 by default of the maker.
        local_port: None: TCP. Otherwise UDP, from and back to this port of ours; 30312 by default of
            the maker.
        timeout_s: For connecting, and for handing over what is written.
    """

    def __init__(self, name: str, host: str, port: int, local_port: int | None, timeout_s: float) -> None:
        self.name = name
        self.address = f"{'tcp' if local_port is None else 'udp'}://{host}:{port}"
        self._to, self._local_port, self._timeout_s = (host, port), local_port, timeout_s
        self._socket: socket.socket | None = None

    @property
    def is_open(self) -> bool:
        """As `Transport.is_open`."""
        return self._socket is not None

    def open(self) -> None:
        """Connects.

        Raises:
            DeviceNotFoundError: If nothing answers there, or UDP's local port is taken.
        """
        if self._socket is not None:
            return
        made: socket.socket | None = None
        try:
            if self._local_port is None:
                made = socket.create_connection(self._to, self._timeout_s)
                made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            else:
                made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                made.bind(("", self._local_port))
                made.connect(self._to)
            made.settimeout(self._timeout_s)
        except OSError as error:
            if made is not None:
                made.close()
            taken = error.errno == errno.EADDRINUSE
            why = f"another program has UDP port {self._local_port}; end that program" if taken else error
            raise DeviceNotFoundError(self.name, f"{self.address}: {why}") from error
        self._socket = made

    def close(self) -> None:
        """Disconnects; never raises."""
        opened, self._socket = self._socket, None
        if opened is not None:
            with contextlib.suppress(OSError):
                opened.close()

    def write(self, data: bytes) -> None:
        """As `Transport.write`."""
        opened = self._opened()
        try:
            opened.sendall(data)
        except TimeoutError as error:
            raise DeviceTimeoutError(
                self.name, f"{self.address}: {len(data)} bytes were not taken"
            ) from error
        except OSError as error:
            raise self._lost(error) from error

    def read(self, limit: int, timeout_s: float) -> bytes:
        """As `Transport.read`."""
        opened = self._opened()
        try:
            poll = select.poll()
            poll.register(opened, select.POLLIN)
            if not poll.poll(max(0.0, timeout_s) * 1000):
                return b""
            data = opened.recv(limit)
        except OSError as error:
            raise self._lost(error) from error
        if not data and self._local_port is None:
            raise self._lost("it closed the connection")
        return data

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise DeviceLostError(self.name, f"{self.address}: not connected")
        return self._socket

    def _lost(self, why: object) -> DeviceLostError:
        return DeviceLostError(self.name, f"{self.address}: the connection is gone: {why}")


class GardasoftLink:
    """Questions and answers; used from one thread at a time.

    A controller carries out its commands in order and ends each answer with a prompt, which says nothing
    about the question. So after anything went wrong the next question waits for a handshake: a line that
    asks for the version several times, another number of times in each handshake. Only its own answer
    names the version that often; a prompt that comes late is dropped on the way.

    Args:
        name: The device's, which errors name.
        transport: Closed.
        timeout_s: For an answer.
    """

    def __init__(self, name: str, transport: Transport, timeout_s: float) -> None:
        self.name, self.transport, self.timeout_s = name, transport, timeout_s
        self.version: Version | None = None
        self.round_trip_s: float | None = None  # of the last answer
        self._reader = ReplyReader()
        self._answers: list[bytes] = []  # complete, not looked at
        self._events: list[Event] = []
        self._in_step = False
        self._versions = 1

    @property
    def in_step(self) -> bool:
        """Whether the next answer is known to be to the next question."""
        return self._in_step

    def open(self, first: bytes) -> None:
        """Opens the transport and finds out what answers there.

        Args:
            first: A command that is told before anything is asked, and again if nobody answers.

        Raises:
            DeviceNotFoundError: If there is nothing, or it does not answer as these controllers do.
            DeviceFaultError, DriverUnavailableError: As the transport.
        """
        self.transport.open()
        self._reader, self._answers, self._events = ReplyReader(), [], []
        try:
            self.tell(first)
            self._get_in_step(time.monotonic() + self.timeout_s)
        except BaseException as error:
            with contextlib.suppress(DriverError):
                self.tell(first)
            self.transport.close()
            if isinstance(error, DeviceTimeoutError | DeviceLostError):
                raise DeviceNotFoundError(self.name, f"no light controller answers: {error}") from error
            raise

    def close(self) -> None:
        """Closes the transport; never raises."""
        self.transport.close()

    def ask(self, *commands: bytes, timeout_s: float | None = None) -> Reply:
        """Returns the answer to one line of commands, with all events since the last one.

        Raises:
            DeviceTimeoutError: If no answer came in time, or what came is none.
            DeviceLostError: If the transport is gone.
        """
        deadline = time.monotonic() + (self.timeout_s if timeout_s is None else timeout_s)
        if not self._in_step:
            self._get_in_step(deadline)
        line = gardasoft.line(*commands)
        self._in_step = False  # until the answer is here
        self._drop_what_came_unasked()
        asked = time.monotonic()
        self.transport.write(line)
        raw = self._next_answer(line, deadline)
        try:
            reply = gardasoft.parse_reply(raw, line)
        except GardasoftError as error:
            asked_for = line.decode().strip()
            raise DeviceTimeoutError(self.name, f"no answer to {asked_for!r}, but noise: {error}") from error
        self.round_trip_s = time.monotonic() - asked
        self._in_step = True
        events, self._events = (*self._events, *reply.events), []
        return Reply(reply.lines, reply.errors, events)

    def tell(self, *commands: bytes) -> None:
        """Sends commands and waits for nothing: for the light, when there is no answer to be had.

        Raises:
            DeviceTimeoutError, DeviceLostError: As the transport.
        """
        self._in_step = False
        self.transport.write(gardasoft.line(*commands))

    def distrust(self) -> None:
        """Has the next question wait for a handshake: an answer made no sense."""
        self._in_step = False

    def _get_in_step(self, deadline: float) -> None:
        self._versions = 2 + (self._versions - 1) % (_MOST_VERSIONS - 1)
        line = gardasoft.line(*[gardasoft.version()] * self._versions)
        self._drop_what_came_unasked()
        self.transport.write(line)
        while True:
            raw = self._next_answer(line, deadline)
            try:
                reply = gardasoft.parse_reply(raw, line)
                self._keep(reply)
                versions = [gardasoft.parse_version(text) for text in reply.lines]
            except GardasoftError:
                continue  # late, or noise
            if len(versions) == self._versions and not reply.errors:
                self.version = versions[0]
                self._in_step = True
                return

    def _drop_what_came_unasked(self) -> None:
        """Keeps the events in what has come; drops late answers, and noise that harmed nobody."""
        late, self._answers = self._answers, []
        with contextlib.suppress(GardasoftError):
            late += self._reader.feed(self.transport.read(_CHUNK, 0.0))
        for raw in late:
            with contextlib.suppress(GardasoftError):
                self._keep(gardasoft.parse_reply(raw))
        self._events += self._reader.flush()
        del self._events[:-_MOST_EVENTS]

    def _keep(self, late: Reply) -> None:
        """Saves of an answer that nobody waits for what must not get lost."""
        fatal = (Event(0, number) for number in late.errors if number in gardasoft.FATAL_ERRORS)
        self._events += (*late.events, *fatal)

    def _next_answer(self, line: bytes, deadline: float) -> bytes:
        while not self._answers:
            data = self.transport.read(_CHUNK, max(0.0, deadline - time.monotonic()))
            try:
                self._answers = self._reader.feed(data)
            except GardasoftError as error:
                raise DeviceTimeoutError(self.name, f"the wire carries noise: {error}") from error
            if not self._answers and time.monotonic() >= deadline:
                asked = line.decode().strip()
                raise DeviceTimeoutError(self.name, f"no answer to {asked!r} in time")
        return self._answers.pop(0)
