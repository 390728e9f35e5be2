"""A device of the runtime and its streams: settings read back, and frames copied within a timeout."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Sequence
from ctypes import POINTER, byref, c_float, c_int, c_void_p
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.openni2 import api
from drivers.openni2.api import DeviceProperty, Sensor, Status, StreamProperty
from drivers.openni2.errors import OpenNI2Error
from drivers.openni2.runtime import Runtime

_TEXT_BYTES = 256
_PIXELS = {
    api.PixelFormat.DEPTH_1_MM: np.uint16,
    api.PixelFormat.DEPTH_100_UM: np.uint16,
    api.PixelFormat.GRAY16: np.uint16,
    api.PixelFormat.GRAY8: np.uint8,
}


@dataclass(frozen=True)
class Mode:
    """A format of a stream."""

    pixel_format: int
    width: int
    height: int
    fps: int


@dataclass(frozen=True)
class Image:
    """One frame, copied out of the runtime.

    Attributes:
        timestamp_us: By the device's clock.
        index: The device's frame counter.
        arrived_ns: When it was fetched, CLOCK_MONOTONIC.
        pixels: (h, w) uint16 or uint8.
    """

    timestamp_us: int
    index: int
    arrived_ns: int
    pixels: NDArray[Any]


class _Object:
    """What devices and streams share: properties.

    Args:
        runtime: The runtime that it belongs to.
        kind: "Device" or "Stream", as the functions are called.
        handle: The runtime's.
    """

    def __init__(self, runtime: Runtime, kind: str, handle: c_void_p) -> None:
        self._api, self._kind, self._handle = runtime.api, kind, handle

    def supports(self, number: int) -> bool:
        """Returns whether there is such a property."""
        return bool(self._api.call(f"{self._kind}IsPropertySupported", self._handle, number))

    def read(self, number: int, into: Any) -> Any:
        """Returns `into`, filled with the property's value.

        Raises:
            OpenNI2Error: If it cannot be read, or has another size.
        """
        size = c_int(ctypes.sizeof(into))
        what = f"{self._kind.lower()} property {number}"
        self._api.must(what, f"{self._kind}GetProperty", self._handle, number, byref(into), byref(size))
        return into

    def write(self, number: int, value: Any) -> None:
        """Sets a property.

        Raises:
            OpenNI2Error: If the device does not take it.
        """
        what = f"setting {self._kind.lower()} property {number}"
        size = ctypes.sizeof(value)
        self._api.must(what, f"{self._kind}SetProperty", self._handle, number, byref(value), size)

    def value(self, number: int, into: Any) -> Any | None:
        """Returns the value of a numeric property, None where there is none.

        The player of recordings says of no property of a stream that it is supported, and has them.

        Raises:
            OpenNI2Error: If there is one that cannot be read.
        """
        try:
            return self.read(number, into).value
        except OpenNI2Error:
            if self.supports(number):
                raise
            return None

    def integer(self, number: int) -> int | None:
        """Returns an integer property, None where there is none; as `value`."""
        value = self.value(number, c_int())
        return None if value is None else int(value)

    def settle(self, number: int, wanted: int) -> int | None:
        """Sets an integer property unless it is so already, and returns what it is then; None: it has none.

        Raises:
            OpenNI2Error: If it cannot be read.
        """
        value = self.integer(number)
        if value is not None and value != wanted:
            try:
                self.write(number, c_int(wanted))
            except OpenNI2Error:
                return value
            value = self.integer(number)
        return value


class Stream(_Object):
    """A stream of images, created and not started."""

    def __init__(self, runtime: Runtime, handle: c_void_p, sensor: Sensor) -> None:
        super().__init__(runtime, "Stream", handle)
        self.sensor = sensor

    def start(self) -> None:
        """Lets frames come.

        Raises:
            OpenNI2Error: If the device refuses.
        """
        self._api.must(f"start of the {self.sensor.name} stream", "StreamStart", self._handle)

    def stop(self) -> None:
        """Lets no more frames come."""
        self._api.call("StreamStop", self._handle)

    def destroy(self) -> None:
        """Releases it; stop it before."""
        self._api.call("StreamDestroy", self._handle)

    @property
    def handle(self) -> c_void_p:
        """The runtime's."""
        return self._handle

    @property
    def mode(self) -> Mode:
        """The format that it has now."""
        mode = self.read(StreamProperty.VIDEO_MODE, api.VideoMode())
        return Mode(mode.pixel_format, mode.width, mode.height, mode.fps)

    def set_mode(self, mode: Mode) -> None:
        """Chooses a format.

        Raises:
            OpenNI2Error: If the device does not take it.
        """
        self.write(
            StreamProperty.VIDEO_MODE, api.VideoMode(mode.pixel_format, mode.width, mode.height, mode.fps)
        )

    def field_of_view(self) -> tuple[float, float] | None:
        """Returns the factory's horizontal and vertical field of view, rad; None where it is not told."""
        numbers = (StreamProperty.HORIZONTAL_FOV, StreamProperty.VERTICAL_FOV)
        horizontal, vertical = (self.value(number, c_float()) or 0.0 for number in numbers)
        return (horizontal, vertical) if horizontal > 0 and vertical > 0 else None

    def fetch(self) -> Image:
        """Returns the frame that `Device.wait` said is there, copied and given back.

        Raises:
            OpenNI2Error: If there is none, or it is not as its mode says.
        """
        frame = POINTER(api.Frame)()
        self._api.must(f"{self.sensor.name} frame", "StreamReadFrame", self._handle, byref(frame))
        arrived_ns = time.monotonic_ns()
        if not frame:
            raise OpenNI2Error(f"{self.sensor.name} frame", Status.ERROR, "the runtime has none")
        try:
            told = frame[0]
            return Image(told.timestamp_us, told.index, arrived_ns, self._pixels(told))
        finally:
            self._api.call("FrameRelease", frame)

    def _pixels(self, frame: Any) -> NDArray[Any]:
        kind = _PIXELS.get(frame.mode.pixel_format)
        sizes = f"{frame.width} × {frame.height}, {frame.stride} bytes a row, {frame.data_size} bytes"
        if kind is None or frame.sensor != self.sensor or not frame.data:
            what = f"sensor {frame.sensor}, format {frame.mode.pixel_format}, {sizes}"
            raise OpenNI2Error(f"{self.sensor.name} frame", Status.ERROR, f"not of this stream: {what}")
        row = frame.width * np.dtype(kind).itemsize
        whole = (frame.mode.width, frame.mode.height) == (frame.width, frame.height)
        if not whole or frame.stride < row or frame.data_size < frame.stride * (frame.height - 1) + row:
            raise OpenNI2Error(f"{self.sensor.name} frame", Status.ERROR, f"cropped or cut short: {sizes}")
        memory = (ctypes.c_uint8 * frame.data_size).from_address(frame.data)
        rows = np.ndarray((frame.height, row), np.uint8, memory, strides=(frame.stride, 1))
        return rows.copy().view(kind)


