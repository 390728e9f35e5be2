"""Colour cameras behind Video4Linux, /dev/video…: raw formats, controls read back, the kernel's times."""

from __future__ import annotations

import errno
import importlib.metadata
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from drivers.exposure import check_exposure
from drivers.interfaces import Clock
from drivers.v4l2 import pixels
from drivers.v4l2.controls import Settings, Wanted
from drivers.v4l2.node import Filled, Format, VideoNode
from drivers.v4l2.options import V4l2Options
from drivers.v4l2.stream import Stream
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import ColourFrame
from surfclass.schema import validate

# The device is gone, or its bus gave up on it.
_GONE = (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN, errno.EIO, errno.EPROTO, errno.EREMOTEIO, errno.EPIPE,
         errno.ENOENT, errno.ETIMEDOUT, errno.ENOLINK)  # fmt: skip
_RATE_TOLERANCE = 0.01


def colour(
    *, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]
) -> V4l2ColourCamera:
    """The backend "v4l2" for colour: returns the camera, closed.

    Raises:
        ConfigurationError: For options that are not V4l2Options', or a pixel format that is not supported.
    """
    return V4l2ColourCamera(name, clock, validate(V4l2Options, options, name))


class V4l2ColourCamera:
    """A free-running camera; frames whose exposure began too early are discarded.

    Frames stream all the time; the kernel holds `buffers` of them and drops what does not fit, so that
    after a pause these few are discarded and the next ones are fresh. Used from one thread at a time.

    Args:
        name: How messages call it.
        clock: CLOCK_MONOTONIC, which the kernel stamps buffers with.
        options: See there.
        open_node: Opens the device node; a test gives one of its own.

    Raises:
        ConfigurationError: If the pixel format is not supported.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        options: V4l2Options,
        open_node: Callable[[str], VideoNode] = VideoNode,
    ) -> None:
        self._name, self._clock, self._options, self._open_node = name, clock, options, open_node
        self._layout = pixels.layout(options.pixel_format)
        try:
            self._layout.row_bytes(options.width)
        except InputError as error:
            raise ConfigurationError(f"{name}: {options.pixel_format}: {error}") from None
        self._stream: Stream | None = None

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._stream is not None

    def open(self) -> None:
        """Negotiates format, rate and controls, and starts the stream; an open camera is opened anew.

        Raises:
            DeviceNotFoundError: If there is no such device, or another program uses it.
            DeviceFaultError: If it cannot do what the options say, or does something else.
            DriverUnavailableError: If linuxpy is not installed.
        """
        self.close()
        try:
            with self._as_driver_errors("opening it", opening=True):
                node = self._open_node(self._options.device_path)
        except ModuleNotFoundError as error:
            raise DriverUnavailableError(
                self._name, f"the library {error.name} is missing; pip install linuxpy"
            ) from error
        try:
            with self._as_driver_errors("setting it up", opening=True):
                self._stream = self._start(node)
        except BaseException:
            node.close()
            raise

    def close(self) -> None:
        """Stops the stream and releases the device."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.node.close()

    def check(self) -> None:
        """Asks the kernel whether the device is there and its controls are as they were set.

        Raises:
            DeviceLostError, DeviceFaultError: As the class says.
        """
        stream = self._must_be_open()
        with self._as_driver_errors("asking for it"):
            stream.node.facts()
            stream.settings.verify()

    def about(self) -> Mapping[str, str]:
        """Returns what is known of the camera; the status counts frames that were not delivered."""
        stream = self._must_be_open()
        facts, form = stream.facts, stream.format
        stamped = "not seen yet" if stream.stamped_at is None else f"stamped at the {stream.stamped_at}"
        told = {
            "library": f"linuxpy {importlib.metadata.version('linuxpy')}, {facts.driver} {facts.version}",
            "model": facts.card,
            "serial": facts.serial,
            "address": f"{self._options.device_path} at {facts.bus}",
            "format": f"{form.pixel_format} {form.width} × {form.height}, {1e9 / stream.period_ns:.4g} Hz",
            "settings": str(stream.settings),
            "clock": f"CLOCK_MONOTONIC of the kernel, frames {stamped}",
            "status": f"{stream.delivered} frames" + (f"; {stream.tally}" if str(stream.tally) else ""),
        }
        return {key: value for key, value in told.items() if value}

    def exposure_range_s(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure; 0 and 0 where the camera does not tell it.

        Raises:
            DeviceLostError: If it is not open.
        """
        stream = self._must_be_open()
        return stream.settings.exposure_range_s(stream.period_ns)

    def set_exposure(self, exposure_s: float) -> float:
        """Sets the exposure time, and returns it in V4L2's steps of 100 µs.

        Raises:
            InputError: If it is outside the range, or cannot be changed (a ValueError).
            DeviceLostError, DeviceFaultError: As the class says.
        """
        stream = self._must_be_open()
        check_exposure(self._name, exposure_s, self.exposure_range_s())
        with self._as_driver_errors("setting its exposure"):
            stream.change_exposure(exposure_s)
        exposure_ns = stream.settings.exposure_ns
        assert exposure_ns is not None  # it has the control
        return exposure_ns / 1e9

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def grab(self, not_before_ns: int, timeout_s: float) -> ColourFrame:
        """Returns the first frame whose exposure certainly began at or after `not_before_ns`.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If none came within `timeout_s` of `not_before_ns` or of now.
            DeviceLostError: If the device is gone.
            DeviceFaultError: If a control was changed, or the data are impossible.
        """
        if not 0 < timeout_s < float("inf"):
            raise InputError(f"timeout {timeout_s} s, allowed is above 0 and finite")
        stream = self._must_be_open()
        deadline_ns = max(not_before_ns, self._clock.now_ns()) + round(timeout_s * 1e9)
        seen = 0
        with self._as_driver_errors("waiting for a frame"):
            fresh = False  # whether the buffers that had filled before this call are through
            while (left_ns := deadline_ns - self._clock.now_ns()) > 0:
                if not stream.node.wait(0.0):
                    fresh = True
                    if not stream.node.wait(left_ns / 1e9):
                        break
                filled = stream.node.take()
                if filled is None:
                    self._clock.sleep(0.001)  # poll(2) and the driver are at odds; not as fast as it goes
                    continue
                seen += 1
                try:
                    frame = self._frame(stream, filled, fresh, not_before_ns)
                finally:
                    stream.node.give_back(filled)
                if frame is not None:
                    stream.settings.verify()
                    stream.delivered += 1
                    return frame
        unused = f" ({seen} did; not used so far: {stream.tally})" if seen else ""
        raise DeviceTimeoutError(self._name, f"no frame came in {timeout_s:g} s{unused}")

    def _start(self, node: VideoNode) -> Stream:
        """What open() does with the open node; whatever it raises, the caller closes it."""
        options, facts = self._options, node.facts()
        if not facts.captures:
            raise self._fault(f"{facts.card} ({facts.driver}) streams no single-planar images")
        form = self._negotiate(node)
        period_ns = round(1e9 / self._rate_hz(node))
        wanted = Wanted(options.exposure_us, options.gain, options.controls)
        settings = Settings(self._name, node, wanted)
        node.start(options.buffers)
        return Stream(node, facts, form, self._layout, period_ns, settings)

    def _negotiate(self, node: VideoNode) -> Format:
        options = self._options
        form = node.set_format(options.width, options.height, options.pixel_format)
        asked = (options.width, options.height, options.pixel_format)
        if (form.width, form.height, form.pixel_format) != asked:
            known = "; ".join(
                f"{code}{'' if code in pixels.LAYOUTS else ' (not supported)'}: {', '.join(sizes)}"
                for code, sizes in node.formats().items()
            )
            raise self._fault(
                f"asked for {options.pixel_format} {options.width} × {options.height}, it gives "
                f"{form.pixel_format} {form.width} × {form.height}; it has: {known or 'no format'}"
            )
        if not form.progressive:
            raise self._fault("its frames are interlaced, so a frame is no single exposure")
        if not form.full_range:
            raise self._fault("its RGB is of limited range (16…235), so its values are no radiance")
        if form.row_bytes < self._layout.row_bytes(form.width):
            raise self._fault(
                f"rows of {form.row_bytes} bytes, {form.pixel_format} needs "
                f"{self._layout.row_bytes(form.width)}"
            )
        return form

    def _rate_hz(self, node: VideoNode) -> float:
        wanted, told = self._options.rate_hz, node.rate_hz()
        if told is None:
            if wanted is None:
                raise self._fault("its driver does not tell its frame rate; set rate_hz to what it is")
            return wanted
        if wanted is not None:
            try:
                node.set_rate(wanted)
            except OSError as error:
                if error.errno not in (errno.ENOTTY, errno.EINVAL):
                    raise
            told = node.rate_hz() or told
            if abs(told / wanted - 1) > _RATE_TOLERANCE:
                raise self._fault(f"asked for {wanted:g} frames a second, it gives {told:g}")
        return told

    def _frame(self, stream: Stream, filled: Filled, fresh: bool, not_before_ns: int) -> ColourFrame | None:
        """The buffer as a frame, or None where it is not to be used."""
        if not filled.monotonic:
            raise self._fault("its driver's time stamps are not of CLOCK_MONOTONIC, so they are of no use")
        exposed = stream.judge(filled, fresh, self._clock.now_ns(), not_before_ns)
        if exposed is None:
            return None
        form, exposure_ns = stream.format, stream.settings.exposure_ns
        data = stream.node.data(filled)
        try:
            rgb = pixels.decode(data, stream.layout, form.width, form.height, form.row_bytes)
        except InputError as error:
            raise self._fault(f"impossible data: {error}") from None
        exposure_s = None if exposure_ns is None else exposure_ns / 1e9
        gain_db = self._gain_db(stream.settings)
        return ColourFrame(exposed.mid_ns, stream.sequence, exposure_s, rgb, exposed.sd_ns, gain_db)

    def _gain_db(self, settings: Settings) -> float | None:
        unit_db = self._options.gain_unit_db
        return None if unit_db is None or settings.gain is None else settings.gain * unit_db

    def _must_be_open(self) -> Stream:
        if self._stream is None:
            raise DeviceLostError(self._name, "it is not open")
        return self._stream

    def _fault(self, message: str) -> DeviceFaultError:
        return DeviceFaultError(self._name, message)

    @contextmanager
    def _as_driver_errors(self, doing: str, opening: bool = False) -> Iterator[None]:
        """Says of the kernel's errors which of the drivers' they are."""
        try:
            yield
        except DriverError:
            raise
        except OSError as error:
            path, code = self._options.device_path, error.errno or 0
            text = f"{path}: {os.strerror(code)} ({errno.errorcode.get(code, code)}), {doing}"
            if code in _GONE:
                raise (DeviceNotFoundError if opening else DeviceLostError)(self._name, text) from error
            if opening and code == errno.EBUSY:
                raise DeviceNotFoundError(self._name, f"{text}: another program uses it") from error
            if opening and code in (errno.EACCES, errno.EPERM):
                raise DeviceNotFoundError(
                    self._name, f"{text}: is this user in the group that owns it (usually video)?"
                ) from error
            raise DeviceFaultError(self._name, text) from error
