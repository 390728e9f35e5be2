"""What an emulated LED controller does with its commands: modes, ratings, limits, faults, and its light."""

from __future__ import annotations

import bisect
import itertools
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.protocol import GardasoftError

VERSION = "RT860F-20 (HW02) V031"
CONTINUOUS, PULSE, SWITCHED = 0, 1, 2  # as the status tells them
_CHANNELS = 8
_LONGEST_HISTORY = 100_000
_SHORTEST_MS, _LONGEST_MS = 0.01, 999.0


class _RefusedError(Exception):
    """Ends a command with an error number."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@dataclass(frozen=True, slots=True)
class Output:
    """One channel's settings; times in ms, as on the wire."""

    mode: int = CONTINUOUS
    percent: float = 0.0
    width_ms: float = 1.0
    delay_ms: float = _SHORTEST_MS
    retrigger_ms: float = 0.0
    trigger_input: int = 0
    volts: float = 0.0
    amps: float = 0.0

    @property
    def is_rated(self) -> bool:
        """Without a rating nothing shines."""
        return self.volts > 0 or self.amps > 0


class LightHistory:
    """The light over time: levels that hold until the next one."""

    def __init__(self) -> None:
        self._t_ns: list[int] = []
        self._level: list[float] = []

    def add(self, level: float, from_ns: int) -> None:
        """From then on, unless something later is known already."""
        at = bisect.bisect_right(self._t_ns, from_ns)
        self._t_ns.insert(at, from_ns)
        self._level.insert(at, level)
        del self._t_ns[:-_LONGEST_HISTORY], self._level[:-_LONGEST_HISTORY]

    def set(self, level: float, from_ns: int) -> None:
        """From then on, whatever was to follow."""
        at = bisect.bisect_left(self._t_ns, from_ns)
        del self._t_ns[at:], self._level[at:]
        self.add(level, from_ns)

    def at(self, t_ns: int) -> float:
        """Returns the level at a time; 0 before the first."""
        at = bisect.bisect_right(self._t_ns, t_ns)
        return self._level[at - 1] if at else 0.0

    def mean(self, begin_ns: int, end_ns: int) -> float:
        """Returns the mean level over an exposure."""
        first, last = (bisect.bisect_right(self._t_ns, t_ns) for t_ns in (begin_ns, end_ns))
        edges = [begin_ns, *self._t_ns[first:last], end_ns]
        light = sum(self.at(a) * (b - a) for a, b in itertools.pairwise(edges))
        return light / max(1, end_ns - begin_ns)