class Device(_Object):
    """An open device; close() also stops and releases its streams, in the order that does not crash.

    Args:
        runtime: The runtime; at most one device is opened through it here.
        uri: As listed, or what a plug-in takes for one, such as a file's path.

    Raises:
        OpenNI2Error: If there is no such device, or it cannot be opened.
    """

    def __init__(self, runtime: Runtime, uri: str) -> None:
        if len(uri.encode()) >= api.MAX_TEXT:
            raise OpenNI2Error(f"device {uri[:40]}…", Status.BAD_PARAMETER, "longer than 255 bytes")
        handle = c_void_p()
        runtime.api.must(f"device {uri}", "DeviceOpen", uri.encode(), byref(handle))
        super().__init__(runtime, "Device", handle)
        self._runtime, self._streams = runtime, list[Stream]()
        info = api.DeviceInfo()
        self._api.call("DeviceGetInfo", handle, byref(info))
        self.uri, self.vendor, self.model = (
            text.decode(errors="replace") for text in (info.uri, info.vendor, info.name)
        )

    def modes(self, sensor: Sensor) -> list[Mode]:
        """Returns the formats that the device has for a sensor; none where it has no such sensor."""
        info = self._api.call("DeviceGetSensorInfo", self._handle, sensor)
        if not info:
            return []
        told = info[0]
        modes = (told.modes[place] for place in range(told.mode_count))
        return [Mode(mode.pixel_format, mode.width, mode.height, mode.fps) for mode in modes]

    def create(self, sensor: Sensor) -> Stream:
        """Returns a new stream of this device.

        Raises:
            OpenNI2Error: If the device has no such sensor.
        """
        handle = c_void_p()
        self._api.must(f"{sensor.name} stream", "DeviceCreateStream", self._handle, sensor, byref(handle))
        stream = Stream(self._runtime, handle, sensor)
        self._streams.append(stream)
        return stream

    def text(self, number: DeviceProperty) -> str | None:
        """Returns a text property, None where the device does not tell."""
        if not self.supports(number):
            return None
        try:
            told: bytes = self.read(number, ctypes.create_string_buffer(_TEXT_BYTES)).value
        except OpenNI2Error:
            return None
        return told.decode(errors="replace").strip() or None

    def wait(self, streams: Sequence[Stream], timeout_s: float) -> Stream | None:
        """Returns the stream of the oldest frame that is there, or None after the timeout.

        `Stream.fetch` after this does not wait; without it, it could wait for ever.

        Raises:
            OpenNI2Error: On anything but a timeout.
        """
        handles = (c_void_p * len(streams))(*(stream.handle.value for stream in streams))
        place = c_int(-1)
        timeout_ms = max(0, round(timeout_s * 1e3))
        arguments = (handles, len(streams), byref(place), timeout_ms)
        allowed = (Status.OK, Status.TIME_OUT)
        status = self._api.status("waiting", "WaitForAnyStream", arguments, allowed, timeout_s)
        return streams[place.value] if status == Status.OK else None

    def forget_wakeup(self) -> None:
        """Takes back the wake-up that the last frame left, so that the next wait really waits.

        Waiting for no stream at all looks at nothing and asks the device for nothing.
        """
        nothing = (c_void_p * 1)(None)
        self._api.call("WaitForAnyStream", nothing, 1, byref(c_int()), 0)

    def close(self) -> None:
        """Stops all streams, releases them, then the device; frames are copies. May be called twice.

        Raises:
            OpenNI2Error: If the library does not come back.
        """
        streams, self._streams = self._streams, []
        for stream in streams:
            stream.stop()
        for stream in streams:
            stream.destroy()
        handle, self._handle = self._handle, c_void_p()
        if handle:
            self._api.call("DeviceClose", handle)
