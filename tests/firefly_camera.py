"""A Firefly MV down to its registers (IIDC 1.31 and Point Grey's few): what any transport to libdc1394 serves."""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.bayer import Pattern, mosaic

GUID = 0x00B09D0100ABCDEF
SENSOR = (1280, 960)
ROM, COMMANDS = 0xF0000400, 0xF0F00000
FORMAT7, ABSOLUTE, STROBE = 0x2000, 0x3000, 0x1300  # from the command base
WHITE_BALANCE, GAMMA, SHUTTER, GAIN, FRAME_RATE = 3, 6, 7, 8, 15
AUTOMATIC_S = 0.02  # what the automatic shutter settles at
GAMMA_EXPONENT = 0.45
RED_GAIN, BLUE_GAIN = 1.5, 0.5  # of the white balance, while it is on


def bit(n: int) -> int:
    """The bit that IIDC calls n: it counts from the most significant."""
    return 1 << (31 - n)


class Source(Protocol):
    """What the camera looks at, of a simulated cell."""

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]: ...


class Ramp:
    """A still scene: three ramps, as bright as exposure and gain make them."""

    def __init__(self, size: tuple[int, int] = SENSOR) -> None:
        width, height = size
        x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
        self._per_second = (np.dstack((x, y, (x + y) / 2)) * 3e6 + 2e5).astype(np.float32)
        self._last: tuple[float, NDArray[np.uint16]] | None = None

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        scale = round((end_ns - begin_ns) / 1e9 * 10 ** (gain_db / 20), 7)
        if self._last is None or self._last[0] != scale:
            self._last = scale, np.minimum(self._per_second * np.float32(scale), 65535).astype(np.uint16)
        return self._last[1]


@dataclass
class FeatureState:
    """One feature's registers: 0x500, 0x700 and 0x800 and what follows them."""

    least: int
    most: int
    raw: int
    step: float = 0.0  # its own unit for each raw one; 0: no absolute value
    switchable: bool = True
    has_auto: bool = True
    on: bool = True
    auto: bool = True
    absolute: bool = False

    @property
    def inquiry(self) -> int:
        flags = bit(0) | bit(4) | bit(7)
        flags |= bit(1) if self.step else 0
        flags |= bit(5) if self.switchable else 0
        flags |= bit(6) if self.has_auto else 0
        return flags | self.least << 12 | self.most

    @property
    def register(self) -> int:
        flags = bit(0) | (bit(1) if self.absolute else 0)
        flags |= bit(6) if self.on else 0
        flags |= bit(7) if self.auto else 0
        return flags | self.raw

    @register.setter
    def register(self, value: int) -> None:
        self.absolute = bool(self.step and value & bit(1))
        self.on = bool(value & bit(6)) or not self.switchable
        self.auto = bool(self.has_auto and value & bit(7))
        if not self.auto and not self.absolute:
            self.raw = min(max(value & 0xFFF, self.least), self.most)

    @property
    def value(self) -> float:
        return self.raw * self.step

    @value.setter
    def value(self, value: float) -> None:
        if self.absolute and not self.auto:
            self.raw = min(max(round(value / self.step), self.least), self.most)


def features() -> dict[int, FeatureState]:
    """As the camera wakes up: all that can be automatic is."""
    return {
        0: FeatureState(0, 255, 16, switchable=False, has_auto=False, auto=False),
        1: FeatureState(1, 1023, 200),
        2: FeatureState(0, 4095, 1000),
        WHITE_BALANCE: FeatureState(0, 1023, 600),
        GAMMA: FeatureState(512, 4095, 1024, has_auto=False, auto=False),
        SHUTTER: FeatureState(1, 2000, 500, step=50e-6, switchable=False),
        GAIN: FeatureState(0, 480, 16, step=0.05, switchable=False),
        FRAME_RATE: FeatureState(8, 480, 120, step=0.125),
    }


class Shot(NamedTuple):
    """An exposure that was made."""

    key: int
    begin_ns: int
    end_ns: int


