"""An emulated slcan adapter on a pseudo-terminal: a CAN bus as lines of text, which can be unplugged."""

from __future__ import annotations

import contextlib
import os
import re
import select
import threading
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

_OK, _ERROR = b"\r", b"\a"
_LINE = re.compile(rb"([tr])([0-9A-Fa-f]{3})([0-8])|([TR])([0-9A-Fa-f]{8})([0-8])")
_LONGEST_LINE = 64
_LATEST = 1000
_WAIT_MS = 50
_JOIN_S = 2.0


class SlcanAdapter:
    """The adapter (LAWICEL's protocol); runs in a thread between start() and stop().

    S0…S8 set the bitrate, O opens, L opens for listening only, C closes, t and T send a frame, V, N and F
    tell version, serial number and flags. An answer ends with CR, a refusal is BEL. While it is closed
    no frame of the bus is told, as with the real ones.

    Args:
        link_path: A symbolic link that leads to its pseudo-terminal; made, and removed when it stops or
            is unplugged. One that is left over is replaced.
        received: Told each frame that the host sends: id, data and whether the id is extended.

    Attributes:
        commands: The latest commands of the host, the oldest first.
        mode: "closed", "open" or "listening".
        lost: Frames that the host did not fetch in time.
    """

    def __init__(
        self, link_path: str | Path, received: Callable[[int, bytes, bool], None] | None = None
    ) -> None:
        self.commands: deque[bytes] = deque(maxlen=_LATEST)
        self.mode = "closed"
        self.lost = 0
        self.link_path = Path(link_path)
        self.received = received
        self._lock = threading.Lock()
        self._files: tuple[int, int] | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Plugs it in."""
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        if self.link_path.is_symlink():
            self.link_path.unlink()
        self.link_path.symlink_to(os.ttyname(slave))
        self.mode = "closed"
        self._files = (master, slave)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(master,), name="emulated slcan adapter")
        self._thread.start()

    def stop(self) -> None:
        """Unplugs it: what the host has open is dead, and the path is gone; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        with self._lock:
            files, self._files = self._files, None
        for file in files or ():
            os.close(file)
        with contextlib.suppress(FileNotFoundError):
            self.link_path.unlink()

    def send(self, can_id: int, data: bytes, extended: bool = False) -> None:
        """Tells the host a frame of the bus, if it has opened the adapter."""
        if self.mode != "closed":
            head = f"T{can_id:08X}" if extended else f"t{can_id:03X}"
            self.babble(f"{head}{len(data)}{data.hex().upper()}\r".encode())

    def babble(self, raw: bytes) -> None:
        """Gives the host any bytes."""
        with self._lock:
            if self._files is None:
                return
            try:
                written = os.write(self._files[0], raw)
            except BlockingIOError:
                written = 0
        self.lost += written < len(raw)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self, master: int) -> None:
        poll = select.poll()
        poll.register(master, select.POLLIN)
        buffer = bytearray()
        while not self._stop.is_set():
            if not poll.poll(_WAIT_MS):
                continue
            with contextlib.suppress(BlockingIOError):
                buffer += os.read(master, 4096)
            *lines, rest = bytes(buffer).split(b"\r")
            buffer = bytearray(rest[:_LONGEST_LINE])
            for line in lines:
                self.commands.append(line)
                self.babble(self._answer(line))

    def _answer(self, line: bytes) -> bytes:
        command, opened = line[:1], self.mode != "closed"
        if line in (b"O", b"L"):
            self.mode = "open" if line == b"O" else "listening"
            return _OK
        if command == b"C":
            self.mode = "closed"
            return _OK
        fixed = {b"": _OK, b"V": b"V1013\r", b"N": b"NA123\r", b"F": b"F00\r" if opened else _ERROR}
        if line in fixed:
            return fixed[line]
        if command in b"SsYZ":
            return _OK
        frame = _LINE.match(line)
        if frame is None or self.mode != "open":
            return _ERROR
        kind, can_id, size = (group for group in frame.groups() if group is not None)
        digits = line[frame.end() : frame.end() + 2 * int(size)]
        try:
            data = bytes.fromhex(digits.decode()) if kind in b"tT" else b""
        except ValueError:
            return _ERROR
        if self.received is not None and kind in b"tT":
            self.received(int(can_id, 16), data, kind == b"T")
        return b"z\r" if kind in b"tr" else b"Z\r"
