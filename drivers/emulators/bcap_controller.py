"""An emulated Denso controller that speaks b-CAP over TCP, UDP and RS-232, and fails on demand."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from drivers.emulators.bcap_machine import BcapFaults, Call, Joints, Machine
from drivers.emulators.bcap_peer import HangUpError, Peer
from drivers.emulators.ports import free_port

_SEND_TIMEOUT_S = 1.0
_PAUSE_S = 0.05  # on a serial line, within no request
_IDLE_UDP_S = 10.0  # a UDP session that says nothing for so long makes room for another
_READ_SIZE = 1 << 16


class BcapController:
    """A controller of the network, of a serial line, or both; `start` and `stop` are its mains switch.

    Each connection, each UDP peer and the serial line is a session of its own. A call that is repeated
    over UDP or RS-232 is answered as before, and not executed again.

    Args:
        cell: Whose arm it moves.
        host: The address to listen at.
        port: Of TCP and UDP; 0: any that is free.
        udp: Whether UDP is served, too.
        serial_link: Where to put a link to its serial port, a pty; None: it has none.
        model: "RC8" has HighCurJntEx; "RC7" has not.
        drift_ppm: How much faster than the host's its clock goes.
        max_sessions: More are refused.

    Attributes:
        machine: What is behind all its connections.
        host: As given.
        port: The one that it listens at, once started.
    """

    def __init__(
        self,
        cell: Joints,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        udp: bool = True,
        serial_link: Path | None = None,
        model: Literal["RC7", "RC8"] = "RC8",
        drift_ppm: float = 20.0,
        max_sessions: int = 20,
    ) -> None:
        self.machine = Machine(cell, model, drift_ppm=drift_ppm)
        self.host, self.port = host, port
        self._udp, self._serial_link, self._max_sessions = udp, serial_link, max_sessions
        self._stop: Callable[[], None] = _not_started
        self._threads: list[threading.Thread] = []
        self._closing = contextlib.ExitStack()
        self._peers: list[Peer] = []

    @property
    def faults(self) -> BcapFaults:
        """What goes wrong from now on."""
        return self.machine.faults

    @property
    def calls(self) -> deque[Call]:
        """What was asked of it so far."""
        return self.machine.calls

    @property
    def open_sessions(self) -> int:
        """Sessions between Service_Start and Service_Stop or the end of their connection."""
        return sum(peer.session.started for peer in list(self._peers))

    def start(self) -> None:
        """Listens, at the same port as before.

        Raises:
            OSError: If the address cannot be had.
        """
        self.stop()
        with contextlib.ExitStack() as made:
            stop = _Stop()
            made.callback(stop.close)
            tcp, udp = _bound(self.host, self.port)
            made.enter_context(tcp)
            made.enter_context(udp)
            self.port = tcp.getsockname()[1]
            tcp.listen(16)
            targets = [partial(self._accept, stop, tcp)]
            if self._udp:
                targets.append(partial(self._serve_udp, stop, udp))
            else:
                udp.close()
            if self._serial_link is not None:
                targets.append(partial(self._serve_line, stop, _pty(made, self._serial_link)))
            self._stop, self._closing = stop.set, made.pop_all()
        for target in targets:
            self._run(target)

    def stop(self) -> None:
        """Goes away with all its connections; may be called twice."""
        self._stop()
        while self._threads:
            self._threads.pop().join()
        self._closing.close()
        self._peers.clear()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self, target: Callable[[], None]) -> None:
        thread = threading.Thread(target=target, name="b-CAP controller", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _peer(
        self, stop: _Stop, send: Callable[[bytes], None], transport: Literal["tcp", "udp", "serial"]
    ) -> Peer:
        peer = Peer(self.machine, send, stop.event, self._has_room, transport)
        self._peers.append(peer)
        return peer

    def _has_room(self) -> bool:
        return self.open_sessions < self._max_sessions

    def _accept(self, stop: _Stop, listener: socket.socket) -> None:
        while stop.waits_for(listener.fileno()):
            connection, _ = listener.accept()
            self._threads = [thread for thread in self._threads if thread.is_alive()]
            self._run(partial(self._serve_tcp, stop, connection))

    def _serve_tcp(self, stop: _Stop, connection: socket.socket) -> None:
        with connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(_SEND_TIMEOUT_S)
            peer = self._peer(stop, connection.sendall, "tcp")
            buffer = bytearray()
            try:
                while stop.waits_for(connection.fileno()):
                    data = connection.recv(_READ_SIZE)
                    if not data:
                        return
                    buffer += data
                    peer.take(buffer)
            except HangUpError as error:
                if error.reset:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            except OSError:
                return  # the client went away
            finally:
                self._peers.remove(peer)

    def _serve_udp(self, stop: _Stop, made: socket.socket) -> None:
        peers: dict[tuple[str, int], Peer] = {}
        while stop.waits_for(made.fileno()):
            data, address = made.recvfrom(_READ_SIZE)
            if address not in peers:
                for known in [known for known, peer in peers.items() if _is_over(peer)]:
                    self._peers.remove(peers.pop(known))
                peers[address] = self._peer(stop, partial(_send_to, made, address), "udp")
            peers[address].take_datagram(data)

    def _serve_line(self, stop: _Stop, master: int) -> None:
        peer = self._peer(stop, partial(_write, master), "serial")
        buffer = bytearray()
        while stop.waits_for(master, _PAUSE_S if buffer else None):
            data = _read(master)
            if not data:
                buffer.clear()  # a pause: what comes next is another request
            buffer += data
            peer.take_serial(buffer)


def _not_started() -> None:
    pass


class _Stop:
    """A flag that also wakes who waits for a file."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self._seen, self._raised = socket.socketpair()

    def set(self) -> None:
        """Stops everybody, for good."""
        self.event.set()
        self._raised.close()  # the other end is readable from now on, to all

    def waits_for(self, number: int, timeout_s: float | None = None) -> bool:
        """Returns True once a file can be read or the time is over, and False once this is set."""
        poll = select.poll()
        for each in (number, self._seen.fileno()):
            poll.register(each, select.POLLIN)
        poll.poll(None if timeout_s is None else timeout_s * 1e3)
        return not self.event.is_set()

    def close(self) -> None:
        """Releases what it holds."""
        self.set()
        self._seen.close()


