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

from drivers.sim.bcap_machine import BcapFaults, Call, Joints, Machine
from drivers.sim.bcap_peer import HangUpError, Peer

_TICK_S = 0.05  # how soon a thread notices that it is stopped
_SEND_TIMEOUT_S = 1.0
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
        self._stopping = threading.Event()
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
            tcp = made.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tcp.bind((self.host, self.port))
            self.port = tcp.getsockname()[1]
            tcp.listen(16)
            targets = [partial(self._accept, tcp)]
            if self._udp:
                udp = made.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                udp.bind((self.host, self.port))
                targets.append(partial(self._serve_udp, udp))
            if self._serial_link is not None:
                targets.append(partial(self._serve_line, _pty(made, self._serial_link)))
            self._closing = made.pop_all()
        for target in targets:
            self._run(target)

    def stop(self) -> None:
        """Goes away with all its connections; may be called twice."""
        self._stopping.set()
        while self._threads:
            self._threads.pop().join()
        self._closing.close()
        self._peers.clear()
        self._stopping = threading.Event()

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

    def _peer(self, send: Callable[[bytes], None], transport: Literal["tcp", "udp", "serial"]) -> Peer:
        peer = Peer(self.machine, send, self._stopping, self._has_room, transport)
        self._peers.append(peer)
        return peer

    def _has_room(self) -> bool:
        return self.open_sessions < self._max_sessions

    def _accept(self, listener: socket.socket) -> None:
        while not self._stopping.is_set():
            if _readable(listener.fileno()):
                connection, _ = listener.accept()
                self._threads = [thread for thread in self._threads if thread.is_alive()]
                self._run(partial(self._serve_tcp, connection))

    def _serve_tcp(self, connection: socket.socket) -> None:
        with connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(_SEND_TIMEOUT_S)
            peer = self._peer(connection.sendall, "tcp")
            buffer = bytearray()
            try:
                while not self._stopping.is_set():
                    if _readable(connection.fileno()):
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

    def _serve_udp(self, made: socket.socket) -> None:
        peers: dict[tuple[str, int], Peer] = {}
        while not self._stopping.is_set():
            if not _readable(made.fileno()):
                continue
            data, address = made.recvfrom(_READ_SIZE)
            if address not in peers:
                for known in [known for known, peer in peers.items() if _is_over(peer)]:
                    self._peers.remove(peers.pop(known))
                peers[address] = self._peer(partial(_send_to, made, address), "udp")
            peers[address].take_datagram(data)

    def _serve_line(self, master: int) -> None:
        peer = self._peer(partial(_write, master), "serial")
        buffer = bytearray()
        while not self._stopping.is_set():
            if _readable(master):
                buffer += os.read(master, _READ_SIZE)
                peer.take_serial(buffer)
            else:
                buffer.clear()  # a pause: what comes next is another request


def _is_over(peer: Peer) -> bool:
    return not peer.session.started or time.monotonic() - peer.heard_s > _IDLE_UDP_S


def _readable(number: int) -> bool:
    poll = select.poll()
    poll.register(number, select.POLLIN)
    return bool(poll.poll(_TICK_S * 1e3))


def _send_to(made: socket.socket, address: tuple[str, int], data: bytes) -> None:
    with contextlib.suppress(OSError):  # the client went away: its next question never comes
        made.sendto(data, address)


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
