"""The one door to pyserial: a port that is ours alone, with a timeout on every wait and the five errors."""

from __future__ import annotations

import contextlib
import errno
import importlib
import math
import select
import termios
from types import TracebackType
from typing import Any, Self

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverUnavailableError,
)

# pyserial's SerialException is an OSError. termios.error is none, and pyserial lets it through wherever
# it flushes or discards; ValueError is select()'s in a program with more than 1024 open files.
_FAILURES = (OSError, termios.error, ValueError)

_WHY_NOT_OPENED = {
    errno.EACCES: "no permission: the user must be in the port's group (dialout on Debian)",
    errno.EPERM: "no permission: the user must be in the port's group (dialout on Debian)",
    errno.EAGAIN: "another program has it open; end that program",
    errno.EBUSY: "another program has it open; end that program",
    errno.ENOENT: "there is no such port: is the adapter plugged in, and the path right?",
    errno.ENXIO: "nothing is behind this port",
    errno.ENODEV: "nothing is behind this port",
    errno.EIO: "nothing is behind this port",
    errno.ENOTTY: "this is no serial port",
    errno.EISDIR: "this is a folder, no serial port",
}


class SerialPort:
    """A serial port, 8 data bits, no parity, 1 stop bit, no handshake.

    Opened exclusively: a second program that asks for the same is refused, while one that does not ask
    is not (Linux), so every tool should. Used from one thread at a time.

    Args:
        name: The device behind it, which its errors name.
        path: Such as /dev/ttyUSB0, or better one of /dev/serial/by-id, which stays the same.
        baud_rate: Bits in a second.
        write_timeout_s: How long a device may refuse to take what is written.
    """

    def __init__(self, name: str, path: str, baud_rate: int, *, write_timeout_s: float = 0.5) -> None:
        self.name, self.path, self.baud_rate = name, path, baud_rate
        self._write_timeout_s = write_timeout_s
        self._port: Any = None
        self._poll = select.poll()
        self.low_latency = False

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close(), whatever became of the device."""
        return self._port is not None

    def open(self) -> None:
        """Opens the port, with nothing in its input buffer.

        Raises:
            DeviceNotFoundError: If there is none, it may not be opened, or another program has it.
            DeviceFaultError: If the port cannot be set to this baud rate.
            DriverUnavailableError: If pyserial is not installed.
        """
        if self._port is not None:
            return
        try:
            serial = importlib.import_module("serial")
        except ModuleNotFoundError as error:
            raise DriverUnavailableError(
                self.name,
                "a serial port needs the library pyserial: install pyserial (PyPI, Debian: python3-serial)",
            ) from error
        try:
            # timeout=0: reads take what is there; the waiting is done by poll(), which knows no limit
            # of file descriptors and does not configure the port anew for each timeout.
            self._port = serial.Serial(
                self.path, self.baud_rate, timeout=0, write_timeout=self._write_timeout_s, exclusive=True
            )
        except ValueError as error:
            message = f"{self.path}: {self.baud_rate} baud cannot be set: {error}"
            raise DeviceFaultError(self.name, message) from error
        except _FAILURES as error:
            number = error.errno if isinstance(error, OSError) else error.args[0]
            why = _WHY_NOT_OPENED.get(number) if number else _WHY_NOT_OPENED[errno.ENOTTY]
            raise DeviceNotFoundError(self.name, f"{self.path}: {why or error}") from error
        self._poll.register(self._port.fileno(), select.POLLIN)
        self.low_latency = self._shorten_latency()

    def close(self) -> None:
        """Releases the port; never raises, and may be called twice."""
        port, self._port = self._port, None
        if port is None:
            return
        with contextlib.suppress(KeyError, *_FAILURES):
            self._poll.unregister(port.fileno())
        with contextlib.suppress(*_FAILURES):
            port.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, data: bytes) -> None:
        """Hands all of `data` to the port.

        Raises:
            DeviceTimeoutError: If it was not taken in time; a part of it may have been.
            DeviceLostError: If the port is gone or not open.
        """
        port = self._opened()
        serial = importlib.import_module("serial")
        try:
            port.write(data)
        except serial.SerialTimeoutException as error:
            message = f"{self.path}: {len(data)} bytes were not taken within {self._write_timeout_s:g} s"
            raise DeviceTimeoutError(self.name, message) from error
        except _FAILURES as error:
            raise self._lost(error) from error

    def read(self, limit: int, timeout_s: float) -> bytes:
        """Returns what has come, up to `limit` bytes, as soon as there is any; b"" if none came in time.

        Raises:
            DeviceLostError: If the port is gone or not open.
        """
        port = self._opened()
        try:
            if not self._poll.poll(max(0, math.ceil(timeout_s * 1000))):
                return b""
            return bytes(port.read(limit))
        except _FAILURES as error:
            raise self._lost(error) from error

    def discard(self) -> None:
        """Drops what has come and was not read.

        Raises:
            DeviceLostError: If the port is gone or not open.
        """
        port = self._opened()
        try:
            port.reset_input_buffer()
        except _FAILURES as error:
            raise self._lost(error) from error

    def _opened(self) -> Any:
        if self._port is None:
            raise DeviceLostError(self.name, f"{self.path}: the port is not open")
        return self._port

    def _lost(self, error: Exception) -> DeviceLostError:
        return DeviceLostError(self.name, f"{self.path}: the port went away: {error}")

    def _shorten_latency(self) -> bool:
        """Asks a USB adapter to pass bytes on at once; many wait 16 ms for more. Returns if it will."""
        try:
            self._port.set_low_latency_mode(True)
        except _FAILURES:  # a pty or an adapter that has no such mode; slower, not wrong
            return False
        return True
