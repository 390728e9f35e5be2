"""One V4L2 capture node, by linuxpy: each ioctl that the driver needs, and none that waits for a frame.

What fails is an OSError with the kernel's errno; what that means is the driver's to say.
"""

from __future__ import annotations

import errno
import mmap
import os
import re
import select
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from types import ModuleType


@dataclass(frozen=True, slots=True)
class Facts:
    """Who answers.

    Attributes:
        driver: The kernel's driver.
        card: The device's name.
        bus: Where it is plugged in.
        version: Of the driver.
        serial: A USB device's serial number; empty where there is none.
        captures: Whether it is a node that streams single-planar images.
        stamps_arrival: Whether stamps said to be of the exposure's start are of the first bytes' arrival.
    """

    driver: str
    card: str
    bus: str
    version: str
    serial: str
    captures: bool
    stamps_arrival: bool


@dataclass(frozen=True, slots=True)
class Format:
    """A negotiated image format.

    Attributes:
        width: Pixels.
        height: Rows.
        pixel_format: V4L2's four characters.
        row_bytes: From one row to the next.
        progressive: Whether a buffer is one whole exposure, no field of an interlaced frame.
        full_range: Whether values use the type's whole range, as far as the driver says.
    """

    width: int
    height: int
    pixel_format: str
    row_bytes: int
    progressive: bool
    full_range: bool


@dataclass(frozen=True, slots=True)
class Control:
    """A setting of the device, as `v4l2-ctl --list-ctrls` names it."""

    id: int
    name: str
    minimum: int
    maximum: int
    step: int
    writable: bool


@dataclass(frozen=True, slots=True)
class Filled:
    """A buffer that the kernel has filled; the driver's until it is given back.

    Attributes:
        index: Which of the buffers.
        sequence: The driver's frame counter, 32 bits.
        stamp_ns: The driver's time stamp.
        monotonic: Whether that is of CLOCK_MONOTONIC.
        at_start: Whether it is said to be of the start of the exposure, not of the frame's end.
        error: Whether the driver says that the data may be wrong.
        size: Bytes that were filled.
    """

    index: int
    sequence: int
    stamp_ns: int
    monotonic: bool
    at_start: bool
    error: bool
    size: int


@lru_cache(maxsize=1)
def _linuxpy() -> ModuleType:
    """Imported late: it takes a tenth of a second, and only this backend needs it."""
    return import_module("linuxpy.video.device")


