"""A simulated Kinect for the real OpenNI2: renders the cell and serves it to the plug-in "virtual".

Applications open it by the URI `virtual://PATH` in a runtime that has that plug-in.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from drivers.openni2.virtual_file import NO_REGISTRATION_YET, VirtualFile
from surfclass.errors import InputError

_TRUTHS = 1000
_STOP_S = 10.0
_log = logging.getLogger("surfclass.sim.kinect")


class DepthCell(Protocol):
    """What is asked of the simulated world; times in host CLOCK_MONOTONIC, ns."""

    @property
    def depth_size(self) -> tuple[int, int]:
        """Width and height, px."""

    def depth(self, t_ns: int, key: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Returns depth (h, w) in mm and IR (h, w) 0…1023 of an exposure; `key` seeds its noise."""


@dataclass(frozen=True)
class Exposure:
    """The truth about one frame.

    Attributes:
        index: The device's frame counter.
        timestamp_us: By the device's clock, as told to the application.
        t_ns: When it was exposed, host CLOCK_MONOTONIC.
        published_ns: When it was handed over.
    """

    index: int
    timestamp_us: int
    t_ns: int
    published_ns: int


class VirtualKinect:
    """Publishes frames from start() to stop(), from a thread; faults on demand.

    An exposure is handed over `latency_s` after it, as a device with a constant delay does. Where
    rendering takes longer the frame comes late, and the next exposure is the next one of the raster
    after that: it shows as a lower frame rate, as of a bus that is busy.

    Args:
        cell: The world that it sees.
        path: The file; `/dev/shm` keeps it in memory.
        fps: Exposures a second at most.
        latency_s: From the exposure until the frame is handed over.
        fov_rad: Horizontal and vertical field of view that the device tells.
        serial: The device's number.
        drift_ppm: How much too fast the device's clock runs.
        offset_us: What that clock shows at the start.
        stubborn_mirroring: Whether mirroring stays on, whatever is asked for.
        stubborn_registration: Likewise registration to colour.

    Raises:
        InputError: If a number is out of its range.
    """

    def __init__(
        self,
        cell: DepthCell,
        path: Path,
        *,
        fps: float = 30.0,
        latency_s: float = 0.04,
        fov_rad: tuple[float, float] = (1.0144686, 0.7898090),
        serial: str = "VIRTUAL-1",
        drift_ppm: float = 0.0,
        offset_us: int = 1_000_000,
        stubborn_mirroring: bool = False,
        stubborn_registration: bool = False,
    ) -> None:
        if not (0 < fps <= 1000 and 0 <= latency_s < 10 and abs(drift_ppm) < 1e5 and offset_us >= 0):
            raise InputError(
                f"virtual Kinect: fps {fps}, latency_s {latency_s}, drift_ppm {drift_ppm}, offset_us "
                f"{offset_us}; allowed are 0 to 1000, 0 to 10, ±100000 and from 0"
            )
        self._cell, self._path, self._period_ns = cell, path, round(1e9 / fps)
        self._latency_ns, self._fov, self._serial = round(latency_s * 1e9), fov_rad, serial
        self._rate, self._offset_us = 1 + drift_ppm * 1e-6, offset_us
        self._stubborn = int(stubborn_mirroring) + 2 * int(stubborn_registration)
        self._lock = threading.Lock()  # of all that follows
        self._file: VirtualFile | None = None
        self._plugs, self._mute, self._late = 0, False, 0
        self._frozen_us: int | None = None
        self._jump_us, self._began_ns = 0, 0
        self._truths = deque[Exposure](maxlen=_TRUTHS)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def uri(self) -> str:
        """What applications open."""
        return f"virtual://{self._path}"

    def start(self) -> None:
        """Makes the file, plugs the camera in and begins to publish.

        Raises:
            OSError: If the file cannot be made.
        """
        if self._thread is not None:
            return
        size, fps = self._cell.depth_size, max(1, round(1e9 / self._period_ns))
        file = VirtualFile(self._path, size, fps, self._fov, self._serial)
        file.header.stubborn = self._stubborn
        with self._lock:
            self._file, self._began_ns = file, time.monotonic_ns()
            self._plugs += 1
            file.plug(True, self._plugs)
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, args=(file,), name="virtual Kinect", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends publishing and removes the file; may be called twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._ending.set()
        thread.join(_STOP_S)
        with self._lock:
            file, self._file = self._file, None
        if file is not None:
            file.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def registration(self) -> int | None:
        """The registration mode that an application last asked for: 0 off, 1 depth to colour."""
        with self._lock:
            asked = NO_REGISTRATION_YET if self._file is None else int(self._file.header.registration)
        return None if asked == NO_REGISTRATION_YET else asked

    def exposures(self) -> list[Exposure]:
        """Returns the truth about the last thousand frames."""
        with self._lock:
            return list(self._truths)

    @property
    def late(self) -> int:
        """How many frames were rendered more slowly than `latency_s` allows: their delay was no constant."""
        with self._lock:
            return self._late

    def unplug(self) -> None:
        """Pulls the cable out."""
        self._plug(False)

    def plug(self) -> None:
        """Plugs the cable in."""
        self._plug(True)

    def mute(self, silent: bool) -> None:
        """Stops publishing with the cable in, or goes on."""
        with self._lock:
            self._mute = silent

    def freeze_clock(self, frozen: bool) -> None:
        """Lets the device's clock stand still while frames go on, or run on from where it would be."""
        now_ns = time.monotonic_ns()
        with self._lock:
            self._frozen_us = self._ticks(now_ns) if frozen else None

    def jump_clock(self, by_us: int) -> None:
        """Moves the device's clock, as a restart of its firmware does."""
        with self._lock:
            self._jump_us += by_us

    def tear(self, hold_s: float, value: int = 0) -> None:
        """Holds a half-written frame for a time: the upper halves of both images are `value`."""
        with self._lock:
            if self._file is not None:
                self._file.begin()
                self._file.spoil(value)
                time.sleep(hold_s)  # publishing waits for the lock; the next frame overwrites this one

    def _plug(self, connected: bool) -> None:
        with self._lock:
            self._plugs += int(connected)
            if self._file is not None:
                self._file.plug(connected, self._plugs)

    def _ticks(self, t_ns: int) -> int:
        """The device's clock at a time, µs; under the lock."""
        if self._frozen_us is not None:
            return self._frozen_us
        running_us = (t_ns - self._began_ns) / 1000 * self._rate
        return max(0, self._offset_us + self._jump_us + round(running_us))

    def _run(self, file: VirtualFile) -> None:
        try:
            self._publish(file)
        finally:
            with self._lock:
                file.plug(False, 0)  # a defect in rendering is not to look like a camera that is mute

    def _publish(self, file: VirtualFile) -> None:
        index = 0
        exposed_ns = time.monotonic_ns()
        while not self._ending.is_set():
            index += 1
            depth, ir = self._cell.depth(exposed_ns, index)
            due_ns = exposed_ns + self._latency_ns
            late_ns = time.monotonic_ns() - due_ns
            if self._ending.wait(max(0, -late_ns) / 1e9):
                return
            with self._lock:
                if late_ns > 0 and not self._late:
                    _log.warning("virtual Kinect: a frame took %.0f ms more than latency_s", late_ns / 1e6)
                self._late += int(late_ns > 0)
                if not self._mute and file.header.plugged:
                    timestamp_us = self._ticks(exposed_ns)
                    file.publish(depth, ir, timestamp_us, index)
                    self._truths.append(Exposure(index, timestamp_us, exposed_ns, time.monotonic_ns()))
            behind = max(0, time.monotonic_ns() - due_ns) // self._period_ns
            exposed_ns += self._period_ns * (1 + behind)
