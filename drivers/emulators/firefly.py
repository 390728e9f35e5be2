"""An emulated Firefly MV behind its USB plug; a transport gives it a bus that the real libdc1394 reads.

In the tests that is a socket under libdc1394 (tests/firefly_socket.py), in the virtual machine Linux's own
USB (tests/vm/firefly_gadget.py).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.bayer import Pattern, mosaic
from drivers.emulators.firefly_registers import (
    COMMANDS,
    FRAME_RATE,
    FULL,
    GAIN,
    GAIN_STEP_DB,
    GAMMA,
    LINE_SOURCE,
    RATE_STEP_HZ,
    SHUTTER,
    SHUTTER_STEP_S,
    SOFTWARE_SOURCE,
    SOFTWARE_TRIGGER,
    WHITE_BALANCE,
    Registers,
    bit,
)

# What the automatic functions and what works on colours do, while they are on.
AUTOMATIC_S, AUTOMATIC_DB = 0.02, 6.0
RED_GAIN, BLUE_GAIN = 1.5, 0.5
GAMMA_EXPONENT = 0.45


class Source(Protocol):
    """What it asks of a simulated cell (`drivers.sim.cell.Cell`)."""

    @property
    def colour_size(self) -> tuple[int, int]:
        """Width and height, each even."""

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        """As `Cell.raw`."""


class Ramps:
    """A still scene, quick to render: a ramp for each colour, as bright as exposure and gain make them."""

    def __init__(self, size: tuple[int, int] = FULL) -> None:
        self.colour_size = size
        x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
        self._per_second = (np.dstack((x, y, (x + y) / 2)) * 3e6 + 2e5).astype(np.float32)
        self._last: tuple[float, NDArray[np.uint16]] | None = None

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        """As `Cell.raw`, but at once."""
        scale = round((end_ns - begin_ns) / 1e9 * 10 ** (gain_db / 20), 7)
        if self._last is None or self._last[0] != scale:
            image = np.minimum(self._per_second * np.float32(scale), 65535).astype(np.uint16)
            self._last = scale, image
        return self._last[1]


class Shot(NamedTuple):
    """An exposure that was made: its number, and when the sensor was exposed."""

    key: int
    begin_ns: int
    end_ns: int


@dataclass
class Faults:
    """What is wrong with the camera; may be set at any time.

    Attributes:
        mute: Exposures are made and not sent.
        short: As many of the next frames end in the middle.
        stuck: Command registers that keep what they have, whatever is written.
        extra: As many frames are sent that nobody triggered.
        delay_s: How long a frame is held back before it is sent.
        accesses_left: It is pulled out at the access of a register after so many; None: it stays.
    """

    mute: bool = False
    short: int = 0
    stuck: set[int] = field(default_factory=set)
    extra: int = 0
    delay_s: float = 0.0
    accesses_left: int | None = None


class Firefly:
    """The camera. Its thread exposes and sends; `read` and `write` come from the transport's.

    Args:
        send: Gives a frame to the bus: waits while the host has no buffer, raises OSError once the plug
            is out.
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
        self.registers = Registers(source.colour_size, pattern, absolute, point_grey)
        self.faults = Faults()
        self.shots: deque[Shot] = deque(maxlen=64)
        self.accesses = 0
        self.unplug: Callable[[], None] = lambda: None  # the transport's
        self._key = 0
        self._triggered = self._busy = self._stop = False
        self._due_ns = 0
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="firefly", daemon=True)
        self._thread.start()

    def reset(self) -> None:
        """As after power-on."""
        with self._changed:
            self.registers.reset()
            self._triggered = self._busy = False
            self._changed.notify_all()

    def stop(self) -> None:
        """Ends its thread, once the plug is out."""
        with self._changed:
            self._stop = True
            self._changed.notify_all()
        self._thread.join(2.0)

    @property
    def exposure_s(self) -> float:
        """What the shutter is at now."""
        shutter = self.registers.features[SHUTTER]
        return AUTOMATIC_S if shutter.auto else shutter.raw * SHUTTER_STEP_S

    @property
    def gain_db(self) -> float:
        """What the gain is now."""
        gain = self.registers.features[GAIN]
        return AUTOMATIC_DB if gain.auto else gain.raw * GAIN_STEP_DB

    def image(self, shot: Shot) -> bytes:
        """Returns what it sends for an exposure.

        The low bytes of the pixels (0, 0), (0, 1), (1, 0) and (1, 1) are those of its number, the high
        one first: a demosaiced image keeps them in the channels of `pattern`.
        """
        registers, region = self.registers, self.registers.region
        scene = self._source.raw(shot.begin_ns, shot.end_ns, self.gain_db, shot.key)
        rows, columns = slice(region.top, region.top + region.height), slice(region.left, None)
        scene = scene[rows, columns][:, : region.width]
        if registers.features[WHITE_BALANCE].on:
            scene = np.minimum(scene * np.array([RED_GAIN, 1, BLUE_GAIN]), 65535).astype(np.uint16)
        if registers.features[GAMMA].on:
            scene = (65535 * (scene / 65535) ** GAMMA_EXPONENT).astype(np.uint16)
        luminance = registers.fixed and not registers.raw_in_mono
        raw = scene.mean(axis=2).astype(np.uint16) if luminance else mosaic(scene, self.pattern)
        pixels = raw.astype(">u2") if region.deep else (raw >> 8).astype(np.uint8)
        pixels[:2, :2] = np.frombuffer(shot.key.to_bytes(4, "big"), np.uint8).reshape(2, 2)
        return pixels.tobytes()

    def read(self, address: int) -> int | None:
        """Returns a quadlet, or None where there is none.

        Raises:
            ConnectionResetError: If the plug comes out by it.
        """
        self._accessed()
        return self.registers.read(address, self._busy)

    def write(self, address: int, value: int) -> bool:
        """Returns whether there is such a register.

        Raises:
            ConnectionResetError: If the plug comes out by it.
        """
        self._accessed()
        if self.registers.read(address, self._busy) is None:
            return False
        offset = address - COMMANDS
        if offset in self.faults.stuck:
            return True
        if offset == SOFTWARE_TRIGGER:
            self._trigger(SOFTWARE_SOURCE if value & bit(0) else None)
            return True
        with self._changed:
            self.registers.write(offset, value)
            self._changed.notify_all()
        return True

    def edge(self) -> None:
        """An edge comes on its trigger line."""
        self._trigger(LINE_SOURCE)

    def _trigger(self, source: int | None) -> None:
        """Begins an exposure, if it listens to that source and has time."""
        registers = self.registers
        with self._changed:
            if registers.waits_for_trigger and registers.trigger_source == source and not self._busy:
                self._triggered = self._busy = True
                self._changed.notify_all()

    def _accessed(self) -> None:
        self.accesses += 1
        left = self.faults.accesses_left
        if left is None:
            return
        self.faults.accesses_left = left - 1 if left > 0 else None
        if left == 0:
            self.unplug()
            raise ConnectionResetError("pulled out")

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._stop and not self._may_begin():
                    self._changed.wait(0.02 if self.registers.streams else None)
                if self._stop:
                    return
                triggered = self._triggered
                if not triggered and self.faults.extra:
                    self.faults.extra -= 1
            self._expose()

    def _may_begin(self) -> bool:
        """Whether an exposure begins now; a camera without a trigger keeps its own pace."""
        if not self.registers.streams:
            return False
        if self._triggered or self.faults.extra:
            return True
        now_ns = time.monotonic_ns()
        if self.registers.waits_for_trigger or now_ns < self._due_ns:
            return False
        rate_hz = self.registers.features[FRAME_RATE].raw * RATE_STEP_HZ
        self._due_ns = max(self._due_ns + round(1e9 / rate_hz), now_ns)
        return True

    def _expose(self) -> None:
        self._key += 1
        exposure_s, begin_ns = self.exposure_s, time.monotonic_ns()
        time.sleep(exposure_s)
        shot = Shot(self._key, begin_ns, begin_ns + round(exposure_s * 1e9))
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
            time.sleep(0.02)  # the plug is out; the transport sees to the rest
