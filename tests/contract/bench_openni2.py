"""The OpenNI2 driver on the real libOpenNI2, reading a virtual Kinect: isolated, and in this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from bench import Backend, Bench, Trouble

from drivers import depth_openni2
from drivers.clock import SystemClock
from drivers.emulators.virtual_kinect import VirtualKinect
from drivers.openni2.build import build
from drivers.openni2.errors import PluginMissingError
from drivers.openni2.plugins import system_folder


class Slope:
    """A tilted plane, with an IR image that changes from frame to frame."""

    depth_size = (64, 48)

    def depth(self, t_ns, key):
        rows, columns = np.mgrid[:48, :64]
        depth = (800 + 3 * columns + 2 * rows).astype(np.uint16)
        depth[0] = 0
        return depth, ((rows + columns + key) % 1024).astype(np.uint16)


@contextmanager
def virtual(folder: Path, isolated: bool) -> Iterator[Bench]:
    kinect = VirtualKinect(Slope(), folder / "kinect")
    make = depth_openni2.depth if isolated else depth_openni2.in_process
    clock = SystemClock()
    camera = make(name="depth", clock=clock, options={"device": kinect.uri}, shared={})

    def fail(kind: str, trouble: Trouble) -> None:
        match trouble:
            case "missing":
                kinect.stop()
            case "unplugged":
                kinect.unplug()
            case "mute":
                kinect.mute(True)
            case "frozen":
                kinect.freeze_clock(True)

    def mend(kind: str) -> None:
        kinect.mute(False)
        kinect.freeze_clock(False)
        kinect.plug()

    with kinect:
        try:
            yield Bench(clock, depth=camera, fail=fail, mend=mend, slack_s=1.0 if isolated else 0.5)
        finally:
            camera.close()


def missing() -> str:
    try:
        system_folder()
        build("virtual")
    except PluginMissingError as error:
        return str(error)
    return ""


_TROUBLES = {"depth": frozenset[Trouble](("missing", "unplugged", "mute", "frozen"))}

BACKENDS = [
    Backend("openni2 (virtual Kinect)", partial(virtual, isolated=True), _TROUBLES, missing()),
    Backend("openni2 in process (virtual Kinect)", partial(virtual, isolated=False), _TROUBLES, missing()),
]
