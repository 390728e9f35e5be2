"""What Gardasoft's light controllers understand and say: commands, replies, errors, events, limits.

Bytes in, values out; no I/O. From the manuals of the RT, RC and TR-HT series. A command line is two
letters and numbers with commas between, more commands after semicolons, and a carriage return; the
answer is the commands' output and then ">" as the very last character. Once GT1 was sent, events may
come at any time, also between a command and its answer.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

PROMPT = b">"
MAX_REPLY_BYTES = 4096  # the longest known, the status of eight channels, has about 800

ERRORS: Mapping[int, str] = {
    1: "a parameter is invalid",
    2: "the command is not recognised",
    3: "a number has the wrong format",
    4: "wrong number of parameters",
    5: "a value was out of range and has been adjusted",
    8: "EEPROM corrupt, the configuration has been cleared",
    9: "the settings could not be saved",
    12: "EEPROM corrupt, the configuration has been cleared",
    19: "the light has no rating",
    20: "the settings could not be saved",
    21: "sensing the light failed",
    22: "sensing the light failed",
    23: "sensing the light failed",
    40: "more current flows than expected",
    41: "more current flows than expected",
    44: "the controller is too hot",
    45: "more current flows than expected",
    46: "a channel dissipates more than 30 W",
    47: "the output's protection has tripped",
}
ADJUSTED = 5  # a warning: the command was carried out, with another value
NO_RATING = 19
EEPROM = frozenset({8, 12})
FATAL_ERRORS = frozenset({40, 41, 44, 45, 46, 47})

EVENTS: Mapping[int, str] = {
    128: "a light was connected",
    129: "a light without a rating was connected",
    130: "over-temperature",
    131: "over-current",
    132: "sensing the light failed",
    138: "SafePower's training has ended",
    139: "SafePower's training has failed",
    140: "the light was switched off: duty cycle too high",
}
LIGHT_CONNECTED, LIGHT_UNRATED = 128, 129
FATAL_EVENTS = frozenset({130, 131})
NOTES = frozenset({LIGHT_CONNECTED, 138})  # events that are no trouble

# Brightness up to (%), pulse at most (s), part of the time at most: the RT manual's overdrive table.
OVERDRIVE = ((100, 0.999, 1.0), (200, 0.030, 0.3), (300, 0.010, 0.2), (500, 0.002, 0.1), (1000, 0.001, 0.05))

_EVENT = re.compile(rb"Evt(\d{1,2}),(\d{1,3})(?:;|\r\n|\n\r|\r|\n)?")
_UNFINISHED_EVENT = re.compile(rb"E(?:v(?:t(?:\d{1,2}(?:,\d{0,3})?)?)?)?$")
_ERROR = re.compile(r"Err\s*(\d{1,3})")
_VERSION = re.compile(r"(\S+) +\((HW\w+)\) +(V\w+)")
_STATUS_ITEM = re.compile(r"([A-Z]{1,3})(?![A-Za-z])\s*[:=]?\s*(.*)")
_QUANTITY = re.compile(r"(-?\d+(?:\.\d+)?|-?\.\d+)\s*([A-Za-z%µ]*)")
_UNITS = {
    "time": {"": 1e-3, "ms": 1e-3, "s": 1.0, "us": 1e-6, "µs": 1e-6},
    "current": {"": 1.0, "a": 1.0, "ma": 1e-3},
    "voltage": {"": 1.0, "v": 1.0},
    "percent": {"": 1.0, "%": 1.0},
}


class GardasoftError(ValueError):
    """What came over the wire is no message of these controllers."""


# ---- commands -------------------------------------------------------------------------------


def line(*commands: bytes) -> bytes:
    """Returns the command line that has these commands carried out one after the other."""
    return b";".join(commands) + b"\r"


def version() -> bytes:
    """Asks for model, hardware and firmware."""
    return b"VR"


def rating(channel: int, volts: float, amps: float) -> bytes:
    """Sets what the light stands; 0 V for a light rated by current, 0 A for one rated by voltage."""
    return f"VL{channel},{_number(volts)},{_number(amps)}".encode()


def continuous(channel: int, percent: float) -> bytes:
    """Shines until told otherwise, 0…100 %; 0 is off in every mode."""
    return f"RS{channel},{_number(percent)}".encode()


def switched(channel: int, percent: float) -> bytes:
    """Shines while the trigger input is active, 0…100 %."""
    return f"RW{channel},{_number(percent)}".encode()


def pulse(
    channel: int, width_s: float, delay_s: float, percent: float, retrigger_s: float | None = None
) -> bytes:
    """Shines for `width_s`, beginning `delay_s` after each trigger, to 999 %.

    Triggers that come less than `retrigger_s` after the last one are ignored.
    """
    numbers = [width_s * 1e3, delay_s * 1e3, percent] + ([] if retrigger_s is None else [retrigger_s * 1e3])
    return f"RT{channel},{','.join(map(_number, numbers))}".encode()


def trigger(channel: int) -> bytes:
    """Does what a pulse on the trigger input would do."""
    return f"TR{channel}".encode()


def trigger_input(channel: int, number: int) -> bytes:
    """Says which trigger input a channel listens to."""
    return f"RP{channel},{number}".encode()


def status(channel: int) -> bytes:
    """Asks for a channel's settings; see `parse_status`."""
    return f"ST{channel}".encode()


def events(on: bool) -> bytes:
    """Has events told as they happen, or not."""
    return b"GT1" if on else b"GT0"


def clear() -> bytes:
    """Asks for the last event and clears it, with the error that it stands for."""
    return b"GR"


def _number(value: float) -> str:
    """To a thousandth: a µs, a mA; never in exponent form."""
    return f"{value:.3f}".rstrip("0").rstrip(".")


