"""The registers of the emulated Firefly MV: IIDC 1.31's map, and three that only Point Grey's cameras have.

Numbers are those of the 1394 Trade Association's "IIDC 1394-based Digital Camera Specification" 1.31 and
of the maps that libdc1394 reads; `bit(n)` counts from the most significant bit, as they do.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from drivers.bayer import Pattern

GUID = 0x00B09D0100ABCDEF
ROM, COMMANDS = 0xF0000400, 0xF0F00000  # where configuration ROM and command registers are
BRIGHTNESS, AUTO_EXPOSURE, SHARPNESS, WHITE_BALANCE, GAMMA, SHUTTER, GAIN, FRAME_RATE = (
    0,
    1,
    2,
    3,
    6,
    7,
    8,
    15,
)
SHUTTER_STEP_S, GAIN_STEP_DB, RATE_STEP_HZ = 50e-6, 0.05, 0.125
ISO_EN, TRIGGER_MODE, SOFTWARE_TRIGGER = 0x614, 0x830, 0x62C
LINE_SOURCE, SOFTWARE_SOURCE = 0, 7  # in TRIGGER_MODE
BAYER_TILE_MAPPING, BAYER_MONO_CTRL = 0x1040, 0x1050
FULL = (1280, 960)

_INITIALIZE, _MODE, _FORMAT = 0x000, 0x604, 0x608
_FORMAT7, _ABSOLUTE, _STROBE, _END = 0x2000, 0x3000, 0x1300, 0x4000  # blocks, from COMMANDS
_VALUE_SETTING = _FORMAT7 + 0x7C
_BASE = COMMANDS - 0xF0000000  # as inquiries give places: from the start of the register space
_PATTERNS: tuple[Pattern, ...] = ("RGGB", "GBRG", "GRBG", "BGGR")


def bit(n: int) -> int:
    """Returns the bit that IIDC calls n."""
    return 1 << (31 - n)


@dataclass
class FeatureState:
    """One feature: its words at 0x500, 0x700 and 0x800 and what follows them.

    Attributes:
        least: Of the raw value.
        most: The same.
        raw: The value.
        step: What a raw one is in s, dB or Hz; 0 where there is no absolute value.
        switchable: Whether it can be off.
        has_auto: Whether it can be automatic.
        on: Whether it is on.
        auto: Whether it is automatic.
        absolute: Whether the absolute register counts, not the raw one.
    """

    least: int
    most: int
    raw: int
    step: float = 0.0
    switchable: bool = True
    has_auto: bool = True
    on: bool = True
    auto: bool = True
    absolute: bool = False

    @property
    def inquiry(self) -> int:
        """What it can."""
        flags = bit(0) | bit(4) | bit(7)
        flags |= bit(1) if self.step else 0
        flags |= bit(5) if self.switchable else 0
        flags |= bit(6) if self.has_auto else 0
        return flags | self.least << 12 | self.most

    @property
    def register(self) -> int:
        """How it is set."""
        flags = bit(0) | (bit(1) if self.absolute else 0)
        flags |= (bit(6) if self.on else 0) | (bit(7) if self.auto else 0)
        return flags | self.raw

    @register.setter
    def register(self, value: int) -> None:
        self.absolute = bool(self.step and value & bit(1))
        self.on = bool(value & bit(6)) or not self.switchable
        self.auto = bool(self.has_auto and value & bit(7))
        if not self.auto and not self.absolute:
            self.raw = min(max(value & 0xFFF, self.least), self.most)

    def absolute_word(self, place: int) -> int | None:
        """Returns least, most or value, at 0, 4 and 8 of its absolute block; None: it has none."""
        if not self.step:
            return None
        raw = {0: self.least, 4: self.most, 8: self.raw}.get(place, 0)
        return int(struct.unpack("<I", struct.pack("<f", raw * self.step))[0])

    def set_absolute(self, word: int) -> None:
        """Takes the nearest value there is."""
        value = struct.unpack("<f", struct.pack("<I", word))[0]
        if self.step and self.absolute and not self.auto:
            self.raw = min(max(round(value / self.step), self.least), self.most)


class Region(NamedTuple):
    """Which pixels are sent, and whether each has 16 bits."""

    left: int
    top: int
    width: int
    height: int
    deep: bool


class Registers:
    """All of them; what happens on a write beyond keeping a value is the camera's.

    Args:
        sensor: Width and height; the fixed formats exist only on one of 1280 × 960.
        pattern: Of the sensor.
        absolute: Whether there are absolute values.
        point_grey: Whether it is Point Grey's, with their registers.
    """

    def __init__(self, sensor: tuple[int, int], pattern: Pattern, absolute: bool, point_grey: bool) -> None:
        self._sensor, self._pattern, self._absolute = sensor, pattern, absolute
        self.point_grey = point_grey
        self._rom = _configuration_rom(0x00B09D if point_grey else 0x00A0B8)
        self._inquiries = _inquiries(fixed=sensor == FULL)
        self.reset()

    def reset(self) -> None:
        """As after power-on: all that can be automatic is."""
        rate, gain, shutter = (
            step if self._absolute else 0.0 for step in (RATE_STEP_HZ, GAIN_STEP_DB, SHUTTER_STEP_S)
        )
        self.features = {
            BRIGHTNESS: FeatureState(0, 255, 16, switchable=False, has_auto=False, auto=False),
            AUTO_EXPOSURE: FeatureState(1, 1023, 200),
            SHARPNESS: FeatureState(0, 4095, 1000),
            WHITE_BALANCE: FeatureState(0, 1023, 600),
            GAMMA: FeatureState(512, 4095, 1024, has_auto=False, auto=False),
            SHUTTER: FeatureState(1, 2000, 500, shutter, switchable=False),
            GAIN: FeatureState(0, 480, 16, gain, switchable=False),
            FRAME_RATE: FeatureState(8, 480, 120, rate),
        }
        format7 = self._sensor != FULL
        self._values = {
            0x600: 3 << 29,
            _MODE: (0 if format7 else 2) << 29,
            _FORMAT: (7 if format7 else 2) << 29,
            0x60C: 2 << 24,
            0x610: bit(0),
            ISO_EN: 0,
            0x61C: 0,
            TRIGGER_MODE: bit(0),
            BAYER_MONO_CTRL: bit(0),
            _STROBE + 0x200: bit(0),
            _STROBE + 0x204: bit(0),
            _FORMAT7 + 0x08: 0,
            _FORMAT7 + 0x0C: self._sensor[0] << 16 | self._sensor[1],
            _FORMAT7 + 0x10: 0,
            _FORMAT7 + 0x44: 4096 << 16,
            _VALUE_SETTING: bit(0),
        }

    @property
    def streams(self) -> bool:
        """Whether it may send frames."""
        return bool(self._values[ISO_EN] & bit(0))

    @property
    def waits_for_trigger(self) -> bool:
        """Whether only a trigger begins an exposure."""
        return bool(self._values[TRIGGER_MODE] & bit(6))

    @property
    def trigger_source(self) -> int:
        """LINE_SOURCE or SOFTWARE_SOURCE, or what else was written."""
        return self._values[TRIGGER_MODE] >> 21 & 7

    @property
    def fixed(self) -> bool:
        """Whether a fixed format is set."""
        return self._values[_FORMAT] >> 29 != 7

    @property
    def raw_in_mono(self) -> bool:
        """Whether a fixed mono format carries raw Bayer."""
        return not self.point_grey or bool(self._values[BAYER_MONO_CTRL] & 1)

    @property
    def region(self) -> Region:
        """What is sent in the format that is set."""
        if self.fixed:
            return Region(0, 0, *FULL, self._values[_MODE] >> 29 == 6)
        return self._region7()

    @property
    def strobe_lines(self) -> dict[int, int]:
        """Returns the control word of each strobe line."""
        return {line: self._values[_STROBE + 0x200 + 4 * line] for line in (0, 1)}

    def read(self, address: int, busy: bool) -> int | None:
        """Returns a quadlet, or None where the map has a hole.

        Args:
            address: In the low 32 bits of the node's space.
            busy: Whether it takes no trigger now.
        """
        if ROM <= address < ROM + 4 * len(self._rom):
            return self._rom[(address - ROM) // 4]
        offset = address - COMMANDS
        if not 0 <= offset < _END or offset % 4:
            return None
        if offset in (BAYER_MONO_CTRL, BAYER_TILE_MAPPING) and not self.point_grey:
            return None
        if offset in self._values:
            return self._values[offset]
        if offset in self._inquiries:
            return self._inquiries[offset]
        if offset == SOFTWARE_TRIGGER:
            return bit(0) if busy else 0
        if offset == BAYER_TILE_MAPPING:
            return int.from_bytes(self._pattern.encode(), "big")
        if _FORMAT7 <= offset < _FORMAT7 + 0x80:
            return self._format7(offset - _FORMAT7)
        return self._feature_word(offset)

    def write(self, offset: int, value: int) -> None:
        """Keeps what is written, as far as it can be."""
        if offset == _INITIALIZE and value & bit(0):
            self.reset()
        elif 0x800 <= offset < 0x840 and offset != TRIGGER_MODE:
            feature = self.features.get((offset - 0x800) // 4)
            if feature is not None:
                feature.register = value
        elif offset >= _ABSOLUTE and offset % 0x20 == 8:
            self.features[(offset - _ABSOLUTE) // 0x20].set_absolute(value)
        elif offset in self._values and offset != _VALUE_SETTING:  # its handshake ends at once
            present = offset in (TRIGGER_MODE, BAYER_MONO_CTRL) or _STROBE <= offset < _FORMAT7
            self._values[offset] = value | (bit(0) if present else 0)

    def _feature_word(self, offset: int) -> int | None:
        if offset >= _ABSOLUTE:
            feature = self.features.get((offset - _ABSOLUTE) // 0x20)
            return None if feature is None else feature.absolute_word(offset % 0x20)
        if offset == 0x404:
            return sum(bit(n) for n in self.features) | bit(12)
        for base in (0x500, 0x700, 0x800):
            if base <= offset < base + 0x40:
                n = (offset - base) // 4
                feature = self.features.get(n)
                if feature is None:
                    return 0
                where = (_BASE + _ABSOLUTE + 0x20 * n) // 4
                return {0x500: feature.inquiry, 0x700: where, 0x800: feature.register}[base]
        return 0

    def _region7(self) -> Region:
        place, size = self._values[_FORMAT7 + 0x08], self._values[_FORMAT7 + 0x0C]
        deep = self._values[_FORMAT7 + 0x10] >> 24 in (5, 10)
        return Region(place >> 16, place & 0xFFFF, size >> 16, size & 0xFFFF, deep)

    def _format7(self, offset: int) -> int:
        region = self._region7()
        size = region.width * region.height * (2 if region.deep else 1)
        packet = max(1, self._values[_FORMAT7 + 0x44] >> 16)
        return {
            0x00: self._sensor[0] << 16 | self._sensor[1],
            0x04: 4 << 16 | 2,  # sizes are multiples of
            0x14: bit(0) | bit(5) | bit(9) | bit(10),  # mono 8 and 16, raw 8 and 16
            0x34: region.width * region.height,
            0x3C: size,
            0x40: 4 << 16 | 4096,  # packets are multiples of, at most
            0x48: -(-size // packet),
            0x4C: 2 << 16 | 2,  # positions are multiples of
            0x54: (16 if region.deep else 8) << 24,
            0x58: _PATTERNS.index(self._pattern) << 24,
        }.get(offset, 0)


def _inquiries(fixed: bool) -> Mapping[int, int]:
    """What never changes, by offset."""
    return {
        0x100: (bit(2) if fixed else 0) | bit(7),  # formats 2 and 7
        0x188: bit(2) | bit(6),  # of format 2: 1280 × 960 in 8 and in 16 bits
        0x19C: bit(0),  # of format 7: mode 0
        0x248: bit(2) | bit(3) | bit(4),  # 7.5, 15 and 30 Hz
        0x258: bit(2) | bit(3),
        0x2E0: (_BASE + _FORMAT7) // 4,
        0x400: bit(3) | bit(16) | bit(19),  # optional functions, power, one shot
        0x40C: bit(3),  # strobes
        0x48C: (_BASE + _STROBE) // 4,
        0x530: bit(0) | bit(4) | bit(5) | bit(6) | bit(8) | bit(15) | bit(16),  # line 0, software; mode 0
        _STROBE: bit(0) | bit(1),
        _STROBE + 0x100: bit(0) | bit(4) | bit(5) | bit(6) | 0xFFF,
        _STROBE + 0x104: bit(0) | bit(4) | bit(5) | bit(6) | 0xFFF,
    }


def _configuration_rom(vendor_id: int) -> list[int]:
    """IEEE 1212: bus information, root, unit and unit dependent directory, two texts."""

    def text(words: str) -> list[int]:
        padded = words.encode() + b"\0" * (4 - len(words) % 4)
        quadlets = [0, 0, *struct.unpack(f">{len(padded) // 4}I", padded)]
        return [len(quadlets) << 16, *quadlets]

    vendor, model = text("Point Grey Research"), text("Firefly MV FMVU-13S2C (emulated)")
    root = [3 << 16, 0x03 << 24 | vendor_id, 0x0C0083C0, 0xD1 << 24 | 1]
    unit = [3 << 16, 0x12 << 24 | 0x00A02D, 0x13 << 24 | 0x000102, 0xD4 << 24 | 1]
    dependent = [
        4 << 16,
        0x40 << 24 | _BASE // 4,
        0x81 << 24 | 3,
        0x82 << 24 | (2 + len(vendor)),
        0x38 << 24 | 0x10,  # the 1 of 1.31
    ]
    bus = [0x04040000, 0x31333934, 0x20008000, GUID >> 32, GUID & 0xFFFFFFFF]
    return [*bus, *root, *unit, *dependent, *vendor, *model]
