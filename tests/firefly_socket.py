"""A Firefly MV for libdc1394 on a computer without USB: behind the socket that iidc_libusb.c reaches."""

from __future__ import annotations

import contextlib
import socket
import struct
import subprocess
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from drivers.bayer import Pattern
from drivers.emulators.firefly import Firefly, Ramps, Source

STALL = -9  # LIBUSB_ERROR_PIPE: there is no such register
_HEAD = struct.Struct("<BBHHH")  # of a control request: type, request, value, index, length


def build_libusb(folder: Path) -> Path:
    """Compiles the stand-in for libusb into `folder`, which goes into LD_LIBRARY_PATH."""
    library, source = folder / "libusb-1.0.so.0", Path(__file__).with_name("iidc_libusb.c")
    command = ["gcc", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", f"-Wl,-soname,{library.name}"]
    subprocess.run([*command, "-o", library, source, "-lpthread"], check=True, timeout=60)
    return folder


class FireflySocket:
    """The camera and its plug; a context manager that plugs it in."""

    def __init__(
        self,
        path: Path,
        source: Source | None = None,
        pattern: Pattern = "GRBG",
        absolute: bool = True,
        point_grey: bool = True,
    ) -> None:
        self.path = path
        self._lock = threading.Condition()
        self._listener: socket.socket | None = None
        self._connections: set[socket.socket] = set()
        self._bulk: socket.socket | None = None
        self._buffers: list[int] = []  # lengths of those that the host has ready
        self.camera = Firefly(self._send, source or Ramps(), pattern, absolute, point_grey)
        self.camera.unplug = self.unplug

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()
        self.camera.stop()

    def plug(self) -> None:
        """Plugs it in; it wakes up as it does after power-on."""
        if self._listener is not None:
            return
        self.camera.reset()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(self.path))
        self._listener.listen(16)
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def unplug(self) -> None:
        """Pulls it out."""
        with self._lock:
            listener, self._listener = self._listener, None
            gone, self._connections = self._connections, set()
            self._bulk = None
            self._buffers.clear()
            self._lock.notify_all()
        if listener is not None:
            self.path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        for connection in gone:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with self._lock:
                if self._listener is not listener:
                    connection.close()
                    return
                self._connections.add(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            purpose = connection.recv(1)
            if purpose == b"C":
                while True:
                    self._control(connection)
            elif purpose == b"B":
                self._serve_bulk(connection)
        except OSError:
            pass
        finally:
            with self._lock:
                self._connections.discard(connection)
                if self._bulk is connection:
                    self._bulk = None
                    self._buffers.clear()
                    self._lock.notify_all()
            connection.close()

    def _control(self, connection: socket.socket) -> None:
        kind, request, value, index, length = _HEAD.unpack(_all(connection, _HEAD.size))
        address, count = index << 16 | value, length // 4
        if kind & 0x80:
            quadlets = [self.camera.read(address + 4 * n) for n in range(count)]
            if request == 0x7F and None not in quadlets:
                connection.sendall(struct.pack("<i", length) + struct.pack(f"<{count}I", *quadlets))
                return
        else:
            written = struct.unpack(f"<{count}I", _all(connection, length))
            if all(self.camera.write(address + 4 * n, quadlet) for n, quadlet in enumerate(written)):
                connection.sendall(struct.pack("<i", length))
                return
        connection.sendall(struct.pack("<i", STALL))

    def _serve_bulk(self, connection: socket.socket) -> None:
        with self._lock:
            self._bulk = connection
            self._buffers.clear()
        while True:
            (length,) = struct.unpack("<I", _all(connection, 4))
            with self._lock:
                self._buffers.append(length)
                self._lock.notify_all()

    def _send(self, frame: bytes) -> None:
        with self._lock:
            self._lock.wait_for(lambda: self._buffers or self._bulk is None)
            if self._bulk is None:
                raise ConnectionResetError
            bulk = self._bulk
            frame = frame[: self._buffers.pop(0)]
        bulk.sendall(struct.pack("<I", len(frame)) + frame)


def _all(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise ConnectionResetError
        data += part
    return data
