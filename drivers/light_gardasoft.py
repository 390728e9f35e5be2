"""An LED behind a Gardasoft controller: by RS-232, TCP or UDP, continuous or flashed by the camera."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Mapping
from importlib import metadata
from types import TracebackType
from typing import Any, Literal, Self

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)
from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.channel import GardasoftChannel, error_text
from drivers.gardasoft.link import GardasoftLink, NetworkPort, Transport
from drivers.gardasoft.on_timer import OnTimer
from drivers.gardasoft.options import LightOptions
from drivers.interfaces import Clock
from drivers.serial_port import SerialPort
from surfclass.errors import InputError
from surfclass.schema import validate

_BAUD_RATE = 115_200
_CHECK_S = 0.25  # all that check() may wait
_AGAIN_S = 0.5  # between attempts to put out a light that does not answer
_PERCENT_STEP = 0.1
# Answers to "off" with which the light is off: what protects it has tripped, or it was never rated.
_DARK_ANYWAY = gardasoft.FATAL_ERRORS | gardasoft.EEPROM | {gardasoft.ADJUSTED, gardasoft.NO_RATING}

_log = logging.getLogger("surfclass.light")


def light(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> GardasoftLight:
    """The factory of `drivers.backends`."""
    return GardasoftLight(name, clock, validate(LightOptions, options, name))


class GardasoftLight:
    """One channel of a controller.

    A level of 1 is `max_percent` of the light's rating. In "continuous" mode a level shines until the
    next one; in "strobe" mode a level above 0 arms the channel, and each pulse of the camera's strobe
    output, wired to the trigger input, gives one flash.

    The light is told to go off when the driver opens and closes, and whenever a call fails; while its
    answer is missing a thread goes on telling it. The same thread puts out a light that was left on for
    `max_on_s`; the next call then raises DeviceTimeoutError.

    What the controller calls fatal (errors 40…47, over-temperature, over-current) stays: every call
    raises DeviceFaultError until the driver is closed and opened again, which clears the controller.

    Args:
        name: How messages call it.
        clock: The host's.
        options: Where it is, and what it may do.
        transport: Closed; None: the one that the options ask for.
    """

    def __init__(
        self, name: str, clock: Clock, options: LightOptions, transport: Transport | None = None
    ) -> None:
        self._name, self._clock, self._options = name, clock, options
        self._link = GardasoftLink(name, transport or _transport(name, options), options.reply_timeout_s)
        self._off = gardasoft.continuous(options.channel, 0)
        self._lock = threading.RLock()  # the caller's thread and the timer's
        self._channel = GardasoftChannel(self._link, options.channel)
        self._timer = OnTimer(f"{name} off", self._expire)
        self._is_open = False
        self._rating_confirmed = False
        self._percent = 0.0  # as set last
        self._lit = False  # it may shine: it was told to, and has not confirmed that it is off again
        self._dark_by = 0.0  # time.monotonic() at which the timer puts it out
        self._is_overdue = False  # whether that would be because nobody else did
        self._trouble: tuple[type[DriverError], str] | None = None  # met by the timer, until a call tells it

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._is_open

    @property
    def timing(self) -> Literal["software", "hardware"]:
        """Hardware where the camera's strobe output makes the flashes."""
        return "hardware" if self._options.mode == "strobe" else "software"

    def open(self) -> None:
        """Connects, puts the light out, clears what the controller reports, and sets its rating.

        Raises:
            DeviceNotFoundError: If nothing is there, or no light controller answers.
            DeviceFaultError: If it goes on reporting a fault, or does not take the settings.
            DriverUnavailableError: If pyserial is missing.
        """
        if self._is_open:
            return
        with self._lock:
            self._link.open(self._off)
            self._channel = GardasoftChannel(self._link, self._options.channel)  # knows of no fault
            try:
                self._prepare()
                self._clock.sleep(self._options.settle_ms / 1e3)
            except BaseException as error:
                self._put_out()
                self._link.close()
                if isinstance(error, DeviceTimeoutError | DeviceLostError):
                    raise DeviceNotFoundError(self._name, f"it answers, but not to all: {error}") from error
                raise
            self._is_open = True
            self._timer.open()

    def close(self) -> None:
        """Puts the light out, waits for its answer (for about four reply timeouts), and disconnects."""
        with self._lock:
            try:
                if self._link.transport.is_open:
                    self._put_out_for_good()
                    self._clock.sleep(self._options.settle_ms / 1e3)  # dark when it returns, not soon after
            except BaseException:  # an interrupt
                self._put_out()
                raise
            finally:
                self._link.close()
                self._is_open = False
                self._lit = False
        self._timer.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def set_level(self, level: float) -> int:
        """Sets the level and returns the time from which it holds, ns.

        That is when the controller has confirmed it, and `settle_ms` later.

        Args:
            level: 0…1 of `max_percent`.

        Raises:
            InputError: If the level is outside 0…1 (a ValueError).
            DeviceTimeoutError: If the controller did not answer, or the light was put out after
                `max_on_s` since the last call.
            DeviceLostError: If the connection is gone, or the light was plugged in anew.
            DeviceFaultError: If the controller reports a fault, now or earlier.
        """
        if not 0 <= level <= 1:
            raise InputError(f"{self._name}: light level {level}, allowed is 0 to 1")
        with self._lock:
            self._must_be_usable()
            try:
                if level > 0:
                    self._tell_trouble()
                    self._light_up(level)
                else:
                    self._put_out_and_know()
                    self._tell_trouble()
            except BaseException:
                self._put_out()
                raise
            return self._clock.now_ns() + round(self._options.settle_ms * 1e6)

    def check(self) -> None:
        """Reads the channel's status and the events.

        Raises:
            DeviceTimeoutError: If there is no answer, or the light was put out after `max_on_s`.
            DeviceLostError: If the connection is gone, or the controller no longer has our settings.
            DeviceFaultError: If the controller reports a fault, now or earlier.
        """
        with self._lock:
            self._must_be_usable()
            try:
                self._tell_trouble(forget=False)  # the capture that it befell, or the next, must fail
                self._channel.read_status(_CHECK_S)
                self._channel.must_have(self._percent)
            except BaseException:
                self._put_out()
                raise

    def about(self) -> Mapping[str, str]:
        """Tells what answers, and what was set."""
        options, version = self._options, self._link.version
        library = f"pyserial {metadata.version('pyserial')}" if options.port_path else "sockets"
        status = ", ".join(f"{key} {value}".strip() for key, value in self._channel.status.items())
        trip = self._link.round_trip_s
        told = [status, *self._channel.notes, f"answers in {trip * 1e3:.1f} ms" if trip is not None else ""]
        facts = {
            "library": library,
            "model": version.model if version else "",
            "firmware": f"{version.firmware}, hardware {version.hardware}" if version else "",
            "address": _address(options),
            "settings": f"channel {options.channel}, {options.mode}, rated {options.rating}"
            f"{'' if self._rating_confirmed else ' (not read back)'}, full level {options.max_percent:g} %, "
            f"off after {options.max_on_s:g} s",
            "status": "; ".join(fact for fact in told if fact),
        }
        return {key: fact for key, fact in facts.items() if fact}

    # ---- opening ----------------------------------------------------------------------------

    def _prepare(self) -> None:
        options, channel, link = self._options, self._channel, self._link
        self._percent, self._is_overdue, self._trouble = 0.0, False, None
        first = link.ask(self._off)  # whatever it says to it
        before = link.ask(gardasoft.clear())
        events = [event.text for event in (*first.events, *before.events)]
        errors = [error_text(number) for number in dict.fromkeys((*first.errors, *before.errors))]
        if events or errors:
            channel.note(f"cleared when opened: {', '.join((*events, *errors))}")
        channel.obey(gardasoft.clear())  # what it reports still, or again, is a fault
        channel.obey(gardasoft.events(True))
        channel.obey(gardasoft.rating(options.channel, options.rating_v, options.rating_a))
        if options.mode == "strobe":
            channel.obey(gardasoft.trigger_input(options.channel, options.trigger_input or options.channel))
        self._put_out_and_know()
        channel.learn_status()
        channel.must_have(0.0)
        self._rating_confirmed = channel.has_rating(options.rating_v, options.rating_a)

    # ---- on and off -------------------------------------------------------------------------

    def _light_up(self, level: float) -> None:
        options = self._options
        percent = max(_PERCENT_STEP, round(level * options.max_percent, 1))
        self._lit, self._dark_by = True, time.monotonic() + options.max_on_s
        self._is_overdue = True
        self._timer.set(options.max_on_s)
        if options.mode == "strobe":
            width_s, delay_s = options.pulse_width_ms / 1e3, options.pulse_delay_ms / 1e3
            command = gardasoft.pulse(
                options.channel, width_s, delay_s, percent, options.allowed_retrigger_ms / 1e3
            )
        else:
            command = gardasoft.continuous(options.channel, percent)
        adjusted = self._channel.obey(command, may_adjust=True)
        self._percent = percent
        if adjusted:  # of a pulse, the times may be; the brightness is what captures are told
            self._channel.read_status()
            if self._channel.percent is None:
                message = f"{command.decode()}: {error_text(gardasoft.ADJUSTED)}, nobody knows which"
                raise DeviceFaultError(self._name, message)
            self._channel.must_have(percent)

    def _put_out_and_know(self) -> None:
        """Puts the light out, and raises what else the answer says."""
        reply = self._link.ask(self._off)
        if not reply.lines and _DARK_ANYWAY.issuperset(reply.errors):
            self._lit, self._percent, self._is_overdue = False, 0.0, False
            self._timer.set(None)
        self._channel.judge(reply, self._off)

    def _put_out(self) -> None:
        """Tells the light to go off without waiting for an answer; the timer then asks until it has one."""
        with contextlib.suppress(DriverError):
            self._link.tell(self._off)
        self._lit, self._dark_by, self._is_overdue = True, time.monotonic() + _AGAIN_S, False
        self._timer.set(_AGAIN_S)

    def _put_out_for_good(self) -> None:
        """Puts the light out before the connection goes: by another connection where this one broke."""
        until = time.monotonic() + 3 * self._options.reply_timeout_s
        connected_again = False
        if not self._link.in_step:
            self._put_out()  # it may well hear, though it does not answer
        self._lit = True
        while True:
            try:
                self._put_out_and_know()
            except DeviceLostError:
                if not self._lit or connected_again:
                    break
                connected_again = True
                self._link.close()
                try:
                    self._link.open(self._off)
                except DriverError:
                    break
            except DeviceTimeoutError:
                if time.monotonic() > until:
                    break
            except DriverError:
                break  # it has answered
            else:
                break
        if self._lit:
            _log.error("%s: gone without having confirmed that the light is off", self._name)

    def _expire(self) -> float | None:
        """Puts out a light whose time is over; called by the timer's thread."""
        with self._lock:
            if not (self._lit and self._link.transport.is_open):
                return None
            left = self._dark_by - time.monotonic()
            if left > 0:
                return left
            if self._is_overdue:
                message = f"it was on for longer than max_on_s = {self._options.max_on_s:g} s and was put out"
                _log.error("%s: %s", self._name, message)
                self._trouble, self._is_overdue = (DeviceTimeoutError, message), False
            try:
                self._put_out_and_know()
            except DriverError as error:
                # Without an answer the next call meets the same trouble; what was answered it would not.
                if not self._lit and self._trouble is None:
                    self._trouble = type(error), str(error).removeprefix(f"{self._name}: ")
            return _AGAIN_S if self._lit else None

    def _must_be_usable(self) -> None:
        if not self._is_open:
            raise DeviceLostError(self._name, "it is not open")
        if self._channel.fault is not None:
            raise DeviceFaultError(
                self._name, f"{self._channel.fault}; it stays off until it is closed and opened again"
            )

    def _tell_trouble(self, forget: bool = True) -> None:
        trouble = self._trouble
        if forget:
            self._trouble = None
        if trouble is not None:
            raise trouble[0](self._name, trouble[1])


def _transport(name: str, options: LightOptions) -> Transport:
    if options.port_path is not None:
        return SerialPort(name, options.port_path, _BAUD_RATE, write_timeout_s=options.reply_timeout_s)
    host = options.host or ""  # the options have one of the two
    return NetworkPort(name, host, options.host_port, options.local_port, options.reply_timeout_s)


def _address(options: LightOptions) -> str:
    if options.port_path is not None:
        return f"{options.port_path}, {_BAUD_RATE} baud"
    return f"{'tcp' if options.local_port is None else 'udp'}://{options.host}:{options.host_port}"