class LedOutputs:
    """Eight channels, of which one feeds the lamp; may be used from several threads.

    Args:
        lamp: Told each level, 0…1, and from when it holds, host ns; levels of flashes too.
        channel: Which of them feeds the lamp.
        full_percent: The brightness that is level 1.
        settle_s: From a command to its light.
    """

    def __init__(
        self,
        lamp: Callable[[float, int], None] | None = None,
        *,
        channel: int = 1,
        full_percent: float = 100.0,
        settle_s: float = 0.002,
    ) -> None:
        self._lamp, self._channel = lamp, channel
        self._full_percent, self._settle_ns = full_percent, round(settle_s * 1e9)
        self._lock = threading.RLock()
        self.history = LightHistory()
        self.outputs = [Output(trigger_input=n + 1) for n in range(_CHANNELS)]
        self.events_told = False
        self._saved = list(self.outputs)
        self._last_trigger_ns: list[int | None] = [None] * _CHANNELS
        self._event: bytes = b""  # the last one, until GR
        self._untold: list[bytes] = []
        self._trip: int | None = None  # the error that keeps the outputs off
        self._hot = False
        self._eeprom_error: int | None = None

    # ---- commands ---------------------------------------------------------------------------

    def execute(self, line: bytes) -> bytes:
        """Returns the answer to a command line (without its CR), with the prompt."""
        with self._lock:
            told = [self._command(text) for text in line.decode("latin-1").split(";")]
        return "".join(f"{text}\n\r" for text in told if text).encode("latin-1") + gardasoft.PROMPT

    def _command(self, text: str) -> str:
        text = text.replace(" ", "").upper()
        name, numbers = text[:2], text[2:].split(",") if text[2:] else []
        command = {
            "VR": self._version, "VL": self._rate, "RS": self._shine, "RW": self._switch, "RT": self._pulse,
            "TR": self._trigger, "RP": self._choose_input, "ST": self._status, "GT": self._tell_events,
            "GR": self._clear, "AW": self._save,
        }.get(name)  # fmt: skip
        try:
            if self._eeprom_error is not None:
                number, self._eeprom_error = self._eeprom_error, None
                raise _RefusedError(number)
            if command is None:
                raise _RefusedError(2)
            return command(numbers)
        except _RefusedError as error:
            return f"Err {error.number}"

    def _version(self, numbers: list[str]) -> str:
        _count(numbers, 0, 0)
        return VERSION

    def _rate(self, numbers: list[str]) -> str:
        _count(numbers, 3, 3)
        channel, volts, amps = _channel(numbers), _parse(numbers[1], "voltage"), _parse(numbers[2], "current")
        if not (0 <= volts <= 48 and 0 <= amps <= 20):
            raise _RefusedError(1)
        self._set(channel, replace(self.outputs[channel], volts=volts, amps=amps))
        return ""

    def _shine(self, numbers: list[str]) -> str:
        _count(numbers, 2, 2)
        channel, percent = _channel(numbers), _parse(numbers[1], "percent")
        return self._set_mode(channel, CONTINUOUS, percent, 100.0)

    def _switch(self, numbers: list[str]) -> str:
        _count(numbers, 2, 4)
        channel, percent = _channel(numbers), _parse(numbers[1], "percent")
        return self._set_mode(channel, SWITCHED, percent, 100.0)

    def _pulse(self, numbers: list[str]) -> str:
        _count(numbers, 4, 5)
        channel = _channel(numbers)
        width, delay = (_parse(text, "time") * 1e3 for text in numbers[1:3])
        percent = _parse(numbers[3], "percent")
        retrigger = _parse(numbers[4], "time") * 1e3 if len(numbers) == 5 else 0.0
        allowed = [min(_LONGEST_MS, max(_SHORTEST_MS, value)) for value in (width, delay)]
        longest_s, duty = gardasoft.overdrive_limit(min(999.0, max(0.0, percent)))
        if allowed[0] > longest_s * 1e3 * (1 + 1e-9):
            raise _RefusedError(1)
        shortest = allowed[0] / duty
        answer = self._set_mode(channel, PULSE, percent, 999.0)
        self.outputs[channel] = replace(
            self.outputs[channel],
            width_ms=allowed[0],
            delay_ms=allowed[1],
            retrigger_ms=max(shortest, retrigger),
        )
        adjusted = allowed != [width, delay] or 0 < retrigger < shortest * (1 - 1e-9)
        return f"Err {gardasoft.ADJUSTED}" if adjusted else answer

    def _set_mode(self, channel: int, mode: int, percent: float, brightest: float) -> str:
        output, allowed = self.outputs[channel], min(brightest, max(0.0, percent))
        if allowed > 0 and self._trip is not None:
            raise _RefusedError(self._trip)
        if allowed > 0 and not output.is_rated:
            raise _RefusedError(gardasoft.NO_RATING)
        self._set(channel, replace(output, mode=mode, percent=allowed))
        return "" if allowed == percent else f"Err {gardasoft.ADJUSTED}"

    def _trigger(self, numbers: list[str]) -> str:
        _count(numbers, 1, 1)
        now_ns = time.monotonic_ns()
        self._strobe_channel(_channel(numbers), now_ns, now_ns)
        return ""

    def _choose_input(self, numbers: list[str]) -> str:
        _count(numbers, 2, 2)
        channel, number = _channel(numbers), _channel(numbers[1:]) + 1
        self._set(channel, replace(self.outputs[channel], trigger_input=number))
        return ""

    def _status(self, numbers: list[str]) -> str:
        _count(numbers, 0, 1)
        if numbers == ["0"]:
            return "TM 0, TP 20.00ms"
        channels = [_channel(numbers)] if numbers else range(_CHANNELS)
        return "\n\r".join(_status_text(channel, self.outputs[channel]) for channel in channels)

    def _tell_events(self, numbers: list[str]) -> str:
        _count(numbers, 1, 1)
        if numbers[0] not in ("0", "1"):
            raise _RefusedError(1)
        self.events_told = numbers[0] == "1"
        return ""

    def _clear(self, numbers: list[str]) -> str:
        _count(numbers, 0, 0)
        event = self._event
        if not self._hot:  # else it says so again, and still does not shine
            self._event, self._trip = b"", None
        return event.decode()

    def _save(self, numbers: list[str]) -> str:
        _count(numbers, 0, 0)
        self._saved = list(self.outputs)
        return ""

    # ---- light ------------------------------------------------------------------------------

    def strobe(self, number: int, begin_ns: int, end_ns: int) -> None:
        """A camera's strobe output is active from `begin_ns` to `end_ns` at trigger input `number`."""
        with self._lock:
            for channel, output in enumerate(self.outputs):
                if output.trigger_input == number:
                    self._strobe_channel(channel, begin_ns, end_ns)

    def _strobe_channel(self, channel: int, begin_ns: int, end_ns: int) -> None:
        output, last_ns = self.outputs[channel], self._last_trigger_ns[channel]
        if output.mode == CONTINUOUS or self._trip is not None:
            return
        if output.mode == PULSE:
            if last_ns is not None and begin_ns - last_ns < output.retrigger_ms * 1e6:
                return  # ignored, and nobody is told
            begin_ns += round(output.delay_ms * 1e6)
            end_ns = begin_ns + round(output.width_ms * 1e6)
        self._last_trigger_ns[channel] = begin_ns
        if channel + 1 == self._channel and end_ns > begin_ns:
            level = output.percent / self._full_percent
            for value, from_ns in ((level, begin_ns), (0.0, end_ns)):
                self.history.add(value, from_ns)
                if self._lamp is not None:
                    self._lamp(value, from_ns)

    def _set(self, channel: int, output: Output) -> None:
        before, self.outputs[channel] = self.outputs[channel], output
        if channel + 1 == self._channel and _steady(before) != _steady(output):
            self._shine_at(_steady(output))

    def _shine_at(self, percent: float) -> None:
        level, from_ns = percent / self._full_percent, time.monotonic_ns() + self._settle_ns
        self.history.set(level, from_ns)
        if self._lamp is not None:
            self._lamp(level, from_ns)

    @property
    def level(self) -> float:
        """The steady light that was set last: 0 when it is off, and between flashes."""
        with self._lock:
            return _steady(self.outputs[self._channel - 1]) / self._full_percent

    def mean_level(self, begin_ns: int, end_ns: int) -> float:
        """Returns the lamp's mean level over an exposure, 0…1."""
        with self._lock:
            return self.history.mean(begin_ns, end_ns)

    # ---- what happens to a controller -------------------------------------------------------

    def event(self, code: int, channel: int | None = None) -> None:
        """Something happens that the controller tells: at once after GT1, or when GR asks."""
        with self._lock:
            self._event = f"Evt{self._channel if channel is None else channel},{code}".encode()
            if self.events_told:
                self._untold.append(self._event + b"\r\n")

    def take_events(self) -> bytes:
        """Returns what the controller tells by itself, once."""
        with self._lock:
            told, self._untold = b"".join(self._untold), []
        return told

    def overheat(self) -> None:
        """It goes off, and says Err 44 until it has cooled down and is cleared."""
        self._hot = True
        self._trip_with(44, 130)

    def cool_down(self) -> None:
        """The heat is gone; the fault stays until GR."""
        self._hot = False

    def overcurrent(self) -> None:
        """It goes off, and says Err 40 until it is cleared."""
        self._trip_with(40, 131)

    def duty_cycle_exceeded(self) -> None:
        """It goes off by itself."""
        with self._lock:
            self._all_off()
            self.event(140)

    def corrupt_eeprom(self, number: int = 8) -> None:
        """All settings are gone; the next command is answered with that."""
        with self._lock:
            self.outputs = [Output(trigger_input=n + 1) for n in range(_CHANNELS)]
            self._saved = list(self.outputs)
            self._eeprom_error = number
            self._shine_at(0.0)

    def change_light(self, rated: bool) -> None:
        """The light is pulled and another one plugged in, with or without a rating of its own."""
        with self._lock:
            channel = self._channel - 1
            if not rated:
                self._set(channel, replace(self.outputs[channel], volts=0.0, amps=0.0, percent=0.0))
            self.event(gardasoft.LIGHT_CONNECTED if rated else gardasoft.LIGHT_UNRATED)

    def restart(self) -> None:
        """The power failed: what was saved last is resumed, and events are told no more."""
        with self._lock:
            self.outputs, self.events_told, self._event, self._untold = list(self._saved), False, b"", []
            self._shine_at(_steady(self.outputs[self._channel - 1]))

    def power_off(self) -> None:
        """The power is gone: it goes dark."""
        with self._lock:
            self._all_off()

    def _trip_with(self, error: int, event: int) -> None:
        with self._lock:
            self._all_off()
            self._trip = error
            self.event(event)

    def _all_off(self) -> None:
        self.outputs = [replace(output, mode=CONTINUOUS, percent=0.0) for output in self.outputs]
        self._shine_at(0.0)


