"""A V4L2 camera behind the seam of `VideoNode`: knows when its frames were exposed, and fails on demand."""

import errno
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.v4l2.node import Control, Facts, Filled, Format

MS = 1_000_000
AUTO_EXPOSURE, EXPOSURE, GAIN, AUTO_GAIN = 0x009A0901, 0x009A0902, 0x00980913, 0x00980912
POWER_LINE = 0x00980918


class FakeClock:
    """Stands still but for sleeping and waiting."""

    def __init__(self, now_ns=10_000 * MS):
        self.ns = now_ns

    def now_ns(self):
        return self.ns

    def sleep(self, seconds):
        self.ns += round(seconds * 1e9)


@dataclass
class FakeCamera:
    """The device that nodes are opened of.

    Attributes:
        fail: Errno by step ("open", "set_format", "take" …): the step fails with it.
        quirks: By frame number, what is wrong with it: "error", "short", "drop", "again" (the stamp of the
            frame before), "future", "realtime" (the stamp is of another clock).
        rounds: What becomes of a value that is written to a control.
        begins: By frame number, when its exposure really began.
    """

    clock: FakeClock
    width: int = 4
    height: int = 2
    pixel_format: str = "RGGB"
    row_bytes: int = 0
    period_ns: int = 30 * MS
    readout_ns: int = 8 * MS
    at_start: bool = False
    arrival: bool = False
    progressive: bool = True
    full_range: bool = True
    captures: bool = True
    rate_hz: float | None = 1e3 / 30
    rates: tuple = ()
    exposure_units: int = 100
    tells_exposure: bool = True
    mute: bool = False
    poll_lies: bool = False
    fail: dict = field(default_factory=dict)
    quirks: dict = field(default_factory=dict)
    rounds: object = None
    values: dict = field(default_factory=dict)
    controls: list = field(default_factory=list)
    begins: dict = field(default_factory=dict)
    first_number: int = 0
    opened: int = 0
    closed: int = 0

    def __post_init__(self):
        self.row_bytes = self.row_bytes or self.width
        if self.controls:
            return
        self.controls = [
            Control(AUTO_EXPOSURE, "auto_exposure", 0, 3, 1, True),
            Control(AUTO_GAIN, "gain_automatic", 0, 1, 1, True),
            Control(POWER_LINE, "power_line_frequency", 0, 2, 1, True),
            Control(GAIN, "gain", 0, 100, 2, True),
            Control(0x00980910, "gamma", 72, 500, 1, True),
        ]
        self.values = {AUTO_EXPOSURE: 3, AUTO_GAIN: 1, POWER_LINE: 1, GAIN: 10, 0x00980910: 100}
        if self.tells_exposure:
            self.controls.append(Control(EXPOSURE, "exposure_time_absolute", 1, 5000, 1, False))
            self.values[EXPOSURE] = self.exposure_units

    @property
    def exposure_ns(self):
        return self.values.get(EXPOSURE, self.exposure_units) * 100_000

    def open(self, path):
        self.step("open")
        self.opened += 1
        return FakeNode(self)

    def step(self, name):
        if name in self.fail:
            raise OSError(self.fail[name], "as the test wants it")


