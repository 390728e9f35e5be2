"""An emulated LED controller on a pseudo-terminal, TCP and UDP, that fails when it is told to."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, Self

from drivers.emulators.led_outputs import LedOutputs
from drivers.emulators.ports import free_port
from surfclass.errors import ConfigurationError

_LONGEST_LINE = 256
_NONSENSE = bytes(range(0x80, 0xA0)) + b"\xff>\x81"
_LATEST_COMMANDS = 10_000
_UNPLUGGED_WITHIN_S = 1.0  # the thread's poll() may hold a socket that was closed so long


class Lamp(Protocol):
    """The part of `drivers.sim.cell.Cell` that a light needs."""

    def set_light(self, level: float, holds_from_ns: int) -> None:
        """The LED gives `level`, 0…1, from that time on."""


@dataclass
class WireFaults:
    """What goes wrong between the controller and its driver; may be changed at any time.

    Attributes:
        mute: "deaf": nothing is carried out or answered. "dumb": all is carried out, nothing answered.
        garbage: Answers are bytes without sense.
        half: Answers stop in the middle, before the prompt.
        late_s: Answers come so much later than they should.
        error: Each command is answered with this error, and not carried out.
        event: Told before each answer, as (channel, code).
    """

    mute: Literal["", "deaf", "dumb"] = ""
    garbage: bool = False
    half: bool = False
    late_s: float = 0.0
    error: int | None = None
    event: tuple[int, int] | None = None


class _Client:
    """Somebody who sends commands: what came of the next one, and the way back."""

    def __init__(self, send: Callable[[bytes], object]) -> None:
        self.send, self.line = send, bytearray()


class LedController:
    """The controller; runs in a thread between start() and stop(), and starts off and unrated.

    Args:
        cell: Whose light it is; None: nobody's, but the history is kept all the same.
        link_path: A symbolic link that leads to its pseudo-terminal; made, and removed when it stops.
            One that is left over is replaced.
        tcp_port: Also listens there on 127.0.0.1; 0 takes a free one, see `tcp_port`.
        udp_port: The same for UDP.
        channel: The output that feeds the lamp.
        full_percent: The brightness that is the cell's level 1.
        settle_s: From a command to its light.
        on_command: Told each command line and its answer, as text for people.
    """

    def __init__(
        self,
        cell: Lamp | None,
        link_path: str | Path,
        *,
        tcp_port: int | None = None,
        udp_port: int | None = None,
        channel: int = 1,
        full_percent: float = 100.0,
        settle_s: float = 0.002,
        on_command: Callable[[str], None] | None = None,
    ) -> None:
        self.link_path = Path(link_path)
        self.faults = WireFaults()
        self.outputs = LedOutputs(
            cell.set_light if cell is not None else None,
            channel=channel,
            full_percent=full_percent,
            settle_s=settle_s,
        )
        self.commands: list[str] = []  # lines as they came, the latest
        self.tcp_port, self.udp_port = tcp_port, udp_port
        self._on_command = on_command
        self._lock = threading.RLock()
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._wake, self._woken = -1, -1
        self._master, self._slave = -1, -1
        self._listener: socket.socket | None = None
        self._datagrams: socket.socket | None = None
        self._sockets: dict[int, socket.socket] = {}  # connections by file descriptor
        self._clients: dict[int, _Client] = {}
        self._network: _Client | None = None  # the latest that sent something: it is told events
        self._due: list[tuple[float, Callable[[bytes], object], bytes]] = []  # late answers

    def start(self) -> None:
        """Makes the terminal and the link, listens, and runs.

        Raises:
            ConfigurationError: If the link's place is taken by something else, or a port by somebody else.
        """
        if self._thread is not None:
            return
        self._stopped.clear()
        self.outputs.restart()
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        try:
            self.replug()
        except BaseException:
            self.unplug()
            self._close_pipe()
            raise
        self._thread = threading.Thread(target=self._run, name="led controller", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Goes dark and away; may be called twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._stopped.set()
        self._nudge()
        thread.join()
        self.outputs.power_off()
        self.unplug()
        self._close_pipe()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Returns True when it was stopped, False after the timeout."""
        return self._stopped.wait(timeout_s)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    # ---- what is done to it -----------------------------------------------------------------

    def unplug(self) -> None:
        """Cable and network are pulled; the controller itself goes on, light and all."""
        with self._lock:
            if self._master >= 0:
                with contextlib.suppress(OSError):
                    if self.link_path.readlink() == Path(os.ttyname(self._slave)):
                        self.link_path.unlink()
                os.close(self._master)
                os.close(self._slave)
            self._master, self._slave = -1, -1
            for opened in (*self._sockets.values(), self._listener, self._datagrams):
                if opened is not None:
                    # The thread's poll() holds a closed socket a moment longer: shut down, it is dead now.
                    with contextlib.suppress(OSError):
                        opened.shutdown(socket.SHUT_RDWR)
                    opened.close()
            self._sockets, self._listener, self._datagrams = {}, None, None
            self._clients, self._network, self._due = {}, None, []
        self._nudge()

    def replug(self) -> None:
        """Plugged in again: another terminal under the same link, the same ports.

        Raises:
            ConfigurationError: As `start`.
        """
        with self._lock:
            if self._master >= 0:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            self._set_baud_rate(termios.B115200)
            os.set_blocking(self._master, False)
            self._clients[self._master] = _Client(self._to_terminal)
            self._point_link()
            if self.tcp_port is not None:
                self._listener = self._bound(socket.SOCK_STREAM, self.tcp_port)
                self._listener.listen()
                self.tcp_port = self._listener.getsockname()[1]
            if self.udp_port is not None:
                self._datagrams = self._bound(socket.SOCK_DGRAM, self.udp_port)
                self.udp_port = self._datagrams.getsockname()[1]
        self._nudge()

    def event(self, code: int, channel: int | None = None) -> None:
        """Something happens that the controller tells: at once after GT1, or when GR asks."""
        self.outputs.event(code, channel)
        self._nudge()

    def send(self, data: bytes) -> None:
        """Bytes on the wire that nobody asked for."""
        with self._lock:
            self._to_all(data)

    def _point_link(self) -> None:
        if self.link_path.exists() and not self.link_path.is_symlink():
            raise ConfigurationError(f"{self.link_path} exists and is no link, so it is not replaced")
        try:
            # Never a moment without a link: a driver that opens it meets the old terminal or the new one.
            made = self.link_path.with_name(f".{self.link_path.name}.new")
            made.unlink(missing_ok=True)
            made.symlink_to(os.ttyname(self._slave))
            made.replace(self.link_path)
        except OSError as error:
            raise ConfigurationError(f"{self.link_path}: the link cannot be made: {error}") from error

    def _bound(self, kind: socket.SocketKind, port: int) -> socket.socket:
        until = time.monotonic() + _UNPLUGGED_WITHIN_S
        while True:
            made = socket.socket(socket.AF_INET, kind)
            try:
                if kind == socket.SOCK_STREAM:
                    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                made.bind(("127.0.0.1", port or free_port()))
            except OSError as error:
                made.close()
                if error.errno == errno.EADDRINUSE and time.monotonic() < until:
                    time.sleep(0.01)
                    continue
                raise ConfigurationError(f"port {port} of 127.0.0.1: {error}") from error
            made.setblocking(False)
            return made

    # ---- the thread -------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopped.is_set():
            ready = self._ready()
            with self._lock:
                for descriptor in ready:
                    with contextlib.suppress(OSError):
                        self._receive(descriptor)
                self._to_all(self.outputs.take_events())
                self._send_due()

    def _ready(self) -> list[int]:
        """Waits; returns the descriptors with something to read."""
        poll = select.poll()
        with self._lock:
            servers = [s.fileno() for s in (self._listener, self._datagrams) if s is not None]
            for descriptor in (self._woken, *self._clients, *servers):
                poll.register(descriptor, select.POLLIN)
            left = min((due - time.monotonic() for due, _, _ in self._due), default=1.0)
        return [descriptor for descriptor, _ in poll.poll(max(0.0, left) * 1000)]

    def _receive(self, descriptor: int) -> None:
        if descriptor == self._woken:
            os.read(descriptor, 4096)
        elif self._listener is not None and descriptor == self._listener.fileno():
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._sockets[connection.fileno()] = connection
            self._clients[connection.fileno()] = _Client(connection.sendall)
        elif self._datagrams is not None and descriptor == self._datagrams.fileno():
            self._receive_datagram(self._datagrams)
        elif descriptor in self._clients:
            self._receive_stream(descriptor)

    def _receive_datagram(self, datagrams: socket.socket) -> None:
        data, sender = datagrams.recvfrom(4096)
        self._network = _Client(lambda answer: datagrams.sendto(answer, sender))
        self._take(self._network, data)

    def _receive_stream(self, descriptor: int) -> None:
        client, connection = self._clients[descriptor], self._sockets.get(descriptor)
        if connection is None:
            self._take(client, os.read(descriptor, 4096))
            return
        try:
            data = connection.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._network = client
            self._take(client, data)
            return
        del self._clients[descriptor], self._sockets[descriptor]
        self._network = None if self._network is client else self._network
        connection.close()

    def _take(self, client: _Client, data: bytes) -> None:
        client.line += data.replace(b"\n", b"")
        *lines, rest = bytes(client.line).split(b"\r")
        client.line[:] = rest[:_LONGEST_LINE]
        for line in lines:
            self._answer(client, line[:_LONGEST_LINE])

    def _answer(self, client: _Client, line: bytes) -> None:
        faults, text = self.faults, line.decode("latin-1")
        self.commands = [*self.commands[-_LATEST_COMMANDS:], text]
        if faults.mute == "deaf":
            return
        if faults.error is not None:
            answer = f"Err {faults.error}\n\r>".encode()
        else:
            answer = self.outputs.execute(line)
        if self._on_command is not None:
            said = answer.decode("latin-1").replace("\n\r", " ")
            self._on_command(f"{text} -> {said}")
        if faults.mute == "dumb":
            return
        if faults.garbage or (client.send == self._to_terminal and not self._same_baud_rate()):
            answer = _NONSENSE
        if faults.half:
            answer = answer[: len(answer) // 2]
        if faults.event is not None:
            answer = b"Evt%d,%d\r\n" % faults.event + answer
        self._due.append((time.monotonic() + faults.late_s, client.send, self.outputs.take_events() + answer))
        self._send_due()

    def _send_due(self) -> None:
        now = time.monotonic()
        due = [entry for entry in self._due if entry[0] <= now]
        self._due = [entry for entry in self._due if entry[0] > now]
        for _, send, data in due:
            with contextlib.suppress(OSError):  # gone, or not reading: so is a real wire's
                send(data)

    def _to_all(self, data: bytes) -> None:
        if not data:
            return
        ways: list[Callable[[bytes], object]] = [self._to_terminal] if self._master >= 0 else []
        if self._network is not None:
            ways.append(self._network.send)
        for send in ways:
            with contextlib.suppress(OSError):
                send(data)

    def _to_terminal(self, data: bytes) -> None:
        os.write(self._master, data)

    def _set_baud_rate(self, code: int) -> None:
        settings = termios.tcgetattr(self._slave)
        settings[4] = settings[5] = code
        termios.tcsetattr(self._slave, termios.TCSANOW, settings)

    def _same_baud_rate(self) -> bool:
        return bool(termios.tcgetattr(self._slave)[5] == termios.B115200)

    def _nudge(self) -> None:
        if self._wake >= 0:
            with contextlib.suppress(BlockingIOError):
                os.write(self._wake, b"x")

    def _close_pipe(self) -> None:
        os.close(self._wake)
        os.close(self._woken)
        self._wake, self._woken = -1, -1
