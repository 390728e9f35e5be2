"""The file through which a process serves frames to the plug-in "virtual"; the layout of src/virtual.cpp.

128 bytes of header, then depth and IR, each (h, w) little-endian uint16. The writer holds a lock on the
file for as long as it lives: a writer that was killed is seen at once, and one that starts again brings
a new file under the same path.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import struct
import tempfile
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError

MAGIC = b"SCKINECT"
VERSION = 1
MAX_SIDE = 8192
NO_REGISTRATION_YET = 0xFFFFFFFF


class Header(ctypes.LittleEndianStructure):
    """The first 128 bytes.

    Attributes:
        plugged: 0: not plugged in; else the how-manieth time.
        stubborn: Settings that do not take: 1 mirroring, 2 registration.
        registration: The mode that the plug-in was last asked for.
        sequence: Odd while a frame is being written.
    """

    _fields_ = [
        ("magic", ctypes.c_char * 8),
        ("version", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("fps", ctypes.c_uint32),
        ("horizontal_fov", ctypes.c_float),
        ("vertical_fov", ctypes.c_float),
        ("plugged", ctypes.c_uint32),
        ("stubborn", ctypes.c_uint32),
        ("registration", ctypes.c_uint32),
        ("frame_index", ctypes.c_uint32),
        ("sequence", ctypes.c_uint64),
        ("timestamp_us", ctypes.c_uint64),
        ("serial", ctypes.c_char * 32),
        ("reserved", ctypes.c_char * 32),
    ]


class VirtualFile:
    """The writer's side; close() removes the file.

    Args:
        path: Where the plug-in looks for it; what lies there is replaced. A folder in memory is best.
        size: Width and height of the images, px, each 1 to 8192.
        fps: Frames a second, as told to the application.
        fov_rad: Horizontal and vertical field of view, as told.
        serial: At most 31 bytes.

    Raises:
        InputError: If an argument is out of its range.
        OSError: If the file cannot be made.
    """

    def __init__(
        self, path: Path, size: tuple[int, int], fps: int, fov_rad: tuple[float, float], serial: str
    ) -> None:
        width, height = size
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and fps >= 1):
            raise InputError(f"images of {width} × {height} at {fps} Hz, allowed: 1 to {MAX_SIDE}, from 1 Hz")
        if len(serial.encode()) > 31:
            raise InputError(f"serial number {serial!r}, allowed are 31 bytes")
        self.path = path
        pixels = width * height
        folder = path.parent
        self._descriptor, temporary = tempfile.mkstemp(dir=folder, prefix=f".{path.name}-")
        try:
            os.ftruncate(self._descriptor, ctypes.sizeof(Header) + 4 * pixels)
            # Of the open file, not of the process: also a reader in this process sees it.
            lock = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
            fcntl.fcntl(self._descriptor, fcntl.F_OFD_SETLK, lock)
            self._memory = mmap.mmap(self._descriptor, ctypes.sizeof(Header) + 4 * pixels)
            self.header = Header.from_buffer(self._memory)
            self.header.magic, self.header.version = MAGIC, VERSION
            self.header.width, self.header.height, self.header.fps = width, height, fps
            self.header.horizontal_fov, self.header.vertical_fov = fov_rad
            self.header.registration = NO_REGISTRATION_YET
            self.header.serial = serial.encode()
            Path(temporary).rename(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            os.close(self._descriptor)
            raise
        images = np.frombuffer(self._memory, "<u2", 2 * pixels, ctypes.sizeof(Header))
        self._depth, self._ir = images.reshape(2, height, width)
        self._inode = os.fstat(self._descriptor).st_ino
        self._fence = threading.Lock()

    def plug(self, connected: bool, times: int) -> None:
        """Plugs the camera in, for the `times`-th time from 1 on, or out."""
        self.header.plugged = times if connected else 0

    def publish(
        self, depth: NDArray[np.uint16], ir: NDArray[np.uint16], timestamp_us: int, index: int
    ) -> None:
        """Writes both images of one exposure.

        Raises:
            ValueError: If an image has another size.
        """
        self.begin()
        self._depth[...] = depth
        self._ir[...] = ir
        self.header.timestamp_us, self.header.frame_index = timestamp_us, index
        self.end()

    def begin(self) -> None:
        """Marks that a frame is being written; what is there until `end` must not be read."""
        with self._fence:  # taking and releasing a lock orders the stores around it on every processor
            self.header.sequence |= 1
        with self._fence:
            pass

    def end(self) -> None:
        """Marks that the frame is whole."""
        with self._fence:
            pass
        with self._fence:
            self.header.sequence += 1

    def spoil(self, value: int) -> None:
        """Overwrites the upper half of both images, for tests of torn frames; between begin() and end()."""
        rows = len(self._depth) // 2
        self._depth[:rows] = self._ir[:rows] = value

    def close(self) -> None:
        """Lets go of the file and removes it, unless another writer's lies there by now."""
        self.header.plugged = 0
        try:
            if self.path.stat().st_ino == self._inode:
                self.path.unlink()
        except FileNotFoundError:
            pass
        os.close(self._descriptor)  # the mapping goes with the last view of it
