"""Depth cameras through OpenNI2: Kinect v1, Xtion, Carmine, the virtual Kinect, and `.oni` recordings.

Depth and IR of one exposure, registration and mirroring off and read back. The library crashes on some
paths; `depth` therefore runs it in a process of its own.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal, Self

from pydantic import Field, Strict, model_validator

from drivers.device_clock import DeviceClock
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from drivers.interfaces import Clock
from drivers.isolation.camera import IsolatedCamera
from drivers.openni2.api import DeviceProperty, PixelFormat
from drivers.openni2.errors import OpenNI2Error, driver_errors
from drivers.openni2.opening import ANY, Streams, open_streams
from drivers.openni2.pairs import Pair, unit_um, whole_millimetres
from drivers.openni2.playback import Playback
from drivers.openni2.reader import Reader
from drivers.openni2.record import record
from drivers.openni2.runtime import Runtime
from surfclass.errors import InputError
from surfclass.frames import DepthFrame
from surfclass.schema import Positive, Table, validate

_FORMATS = {"1mm": PixelFormat.DEPTH_1_MM, "100um": PixelFormat.DEPTH_100_UM}
_VIRTUAL = "virtual://"
_log = logging.getLogger("surfclass.depth")
_Driver = Literal["kinect1", "virtual", "OniFile", "PS1080", "PSLink", "DummyDevice"]
_Milliseconds = Annotated[float, Strict(), Field(ge=0, le=1000, allow_inf_nan=False)]


class Options(Table):
    """The keys of `[depth]` beside `backend = "openni2"`.

    Attributes:
        device: Its URI, as the runtime lists it ("kinect1://A00366…", "1d27/0601@1/5",
            "virtual:///dev/shm/kinect"); "any" is the first that is connected.
        serial: It must have this serial number.
        file_path: An `.oni` recording to play back instead of a device: one exposure for each frame
            asked for, in the file's order, as if it were taken then.
        drivers: The driver plug-ins to load; by default those of Kinect v1 and of Xtion and Carmine,
            or what `device` or `file_path` needs.
        depth_unit: What the device is asked for, "1mm" or "100um". Frames hold whole millimetres in
            either case: tenths are rounded to the nearest, and end at 6.553 m.
        infrared: Whether the device must give IR images, too.
        exposure_ms: How long an exposure lasts, where that is known: no device tells. Without it a frame
            is held to be exposed for a whole frame period, and `exposure_s` of frames is None.
        latency_ms: From mid-exposure until the frame can be here at the earliest.
        latency_sd_ms: Half the interval in which that can be.
        pair_ms: Time stamps of one exposure's depth and IR differ by no more; never by half a period.
        frame_timeout_s: Silence for longer means that the device is mute.
    """

    device: Annotated[str, Field(min_length=1, max_length=255)] = ANY
    serial: str | None = None
    file_path: Path | None = None
    drivers: tuple[_Driver, ...] | None = None
    depth_unit: Literal["1mm", "100um"] = "1mm"
    infrared: Annotated[bool, Strict()] = True
    exposure_ms: Annotated[float, Strict(), Field(gt=0, le=1000, allow_inf_nan=False)] | None = None
    latency_ms: _Milliseconds = 40.0
    latency_sd_ms: _Milliseconds = 20.0
    pair_ms: _Milliseconds = 5.0
    frame_timeout_s: Positive = 2.0

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.file_path is not None and (self.device != ANY or self.serial is not None):
            raise ValueError("file_path goes without device and serial")
        if self.drivers is not None and not self.drivers:
            raise ValueError("drivers is empty; leave it out for the usual ones")
        return self

    @property
    def plugins(self) -> tuple[str, ...]:
        """The driver plug-ins to load."""
        if self.drivers is not None:
            return self.drivers
        if self.file_path is not None:
            return ("OniFile",)
        return ("virtual",) if self.device.startswith(_VIRTUAL) else ("kinect1", "PS1080")


def depth(
    *, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]
) -> IsolatedCamera[DepthFrame]:
    """A depth camera through OpenNI2, in a process of its own.

    Raises:
        ConfigurationError: For options that it does not know.
    """
    checked = validate(Options, options, name)
    sent = checked.model_dump(mode="json", exclude_none=True)
    return IsolatedCamera("drivers.depth_openni2:in_process", name=name, options=sent)


def in_process(
    *, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]
) -> OpenNI2Camera:
    """The same in this process; one at a time.

    Raises:
        ConfigurationError: For options that it does not know.
    """
    return OpenNI2Camera(name, clock, validate(Options, options, name))


class OpenNI2Camera:
    """A depth camera, or a recording, in this process.

    Args:
        name: How messages call it.
        clock: The host's.
        options: What to open, and how.
    """

    def __init__(self, name: str, clock: Clock, options: Options) -> None:
        self._name, self._clock, self._options = name, clock, options
        self._exposure_s = None if options.exposure_ms is None else options.exposure_ms / 1e3
        self._runtime: Runtime | None = None
        self._streams: Streams | None = None
        self._source: Reader | Playback | None = None
        self._gone: set[str] = set()

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._source is not None

    def open(self) -> None:
        """Starts the runtime, opens the device, sets it up and lets it run.

        Raises:
            DeviceNotFoundError: If it is not connected or cannot be opened.
            DeviceFaultError: If it cannot do what measuring needs, or a setting does not take; or
                something else in this process uses OpenNI2.
            DriverUnavailableError: If the library or a plug-in is missing; the message says what to do.
        """
        if self.is_open:
            return
        self._gone = set()
        with driver_errors(self._name, is_open=False):
            try:
                self._runtime = Runtime(self._options.plugins, self._on_disconnect)
                self._source = self._open_source(self._runtime)
            except BaseException:
                self.close()
                raise
        if self._streams is not None and self._streams.device.uri in self._gone:
            self.close()
            raise DeviceNotFoundError(self._name, "it was unplugged while it was being opened")

    def close(self) -> None:
        """Stops the streams, closes the device and unloads the runtime; never raises, may be called twice."""
        source, self._source = self._source, None
        streams, self._streams = self._streams, None
        runtime, self._runtime = self._runtime, None
        if source is not None:
            source.close()
        try:
            if streams is not None:
                streams.device.close()
            if runtime is not None:
                runtime.close()
        except OpenNI2Error as error:  # nothing more can be done in this process
            _log.error("%s: not closed: %s", self._name, error)

    def check(self) -> None:
        """Says what became of it.

        Raises:
            DeviceTimeoutError: If nothing has come for `frame_timeout_s`.
            DeviceLostError: If it was unplugged, or is not open.
            DeviceFaultError: If what it sends cannot be used, or the recording ended.
        """
        source = self._opened()
        if isinstance(source, Playback):
            if source.ended:
                raise DeviceFaultError(self._name, f"the recording ended after {source.pairs} exposures")
            return
        with driver_errors(self._name, is_open=True):
            silent_s = source.silent_s()
        if silent_s > self._options.frame_timeout_s:
            raise DeviceTimeoutError(self._name, f"nothing usable for {silent_s:.1f} s: {source.describe()}")

    def about(self) -> Mapping[str, str]:
        """Returns what device it is, what holds, and how well its clock is known.

        Raises:
            DeviceLostError: If it is not open.
        """
        source, streams, runtime = self._opened(), self._streams, self._runtime
        assert streams is not None
        assert runtime is not None
        device = streams.device
        with driver_errors(self._name, is_open=True):
            facts = {
                "library": f"OpenNI2 {runtime.version} with {', '.join(self._options.plugins)}",
                "model": f"{device.vendor} {device.model}",
                "serial": device.text(DeviceProperty.SERIAL_NUMBER),
                "firmware": device.text(DeviceProperty.FIRMWARE_VERSION),
                "address": device.uri,
                "format": streams.describe(),
                "settings": streams.settings,
            }
        if isinstance(source, Playback):
            facts["clock"] = "the recording's; frames are stamped as if taken when asked for"
            facts["status"] = f"{source.pairs} of {source.frames or 'unknown'} exposures played"
        else:
            facts["clock"], facts["status"] = source.describe_clock(), source.describe()
        return {key: value for key, value in facts.items() if value}

    def grab(self, not_before_ns: int, timeout_s: float, with_ir: bool = False) -> DepthFrame:
        """Returns the first exposure that certainly began at or after `not_before_ns`.

        `t_sd_ns` is by `latency_sd_ms` and by what its clock is not yet known to. Depth from tenths of
        a millimetre is rounded to whole ones.

        Raises:
            InputError: If the timeout is not above 0 and finite.
            DeviceTimeoutError: If none came within `timeout_s` of `not_before_ns` or of now.
            DeviceLostError: If it was unplugged, or is not open.
            DeviceFaultError: If what it sends cannot be used, the recording ended, or IR is asked for
                with `infrared = false`.
        """
        if not 0 < timeout_s < math.inf:
            raise InputError(f"timeout {timeout_s} s, allowed is above 0 and finite")
        source, streams = self._opened(), self._streams
        assert streams is not None
        if with_ir and streams.infrared is None:
            raise DeviceFaultError(self._name, "IR is asked for, but options say infrared = false")
        with driver_errors(self._name, is_open=True):
            mode = streams.depth_mode
            half_ns = round(5e8 * (self._exposure_s or 1 / max(1, mode.fps)))
            deadline_ns = max(not_before_ns, self._clock.now_ns()) + round(timeout_s * 1e9)
            if isinstance(source, Playback):
                pair, t_ns, t_sd_ns = self._played(source, not_before_ns, half_ns, timeout_s)
            else:
                timed = source.first_from(not_before_ns, half_ns, deadline_ns)
                if timed is None:
                    raise DeviceTimeoutError(
                        self._name,
                        f"no exposure of the time asked for within {timeout_s:g} s: {source.describe()}",
                    )
                pair, t_ns, t_sd_ns = timed.pair, timed.t_ns, timed.t_sd_ns
            depth_mm = whole_millimetres(pair.depth, unit_um(mode.pixel_format))
        return DepthFrame(t_ns, pair.index, self._exposure_s, depth_mm, pair.ir if with_ir else None, t_sd_ns)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open_source(self, runtime: Runtime) -> Reader | Playback:
        options = self._options
        uri = options.device if options.file_path is None else str(options.file_path)
        wanted = _FORMATS[options.depth_unit] if options.file_path is None else None
        self._streams = open_streams(runtime, uri, options.serial, wanted, options.infrared)
        pair_us = round(options.pair_ms * 1000)
        if options.file_path is not None:
            playback = Playback(self._streams, pair_us)
            playback.start()
            return playback
        clock = DeviceClock(
            1e-6, latency_s=options.latency_ms / 1e3, latency_sd_s=options.latency_sd_ms / 1e3
        )
        reader = Reader(self._streams, clock, pair_us)
        reader.start()
        return reader

    def _played(
        self, playback: Playback, not_before_ns: int, half_ns: int, timeout_s: float
    ) -> tuple[Pair, int, int]:
        """The recording's next exposure, as if its middle were half a frame from when it may begin."""
        t_ns = max(not_before_ns, self._clock.now_ns()) + half_ns
        pair = playback.next(timeout_s)
        if pair is None:
            raise DeviceTimeoutError(self._name, f"the player gave no image within {timeout_s:g} s")
        self._clock.sleep((t_ns - self._clock.now_ns()) / 1e9)
        return pair, t_ns, 0

    def _opened(self) -> Reader | Playback:
        if self._source is None:
            raise DeviceLostError(self._name, "it is not open")
        return self._source

    def _on_disconnect(self, uri: str) -> None:
        self._gone.add(uri)
        streams, source = self._streams, self._source
        if streams is not None and streams.device.uri == uri and isinstance(source, Reader):
            source.disconnected()


def record_oni(
    name: str, options: Mapping[str, Any], path: Path, exposures: int, timeout_s: float = 30.0
) -> int:
    """Records depth and IR of a device into an `.oni` file, reads it back and compares.

    Args:
        name: How messages call the device.
        options: As of `depth`, without `file_path`.
        path: The file; one that is there is replaced when the new one is proved.
        exposures: At least so many, from 1.
        timeout_s: For the recording.

    Returns:
        How many exposures are in the file.

    Raises:
        ConfigurationError: For options that it does not know.
        InputError: If a number is out of its range.
        DriverError: One of the five.
    """
    checked = validate(Options, options, name)
    if exposures < 1 or not 0 < timeout_s < math.inf or checked.file_path is not None:
        raise InputError(f"{exposures} exposures in {timeout_s} s of a device, allowed are from 1, above 0")
    with driver_errors(name, is_open=False):
        runtime = Runtime((*checked.plugins, "OniFile"))
        try:
            unit, pair_us = _FORMATS[checked.depth_unit], round(checked.pair_ms * 1000)
            source = checked.device, checked.serial
            return record(runtime, *source, unit, path.absolute(), exposures, timeout_s, pair_us)
        finally:
            runtime.close()
