"""How b-CAP packets travel: TCP, UDP and RS-232; which of them a link is changes nothing above it."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from typing import Protocol

from drivers.bcap import packet as bcap
from drivers.bcap.packet import Packet
from drivers.bcap.variant import PacketError
from drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from drivers.serial_port import SerialPort

_READ_SIZE = 1 << 16
_SEND_TIMEOUT_S = 0.2  # a peer that takes no more bytes has stopped reading


class Link(Protocol):
    """Carries packets to a controller and back; used by one thread at a time.

    Attributes:
        address: For messages.
        repeats: Whether a packet can be lost, so that a call is tried again with a new serial number
            and the first one's in `reserved`.
        ignored: Messages and bytes that were no packet and were passed over.
    """

    address: str
    repeats: bool
    ignored: int

    def open(self, timeout_s: float) -> None:
        """Raises DeviceNotFoundError or DriverUnavailableError."""

    def close(self) -> None:
        """Never raises; may be called twice."""

    def send(self, packet: Packet) -> None:
        """Raises DeviceLostError, or PacketError for one that this link cannot carry."""

    def receive(self, timeout_s: float) -> Packet | None:
        """Returns the next packet, or None if none came in time.

        Raises:
            DeviceLostError: If the other side went away or what comes is no b-CAP.
        """

    def is_amid_packet(self) -> bool:
        """Whether a part of a packet has come whose rest is due."""


class TcpLink:
    """A stream: no packet is ever lost, and one that is malformed ends it."""

    repeats = False

    def __init__(self, device: str, host: str, port: int) -> None:
        self.address, self.ignored = f"tcp {host}:{port}", 0
        self._device, self._host, self._port = device, host, port
        self._socket: socket.socket | None = None
        self._poll = select.poll()
        self._buffer = bytearray()

    def open(self, timeout_s: float) -> None:
        """Connects."""
        self.close()
        try:
            made = socket.create_connection((self._host, self._port), timeout_s)
        except OSError as error:
            message = f"{self.address}: no connection: {error}; is the controller on, and the address right?"
            raise DeviceNotFoundError(self._device, message) from error
        # Without it a request would wait for the acknowledgement of the last, 40 ms away.
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.settimeout(_SEND_TIMEOUT_S)
        self._socket, self._poll = made, _readable(made)

    def close(self) -> None:
        """Disconnects."""
        made, self._socket = self._socket, None
        self._buffer.clear()
        if made is not None:
            with contextlib.suppress(OSError):
                made.close()

    def send(self, packet: Packet) -> None:
        """Hands a packet to the connection."""
        try:
            self._opened().sendall(bcap.encode(packet))
        except OSError as error:  # also a timeout: a part may have gone, so that nothing can follow it
            raise DeviceLostError(self._device, f"{self.address}: it takes no packets: {error}") from error

    def receive(self, timeout_s: float) -> Packet | None:
        """Returns the next packet of the stream."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            try:
                length = bcap.expected_length(self._buffer)
                if length is not None and len(self._buffer) >= length:
                    packet = bcap.decode(bytes(self._buffer[:length]))
                    del self._buffer[:length]
                    return packet
            except PacketError as error:
                raise DeviceLostError(
                    self._device, f"{self.address}: what it sends is no b-CAP: a packet that {error}"
                ) from error
            if not self._poll.poll(_ms_until(deadline_ns)):
                return None
            try:
                data = self._opened().recv(_READ_SIZE)
            except OSError as error:
                raise DeviceLostError(self._device, f"{self.address}: {error}") from error
            if not data:
                raise DeviceLostError(self._device, f"{self.address}: the controller closed the connection")
            self._buffer += data

    def is_amid_packet(self) -> bool:
        """As `Link.is_amid_packet`."""
        return bool(self._buffer)

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise DeviceLostError(self._device, f"{self.address}: not connected")
        return self._socket


