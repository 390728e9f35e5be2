"""An IIDC camera by libdc1394, such as Point Grey's Firefly MV on USB: raw Bayer, demosaiced here.

Tested against Debian's real library with a camera emulated down to its registers; not on a camera.

libdc1394 gives frames of a USB camera no time of its own, so their times come by construction: an
exposure by software trigger began after that was sent and ended before the frame was here. The library
may crash or hang once the camera is unplugged: `colour` therefore makes a camera in a process of its own.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from types import TracebackType
from typing import Any, NoReturn, Self

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverUnavailableError,
)
from drivers.exposure import check_exposure
from drivers.iidc.dc1394 import Camera, Dc1394Error, Library
from drivers.iidc.dc1394_types import CAPTURE_FLAGS_DEFAULT, ISO_SPEED_400, LIBRARY, PACKAGE
from drivers.iidc.features import (
    Exposure,
    change_exposure,
    exposure_range_s,
    set_exposure,
    set_registers,
    set_strobe,
    set_trigger,
)
from drivers.iidc.finding import found
from drivers.iidc.image_format import Format, set_format
from drivers.iidc.options import IidcOptions, SetupError
from drivers.iidc.stream import Arrival, IidcStream, StreamEndedError
from drivers.interfaces import Clock
from drivers.isolation.colour import IsolatedColourCamera
from surfclass.errors import InputError
from surfclass.frames import ColourFrame
from surfclass.schema import validate

_READY_POLL_S = 0.001
_STILL_S = 0.05  # besides exposure and read-out, until a camera that was stopped sends nothing more


def colour(
    *, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]
) -> IsolatedColourCamera:
    """An IIDC camera in a process of its own.

    Raises:
        ConfigurationError: For options that are none of IidcOptions'.
    """
    validate(IidcOptions, options, name)
    return IsolatedColourCamera("drivers.colour_iidc:in_process", name=name, options=options)


def in_process(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> IidcCamera:
    """The same in this process, which must not outlive the camera's loss."""
    return IidcCamera(name, clock, validate(IidcOptions, options, name))