class VideoNode:
    """A node that is open; the seam behind which a test puts a camera of its own.

    Args:
        path: Such as /dev/video0 or a link to it.

    Raises:
        OSError: As open(2) does.
        ModuleNotFoundError: If linuxpy is not installed.
    """

    def __init__(self, path: str) -> None:
        self._v4l2 = _linuxpy()
        self._type = self._v4l2.BufferType.VIDEO_CAPTURE
        self._memory = self._v4l2.Memory.MMAP
        self._path = path
        self._maps: list[mmap.mmap] = []
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def facts(self) -> Facts:
        """Asks who answers; does not touch the device itself."""
        told = self._v4l2.read_capabilities(self._fd)
        flags = self._v4l2.Capability(told.device_caps or told.capabilities)
        wanted = self._v4l2.Capability.VIDEO_CAPTURE | self._v4l2.Capability.STREAMING
        version = ".".join(str(told.version >> shift & 0xFF) for shift in (16, 8, 0))
        texts = (told.driver, told.card, told.bus_info)
        driver, card, bus = (text.decode("utf-8", "replace") for text in texts)
        arrival = driver == "uvcvideo" and not _uvc_uses_the_cameras_clock()
        return Facts(driver, card, bus, version, self._serial(), wanted in flags, arrival)

    def formats(self) -> dict[str, list[str]]:
        """Returns the pixel formats that there are, each with its sizes as text."""
        described = {}
        for each in self._v4l2.iter_read_formats(self._fd, self._type):
            sizes = self._v4l2.iter_read_frame_sizes(self._fd, each.pixel_format)
            described[each.pixel_format.human_str()] = [self._size(size) for size in sizes]
        return described

    def set_format(self, width: int, height: int, pixel_format: str) -> Format:
        """Asks for a format and returns what the driver made of it, read back."""
        self._v4l2.set_format(self._fd, self._type, width, height, pixel_format)
        told = self._v4l2.get_raw_format(self._fd, self._type).fmt.pix
        return Format(
            told.width,
            told.height,
            self._v4l2.human_pixel_format(told.pixelformat),
            told.bytesperline,
            told.field == self._v4l2.Field.NONE,
            told.quantization != self._v4l2.raw.Quantization.LIM_RANGE,
        )

    def set_rate(self, rate_hz: float) -> None:
        """Asks for so many frames per second."""
        self._v4l2.set_fps(self._fd, self._type, rate_hz)

    def rate_hz(self) -> float | None:
        """Returns frames per second, or None where the driver does not tell."""
        try:
            return float(self._v4l2.get_fps(self._fd, self._type)) or None
        except ZeroDivisionError:
            return None
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                return None
            raise

    def controls(self) -> dict[str, Control]:
        """Returns the settings that are one number, by name."""
        kinds, flag = self._v4l2.ControlType, self._v4l2.ControlFlag
        numbers = (kinds.INTEGER, kinds.BOOLEAN, kinds.MENU, kinds.INTEGER_MENU, kinds.BITMASK)
        found = {}
        for each in self._v4l2.iter_read_controls(self._fd):
            if each.type in numbers and not each.flags & (flag.DISABLED | flag.HAS_PAYLOAD | flag.WRITE_ONLY):
                name = re.sub(r"[^a-z0-9]+", "_", each.name.decode("utf-8", "replace").lower()).strip("_")
                writable = not each.flags & (flag.READ_ONLY | flag.INACTIVE | flag.GRABBED)
                found[name] = Control(each.id, name, each.minimum, each.maximum, each.step, writable)
        return found

    def read(self, control: Control) -> int:
        """Returns a setting's value."""
        return int(self._v4l2.get_control(self._fd, control.id))

    def write(self, control: Control, value: int) -> None:
        """Sets it; the driver may make another value of it."""
        self._v4l2.set_control(self._fd, control.id, value)

    def start(self, buffers: int) -> int:
        """Maps buffers, gives them all to the driver and starts the stream; returns how many there are."""
        count = self._v4l2.request_buffers(self._fd, self._type, self._memory, buffers).count
        for index in range(count):
            told = self._v4l2.query_buffer(self._fd, self._type, self._memory, index)
            self._maps.append(mmap.mmap(self._fd, told.length, offset=told.m.offset))
            self._v4l2.enqueue_buffer(self._fd, self._type, self._memory, 0, index)
        self._v4l2.stream_on(self._fd, self._type)
        return int(count)

    def stop(self) -> None:
        """Stops the stream; buffers lose what they hold, and none may be with the caller."""
        self._v4l2.stream_off(self._fd, self._type)

    def resume(self) -> None:
        """Gives all buffers to the driver anew and starts the stopped stream."""
        for index in range(len(self._maps)):
            self._v4l2.enqueue_buffer(self._fd, self._type, self._memory, 0, index)
        self._v4l2.stream_on(self._fd, self._type)

    def wait(self, timeout_s: float) -> bool:
        """Returns whether `take` has something to say within the timeout: a buffer or an error."""
        return bool(self._poll.poll(max(0.0, timeout_s) * 1e3))

    def take(self) -> Filled | None:
        """Returns the oldest filled buffer, or None where there is none."""
        try:
            told = self._v4l2.dequeue_buffer(self._fd, self._type, self._memory)
        except BlockingIOError:
            return None
        flag, stamp = self._v4l2.BufferFlag, told.timestamp
        return Filled(
            told.index,
            told.sequence,
            stamp.secs * 1_000_000_000 + stamp.usecs * 1_000,
            told.flags & flag.TIMESTAMP_MASK == flag.TIMESTAMP_MONOTONIC,
            told.flags & flag.TSTAMP_SRC_MASK == flag.TSTAMP_SRC_SOE,
            bool(told.flags & flag.ERROR),
            told.bytesused,
        )

    def data(self, filled: Filled) -> bytes:
        """Returns a copy of what the buffer holds."""
        return self._maps[filled.index][: filled.size]

    def give_back(self, filled: Filled) -> None:
        """Lets the driver fill the buffer again."""
        self._v4l2.enqueue_buffer(self._fd, self._type, self._memory, 0, filled.index)

    def close(self) -> None:
        """Stops the stream and releases everything; what fails here is past mending."""
        if self._fd < 0:
            return
        with suppress(OSError):
            self._v4l2.stream_off(self._fd, self._type)
        for each in self._maps:
            each.close()
        self._maps.clear()
        with suppress(OSError):
            os.close(self._fd)
        self._fd = -1

    def _size(self, size: object) -> str:
        info = size.info  # type: ignore[attr-defined]  # linuxpy's namedtuple has no types
        if hasattr(info, "min_width"):
            return f"{info.min_width} × {info.min_height} to {info.max_width} × {info.max_height}"
        return f"{info.width} × {info.height}"

    def _serial(self) -> str:
        """The USB device's serial number, from sysfs; empty where it has none."""
        with suppress(OSError):
            node = Path("/sys/class/video4linux") / Path(self._path).resolve().name / "device"
            return (node.resolve().parent / "serial").read_text().strip()
        return ""


def _uvc_uses_the_cameras_clock() -> bool:
    """Whether uvcvideo stamps frames by the camera's clock; by default it does as their first bytes come."""
    with suppress(OSError):
        return Path("/sys/module/uvcvideo/parameters/hwtimestamps").read_text().strip() in ("1", "Y")
    return False
