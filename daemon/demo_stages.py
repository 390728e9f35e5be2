"""Where the demo's captures come from: simulated devices here, or emulators behind the real drivers."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from daemon import wiring
from daemon.config import load_config
from daemon.emulated_rig import DEVICES, SOCKET
from daemon.processes import last_words, process
from drivers.sensor_package import SensorPackage
from drivers.sim import truth
from drivers.sim.cell_server import CellClient
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld
from surfclass.errors import InputError

_START_S = 180.0
# Frames are rendered, not read out: they are few a second, late, and further apart than a camera's.
_PATIENCE = """\
[capture]
max_skew_s = 1.0

[limits]
device_s = 6.0
heartbeat_s = 60.0

"""


class Stage(Protocol):
    """What stands in front of which devices."""

    def rig(self) -> str:
        """Returns the text of the `rig.toml` that a perfect calibration of its devices would give."""

    def board(self, scene: str, seed: int) -> tuple[SensorPackage, SimWorld]:
        """Puts up a board; returns the devices that look at it, open and still the stage's, and its truth."""

    def cell(self) -> str:
        """Puts up the cell, lets go of the devices, and returns their tables of a configuration."""

    def captured(self, count: int) -> None:
        """Tells how many viewpoints of the cell have been captured so far."""


class SimulatedStage:
    """The simulated devices; each board is a world of its own, and the cell is the service's."""

    def __init__(self, seed: int, viewpoints: int) -> None:
        self._seed, self._viewpoints = seed, viewpoints
        self._opened = ExitStack()

    def rig(self) -> str:
        """As `Stage.rig`."""
        return truth.rig(SimWorld("cell", self._seed))

    def board(self, scene: str, seed: int) -> tuple[SensorPackage, SimWorld]:
        """As `Stage.board`."""
        self._opened.close()
        world = SimWorld(scene, seed)
        devices = SimColourCamera(world), SimDepthCamera(world), SimLight(world), SimArm(world)
        return self._opened.enter_context(SensorPackage(world.clock, *devices)), world

    def cell(self) -> str:
        """As `Stage.cell`."""
        self._opened.close()
        tables = [f'[{kind}]\nbackend = "sim"\n' for kind in ("colour", "depth", "light", "arm")]
        told = f'[sim]\nscene = "cell"\nseed = {self._seed}\nviewpoints = {self._viewpoints}\n'
        return "\n".join([*tables, told])

    def captured(self, count: int) -> None:
        """Changes nothing: this arm goes on when a lit exposure is over."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opened.close()


class EmulatedStage:
    """The real drivers on their real runtimes and wires; behind those, one process for each emulated device.

    Args:
        out: Where the logs go.
        seed: Of the cell.
        viewpoints: How many the arm visits.
    """

    def __init__(self, out: Path, seed: int, viewpoints: int) -> None:
        self._out, self._seed, self._viewpoints = out, seed, viewpoints
        self._running = ExitStack()
        self._package: SensorPackage | None = None

    def __enter__(self) -> Self:
        folder = Path(self._running.enter_context(tempfile.TemporaryDirectory(prefix="surfclass-")))
        log = self._out / "devices.log"
        arguments = ["sim", "cell", "--dir", str(folder), "--seed", str(self._seed)]
        arguments += ["--viewpoints", str(self._viewpoints), "--told"]
        try:
            running = self._running.enter_context(process(log, arguments))
            until = time.monotonic() + _START_S
            while not (folder / DEVICES).exists():
                if running.poll() is not None or time.monotonic() > until:
                    raise InputError(f"the emulated devices did not start: {last_words(log)}")
                time.sleep(0.1)
            self._cell = CellClient(folder / SOCKET)
            self._running.callback(self._cell.close)
        except BaseException:
            self._running.close()
            raise
        self._tables = _PATIENCE + (folder / DEVICES).read_text()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._let_go()
        self._running.close()

    def rig(self) -> str:
        """As `Stage.rig`: this camera's images are raw, so they are linear."""
        return truth.rig(SimWorld("cell", self._seed), raw=True)

    def board(self, scene: str, seed: int) -> tuple[SensorPackage, SimWorld]:
        """As `Stage.board`."""
        if self._package is not None:
            self._package.release("arm")  # whose reader does not believe that it can be elsewhere at once
        self._cell.show(scene, seed)
        if self._package is None:
            config = self._out / "boards.toml"
            config.write_text(f'schema = 1\nrig = "rig.toml"\nmodel = "model.npz"\n\n{self._tables}')
            self._package = wiring.build_sensors(load_config(config)).package
        self._package.open()
        return self._package, SimWorld(scene, seed)

    def cell(self) -> str:
        """As `Stage.cell`."""
        self._let_go()
        self._cell.show("cell", self._seed)
        return self._tables

    def captured(self, count: int) -> None:
        """As `Stage.captured`: the arm waits for that, so a capture that was rejected is taken again."""
        self._cell.go_on(count)

    def _let_go(self) -> None:
        if self._package is not None:
            self._package.close()
            self._package = None