# ---- replies --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Event:
    """Something that the controller tells by itself; channel 0 is none in particular."""

    channel: int
    code: int

    @property
    def text(self) -> str:
        """What it means."""
        meaning = EVENTS.get(self.code) or ERRORS.get(self.code) or "unknown"
        return f"event {self.code}{f' of channel {self.channel}' if self.channel else ''}: {meaning}"

    @property
    def is_fatal(self) -> bool:
        """Whether the light must stay off until somebody has looked; 1…127 are the errors' numbers."""
        return self.code in FATAL_EVENTS or self.code in FATAL_ERRORS


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to one command line.

    Attributes:
        lines: Its output, without errors and events.
        errors: The numbers of its `Err` lines.
        events: Those that came since the last reply.
    """

    lines: tuple[str, ...]
    errors: tuple[int, ...] = ()
    events: tuple[Event, ...] = ()


class ReplyReader:
    """Makes replies of bytes that come in pieces of any size."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Returns the answers that `data` completes, each without its prompt.

        Raises:
            GardasoftError: If too much came without a prompt; it is dropped.
        """
        self._buffer += data
        *whole, rest = bytes(self._buffer).split(PROMPT)
        self._buffer[:] = rest
        if len(rest) > MAX_REPLY_BYTES or any(len(part) > MAX_REPLY_BYTES for part in whole):
            self._buffer.clear()
            raise GardasoftError(f"more than {MAX_REPLY_BYTES} bytes without a prompt")
        return whole

    def flush(self) -> tuple[Event, ...]:
        """Returns the events that came unasked, and drops everything else but a part of one."""
        rest = bytes(self._buffer)
        tail = _UNFINISHED_EVENT.search(rest)
        begin = tail.start() if tail else len(rest)
        self._buffer[:] = rest[begin:]
        return _split_events(rest[:begin])[0]


def parse_reply(raw: bytes, command_line: bytes = b"") -> Reply:
    """Returns what stands before a prompt.

    Args:
        raw: One of `ReplyReader.feed`.
        command_line: What was asked, for the controllers that echo it: an echo is dropped.

    Raises:
        GardasoftError: If it is no text.
    """
    found, rest = _split_events(raw)
    try:
        text = rest.decode("ascii")
    except UnicodeDecodeError:
        raise GardasoftError(f"no text: {raw[:40]!r}") from None
    parts = [part.strip() for part in re.split(r"[\r\n]+", text)]
    lines = [part for part in parts if part]
    if lines and command_line and lines[0] == command_line.decode("ascii").strip():
        del lines[0]
    if not all(part.isprintable() for part in lines):
        raise GardasoftError(f"no text: {raw[:40]!r}")
    errors = [(part, _ERROR.fullmatch(part)) for part in lines]
    return Reply(
        tuple(part for part, error in errors if error is None),
        tuple(int(error[1]) for _, error in errors if error is not None),
        found,
    )


def _split_events(raw: bytes) -> tuple[tuple[Event, ...], bytes]:
    """The events in `raw`, and what is left when they are taken out."""
    found = tuple(Event(int(match[1]), int(match[2])) for match in _EVENT.finditer(raw))
    return found, _EVENT.sub(b"", raw)


@dataclass(frozen=True, slots=True)
class Version:
    """What a controller is, such as RT860F-20, HW02, V031."""

    model: str
    hardware: str
    firmware: str


def parse_version(text: str) -> Version:
    """Returns what the answer to VR says.

    Raises:
        GardasoftError: If it is none.
    """
    match = _VERSION.fullmatch(text)
    if match is None:
        raise GardasoftError(f"{text[:60]!r} is no version, which looks like 'RT420-20 (HW02) V031'")
    return Version(match[1], match[2], match[3])


def parse_status(reply: Reply) -> dict[str, str]:
    """Returns the answer to ST by its keys, such as {"CH": "1", "S": "50.0%", "RA": "0.700A"}.

    Of CH (channel), MD (mode: 0 continuous, 1 pulse, 2 switched), S (brightness), DL (delay), PU (pulse
    width), RT (retrigger delay), IP (trigger input), FL (flags), CS (sensed rating), RA (rating). Which
    of them come, and in which order, is the firmware's business.

    Raises:
        GardasoftError: If nothing in it is a key and a value.
    """
    items = [item.strip() for text in reply.lines for item in text.split(",")]
    matches = [match for item in items if (match := _STATUS_ITEM.fullmatch(item))]
    if not matches:
        raise GardasoftError(f"{' '.join(reply.lines)[:60]!r} is no status, which looks like 'CH 1, MD 0, …'")
    return {match[1]: match[2] for match in matches}


def quantity(text: str, kind: str) -> float:
    """Returns a number with or without its unit: seconds (ms without), A, V or %.

    Args:
        text: Such as "200us", "0.1s", "100ma", "2.45A", "0.1".
        kind: "time", "current", "voltage" or "percent".

    Raises:
        GardasoftError: If it is none of that kind.
    """
    match = _QUANTITY.fullmatch(text.strip())
    factor = _UNITS[kind].get(match[2].lower()) if match else None
    if match is None or factor is None:
        raise GardasoftError(f"{text[:40]!r} is no {kind}")
    return float(match[1]) * factor


# ---- limits ---------------------------------------------------------------------------------


def overdrive_limit(percent: float) -> tuple[float, float]:
    """Returns for a brightness how long a pulse may last, s, and which part of the time, 0…1.

    Raises:
        GardasoftError: If no pulse may be so bright.
    """
    for brightest, width_s, duty in OVERDRIVE:
        if percent <= brightest:
            return width_s, duty
    raise GardasoftError(f"brightness {percent:g} %, allowed is up to {OVERDRIVE[-1][0]} %")
