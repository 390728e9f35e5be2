"""A GigE Vision camera on loopback that sees the simulated cell: Aravis's own emulator with our pixels.

`python -m drivers.emulators.gige_camera` runs one as a process of its own, told by lines on its
standard input.
"""

from __future__ import annotations

import argparse
import logging
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from drivers.emulators.gige_image import FORMATS, Processing, encoded
from drivers.emulators.gige_library import FakeCamera
from surfclass.errors import InputError

FEATURES = Path(__file__).with_suffix(".xml")
LINES = ("Line0", "Line1", "Line2", "Line3")

_log = logging.getLogger("surfclass.sim.gige")

# Registers of GvFakeCamera (arvfakecamera.h), then those that only gige_camera.xml knows.
_WIDTH, _HEIGHT, _X, _Y, _FORMAT, _PERIOD_US = 0x100, 0x104, 0x130, 0x134, 0x128, 0x138
_SENSOR_HEIGHT, _SENSOR_WIDTH, _GAIN, _EXPOSURE, _ACQUISITION = 0x118, 0x11C, 0x110, 0x120, 0x124
_VENDOR, _MODEL, _SEND_MODE, _SEND_SOURCE, _SEND = 0x48, 0x68, 0x300, 0x304, 0x30C
_EXPOSURE_AUTO, _GAIN_AUTO, _WHITE_AUTO, _BALANCE_RED, _BALANCE_BLUE = 0x8000, 0x8004, 0x8008, 0x8010, 0x8014
_GAMMA_ENABLE, _GAMMA, _SHARPENING, _SATURATION = 0x8020, 0x8024, 0x8028, 0x802C
_REVERSE_X, _REVERSE_Y, _TRIGGER_SOURCE, _TRIGGER_MODE, _TRIGGER = 0x8034, 0x8038, 0x8040, 0x8048, 0x804C
_LINE_MODE, _LINE_SOURCE, _FIRMWARE = 0x8060, 0x8070, 0x80A0

_SOFTWARE, _OUTPUT, _EXPOSURE_ACTIVE, _CONTINUOUS = 1, 1, 1, 2
_BAYER_RG8 = 0x01080009
_ON_FOR_NS = 3_600_000_000_000  # at start: its clock can be set back
_POLL_S = 0.004  # how often a trigger is looked for
_END_S = 60.0  # an exposure of 30 s, and its rendering


class ColourCell(Protocol):
    """What the camera asks of `drivers.sim.cell.Cell`."""

    @property
    def colour_size(self) -> tuple[int, int]:
        """Width and height."""

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        """As `Cell.raw`."""

    def rgb(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint8]:
        """As `Cell.rgb`."""


