"""The Aravis driver on a GigE Vision camera on loopback: Aravis's own emulator, in a process to be killed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import gige_process
from bench import Backend, Bench, Trouble

from drivers import colour_aravis
from drivers.clock import SystemClock
from drivers.interfaces import ColourCamera

_OPTIONS = {"address": gige_process.ADDRESS, "exposure_us": 2000.0, "region": (0, 0, 32, 24)}
_MUTE = "lose 1"
_HALF = "lose 0.5"


@contextmanager
def on_loopback(_: Path, factory: Callable[..., ColourCamera], slack_s: float) -> Iterator[Bench]:
    process = gige_process.shared()
    process.as_new()
    clock = SystemClock()

    def fail(kind: str, trouble: Trouble) -> None:
        match trouble:
            case "mute":
                process.tell(_MUTE)
            case "half":
                process.tell(_HALF)
            case "faulty":
                process.tell("shrink")
            case "frozen":
                process.tell("freeze")
            case _:
                process.kill()

    def mend(kind: str) -> None:
        process.as_new()

    camera = factory(name="colour", clock=clock, options=_OPTIONS, shared={})
    try:
        yield Bench(clock, colour=camera, fail=fail, mend=mend, slack_s=slack_s)
    finally:
        camera.close()


_TROUBLES: dict[str, frozenset[Trouble]] = {
    "colour": frozenset({"missing", "unplugged", "mute", "faulty", "half", "frozen"})
}

BACKENDS = [
    Backend(
        "aravis (GigE Vision on loopback), in process",
        partial(on_loopback, factory=colour_aravis.in_process, slack_s=0.4),
        _TROUBLES,
        gige_process.missing(),
    ),
    Backend(
        "aravis (GigE Vision on loopback)",
        partial(on_loopback, factory=colour_aravis.colour, slack_s=1.0),
        _TROUBLES,
        gige_process.missing(),
        slow=True,
    ),
]
