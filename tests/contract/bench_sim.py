"""The simulated devices, on a clock that jumps and on one that runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import cast

from bench import Backend, Bench, Trouble

from drivers.sim.clock import SimClock
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.faults import DeviceName, Fault, FaultKind, Faults
from drivers.sim.world import SimWorld

_FAULTS: dict[Trouble, FaultKind] = {
    "missing": "absent",
    "unplugged": "absent",
    "mute": "silent",
    "faulty": "broken",
}


@contextmanager
def simulated(_: Path, realtime: bool) -> Iterator[Bench]:
    world = SimWorld("grey_card", seed=1, clock=SimClock(realtime), scale=0.05)
    colour = SimColourCamera(world)

    def fail(kind: str, trouble: Trouble) -> None:
        now_s = world.seconds(world.clock.now_ns())
        fault = Fault(cast(DeviceName, kind), _FAULTS[trouble], now_s)
        world.faults = Faults((*world.faults.faults, fault))

    def mend(kind: str) -> None:
        world.faults = Faults(tuple(fault for fault in world.faults.faults if fault.device != kind))

    def brightness(not_before_ns: int) -> float:
        with SimColourCamera(world) as camera:
            return float(camera.grab(not_before_ns, 1.0).rgb.mean())

    yield Bench(
        world.clock,
        colour,
        SimDepthCamera(world),
        SimLight(world),
        SimArm(world),
        fail,
        mend,
        brightness,
    )


_TROUBLES = {kind: frozenset(_FAULTS) for kind in ("colour", "depth", "light", "arm")}

BACKENDS = [
    Backend("sim", partial(simulated, realtime=False), _TROUBLES),
    Backend("sim, real time", partial(simulated, realtime=True), _TROUBLES),
]