def _steady(output: Output) -> float:
    return output.percent if output.mode == CONTINUOUS and output.is_rated else 0.0


def _status_text(channel: int, output: Output) -> str:
    rating = " ".join(
        f"{value:{digits}}{unit}"
        for value, digits, unit in ((output.volts, ".1f", "V"), (output.amps, ".3f", "A"))
        if value
    )
    return (
        f"CH {channel + 1}, MD {output.mode}, S {output.percent:.1f}%, DL {output.delay_ms:.3f}ms, "
        f"PU {output.width_ms:.3f}ms, RT {output.retrigger_ms:.1f}ms, IP {output.trigger_input}, FL 0, "
        f"CS 0.000A, RA {rating or '0'}"
    )


def _count(numbers: list[str], fewest: int, most: int) -> None:
    if not fewest <= len(numbers) <= most:
        raise _RefusedError(4)


def _parse(text: str, kind: str) -> float:
    try:
        return gardasoft.quantity(text, kind)
    except GardasoftError:
        raise _RefusedError(3) from None


def _channel(numbers: list[str]) -> int:
    """The first of the numbers, which counts channels or inputs from 1, counted from 0."""
    if not (numbers[0].isascii() and numbers[0].isdigit()):
        raise _RefusedError(3)
    if not 1 <= int(numbers[0]) <= _CHANNELS:
        raise _RefusedError(1)
    return int(numbers[0]) - 1