@dataclass
class Faults:
    """What is wrong with the camera; a test sets these while it runs.

    Attributes:
        mute: Frames are exposed and not sent.
        short: As many of the next frames come short of their last bytes.
        stuck: Command registers that keep what they have, whatever is written.
        extra: As many frames are sent that nobody triggered.
        delay_s: How long a frame is held back before it is sent.
        accesses_left: After so many reads and writes the camera is pulled out; None: it stays.
    """

    mute: bool = False
    short: int = 0
    stuck: set[int] = field(default_factory=set)
    extra: int = 0
    delay_s: float = 0.0
    accesses_left: int | None = None


class Firefly:
    """The camera behind its USB plug.

    Args:
        send: Gives a frame to the bus; waits while the host has no buffer, and raises OSError once
            the plug is out.
        source: What it looks at.
        pattern: Of its sensor.
        absolute: Whether it has absolute registers.
        point_grey: Whether it has Point Grey's registers.
    """

    def __init__(
        self,
        send: Callable[[bytes], None],
        source: Source,
        pattern: Pattern = "GRBG",
        absolute: bool = True,
        point_grey: bool = True,
    ) -> None:
        self._send, self._source, self.pattern = send, source, pattern
        self.absolute, self.point_grey = absolute, point_grey
        self.faults = Faults()
        self.shots: deque[Shot] = deque(maxlen=64)
        self.accesses = 0
        self.unplug: Callable[[], None] = lambda: None  # the transport's
        self._key = 0
        self._changed = threading.Condition()
        self._stop = False
        self.reset()
        self._rom = _config_rom(GUID, 0x00B09D if point_grey else 0x00A0B8)
        self._thread = threading.Thread(target=self._run, name="firefly", daemon=True)
        self._thread.start()

    def reset(self) -> None:
        """As after power-on."""
        with self._changed:
            self.features = features()
            if not self.absolute:
                for feature in self.features.values():
                    feature.step = 0.0
            self._values = {
                0x600: 3 << 29, 0x604: 2 << 29, 0x608: 2 << 29, 0x60C: 2 << 24, 0x610: bit(0),
                0x614: 0, 0x61C: 0, 0x830: bit(0), BAYER_MONO_CTRL: bit(0),
                STROBE + 0x200: bit(0), STROBE + 0x204: bit(0),
                FORMAT7 + 0x08: 0, FORMAT7 + 0x0C: SENSOR[0] << 16 | SENSOR[1], FORMAT7 + 0x10: 0,
                FORMAT7 + 0x44: 4096 << 16, FORMAT7 + 0x7C: bit(0),
            }  # fmt: skip
            self._triggered = self._busy = False
            self._changed.notify_all()

    def stop(self) -> None:
        """Ends its thread."""
        with self._changed:
            self._stop = True
            self._changed.notify_all()

    @property
    def exposure_s(self) -> float:
        shutter = self.features[SHUTTER]
        return AUTOMATIC_S if shutter.auto else shutter.raw * 50e-6

    @property
    def gain_db(self) -> float:
        return self.features[GAIN].raw * 0.05

    def image(self, shot: Shot) -> bytes:
        """What it sends for an exposure; the pixels (0, 0) … (1, 1) hold the key, high byte first."""
        left, top, width, height, deep = self._region()
        scene = self._source.raw(shot.begin_ns, shot.end_ns, self.gain_db, shot.key)
        scene = scene[top : top + height, left : left + width]
        if self.features[WHITE_BALANCE].on:
            scene = np.minimum(scene * np.array([RED_GAIN, 1, BLUE_GAIN]), 65535).astype(np.uint16)
        if self.features[GAMMA].on:
            scene = (65535 * (scene / 65535) ** GAMMA_EXPONENT).astype(np.uint16)
        luminance = self._fixed() and not self._values[BAYER_MONO_CTRL] & 1 and self.point_grey
        raw = scene.mean(axis=2).astype(np.uint16) if luminance else mosaic(scene, self.pattern)
        pixels = raw.astype(">u2") if deep else (raw >> 8).astype(np.uint8)
        pixels[:2, :2] = np.frombuffer(shot.key.to_bytes(4, "big"), np.uint8).reshape(2, 2)
        return pixels.tobytes()

    def read(self, address: int) -> int | None:
        """A quadlet, or None where there is none."""
        self._accessed()
        if ROM <= address < ROM + 4 * len(self._rom):
            return self._rom[(address - ROM) // 4]
        offset = address - COMMANDS
        return self._register(offset) if 0 <= offset < 0x4000 and offset % 4 == 0 else None

    def write(self, address: int, value: int) -> bool:
        """Returns whether there is such a register."""
        self._accessed()
        offset = address - COMMANDS
        if self._register(offset) is None:
            return False
        if offset in self.faults.stuck:
            return True
        with self._changed:
            self._write(offset, value)
            self._changed.notify_all()
        return True

    def _accessed(self) -> None:
        self.accesses += 1
        left = self.faults.accesses_left
        if left is not None:
            self.faults.accesses_left = left - 1
            if left <= 0:
                self.faults.accesses_left = None
                self.unplug()
                raise ConnectionResetError

    def _write(self, offset: int, value: int) -> None:
        if offset == 0x000 and value & bit(0):
            self.reset()
        elif 0x800 <= offset < 0x840 and offset != 0x830:
            self.features[(offset - 0x800) // 4].register = value
        elif ABSOLUTE <= offset and offset % 0x20 == 8:
            self.features[(offset - ABSOLUTE) // 0x20].value = struct.unpack("<f", struct.pack("<I", value))[0]
        elif offset == 0x62C:
            if value & bit(0) and self._values[0x830] & bit(6) and not self._busy:
                self._triggered = self._busy = True
        elif offset == FORMAT7 + 0x7C:
            pass  # the handshake of IIDC 1.30: all values are in force at once
        elif offset in self._values:
            keep = bit(0) if offset in (0x830, BAYER_MONO_CTRL) or STROBE <= offset < FORMAT7 else 0
            self._values[offset] = value | keep

    def _register(self, offset: int) -> int | None:
        """What is read there; None where the map has a hole."""
        if offset == 0x62C:
            return bit(0) if self._busy else 0
        if offset in (BAYER_MONO_CTRL, 0x1040) and not self.point_grey:
            return None
        if offset in self._values:
            return self._values[offset]
        if offset in _INQUIRIES:
            return _INQUIRIES[offset]
        if offset == 0x1040:
            return int.from_bytes(self.pattern.encode(), "big")
        if FORMAT7 <= offset < FORMAT7 + 0x80:
            return self._format7(offset - FORMAT7)
        if offset == 0x404:
            return sum(bit(n) for n in self.features) | bit(12)
        for base in (0x500, 0x700, 0x800):
            n = (offset - base) // 4
            if base <= offset < base + 0x40:
                feature = self.features.get(n)
                if feature is None:
                    return 0
                where = (COMMANDS - 0xF0000000 + ABSOLUTE + 0x20 * n) // 4
                return {0x500: feature.inquiry, 0x700: where, 0x800: feature.register}[base]
        if ABSOLUTE <= offset:
            feature = self.features.get((offset - ABSOLUTE) // 0x20)
            if feature is None or not feature.step:
                return None
            value = {0: feature.least * feature.step, 4: feature.most * feature.step, 8: feature.value}
            return struct.unpack("<I", struct.pack("<f", value.get(offset % 0x20, 0.0)))[0]
        return 0

    def _format7(self, offset: int) -> int:
        _, _, width, height, deep = self._region(format7=True)
        packet = max(1, self._values[FORMAT7 + 0x44] >> 16)
        size = width * height * (2 if deep else 1)
        return {
            0x00: SENSOR[0] << 16 | SENSOR[1],
            0x04: 4 << 16 | 2,
            0x14: bit(0) | bit(5) | bit(9) | bit(10),
            0x34: width * height,
            0x3C: size,
            0x40: 4 << 16 | 4096,
            0x48: -(-size // packet),
            0x4C: 2 << 16 | 2,
            0x54: (16 if deep else 8) << 24,
            0x58: ["RGGB", "GBRG", "GRBG", "BGGR"].index(self.pattern) << 24,
        }.get(offset, 0)

    def _fixed(self) -> bool:
        return self._values[0x608] >> 29 != 7

    def _region(self, format7: bool = False) -> tuple[int, int, int, int, bool]:
        """Left, top, width, height, and whether pixels have 16 bits."""
        if self._fixed() and not format7:
            return 0, 0, *SENSOR, self._values[0x604] >> 29 == 6
        place, size = self._values[FORMAT7 + 0x08], self._values[FORMAT7 + 0x0C]
        deep = self._values[FORMAT7 + 0x10] >> 24 in (5, 10)
        return place >> 16, place & 0xFFFF, size >> 16, size & 0xFFFF, deep

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop:
            with self._changed:
                begun = self._changed.wait_for(self._may_begin, 0.1)
                software = self._triggered
            if not begun or self._stop:
                continue
            if not software and not self.faults.extra:  # its own pace
                rest = due - time.monotonic()
                if rest > 0:
                    time.sleep(min(rest, 0.1))
                    continue
                due = time.monotonic() + 1 / (self.features[FRAME_RATE].raw * 0.125)
            self.faults.extra = max(0, self.faults.extra - 1) if not software else self.faults.extra
            self._expose()

    def _may_begin(self) -> bool:
        streams = bool(self._values[0x614] & bit(0))
        waits = bool(self._values[0x830] & bit(6))
        return self._stop or (streams and (self._triggered or not waits or self.faults.extra > 0))

    def _expose(self) -> None:
        self._key += 1
        begin_ns = time.monotonic_ns()
        time.sleep(self.exposure_s)
        # Light is counted for the time that was asked: the sensor is exacter than this computer's timer.
        shot = Shot(self._key, begin_ns, begin_ns + round(self.exposure_s * 1e9))
        image = self.image(shot)
        time.sleep(self.faults.delay_s)
        self.shots.append(shot)
        with self._changed:
            self._triggered = self._busy = False
        if self.faults.mute:
            return
        if self.faults.short > 0:
            self.faults.short -= 1
            image = image[: len(image) // 2 + 100]
        try:
            self._send(image)
        except OSError:
            time.sleep(0.02)  # the plug is out; the transport says so


BAYER_MONO_CTRL = 0x1050
_INQUIRIES = {
    0x100: bit(2) | bit(7),  # formats 2 and 7
    0x188: bit(2) | bit(6),  # of format 2: 1280 × 960 in 8 and 16 bits
    0x19C: bit(0),  # of format 7: mode 0
    0x248: bit(2) | bit(3) | bit(4),  # 7.5, 15 and 30 Hz
    0x258: bit(2) | bit(3),
    0x2E0: (COMMANDS - 0xF0000000 + FORMAT7) // 4,
    0x400: bit(3) | bit(16) | bit(19),
    0x40C: bit(3),
    0x48C: (COMMANDS - 0xF0000000 + STROBE) // 4,
    0x530: bit(0) | bit(4) | bit(5) | bit(6) | bit(8) | bit(15) | bit(16),  # line 0, software; mode 0
    STROBE: bit(0) | bit(1),
    STROBE + 0x100: bit(0) | bit(4) | bit(5) | bit(6) | 0xFFF,
    STROBE + 0x104: bit(0) | bit(4) | bit(5) | bit(6) | 0xFFF,
}


def _config_rom(guid: int, vendor_id: int) -> list[int]:
    """IEEE 1212: bus information, root, unit and unit dependent directory, two texts."""

    def text(words: str) -> list[int]:
        padded = words.encode() + b"\0" * (4 - len(words) % 4)
        quadlets = [0, 0, *struct.unpack(f">{len(padded) // 4}I", padded)]
        return [len(quadlets) << 16, *quadlets]

    vendor, model = text("Point Grey Research"), text("Firefly MV FMVU-13S2C")
    root = [3 << 16, 0x03 << 24 | vendor_id, 0x0C0083C0, 0xD1 << 24 | 1]
    unit = [3 << 16, 0x12 << 24 | 0x00A02D, 0x13 << 24 | 0x000102, 0xD4 << 24 | 1]
    base = (COMMANDS - 0xF0000000) // 4
    dependent = [
        4 << 16,
        0x40 << 24 | base,
        0x81 << 24 | 3,
        0x82 << 24 | (2 + len(vendor)),
        0x38 << 24 | 0x10,  # IIDC 1.31
    ]
    bus = [0x04040000, 0x31333934, 0x20008000, guid >> 32, guid & 0xFFFFFFFF]
    return [*bus, *root, *unit, *dependent, *vendor, *model]