class GigeCamera:
    """The emulated camera. Like a real one after power-on, it starts with every automatic function on.

    An exposure begins about 4 ms after its trigger, and lasts as long as the client has set; triggers
    during it are lost. Rendering takes the place of read-out. RGB8 comes through the cell's own response
    and no other processing.

    Args:
        cell: Whose light it sees.
        serial: Its serial number, at most 15 characters.
        address: Of a network interface of this host; one camera for each.
        strobed: Called as `strobed(begin_ns, end_ns)` at the start of each exposure for which the client
            has made a line an output and "ExposureActive" its source.
    """

    def __init__(
        self,
        cell: ColourCell,
        serial: str = "SIM01",
        address: str = "127.0.0.1",
        strobed: Callable[[int, int], None] | None = None,
    ) -> None:
        if not 0 < len(serial.encode()) < 16:
            raise InputError(f"serial number {serial!r}, allowed are 1 to 15 characters")
        self._cell, self._serial, self._address, self._strobed = cell, serial, address, strobed
        self._camera: FakeCamera | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._edge = threading.Event()  # on the line that triggers
        self._frame: tuple[int, NDArray[np.uint8]] | None = None  # device time and bytes, to be sent
        self._on_ns = 0
        self._frozen_at_ns: int | None = None
        self.frames = 0

    def start(self) -> None:
        """Makes the camera appear.

        Raises:
            DriverUnavailableError: If Aravis is not installed.
            InputError: If the address is not of this host, or another camera is there.
        """
        if self._camera is None:
            self._ending.clear()
            self._frozen_at_ns, self._on_ns = None, time.monotonic_ns() - _ON_FOR_NS
            self._camera = FakeCamera(self._address, self._serial, FEATURES, self._sent)
            self.power_cycle()
            self._thread = threading.Thread(target=self._run, args=(self._camera,), daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Makes it disappear, after the exposure under way; may be called twice."""
        camera, thread, self._camera, self._thread = self._camera, self._thread, None, None
        if camera is not None and thread is not None:
            self._ending.set()
            thread.join(_END_S)
            camera.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def strobe_lines(self) -> tuple[str, ...]:
        """The lines that the client has made give a pulse while a frame is exposed."""
        return _strobe_lines(self._running())

    def pulse(self, line: str = "Line0") -> None:
        """An edge on an input line: exposes a frame, if the client has made it the trigger."""
        if line not in LINES:
            raise InputError(f"line {line!r}, allowed: {', '.join(LINES)}")
        if self._running().read(_TRIGGER_SOURCE) == LINES.index(line):
            self._edge.set()

    def lose_packets(self, share: float) -> None:
        """From now on this share, 0…1, of all image packets is not sent; at 1 the camera is mute."""
        if not 0 <= share <= 1:
            raise InputError(f"share of lost packets {share}, allowed is 0 to 1")
        self._running().lose_packets(share)

    def freeze_clock(self) -> None:
        """Stops the device's clock."""
        self._frozen_at_ns = time.monotonic_ns()

    def set_clock(self, ahead_s: float) -> None:
        """Sets the device's clock forward, or back; it goes on from there."""
        self._frozen_at_ns = None
        self._on_ns -= round(ahead_s * 1e9)

    def shrink(self) -> None:
        """Halves the image height behind the client's back."""
        self._running().write(_HEIGHT, self._running().read(_HEIGHT) // 2)

    def power_cycle(self) -> None:
        """Ends the acquisition and sets everything to what it is after power-on."""
        width, height = (
            side // step * step for side, step in zip(self._cell.colour_size, (4, 2), strict=True)
        )
        values = {
            _ACQUISITION: 0,
            _SENSOR_WIDTH: width,
            _SENSOR_HEIGHT: height,
            _WIDTH: width,
            _HEIGHT: height,
            **dict.fromkeys((_X, _Y, _GAIN, _REVERSE_X, _REVERSE_Y), 0),
            **dict.fromkeys((_TRIGGER, _TRIGGER_MODE, _TRIGGER_SOURCE), 0),
            **{start + 4 * n: 0 for start in (_LINE_MODE, _LINE_SOURCE) for n in range(len(LINES))},
            **dict.fromkeys((_EXPOSURE_AUTO, _GAIN_AUTO, _WHITE_AUTO), _CONTINUOUS),
            **dict.fromkeys((_GAMMA_ENABLE, _SHARPENING, _SATURATION), 1),
            _GAMMA: 800,
            _BALANCE_RED: 1400,
            _BALANCE_BLUE: 1700,
            _EXPOSURE: 5000,
            _FORMAT: _BAYER_RG8,
            _PERIOD_US: 40_000,
            # Aravis's emulator sends a frame at each trigger of its own; the client's trigger is ours.
            _SEND_MODE: 1,
            _SEND_SOURCE: _SOFTWARE,
        }
        for register, value in values.items():
            self._running().write(register, value)
        for register, text in ((_VENDOR, "surfclass"), (_MODEL, "SimulatedCamera"), (_FIRMWARE, "1.0")):
            self._running().write_text(register, text)

    def _running(self) -> FakeCamera:
        if self._camera is None:
            raise InputError(f"camera {self._serial} is not started")
        return self._camera

    def _run(self, camera: FakeCamera) -> None:
        """Exposes when it is time to, so that Aravis's own thread goes on answering commands."""
        next_ns = 0
        while not self._ending.wait(_POLL_S):
            triggered = self._edge.is_set() or camera.read(_TRIGGER) == 1
            if triggered:  # and not otherwise: one may just be coming
                self._edge.clear()
                camera.write(_TRIGGER, 0)
            if not camera.read(_ACQUISITION):
                continue
            now_ns = time.monotonic_ns()
            if triggered if camera.read(_TRIGGER_MODE) else now_ns >= next_ns:
                next_ns = now_ns + 1000 * camera.read(_PERIOD_US)
                try:
                    self._expose(camera, now_ns)
                except Exception:  # noqa: BLE001 - whatever a cell may raise; this thread has no caller
                    _log.exception("an exposure failed: no more frames are sent")
                    return

    def _expose(self, camera: FakeCamera, begin_ns: int) -> None:
        ticks = (self._frozen_at_ns or begin_ns) - self._on_ns
        end_ns, gain_db = begin_ns + 1000 * camera.read(_EXPOSURE), camera.read(_GAIN) / 100
        if self._strobed is not None and _strobe_lines(camera):
            self._strobed(begin_ns, end_ns)
        self.frames += 1
        pixel_format, processing = FORMATS[camera.read(_FORMAT)], _processing(camera)
        if pixel_format.name == "RGB8":
            rgb = self._cell.rgb(begin_ns, end_ns, gain_db, self.frames)
            content = np.ascontiguousarray(processing.cropped(rgb), np.uint8).ravel()
        else:
            linear = self._cell.raw(begin_ns, end_ns, gain_db, self.frames)
            content = encoded(processing.processed(linear), pixel_format)
        if camera.read(_ACQUISITION):
            self._frame = ticks, content
            camera.write(_SEND, 1)

    def _sent(self) -> tuple[int, NDArray[np.uint8]] | None:
        return self._frame


def _strobe_lines(camera: FakeCamera) -> tuple[str, ...]:
    read = camera.read
    return tuple(
        line
        for n, line in enumerate(LINES)
        if read(_LINE_MODE + 4 * n) == _OUTPUT and read(_LINE_SOURCE + 4 * n) == _EXPOSURE_ACTIVE
    )


def _processing(camera: FakeCamera) -> Processing:
    read = camera.read
    return Processing(
        (read(_X), read(_Y), read(_WIDTH), read(_HEIGHT)),
        (bool(read(_REVERSE_X)), bool(read(_REVERSE_Y))),
        bool(read(_EXPOSURE_AUTO) or read(_GAIN_AUTO)),
        bool(read(_WHITE_AUTO)),
        (read(_BALANCE_RED) / 1000, read(_BALANCE_BLUE) / 1000),
        read(_GAMMA) / 1000 if read(_GAMMA_ENABLE) else 1.0,
        bool(read(_SHARPENING)),
    )


def obey(camera: GigeCamera, line: str) -> str:
    """Does what a line of text says, and returns the answer.

    The lines: "lose SHARE", "freeze", "clock SECONDS", "shrink", "pulse [LINE]", "power_cycle",
    "strobes", "frames".

    Raises:
        InputError: For any other.
    """
    match line.split():
        case ["lose", share]:
            camera.lose_packets(float(share))
        case ["freeze"]:
            camera.freeze_clock()
        case ["clock", ahead_s]:
            camera.set_clock(float(ahead_s))
        case ["shrink"]:
            camera.shrink()
        case ["pulse", *lines] if len(lines) < 2:
            camera.pulse(*lines)
        case ["power_cycle"]:
            camera.power_cycle()
        case ["strobes"]:
            return " ".join(camera.strobe_lines)
        case ["frames"]:
            return str(camera.frames)
        case _:
            raise InputError(f"{line.strip()!r} is no command of the emulated camera")
    return "done"


def main() -> None:
    """Runs a camera until its standard input ends."""
    from drivers.sim.cell import host_cell

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serial", default="SIM01")
    parser.add_argument("--address", default="127.0.0.1")
    parser.add_argument("--scene", default="grey_card")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--light", type=float, default=0.0, help="level of the LED, 0 to 1")
    given = parser.parse_args()
    logging.basicConfig(stream=sys.stderr)
    cell = host_cell(given.scene, given.seed, scale=given.scale)
    cell.set_light(given.light, time.monotonic_ns())
    cell.bake()
    with GigeCamera(cell, given.serial, given.address) as camera:
        print("ready", flush=True)
        for line in sys.stdin:
            try:
                answer = obey(camera, line)
            except ValueError as error:
                answer = f"error: {error}"
            print(answer, flush=True)


if __name__ == "__main__":
    main()
