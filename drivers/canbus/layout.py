"""The one door to cantools: which bits of which frame are a joint, by a DBC file and a table."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite, pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, Strict, model_validator

from drivers.canbus.joints import JOINTS
from drivers.canbus.options import ReaderOptions
from drivers.errors import DriverUnavailableError
from surfclass.errors import ConfigurationError
from surfclass.schema import Number, Table

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

_RAD_PER_UNIT = {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180, "°": pi / 180, "degree": pi / 180}
_Name = Annotated[str, Strict(), Field(min_length=1)]


class JointSignal(Table):
    """Where a joint's angle is: sign · scale_rad · signal + offset_rad.

    Attributes:
        message: Its message in the DBC file.
        signal: Its signal in that message.
        scale_rad: Radians in one unit of the signal (after the DBC's own factor and offset); None: by
            the DBC's unit, where that is rad, mrad, deg or °.
        offset_rad: The joint's angle where the signal is 0.
        sign: -1 where the signal turns the other way.
    """

    message: _Name
    signal: _Name
    scale_rad: Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)] | None = None
    offset_rad: Number = 0.0
    sign: Literal[1, -1] = 1


class JointSignals(Table):
    """The signals of the six joints."""

    j1: JointSignal
    j2: JointSignal
    j3: JointSignal
    j4: JointSignal
    j5: JointSignal
    j6: JointSignal


class DbcOptions(ReaderOptions):
    """The joints in frames that a DBC file describes.

    Attributes:
        dbc_path: The DBC file.
        joints: A signal for each of j1 to j6.
        sync: The frame that a set's frames follow: its id (above 0x7FF: extended), or its message's
            name in the DBC file.
        counter: The signal that a set's frames have in common: its name, where it is the same in all
            messages, or a table message → name.
    """

    dbc_path: Path
    joints: JointSignals
    sync: Annotated[int, Strict(), Field(ge=1, le=0x1FFFFFFF)] | _Name | None = None
    counter: _Name | dict[_Name, _Name] | None = None

    @model_validator(mode="after")
    def _one_way_to_close_a_set(self) -> DbcOptions:
        if (self.sync is None) == (self.counter is None):
            raise ValueError("sync, counter: exactly one of the two says which frames are one set")
        if self.sync is not None and self.window_ms > self.period_ms:
            raise ValueError(
                f"window_ms: {self.window_ms:g} is longer than period_ms, {self.period_ms:g}: "
                "a set could hold frames of two SYNCs"
            )
        return self


@dataclass(frozen=True, slots=True)
class JointFrame:
    """What a frame says.

    Attributes:
        angles: Joint 0…5 → rad.
        counter: Of the set that it is of; 0 where sets follow a SYNC.
    """

    angles: dict[int, float]
    counter: int


class ImpossibleAngleError(ValueError):
    """What came says that a joint has no angle."""


class Layout:
    """The frames of six joints.

    Args:
        device: What errors name.
        options: The DBC file, and the signals in it.

    Attributes:
        sync: Id and whether extended of the SYNC; None where frames carry a counter.
        modulus: How many values the counter has; 0 where there is none.
        messages: Names of the joints' messages.
        library: cantools and its version.

    Raises:
        ConfigurationError: If the file cannot be read or does not fit the table.
        DriverUnavailableError: If cantools is not installed.
    """

    def __init__(self, device: str, options: DbcOptions) -> None:
        self._where = f"{device}: {options.dbc_path}"
        database = self._load(device, options.dbc_path)
        self._by_id: dict[tuple[int, bool], tuple[Message, list[tuple[int, JointSignal, float]]]] = {}
        signals = [getattr(options.joints, joint) for joint in JOINTS]
        taken: dict[tuple[str, str], str] = {}
        for joint, entry in enumerate(signals):
            key = (entry.message, entry.signal)
            if (other := taken.setdefault(key, JOINTS[joint])) != JOINTS[joint]:
                raise ConfigurationError(
                    f"{device}: joints.{JOINTS[joint]}: {entry.message}.{entry.signal} is {other} already"
                )
            message = self._message(database, entry.message, f"joints.{JOINTS[joint]}.message")
            signal = self._signal(message, entry.signal, f"joints.{JOINTS[joint]}.signal")
            scale = self._scale(signal, entry, joint)
            _, parts = self._by_id.setdefault(_key(message), (message, []))
            parts.append((joint, entry, entry.sign * scale))
        self.messages = tuple(message.name for message, _ in self._by_id.values())
        self._no_id_twice(database)
        self.sync = self._sync(database, options.sync)
        self._counters, self.modulus = self._counter(options)

    @property
    def wanted(self) -> frozenset[tuple[int, bool]]:
        """Ids, and whether they are extended, of all frames that matter."""
        return frozenset(self._by_id) | ({self.sync} if self.sync is not None else set())

    def read(self, can_id: int, extended: bool, data: bytes) -> JointFrame | None:
        """Returns what a frame of a joint's message says; None if it is malformed.

        Raises:
            ImpossibleAngleError: If it says what cannot be.
        """
        message, parts = self._by_id[can_id, extended]
        if len(data) != message.length:
            return None
        try:
            values = message.decode(data)
        except self._error:  # a selector that the DBC does not know
            return None
        if not isinstance(values, dict):
            return None
        angles = {}
        for joint, entry, scale in parts:
            if (value := values.get(entry.signal)) is not None:  # of a multiplexed message, some
                angles[joint] = self._angle(joint, entry, scale, value)
        counter = 0
        if self.modulus:
            raw = values.get(self._counters[message.name])
            if not isinstance(raw, int) or raw >= self.modulus:
                return None
            counter = raw
        return JointFrame(angles, counter)

    def _angle(self, joint: int, entry: JointSignal, scale: float, value: object) -> float:
        # A value that the DBC has a name for is no number, and neither is NaN.
        if not isinstance(value, int | float) or not isfinite(value):
            raise ImpossibleAngleError(f"{JOINTS[joint]}: {entry.message}.{entry.signal} says {str(value)!r}")
        return scale * value + entry.offset_rad

    def _load(self, device: str, path: Path) -> Database:
        try:
            cantools = importlib.import_module("cantools")
        except ModuleNotFoundError as error:
            raise DriverUnavailableError(
                device, "a DBC file needs the library cantools (PyPI, Debian: python3-cantools)"
            ) from error
        try:
            database: Database = cantools.database.load_file(path, database_format="dbc")
        except (cantools.Error, OSError, ValueError, LookupError) as error:
            raise ConfigurationError(f"{self._where}: not a DBC file that can be read: {error}") from error
        self._error = cantools.Error
        self.library = f"cantools {cantools.__version__}"
        return database

    def _message(self, database: Database, name: str, key: str) -> Message:
        known = {message.name: message for message in database.messages}
        if name not in known:
            raise ConfigurationError(f"{self._where}: {key}: {_not_among(name, known, 'message')}")
        return known[name]

    def _signal(self, message: Message, name: str, key: str) -> Signal:
        known = {signal.name: signal for signal in message.signals}
        if name not in known:
            raise ConfigurationError(
                f"{self._where}: {key}: {_not_among(name, known, f'signal of {message.name}')}"
            )
        return known[name]

    def _scale(self, signal: Signal, entry: JointSignal, joint: int) -> float:
        if entry.scale_rad is not None:
            return entry.scale_rad
        if signal.unit not in _RAD_PER_UNIT:
            raise ConfigurationError(
                f"{self._where}: joints.{JOINTS[joint]}.scale_rad: missing, and the unit of "
                f"{entry.message}.{entry.signal} is {signal.unit!r}, none of {', '.join(_RAD_PER_UNIT)}"
            )
        return _RAD_PER_UNIT[signal.unit]

    def _no_id_twice(self, database: Database) -> None:
        for message in database.messages:
            ours = self._by_id.get(_key(message))
            if ours is not None and ours[0].name != message.name:
                raise ConfigurationError(
                    f"{self._where}: {ours[0].name} and {message.name}: the same id 0x{message.frame_id:X}"
                )

    def _sync(self, database: Database, sync: int | str | None) -> tuple[int, bool] | None:
        if sync is None:
            return None
        key = _key(self._message(database, sync, "sync")) if isinstance(sync, str) else (sync, sync > 0x7FF)
        if key in self._by_id:
            raise ConfigurationError(
                f"{self._where}: sync: 0x{key[0]:X} is a joint's message, {self._by_id[key][0].name}"
            )
        return key

    def _counter(self, options: DbcOptions) -> tuple[dict[str, str], int]:
        """Returns the counter's signal in each message, and how many values it has."""
        if options.counter is None:
            return {}, 0
        table = options.counter
        names = dict.fromkeys(self.messages, table) if isinstance(table, str) else dict(table)
        if names.keys() != set(self.messages):
            raise ConfigurationError(
                f"{self._where}: counter: a table for {', '.join(sorted(names))}, the joints are in "
                f"{', '.join(sorted(self.messages))}"
            )
        sizes = {}
        for message, _ in self._by_id.values():
            signal = self._signal(message, names[message.name], "counter")
            plain = signal.scale == 1 and signal.offset == 0 and not signal.choices
            if signal.is_float or signal.is_signed or not plain:
                raise ConfigurationError(
                    f"{self._where}: counter: {message.name}.{signal.name} is no plain unsigned number"
                )
            sizes[message.name] = int(signal.maximum) + 1 if signal.maximum else 1 << signal.length
        modulus = min(sizes.values())
        if max(sizes.values()) != modulus or modulus < 2:
            raise ConfigurationError(f"{self._where}: counter: of different or no range: {sizes}")
        if options.window_ms > options.period_ms * max(1, modulus // 2 - 1):
            raise ConfigurationError(
                f"{self._where}: window_ms: {options.window_ms:g} is longer than it takes a counter of "
                f"{modulus} values to be mistaken, {options.period_ms * max(1, modulus // 2 - 1):g}"
            )
        return names, modulus


def _key(message: Message) -> tuple[int, bool]:
    return message.frame_id, message.is_extended_frame


def _not_among(name: str, known: Iterable[str], what: str) -> str:
    names = sorted(known)
    by_lower = {each.lower(): each for each in names}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1)
    hint = f"; did you mean {by_lower[near[0]]!r}?" if near else ""
    return f"{name!r} is no {what}{hint} (there are: {', '.join(names)})"
