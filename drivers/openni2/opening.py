"""Opens a device as a measuring instrument: formats chosen, registration and mirroring off and read back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.openni2.api import DeviceProperty, PixelFormat, Sensor, Status, StreamProperty
from drivers.openni2.device import Device, Mode, Stream
from drivers.openni2.errors import OpenNI2Error, SettingError
from drivers.openni2.pairs import Pairing, unit_um
from drivers.openni2.runtime import Runtime

ANY = "any"


@dataclass(frozen=True)
class Streams:
    """An open device with its streams, not started.

    Attributes:
        depth: The depth stream.
        depth_mode: Its format.
        infrared: The IR stream, of the same size, or None.
        settings: What was found to hold, for people.
    """

    device: Device
    depth: Stream
    depth_mode: Mode
    infrared: Stream | None
    settings: str

    @property
    def all(self) -> list[Stream]:
        """Those that there are."""
        return [self.depth] if self.infrared is None else [self.depth, self.infrared]

    def pairing(self, tolerance_us: int) -> Pairing:
        """Returns what pairs these streams' images: within the tolerance, and never half a period apart."""
        return Pairing(self.infrared is not None, min(tolerance_us, 499_999 // max(1, self.depth_mode.fps)))

    def describe(self) -> str:
        """Returns size, rate, units and the factory's field of view, in words.

        Raises:
            OpenNI2Error: If the device does not tell.
        """
        mode, fov = self.depth_mode, self.depth.field_of_view()
        words = [
            f"{mode.width} × {mode.height} at {mode.fps} Hz",
            f"depth in {unit_um(mode.pixel_format)} µm",
        ]
        words.append("no IR" if self.infrared is None else "IR 16 bit")
        if fov is not None:
            horizontal, vertical = (math.degrees(angle) for angle in fov)
            words.append(f"factory field of view {horizontal:.2f}° × {vertical:.2f}°")
        return ", ".join(words)


def open_streams(
    runtime: Runtime, uri: str, serial: str | None, depth_format: PixelFormat | None, with_ir: bool
) -> Streams:
    """Opens a device and sets it up; nothing is open when this raises.

    Args:
        runtime: The runtime.
        uri: The device's, or `ANY`: the first that is connected (and has the serial number).
        serial: Its serial number, None: whatever it is.
        depth_format: The depth format, None for a recording, which has the one that it has.
        with_ir: Whether the device must have IR images of the same size.

    Raises:
        OpenNI2Error: If there is no such device, or it cannot be opened or started.
        SettingError: If it lacks a sensor or a format, or a setting does not take.
    """
    device = _open(runtime, uri, serial)
    try:
        depth, infrared = _set_up(device, depth_format, with_ir)
        settings = [_registration_off(device)]
        settings += [_mirroring_off(stream) for stream in (depth, infrared) if stream is not None]
        return Streams(device, depth, depth.mode, infrared, ", ".join(settings))
    except BaseException:
        device.close()
        raise


def _open(runtime: Runtime, uri: str, serial: str | None) -> Device:
    uris = [listed.uri for listed in runtime.devices()] if uri == ANY else [uri]
    seen = []
    for each in uris:
        device = Device(runtime, each)
        told = device.text(DeviceProperty.SERIAL_NUMBER)
        if serial is None or told == serial:
            return device
        device.close()
        seen.append(f"{each} has {told or 'none'}")
    if seen:
        raise OpenNI2Error(f"serial number {serial}", Status.NO_DEVICE, ", ".join(seen))
    raise OpenNI2Error(
        "no depth camera",
        Status.NO_DEVICE,
        "none is connected that may be opened (is its udev rule installed, and for a Kinect v1: does "
        "the kernel module gspca_kinect hold it?)",
    )


def _set_up(device: Device, depth_format: PixelFormat | None, with_ir: bool) -> tuple[Stream, Stream | None]:
    depths = _modes(device, Sensor.DEPTH, None if depth_format is None else [depth_format])
    infrareds = _modes(device, Sensor.IR, [PixelFormat.GRAY16]) if with_ir else []
    both = [(a, b) for a in depths for b in infrareds if (a.width, a.height) == (b.width, b.height)]
    if with_ir and not both:
        raise SettingError("it has no depth and IR images of the same size")
    # The largest; of those the fastest.
    mode = max(depths, key=_size_and_rate)
    infrared_mode = None
    if with_ir:
        mode, infrared_mode = max(both, key=lambda pair: (_size_and_rate(pair[0]), _size_and_rate(pair[1])))
    depth = _stream(device, Sensor.DEPTH, mode)
    return depth, None if infrared_mode is None else _stream(device, Sensor.IR, infrared_mode)


def _modes(device: Device, sensor: Sensor, formats: Sequence[PixelFormat] | None) -> list[Mode]:
    modes = device.modes(sensor)
    fitting = [mode for mode in modes if formats is None or mode.pixel_format in formats]
    if not fitting:
        wanted = "".join(f" of format {each.name}" for each in formats or ())
        has = ", ".join(f"{mode.width} × {mode.height} of format {mode.pixel_format}" for mode in modes)
        raise SettingError(f"no {sensor.name} images{wanted}; it has {has or 'none'}")
    return fitting


def _size_and_rate(mode: Mode) -> tuple[int, int]:
    return mode.width * mode.height, mode.fps


def _stream(device: Device, sensor: Sensor, mode: Mode) -> Stream:
    stream = device.create(sensor)
    if stream.mode != mode:
        stream.set_mode(mode)
    if stream.mode != mode:
        raise SettingError(f"the format of the {sensor.name} images does not take: {stream.mode} for {mode}")
    return stream


def _registration_off(device: Device) -> str:
    value = device.settle(DeviceProperty.IMAGE_REGISTRATION, 0)
    if value:
        raise SettingError("registration of depth to colour cannot be switched off")
    return "registration off" if value == 0 else "no registration"


def _mirroring_off(stream: Stream) -> str:
    value = stream.settle(StreamProperty.MIRRORING, 0)
    if value:
        raise SettingError(f"mirroring of the {stream.sensor.name} images cannot be switched off")
    return f"{stream.sensor.name} {'mirroring off' if value == 0 else 'without mirroring'}"
