"""The simulated cameras as an isolated process makes them; a file says what goes wrong with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers.sim.clock import SimClock
from drivers.sim.devices import SimColourCamera, SimDepthCamera
from drivers.sim.faults import Fault, Faults
from drivers.sim.world import SimWorld


class ToldWorld(SimWorld):
    """The simulated world, with the fault that a file names: one word, or nothing.

    Args:
        kind: Whose fault.
        path: The file; it may change at any time.
    """

    def __init__(self, kind: str, path: str) -> None:
        self._kind, self._path = kind, Path(path)
        super().__init__("grey_card", seed=1, clock=SimClock(of_host=True), scale=0.05, ambient=0.2)

    def fault(self, device: Any, kind: Any, t_ns: int | None = None) -> Fault | None:
        told = self._path.read_text()
        self.faults = Faults((Fault(self._kind, told),) if told else ())
        return super().fault(device, kind, t_ns)


def colour(*, name: str, options: dict[str, Any], **_: object) -> SimColourCamera:
    return SimColourCamera(ToldWorld(name, options["fault_path"]))


def depth(*, name: str, options: dict[str, Any], **_: object) -> SimDepthCamera:
    return SimDepthCamera(ToldWorld(name, options["fault_path"]))
