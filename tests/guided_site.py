"""A simulated cell, a guide and a person for tests of guided captures."""

from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from calibration.guide import Look
from calibration.live.loop import GuidedSettings
from drivers.recordings import Recording, RecordingWriter
from drivers.sensor_package import SensorPackage, SensorSettings
from drivers.sim import scenes, truth
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld

SCALE = 0.06
SETTINGS = GuidedSettings(title="test", idle_s=20.0)


@dataclass
class CountingGuide:
    """Accepts views until it has enough, but for those whose number, from 1, is in `refuse`."""

    role: str = "board"
    needed: int = 3
    refuse: tuple = ()
    seen: int = 0
    taken: list = field(default_factory=list)

    def next_step(self):
        return f"show view {len(self.taken) + 1}"

    def look(self, capture):
        self.seen += 1
        picture = np.full((6, 8, 3), self.seen, np.uint8)
        if self.seen in self.refuse:
            return Look(False, (f"view {self.seen} shows nothing",), picture)
        self.taken.append(capture)
        return Look(True, (), picture)

    def progress(self):
        return len(self.taken), self.needed

    def coverage(self):
        return {"views": len(self.taken) / self.needed, "image": [[len(self.taken), 0]]}


class Person:
    """Says what `says` has next each time it is asked; remembers what it was shown."""

    def __init__(self, *says):
        self.says = list(says)
        self.shown = []

    def show(self, situation):
        self.shown.append(situation)

    def command(self):
        said = self.says.pop(0) if self.says else None
        return said() if callable(said) else said

    @property
    def last(self):
        return self.shown[-1]


@dataclass
class Site:
    """An open package in a simulated world, and a recording that was begun."""

    world: SimWorld
    package: SensorPackage
    writer: RecordingWriter

    @property
    def captures(self):
        """What the finished recording has."""
        return list(Recording.open(self.writer.path).captures())

    @property
    def left(self):
        """The names of the files in the recording's folder."""
        return sorted(path.name for path in self.writer.path.parent.iterdir())


@contextmanager
def site(folder, scene="checkerboard", viewpoints=None, settings=None, scale=SCALE, **world):
    """An open package before a scene, whose viewpoints the arm visits."""
    made = SimWorld(scene, 0, scale=scale, program=scenes.spread(scene, viewpoints), **world)
    devices = SimColourCamera(made), SimDepthCamera(made), SimLight(made), SimArm(made)
    writer = RecordingWriter(folder / "live.mcap", truth.rig(made), truth.classes_toml())
    try:
        with SensorPackage(made.clock, *devices, settings or SensorSettings(with_ir=True)) as package:
            yield Site(made, package, writer)
    finally:
        writer.discard()  # what nobody finished
