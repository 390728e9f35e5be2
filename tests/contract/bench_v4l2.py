"""A V4L2 camera on the kernel's vivid, which shows the simulated cell; in the virtual machine only."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from bench import Backend, Bench, Trouble
from vivid import Vivid, missing

from drivers.backends import create
from drivers.clock import SystemClock
from drivers.sim.cell import host_cell

_SIZE = (640, 480)


@cache
def cell_image() -> bytes:
    """A grey card in the simulated cell; RGB, for demosaicing takes a second on an emulated processor."""
    cell = host_cell("grey_card", seed=1, scale=0.05)
    now_ns = time.monotonic_ns()
    cell.set_light(1.0, now_ns)
    rgb = cell.raw(now_ns, now_ns + 5_000_000, gain_db=0.0, key=1)
    return cv2.resize((rgb >> 8).astype(np.uint8), _SIZE, interpolation=cv2.INTER_NEAREST).tobytes()


@contextmanager
def on_vivid(_: Path) -> Iterator[Bench]:
    with Vivid(*_SIZE, fps=40) as vivid:
        vivid.show(cell_image(), "RGB3")
        options = {"device_path": "/dev/video0", "width": 640, "height": 480, "pixel_format": "RGB3"}
        clock = SystemClock()
        colour = create("colour", "v4l2", clock=clock, options={**options, "gain": 40})

        def fail(_: str, trouble: Trouble) -> None:
            match trouble:
                case "missing" | "unplugged":
                    vivid.unplug()
                case "mute":
                    vivid.set(percentage_of_dropped_buffers=100)
                case "faulty":
                    vivid.set(gain=77)

        try:
            yield Bench(clock, colour=colour, fail=fail, mend=lambda _: vivid.plug(), slack_s=1.0)
        finally:
            colour.close()


BACKENDS = [
    Backend(
        "v4l2",
        on_vivid,
        {"colour": frozenset({"missing", "unplugged", "mute", "faulty"})},
        missing=missing(),
    )
]