class FakeNode:
    """Frame n begins n periods after the start; one that finds no buffer is dropped, but counted."""

    def __init__(self, camera):
        self.camera = camera
        self.filled, self.free, self.taken = [], [], set()
        self.next = 0
        self.begun_ns = 0
        self.is_closed = False

    def facts(self):
        self.camera.step("facts")
        return Facts("fake", "Fake Camera", "usb-1", "6.1.0", "A1", self.camera.captures, self.camera.arrival)

    def formats(self):
        return {"RGGB": ["4 × 2"], "YUYV": ["640 × 480"]}

    def set_format(self, width, height, pixel_format):
        self.camera.step("set_format")
        camera = self.camera
        return Format(
            camera.width,
            camera.height,
            camera.pixel_format,
            camera.row_bytes,
            camera.progressive,
            camera.full_range,
        )

    def set_rate(self, rate_hz):
        self.camera.step("set_rate")
        if rate_hz in self.camera.rates:
            self.camera.rate_hz = rate_hz
            self.camera.period_ns = round(1e9 / rate_hz)

    def rate_hz(self):
        self.camera.step("rate_hz")
        return self.camera.rate_hz

    def controls(self):
        self.camera.step("controls")
        manual = self.camera.values.get(AUTO_EXPOSURE) == 1
        return {
            each.name: replace(each, writable=each.writable or (each.id == EXPOSURE and manual))
            for each in self.camera.controls
        }

    def read(self, control):
        self.camera.step("read")
        return self.camera.values[control.id]

    def write(self, control, value):
        self.camera.step("write")
        rounds = self.camera.rounds
        self.camera.values[control.id] = rounds(control, value) if rounds else value

    def start(self, buffers):
        self.camera.step("start")
        self.begun_ns = self.camera.clock.ns
        self.free = list(range(buffers))
        return buffers

    def stop(self):
        self.camera.step("stop")
        assert not self.taken, "a buffer is still with the caller"
        self.filled, self.free = [], []

    def resume(self):
        self.camera.step("resume")
        self.begun_ns, self.next = self.camera.clock.ns, 0
        self.free = list(range(4))

    def wait(self, timeout_s):
        self.camera.step("wait")
        clock = self.camera.clock
        if self.camera.poll_lies:
            return True
        self._pass_time()
        until_ns = clock.ns + round(timeout_s * 1e9)
        while not self.filled and not self.camera.mute:
            there_ns = self._there_ns(self.next)
            if there_ns > until_ns:
                break
            clock.ns = max(clock.ns, there_ns)
            self._pass_time()
        if not self.filled:
            clock.ns = until_ns
        return bool(self.filled)

    def take(self):
        self.camera.step("take")
        if self.camera.poll_lies:
            return None
        self._pass_time()
        if not self.filled:
            return None
        buffer = self.filled.pop(0)
        self.taken.add(buffer.index)
        return buffer

    def data(self, filled):
        self.camera.step("data")
        return picture(filled.sequence, self.camera.row_bytes, self.camera.height)[: filled.size]

    def give_back(self, filled):
        self.camera.step("give_back")
        self.taken.remove(filled.index)
        self.free.append(filled.index)

    def close(self):
        assert not self.is_closed, "closed twice"
        self.is_closed = True
        self.camera.closed += 1

    def _there_ns(self, number):
        camera = self.camera
        return self.begun_ns + number * camera.period_ns + camera.exposure_ns + camera.readout_ns

    def _pass_time(self):
        camera = self.camera
        while not camera.mute and self._there_ns(self.next) <= camera.clock.ns:
            number, self.next = self.next, self.next + 1
            quirk = camera.quirks.get(number)
            if quirk == "drop" or not self.free:
                continue
            begin_ns = self.begun_ns + number * camera.period_ns
            counted = (camera.first_number + number) & 0xFFFF_FFFF
            camera.begins[counted] = begin_ns
            self.filled.append(self._buffer(begin_ns, number, counted, quirk))

    def _buffer(self, begin_ns, number, counted, quirk):
        camera = self.camera
        there_ns = self._there_ns(number)
        stamp_ns = begin_ns if camera.at_start and not camera.arrival else there_ns
        stamp_ns -= {"again": camera.period_ns, "future": -100 * MS}.get(quirk, 0)
        size = camera.row_bytes * camera.height
        return Filled(
            self.free.pop(0),
            counted,
            stamp_ns // 1000 * 1000,
            quirk != "realtime",
            camera.at_start or camera.arrival,
            quirk == "error",
            size - 1 if quirk == "short" else size,
        )


def picture(number, row_bytes, height):
    """What frame `number` shows, as the bytes of a buffer."""
    return np.random.default_rng(number).integers(0, 256, row_bytes * height, np.uint8).tobytes()


GONE = (errno.ENODEV, errno.EIO, errno.EPROTO, errno.ENXIO, errno.ESHUTDOWN)
