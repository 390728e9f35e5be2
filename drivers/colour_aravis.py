"""Colour cameras by Aravis: any GenICam camera on USB3 Vision (Firefly S) or GigE Vision.

Everything automatic is off and read back, raw Bayer is preferred and becomes RGB in linear light, and each
frame says when its exposure was and how sure that is. Aravis can block for seconds when a camera goes
away, so the backend runs in a process of its own.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from types import TracebackType
from typing import Any, NoReturn, Self, TypeVar

from drivers.aravis.control import ControlThread
from drivers.aravis.library import Buffer, Camera, GenicamError
from drivers.aravis.options import AravisOptions
from drivers.aravis.session import (
    Session,
    change_exposure,
    change_trigger,
    connect,
    exposure_range_us,
    restart,
)
from drivers.aravis.timing import Trigger
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
)
from drivers.interfaces import Clock, ColourCamera
from drivers.isolation.colour import IsolatedColourCamera
from surfclass.errors import InputError
from surfclass.frames import ColourFrame
from surfclass.schema import validate

T = TypeVar("T")

_OPEN_S = 12.0  # a search takes 1 s, a description of 1 MB over GigE several
_WARM_UP_FRAMES, _WARM_UP_S = 3, 3.0
_SETTING_S = 2.0
_COMMAND_S = 0.3  # a camera that is there takes a command within milliseconds
_SLICE_S = 0.05  # how long a loss goes unnoticed while a frame is waited for
_log = logging.getLogger("surfclass.aravis")


def colour(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> ColourCamera:
    """The backend "aravis": the camera in a process of its own.

    Raises:
        ConfigurationError: For options that are not `AravisOptions`.
    """
    checked = validate(AravisOptions, options, name)
    return IsolatedColourCamera(
        "drivers.colour_aravis:in_process", name=name, options=checked.model_dump(mode="json")
    )


def in_process(
    *, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]
) -> AravisCamera:
    """The camera in this process.

    Raises:
        ConfigurationError: For options that are not `AravisOptions`.
    """
    return AravisCamera(name, clock, validate(AravisOptions, options, name))


class AravisCamera:
    """A colour camera of `drivers.interfaces.ColourCamera`.

    Args:
        name: How messages call it.
        clock: The host's; stamps of other clocks are mapped to it.
        options: Which camera, and how it is set up.
    """

    def __init__(self, name: str, clock: Clock, options: AravisOptions) -> None:
        self._name, self._clock, self._options = name, clock, options
        self._control: ControlThread | None = None
        self._session: Session | None = None

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._session is not None

    def open(self) -> None:
        """Finds the camera, sets it up and starts it, with a few frames to learn its clock from.

        Raises:
            ConfigurationError: If the camera cannot do what the options ask for.
            DeviceNotFoundError: If it is not there, does not answer, or another application controls it.
            DeviceFaultError: If a setting does not take its value.
            DriverUnavailableError: If PyGObject or Aravis is missing.
        """
        self.close()
        self._control = ControlThread(self._name, silence_s=self._options.silence_s)
        try:
            until_ns = self._clock.now_ns() + round(_OPEN_S * 1e9)
            self._session = self._control.call(
                partial(connect, self._name, self._options, self._clock, self._control), until_ns
            )
            self._warm_up(self._session)
            self._control.call(
                partial(change_trigger, self._session, self._name, self._options.trigger), until_ns
            )
        except (GenicamError, DeviceLostError) as error:
            self.close()
            raise DeviceNotFoundError(self._name, f"it went away while it was opened: {error}") from error
        except TimeoutError as error:
            self.close()
            raise DeviceNotFoundError(
                self._name, f"it could not be opened in {_OPEN_S:g} s: it does not answer, or not always"
            ) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stops and releases the camera, within about a second; may be called twice."""
        control, self._control, self._session = self._control, None, None
        if control is not None:
            control.end()

    def check(self) -> None:
        """Says whether the camera still answers; it is asked all the time.

        Raises:
            DeviceLostError: If it does not, or has lost its settings.
        """
        self._must_be_there()

    def about(self) -> Mapping[str, str]:
        """Returns facts about the open camera.

        Raises:
            DeviceLostError: If it is not open.
        """
        session = self._opened()
        missing = max(0, session.count.missing - session.incomplete)
        status = f"{session.frames} frames, {session.incomplete} incomplete, {missing} missing"
        exposure = f"exposure {session.setup.exposure_s * 1e3:.3f} ms"
        return {
            **session.facts,
            "settings": f"trigger {self._options.trigger}; {exposure}; {session.setup.facts}",
            "clock": session.exposures.clock.describe(),
            "status": status,
        }

    def exposure_range_s(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure that the camera allows as it is set up.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        shortest_us, longest_us = self._ask(partial(exposure_range_us, self._must_be_there()), self._soon())
        return shortest_us / 1e6, longest_us / 1e6

    def set_exposure(self, exposure_s: float) -> float:
        """Sets the exposure time, and returns the one that the camera made of it.

        Raises:
            InputError: If it is outside the range (a ValueError).
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        session = self._must_be_there()
        if not 0 < exposure_s < math.inf:
            raise InputError(f"{self._name}: exposure {exposure_s} s, allowed is above 0 and finite")
        until_ns = self._soon(session.setup.exposure_s)
        self._ask(partial(change_exposure, session, self._name, exposure_s * 1e6), until_ns)
        return session.setup.exposure_s

    def grab(self, not_before_ns: int, timeout_s: float) -> ColourFrame:
        """Returns the first frame whose exposure certainly began at or after `not_before_ns`.

        Raises:
            InputError: If the timeout is not above 0 and finite.
            DeviceTimeoutError: If none came within `timeout_s` of `not_before_ns` (or of now, where that
                is later).
            DeviceLostError: If the camera went away, or was reset.
            DeviceFaultError: If frames are not what was set up, or the camera's clock stands still.
        """
        if not 0 < timeout_s < math.inf:
            raise InputError(f"timeout {timeout_s} s, allowed is above 0 and finite")
        session = self._must_be_there()
        until_ns = max(not_before_ns, self._clock.now_ns()) + round(timeout_s * 1e9)
        if session.trigger == "software":
            while (ahead_ns := not_before_ns - self._clock.now_ns()) > 0:
                self._clock.sleep(min(_SLICE_S, ahead_ns / 1e9))
                self._must_be_there()
            return self._triggered(session, until_ns)
        session.stream.drop_all()
        session.count.restart()
        session.arrivals.begin()
        while True:
            buffer = self._next(session, until_ns, None)
            assert buffer is not None
            began_ns, half_ns = session.exposures.began(buffer, *session.arrivals.of(buffer), None)
            if began_ns - half_ns >= not_before_ns:
                return self._frame(session, buffer, began_ns, half_ns)
            session.count.number(buffer.frame_id)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _triggered(self, session: Session, until_ns: int) -> ColourFrame:
        if session.unanswered:  # its frame may still come, and would be taken for the next one
            self._ask(partial(restart, session), until_ns)
        while True:
            session.stream.drop_all()
            session.arrivals.begin()
            session.unanswered = True
            trigger = self._ask(partial(self._send_trigger, session.camera, not session.fresh), until_ns)
            buffer = self._next(session, until_ns, trigger)
            session.unanswered = False
            if buffer is None:
                continue  # lost on the way; there is another
            session.fresh = False
            began_ns, half_ns = session.exposures.began(buffer, *session.arrivals.of(buffer), trigger)
            return self._frame(session, buffer, began_ns, half_ns)

    def _soon(self, more_s: float = 0.0) -> int:
        """Until when a camera that is there does what needs a few commands, ns."""
        return self._clock.now_ns() + round((_SETTING_S + more_s) * 1e9)

    def _send_trigger(self, camera: Camera, prompt: bool) -> Trigger:
        sent_ns = self._clock.now_ns()
        camera.execute("TriggerSoftware")
        return Trigger(sent_ns, self._clock.now_ns(), prompt)

    def _next(self, session: Session, until_ns: int, trigger: Trigger | None) -> Buffer | None:
        """Returns the next whole frame; None where that of a trigger came incomplete."""
        while True:
            left_s = max(0.0, (until_ns - self._clock.now_ns()) / 1e9)
            buffer = session.stream.pop(min(_SLICE_S, left_s))
            if buffer is None:
                self._must_be_there()
                if not left_s:
                    raise DeviceTimeoutError(self._name, "no frame came in time")
            elif not buffer.complete:
                session.incomplete += 1  # its frame id may be that of an older one
                _log.debug("%s: frame %d: %s", self._name, buffer.frame_id, buffer.status)
                if trigger is not None:
                    return None
            elif not (
                trigger is not None
                and session.fresh
                and session.exposures.is_from_before(buffer, trigger.sent_ns)
            ):
                return buffer

    def _frame(self, session: Session, buffer: Buffer, began_ns: int, half_ns: int) -> ColourFrame:
        setup = session.setup
        if buffer.size != setup.size:
            raise DeviceFaultError(
                self._name,
                f"frame {buffer.frame_id} has {buffer.size[0]} × {buffer.size[1]} pixels, "
                f"{setup.size[0]} × {setup.size[1]} were set up",
            )
        try:
            rgb = setup.format.rgb(buffer.content, *setup.size)
        except InputError as error:
            raise DeviceFaultError(self._name, f"frame {buffer.frame_id}: {error}") from error
        session.frames += 1
        return ColourFrame(
            began_ns + round(setup.exposure_s * 5e8),
            session.count.number(buffer.frame_id),
            setup.exposure_s,
            rgb,
            half_ns,
            setup.gain_db,
        )

    def _warm_up(self, session: Session) -> None:
        """Takes frames by software trigger, which says best how the device's clock goes.

        The first after a start may begin late, too, as no other will.
        """
        until_ns = self._clock.now_ns() + round((session.setup.exposure_s + _WARM_UP_S) * 1e9)
        try:
            for _ in range(_WARM_UP_FRAMES if session.trigger == "software" else 0):
                self._triggered(session, until_ns)
        except DeviceTimeoutError as error:
            _log.warning("%s; waiting goes on when it is asked for one", error)

    def _ask(self, what: Callable[[], T], until_ns: int) -> T:
        """Has the control thread do something, and raises the driver's errors."""
        assert self._control is not None
        try:
            return self._control.call(what, until_ns)
        except TimeoutError:
            if self._control.how_lost(_COMMAND_S):
                self._lose()
            raise DeviceTimeoutError(self._name, "it did not take a command in time") from None
        except GenicamError as error:
            if not (error.gone or error.denied):
                raise DeviceFaultError(self._name, f"it refused a command: {error}") from error
            self._control.mark_lost(str(error))
            self._lose()

    def _opened(self) -> Session:
        if self._session is None:
            raise DeviceLostError(self._name, "it is not open")
        return self._session

    def _must_be_there(self) -> Session:
        session = self._opened()
        assert self._control is not None
        if self._control.how_lost():
            self._lose()
        return session

    def _lose(self) -> NoReturn:
        assert self._control is not None
        raise DeviceLostError(self._name, self._control.lost)
