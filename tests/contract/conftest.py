"""The backends that the contract is tested on; another one is one more entry of BACKENDS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast

import pytest

from drivers.interfaces import Arm, Clock, ColourCamera, DepthCamera, Device, Light
from drivers.sim.clock import SimClock
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.faults import DeviceName, Fault, FaultKind, Faults
from drivers.sim.world import SimWorld

Trouble = Literal["missing", "unplugged", "mute", "faulty"]


@dataclass
class Bench:
    """One set of devices, closed, and what a test may do to the world behind them.

    Attributes:
        clock: The one they stamp with.
        colour: May be None where a backend has no such device; likewise the others.
        trouble: Makes a device fail from now on, or None where nobody can (real hardware).
    """

    clock: Clock
    colour: ColourCamera | None
    depth: DepthCamera | None
    light: Light | None
    arm: Arm | None
    trouble: Callable[[str, Trouble], None] | None

    def device(self, kind: str) -> Device:
        device: Device | None = getattr(self, kind)
        if device is None:
            pytest.skip(f"this backend has no {kind} device")
        return device

    def fail(self, kind: str, trouble: Trouble) -> None:
        if self.trouble is None:
            pytest.skip("nothing here can make the device fail")
        self.trouble(kind, trouble)


def _simulated(realtime: bool) -> Bench:
    world = SimWorld("grey_card", seed=1, clock=SimClock(realtime), scale=0.05)
    kinds = {"missing": "absent", "unplugged": "absent", "mute": "silent", "faulty": "broken"}

    def trouble(kind: str, what: Trouble) -> None:
        # The tests' parameters are among the names that a fault knows.
        fault = Fault(
            cast(DeviceName, kind), cast(FaultKind, kinds[what]), world.seconds(world.clock.now_ns())
        )
        world.faults = Faults((*world.faults.faults, fault))

    return Bench(
        world.clock, SimColourCamera(world), SimDepthCamera(world), SimLight(world), SimArm(world), trouble
    )


BACKENDS: dict[str, Callable[[], Bench]] = {
    "sim": lambda: _simulated(realtime=False),
    "sim, real time": lambda: _simulated(realtime=True),
}


@pytest.fixture(params=BACKENDS)
def bench(request: pytest.FixtureRequest) -> Bench:
    return BACKENDS[request.param]()