def _bound(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Returns sockets of TCP and UDP that have the same port; for 0 one that is free in both."""
    port = port or free_port(host)
    with contextlib.ExitStack() as made:
        tcp = made.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
        udp = made.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        tcp.bind((host, port))
        udp.bind((host, port))
        made.pop_all()
        return tcp, udp


def _is_over(peer: Peer) -> bool:
    return not peer.session.started or time.monotonic() - peer.heard_s > _IDLE_UDP_S


def _send_to(made: socket.socket, address: tuple[str, int], data: bytes) -> None:
    with contextlib.suppress(OSError):  # the client went away: its next question never comes
        made.sendto(data, address)


def _read(master: int) -> bytes:
    """Returns what has come, if anything."""
    with contextlib.suppress(BlockingIOError):
        return os.read(master, _READ_SIZE)
    return b""


def _write(master: int, data: bytes) -> None:
    with contextlib.suppress(BlockingIOError):  # nobody reads: as if the line were not connected
        os.write(master, data)


def _pty(made: contextlib.ExitStack, link: Path) -> int:
    """Returns the controller's end of a pty whose other end `link` names."""
    master, slave = os.openpty()
    made.callback(os.close, master)
    made.callback(os.close, slave)  # held open, or the line would hang up whenever the driver closes it
    tty.setraw(slave)
    os.set_blocking(master, False)
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(slave))
    made.callback(link.unlink, missing_ok=True)
    return master