class UdpLink:
    """Datagrams of one packet each, from this controller only; anyone's garbage is passed over."""

    repeats = True

    def __init__(self, device: str, host: str, port: int) -> None:
        self.address, self.ignored = f"udp {host}:{port}", 0
        self._device, self._host, self._port = device, host, port
        self._socket: socket.socket | None = None
        self._poll = select.poll()

    def open(self, timeout_s: float) -> None:
        """Binds a port of ours to the controller's; says nothing of whether one is there."""
        self.close()
        try:
            found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
            family, kind, protocol, _, address = found[0]
            made = socket.socket(family, kind, protocol)
            try:
                made.connect(address)
                made.setblocking(False)
            except OSError:
                made.close()
                raise
        except OSError as error:
            raise DeviceNotFoundError(self._device, f"{self.address}: no such address: {error}") from error
        self._socket, self._poll = made, _readable(made)

    def close(self) -> None:
        """Gives the port back."""
        made, self._socket = self._socket, None
        if made is not None:
            with contextlib.suppress(OSError):
                made.close()

    def send(self, packet: Packet) -> None:
        """Sends a datagram."""
        data = bcap.encode(packet)
        if len(data) > bcap.MAX_DATAGRAM:
            raise PacketError(f"a packet of {len(data)} bytes, on UDP allowed are {bcap.MAX_DATAGRAM}")
        try:
            self._opened().send(data)
        except BlockingIOError:
            return  # the queue is full: as if it were lost on the way, so the call tries again
        except OSError as error:
            raise self._lost(error) from error

    def receive(self, timeout_s: float) -> Packet | None:
        """Returns the next packet."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while self._poll.poll(_ms_until(deadline_ns)):
            try:
                return bcap.decode(self._opened().recv(_READ_SIZE))
            except (PacketError, BlockingIOError):
                self.ignored += 1
            except OSError as error:
                raise self._lost(error) from error
        return None

    def is_amid_packet(self) -> bool:
        """Never: a datagram is whole."""
        return False

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise DeviceLostError(self._device, f"{self.address}: not open")
        return self._socket

    def _lost(self, error: OSError) -> DeviceLostError:
        return DeviceLostError(self._device, f"{self.address}: nobody listens there: {error}")


class SerialLink:
    """RS-232, 8N1: each packet has a CRC, and what is no packet is passed over up to the next one."""

    repeats = True

    def __init__(self, device: str, path: str, baud: int) -> None:
        self.address, self.ignored = f"{path} at {baud} baud", 0
        self._port = SerialPort(device, path, baud, write_timeout_s=_SEND_TIMEOUT_S)
        self._buffer = bytearray()

    def open(self, timeout_s: float) -> None:
        """Opens the port."""
        self.close()
        self._port.open()

    def close(self) -> None:
        """Releases the port."""
        self._buffer.clear()
        self._port.close()

    def send(self, packet: Packet) -> None:
        """Writes a packet; the rest of what has come in part is no longer waited for."""
        data = bcap.encode(packet, crc=True)
        if len(data) > bcap.MAX_DATAGRAM:
            raise PacketError(f"a packet of {len(data)} bytes, on RS-232 allowed are {bcap.MAX_DATAGRAM}")
        self._buffer.clear()
        with contextlib.suppress(DeviceTimeoutError):  # not taken: as if it were lost on the way
            self._port.write(data)

    def receive(self, timeout_s: float) -> Packet | None:
        """Returns the next packet whose CRC is right."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            packet = self._take()
            if packet is not None:
                return packet
            data = self._port.read(_READ_SIZE, _ms_until(deadline_ns) / 1e3)
            if not data:
                return None
            self._buffer += data

    def is_amid_packet(self) -> bool:
        """Never: the rest is not needed, since the next packet is found without it."""
        return False

    def _take(self) -> Packet | None:
        """Takes the first packet out of the buffer, and what is no packet before it."""
        while self._buffer:
            try:
                length = bcap.expected_length(self._buffer)
                if length is not None and length > bcap.MAX_DATAGRAM:
                    raise PacketError(f"says that it has {length} bytes")
                if length is None or len(self._buffer) < length:
                    return None
                packet = bcap.decode(bytes(self._buffer[:length]), crc=True)
            except PacketError:
                start = self._buffer.find(1, 1)
                dropped = start if start > 0 else len(self._buffer)
                self.ignored += dropped
                del self._buffer[:dropped]
                continue
            del self._buffer[:length]
            return packet
        return None


def _readable(made: socket.socket) -> select.poll:
    poll = select.poll()
    poll.register(made.fileno(), select.POLLIN)
    return poll


def _ms_until(deadline_ns: int) -> int:
    """Whole milliseconds, rounded up: poll() takes no less."""
    return max(0, -((time.monotonic_ns() - deadline_ns) // 1_000_000))
