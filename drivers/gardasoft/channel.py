"""One channel of a Gardasoft controller: what its answers and events mean for whoever uses the light."""

from __future__ import annotations

import contextlib
import logging

from drivers.errors import DeviceFaultError, DeviceLostError, DeviceTimeoutError
from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.link import GardasoftLink
from drivers.gardasoft.protocol import Event, GardasoftError, Reply

_PERCENT_TOLERANCE = 0.1  # the finest step of any of these controllers
_RATING_TOLERANCE = 0.01
_NOTES = 5  # the latest are kept

_log = logging.getLogger("surfclass.light")


class GardasoftChannel:
    """Asks over a link, and turns what comes into the errors of `drivers.errors`.

    Attributes:
        fault: What the controller called fatal, from then on; None while it called nothing so.
        status: The channel's settings as read last, by the controller's own keys.
        notes: The latest things worth knowing that are no trouble.

    Args:
        link: Open whenever anything is asked here.
        number: Of the channel.
    """

    def __init__(self, link: GardasoftLink, number: int) -> None:
        self.name, self.link, self.number = link.name, link, number
        self.fault: str | None = None
        self.status: dict[str, str] = {}
        self.notes: list[str] = []
        self._tells_status = True

    def obey(self, command: bytes, may_adjust: bool = False) -> bool:
        """Has a command without output carried out; returns whether a value was adjusted.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As `judge` and the link.
        """
        return self.judge(self.link.ask(command), command, may_adjust)

    def judge(self, reply: Reply, command: bytes, may_adjust: bool = False) -> bool:
        """Raises what the answer to a command without output says; returns whether a value was adjusted.

        Raises:
            DeviceFaultError: For an error, and for an event that is the light's or the controller's trouble.
            DeviceLostError: If another light was plugged in, which has no rating.
            DeviceTimeoutError: If it is no answer to this.
        """
        for event in reply.events:
            self._judge_event(event)
        for number in reply.errors:
            message = f"{command.decode()}: {error_text(number)}"
            if number in gardasoft.FATAL_ERRORS or number in gardasoft.EEPROM:
                self.fault = message
            if number != gardasoft.ADJUSTED or not may_adjust:
                raise DeviceFaultError(self.name, message)
        if reply.lines:
            self.link.distrust()
            came = " ".join(reply.lines)[:60]
            raise DeviceTimeoutError(self.name, f"no answer to {command.decode()!r}, but {came!r}")
        return gardasoft.ADJUSTED in reply.errors

    def _judge_event(self, event: Event) -> None:
        if event.is_fatal:
            self.fault = event.text
            raise DeviceFaultError(self.name, event.text)
        known = event.code in gardasoft.EVENTS or event.code in gardasoft.ERRORS
        if not known or event.code in gardasoft.NOTES or event.channel not in (0, self.number):
            self.note(event.text)
        elif event.code == gardasoft.LIGHT_UNRATED:
            raise DeviceLostError(self.name, event.text)
        else:
            raise DeviceFaultError(self.name, event.text)

    def note(self, text: str) -> None:
        """Keeps and logs what is worth knowing."""
        _log.warning("%s: %s", self.name, text)
        self.notes = [*self.notes, text][-_NOTES:]

    def learn_status(self) -> None:
        """Reads the settings for the first time; a firmware whose way to tell them is unknown may be used.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As `judge` and the link.
        """
        reply = self._ask_status(None)
        try:
            self.status = gardasoft.parse_status(reply)
        except GardasoftError as error:
            self._tells_status = False
            self.note(f"its status is not understood, so it is not watched: {error}")

    def read_status(self, timeout_s: float | None = None) -> None:
        """Reads the settings again, or just whether somebody answers where they were not understood.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As `judge` and the link.
        """
        reply = self._ask_status(timeout_s)
        try:
            if self._tells_status:
                self.status = gardasoft.parse_status(reply)
        except GardasoftError as error:
            self.link.distrust()
            raise DeviceTimeoutError(self.name, f"no answer to its status question: {error}") from error

    def _ask_status(self, timeout_s: float | None) -> Reply:
        question = gardasoft.status(self.number) if self._tells_status else gardasoft.version()
        reply = self.link.ask(question, timeout_s=timeout_s)
        self.judge(Reply((), reply.errors, reply.events), question)
        return reply

    @property
    def percent(self) -> float | None:
        """The brightness as read last, or None where it was not told."""
        with contextlib.suppress(KeyError, GardasoftError):
            return gardasoft.quantity(self.status["S"], "percent")
        return None

    def must_have(self, percent: float) -> None:
        """Compares the brightness as read: a controller that was restarted resumes what is in its flash.

        Raises:
            DeviceLostError: If it is another one than `percent`.
        """
        told = self.percent
        if told is not None and abs(told - percent) > _PERCENT_TOLERANCE:
            raise DeviceLostError(
                self.name,
                f"its brightness is {told:g} %, it was set to {percent:g} %: it was restarted, or something "
                "else sets it",
            )

    def has_rating(self, volts: float, amps: float) -> bool:
        """Compares the rating as read; returns False where the controller does not tell it with a unit.

        Raises:
            DeviceFaultError: If it is another one.
        """
        told = self.status.get("RA", "")
        confirmed = False
        for kind, wanted in (("voltage", volts), ("current", amps)):
            for word in told.replace("/", " ").split():
                if not wanted or not word[-1].isalpha():
                    continue
                with contextlib.suppress(GardasoftError):
                    got = gardasoft.quantity(word, kind)
                    if abs(got - wanted) > _RATING_TOLERANCE * wanted:
                        message = (
                            f"told to take {wanted:g} for the {kind} that the light stands, it has {told}"
                        )
                        raise DeviceFaultError(self.name, message)
                    confirmed = True
        return confirmed


def error_text(number: int) -> str:
    """Returns what an error number means, with the number."""
    return f"Err {number}: {gardasoft.ERRORS.get(number, 'unknown')}"
