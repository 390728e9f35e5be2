"""The simulated cameras, each in a process of its own; unplugging one kills that, too."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench import Backend, Bench, Trouble

from drivers.clock import SystemClock
from drivers.isolation.camera import IsolatedCamera
from drivers.isolation.colour import IsolatedColourCamera
from surfclass.frames import DepthFrame

HERE = Path(__file__).parent
FAULTS: dict[Trouble, str] = {
    "missing": "absent",
    "unplugged": "absent",
    "mute": "silent",
    "faulty": "broken",
}


@contextmanager
def isolated(folder: Path) -> Iterator[Bench]:
    paths = {kind: folder / f"{kind}_fault" for kind in ("colour", "depth")}
    for path in paths.values():
        path.write_text("")

    def options(kind: str) -> dict[str, str]:
        return {"fault_path": str(paths[kind])}

    there = {"PYTHONPATH": str(HERE)}
    colour = IsolatedColourCamera(
        "isolated_sim:colour", name="colour", options=options("colour"), environment=there
    )
    depth: IsolatedCamera[DepthFrame] = IsolatedCamera(
        "isolated_sim:depth", name="depth", options=options("depth"), environment=there
    )

    def fail(kind: str, trouble: Trouble) -> None:
        told = folder / "told"
        told.write_text(FAULTS[trouble])
        told.replace(paths[kind])
        pid = (colour if kind == "colour" else depth).pid
        if trouble == "unplugged" and pid is not None:  # a library that dies of it
            os.kill(pid, signal.SIGKILL)

    def mend(kind: str) -> None:
        paths[kind].write_text("")

    try:
        yield Bench(SystemClock(), colour, depth, None, None, fail, mend, slack_s=0.5)
    finally:
        colour.close()
        depth.close()


_TROUBLES = {kind: frozenset(FAULTS) for kind in ("colour", "depth")}

# Slow: it loads the renderer for each opening.
BACKENDS = [Backend("sim, isolated", isolated, _TROUBLES, slow=True)]