class IidcCamera:
    """A `ColourCamera` on libdc1394, in the process that calls it.

    After a DeviceLostError nothing of the library is called any more, so what it holds stays held until
    the process ends.

    Args:
        name: How messages call it.
        clock: The host's.
        options: What is wanted of it.
    """

    def __init__(self, name: str, clock: Clock, options: IidcOptions) -> None:
        self._name, self._clock, self._options = name, clock, options
        self._library: Library | None = None
        self._camera: Camera | None = None
        self._stream: IidcStream | None = None
        self._capturing = False
        self._format: Format | None = None
        self._exposure: Exposure | None = None
        self._lost = ""
        self._due_ns: int | None = None  # until when the frame of a trigger that was given up may come
        self._seen_ready = False  # the camera, since its last trigger
        self._since_ns = 0  # since when exposures are as long as they are now
        self._late = self._missing = self._unasked = 0

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._stream is not None

    def open(self) -> None:
        """Finds the camera, sets it up, reads everything back and starts it.

        Raises:
            DriverUnavailableError: If libdc1394 is not installed.
            DeviceNotFoundError: If there is no such camera, or it went away meanwhile.
            DeviceFaultError: If it cannot do what the options ask for, or does not keep it.
        """
        self.close()
        self._lost, self._due_ns = "", None
        self._late = self._missing = self._unasked = 0
        try:
            self._library = Library()
        except OSError as error:
            raise DriverUnavailableError(
                self._name, f"{LIBRARY} cannot be loaded ({error}); install the Debian package {PACKAGE}"
            ) from error
        try:
            self._camera = found(self._name, self._library, self._options.guid)
            self._start(self._camera)
        except BaseException as error:
            if isinstance(error, Dc1394Error) and error.means_gone:
                self._lost = str(error)
            self.close()
            if isinstance(error, Dc1394Error) and error.means_gone:
                raise DeviceNotFoundError(
                    self._name, f"the camera did not answer while it was set up: {error}"
                ) from error
            if isinstance(error, Dc1394Error | SetupError):
                raise DeviceFaultError(self._name, str(error)) from error
            raise

    def close(self) -> None:
        """Stops the camera and releases it; a lost one is only forgotten."""
        stream, self._stream = self._stream, None
        camera, self._camera = self._camera, None
        library, self._library = self._library, None
        capturing, self._capturing = self._capturing, False
        stopped = stream is None or stream.stop()
        if self._lost or not stopped or (stream is not None and stream.ended):
            return
        with contextlib.suppress(Dc1394Error):  # unplugged this moment: then it is only forgotten as well
            if camera is not None:
                camera.call("video_set_transmission", 0)
                if self._options.trigger != "free":
                    camera.call("external_trigger_set_power", 0)
                if capturing:
                    camera.call("capture_stop")
                camera.close()
            if library is not None:
                library.close()

    def check(self) -> None:
        """Says whether the camera answers and still transmits.

        Raises:
            DeviceLostError: If it does not.
        """
        camera, stream = self._opened()
        if stream.ended:
            self._lose(stream.ended)
        try:
            transmits = camera.number("video_get_transmission")
        except Dc1394Error as error:
            self._lose(str(error))
        if not transmits:
            self._lose("it no longer transmits: it was reset, or another program stopped it")

    def about(self) -> Mapping[str, str]:
        """Returns what the camera is, how it is set up, and what became of its frames.

        Raises:
            DeviceLostError: If it does not answer.
        """
        camera, stream = self._opened()
        assert self._format is not None
        try:
            platform = camera.platform()
            device, bus = camera.pair("camera_get_node")
        except Dc1394Error as error:
            self._lose(str(error))
        return {
            "library": f"libdc1394 ({LIBRARY})",
            "model": f"{camera.vendor} {camera.model}".strip() or "unnamed",
            "serial": f"{camera.guid:016x}",
            "address": f"usb {bus:03d}:{device:03d}" if platform == "usb" else f"{platform} node {device}",
            "format": self._format.name,
            "settings": f"{self._exposing}, trigger {self._options.trigger}",
            "clock": "the host's: the camera stamps nothing",
            "status": f"{stream.frames} frames, {stream.corrupt} corrupt, {self._late} too late, "
            f"{self._missing} missing, {self._unasked} not asked for",
        }

    def grab(self, not_before_ns: int, timeout_s: float) -> ColourFrame:
        """Returns the first frame whose exposure certainly began at or after `not_before_ns`.

        Raises:
            InputError: If the timeout is not above 0 and finite.
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        if not 0 < timeout_s < math.inf:
            raise InputError(f"timeout {timeout_s} s, allowed is above 0 and finite")
        camera, stream = self._opened()
        begin_ns = max(not_before_ns, self._clock.now_ns())
        deadline_ns = begin_ns + round(timeout_s * 1e9)
        try:
            if self._options.trigger == "software":
                return self._triggered(camera, stream, begin_ns, deadline_ns)
            return self._running(stream, not_before_ns, deadline_ns)
        except (StreamEndedError, Dc1394Error) as error:
            self._lose(str(error))

    def exposure_range_s(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure at this frame rate.

        Raises:
            DeviceLostError: If the camera does not answer.
        """
        camera, _ = self._opened()
        try:
            return exposure_range_s(camera, self._options, self._exposing)
        except Dc1394Error as error:
            self._lose(str(error))

    def set_exposure(self, exposure_s: float) -> float:
        """Sets the shutter, and returns the exposure time that the camera made of it.

        Raises:
            InputError: If it is outside the range (a ValueError).
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        camera, stream = self._opened()
        check_exposure(self._name, exposure_s, self.exposure_range_s())
        try:
            self._finish_exposures(camera, stream)
            self._exposure = change_exposure(camera, self._options, self._exposing, exposure_s)
            self._since_ns = self._clock.now_ns()
            camera.call("video_set_transmission", 1)
        except SetupError as error:
            raise DeviceFaultError(self._name, str(error)) from error
        except (StreamEndedError, Dc1394Error) as error:
            self._lose(str(error))
        return self._exposing.exposure_s

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self, camera: Camera) -> None:
        options = self._options
        if camera.can_switch_on_off:
            camera.call("camera_set_power", 1)
        camera.call("video_set_transmission", 0)
        camera.call("video_set_iso_speed", ISO_SPEED_400)  # FireWire's; USB has one speed
        set_registers(camera, options)
        self._format = set_format(camera, options)
        self._exposure = set_exposure(camera, options)
        set_trigger(camera, options)
        set_strobe(camera, options)
        if options.trigger != "software" and (self._exposure.period_s or options.readout_max_s) is None:
            raise SetupError(f"mode {options.mode}: the camera tells no frame rate; give readout_max_s")
        camera.call("capture_setup", options.buffers, CAPTURE_FLAGS_DEFAULT)
        self._capturing = True
        readout_s = options.readout_max_s or self._exposure.period_s or 0.0
        self._stream = IidcStream(camera, readout_s, self._clock)
        camera.call("video_set_transmission", 1)

    def _triggered(self, camera: Camera, stream: IidcStream, begin_ns: int, deadline_ns: int) -> ColourFrame:
        """Triggers at `begin_ns`, and again where the frame comes damaged or is lost."""
        missed = "a frame of a trigger before is still under way"
        if self._due_ns is not None and self._due_frame(camera, stream, deadline_ns, missed) is not None:
            self._due_ns = None
            self._late += 1
        stream.rest_until(begin_ns)
        missed, damaged = "no frame came in time", 0
        while True:
            while camera.number("software_trigger_get_power"):  # busy with an exposure
                self._before(deadline_ns, "the camera was not ready for a trigger")
                stream.rest_until(self._clock.now_ns() + round(_READY_POLL_S * 1e9))
            self._unasked += stream.clear()
            sent_ns = self._clock.now_ns()
            self._due_ns, self._seen_ready = sent_ns + self._least_ns() + self._late_ns(), False
            camera.call("software_trigger_set_power", 1)
            while (arrival := self._due_frame(camera, stream, deadline_ns, missed)) is not None:
                if arrival.at_ns - sent_ns >= self._least_ns():
                    break
                self._unasked += 1  # its exposure cannot have begun after the trigger
            self._due_ns = None
            if arrival is None:
                self._missing += 1
            elif arrival.image is not None:
                return self._frame(arrival, arrival.image, sent_ns)
            else:
                damaged += 1
                missed = f"no frame came in time, but {damaged} came damaged"
            self._before(deadline_ns, missed)

    def _due_frame(self, camera: Camera, stream: IidcStream, deadline_ns: int, missed: str) -> Arrival | None:
        """Returns the next frame, or None once that of the last trigger will not come any more.

        Its time counts from when the camera was seen to be ready again: a frame that is late is worse
        than one that is lost, for the next trigger would be taken for its own.
        """
        while self._due_ns is not None:
            arrival = stream.next(min(deadline_ns, self._due_ns))
            if arrival is not None:
                return arrival
            self._before(deadline_ns, missed)
            if self._seen_ready:
                self._due_ns = None
            else:
                self._seen_ready = not camera.number("software_trigger_get_power")
                self._due_ns = self._clock.now_ns() + self._late_ns()
        return None

    def _finish_exposures(self, camera: Camera, stream: IidcStream) -> None:
        """Returns when no frame is on its way any more, and none will come by itself."""
        if self._options.trigger == "software":
            until_ns = self._clock.now_ns() + self._least_ns() + 2 * self._late_ns()
            if self._due_frame(camera, stream, until_ns, "a frame is still under way") is not None:
                self._late += 1
            self._due_ns = None
        else:
            camera.call("video_set_transmission", 0)
            readout_s = self._options.readout_max_s or self._exposing.period_s or 0.0
            still_s = self._exposing.exposure_s + readout_s + _STILL_S
            stream.rest_until(self._clock.now_ns() + round(still_s * 1e9))
        self._unasked += stream.clear()

    def _running(self, stream: IidcStream, not_before_ns: int, deadline_ns: int) -> ColourFrame:
        """Waits for an exposure that the camera or a line begins."""
        while (arrival := stream.next(deadline_ns)) is not None:
            if arrival.image is not None and self._earliest_ns(arrival) >= max(not_before_ns, self._since_ns):
                return self._frame(arrival, arrival.image, self._earliest_ns(arrival))
        raise DeviceTimeoutError(self._name, "no frame came in time")

    def _frame(self, arrival: Arrival, image: bytes, earliest_ns: int) -> ColourFrame:
        """The frame of an exposure that began at `earliest_ns` or later."""
        form, exposure = self._format, self._exposing
        assert form is not None
        try:
            rgb = form.decoded(image)
        except InputError as error:
            raise DeviceFaultError(self._name, str(error)) from error
        if self._options.readout_max_s is not None:
            earliest_ns = max(earliest_ns, self._earliest_ns(arrival))
        latest_ns = arrival.at_ns - self._least_ns()
        return ColourFrame(
            (earliest_ns + latest_ns + round(exposure.exposure_s * 1e9)) // 2,
            arrival.sequence,
            exposure.exposure_s,
            rgb,
            t_sd_ns=(latest_ns - earliest_ns + 1) // 2,
            gain_db=exposure.gain_db,
        )

    @property
    def _exposing(self) -> Exposure:
        assert self._exposure is not None  # it is open
        return self._exposure

    def _late_ns(self) -> int:
        """How late the frame of a trigger may be."""
        return round((self._options.late_s + (self._exposing.period_s or 0.0)) * 1e9)

    def _least_ns(self) -> int:
        """From an exposure's begin until its frame is here, at least."""
        return round((self._exposing.exposure_s + self._options.readout_min_s) * 1e9)

    def _earliest_ns(self, arrival: Arrival) -> int:
        """When the exposure of a frame began at the earliest, by its arrival."""
        readout_s = self._options.readout_max_s or self._exposing.period_s
        assert readout_s is not None  # _start sees to it
        return arrival.after_ns - round((readout_s + self._exposing.exposure_s) * 1e9)

    def _opened(self) -> tuple[Camera, IidcStream]:
        if self._lost:
            raise DeviceLostError(self._name, self._lost)
        if self._camera is None or self._stream is None:
            raise DeviceLostError(self._name, "it is not open")
        return self._camera, self._stream

    def _lose(self, how: str) -> NoReturn:
        """From here on the library is not called any more."""
        self._lost = f"the camera went away: {how}"
        raise DeviceLostError(self._name, self._lost)

    def _before(self, deadline_ns: int, otherwise: str) -> None:
        if self._clock.now_ns() >= deadline_ns:
            raise DeviceTimeoutError(self._name, otherwise)
