"""The simulated world as emulated devices ask it: on the host's clock, from any thread."""

from __future__ import annotations

import threading
import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.sim import scenes
from drivers.sim.clock import SimClock
from drivers.sim.world import SimWorld
from surfclass.types import Float64

# What the arm's programme waits after a capture: long enough for its last joint reading.
_DWELL_S = 0.3
_STILL_NS = 50_000_000


class Cell(Protocol):
    """What an emulated device asks; all times are the host's CLOCK_MONOTONIC, ns."""

    @property
    def colour_size(self) -> tuple[int, int]:
        """Width and height of a colour image."""

    @property
    def depth_size(self) -> tuple[int, int]:
        """Width and height of a depth image."""

    def joints(self, t_ns: int) -> Float64:
        """Returns the true joint angles (6,), rad."""

    def set_light(self, level: float, holds_from_ns: int) -> None:
        """The LED gives `level`, 0…1, from that time on."""

    def light_level(self, begin_ns: int, end_ns: int) -> float:
        """Returns the LED's mean level over an exposure, 0…1."""

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        """Returns the sensor's linear image (h, w, 3) before any mosaic, full scale 65535.

        Waits for `end_ns`.
        """

    def rgb(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint8]:
        """Returns the image (h, w, 3) through the camera's own response; waits for `end_ns` too."""

    def depth(self, t_ns: int, key: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Returns depth (h, w) in mm, 0 = no return, and IR (h, w) in 0…1023 at `t_ns`."""


class WorldCell:
    """A simulated world as a `Cell`; may be used from several threads.

    Args:
        world: On the host's clock.
        told: When the arm's programme goes on. True: when `go_on` says so. False: when a capture seems to
            be over, that is when the light goes off after an exposure that it lit while the arm stood
            still; whether the capture was any good nobody here knows.
    """

    def __init__(self, world: SimWorld, told: bool = False) -> None:
        self.world = world
        self._told = told
        self._lock = threading.Lock()
        self._lit: tuple[int, float] | None = None  # when the last lit exposure began, and its level
        self._level = 0.0

    @property
    def colour_size(self) -> tuple[int, int]:
        """As `Cell.colour_size`."""
        return self.world.package.rgb.size

    @property
    def depth_size(self) -> tuple[int, int]:
        """As `Cell.depth_size`."""
        return self.world.package.depth.size

    def joints(self, t_ns: int) -> Float64:
        """As `Cell.joints`."""
        return self.world.joints(t_ns)

    def set_light(self, level: float, holds_from_ns: int) -> None:
        """As `Cell.set_light`."""
        self.world.set_light(level, holds_from_ns)
        with self._lock:
            self._level = level
            if level > 0 or self._lit is None:
                return
            (began_ns, lit_level), self._lit = self._lit, None
        if not self._told:
            self.world.exposed(began_ns, max(holds_from_ns, began_ns + 1), lit_level)

    def go_on(self, captured: int) -> None:
        """Tells that so many viewpoints were captured; the arm leaves if the one it is at is among them."""
        if self.world.program_index < captured:
            self.world.go_on()

    @property
    def light_is_on(self) -> bool:
        """Whether the last level that was set is above 0."""
        return self._level > 0

    def light_level(self, begin_ns: int, end_ns: int) -> float:
        """As `Cell.light_level`."""
        return self.world.light_level(begin_ns, end_ns)

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        """As `Cell.raw`."""
        q, level, exposure_s = self._exposure(begin_ns, end_ns)
        return self.world.render_raw(q, level, key, exposure_s, 10 ** (gain_db / 20))

    def rgb(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint8]:
        """As `Cell.rgb`."""
        q, level, exposure_s = self._exposure(begin_ns, end_ns)
        return self.world.render_colour(q, level, key, exposure_s, 10 ** (gain_db / 20))

    def depth(self, t_ns: int, key: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """As `Cell.depth`."""
        return self.world.render_depth(self.world.joints(t_ns), key)

    def prepare(self) -> None:
        """Where the arm stands still, computes what the next colour image from there needs.

        A first image from a place takes a second or more, which no camera needs.
        """
        now_ns = time.monotonic_ns()
        q = self.world.joints(now_ns)
        if (q == self.world.joints(now_ns - _STILL_NS)).all():
            self.world.renderer.prepare(self.world.base_T_rgb(q))

    def bake(self) -> None:
        """Makes all textures and looks once with each camera, so that no exposure has to wait for that."""
        for number in range(len(self.world.renderer.surfaces)):
            self.world.texture(number)
        q = self.world.joints()
        self.world.render_depth(q, 0)
        self.world.render_colour(q, 1.0, 0)

    def _exposure(self, begin_ns: int, end_ns: int) -> tuple[Float64, float, float]:
        """Waits for the end; returns the joints at the middle, the light's level and the exposure time."""
        time.sleep(max(0.0, (end_ns - time.monotonic_ns()) / 1e9))
        level = self.world.light_level(begin_ns, end_ns)
        if level > 0:
            with self._lock:
                self._lit = begin_ns, level
        return self.world.joints((begin_ns + end_ns) // 2), level, (end_ns - begin_ns) / 1e9


def host_cell(
    scene: str = "cell",
    seed: int = 0,
    *,
    scale: float = 1.0,
    viewpoints: int | None = None,
    told: bool = False,
) -> WorldCell:
    """Returns a simulated world on the host's clock.

    Args:
        scene: One of `scenes.SCENES`.
        seed: Of textures and noise.
        scale: Of the images, 0.05…1.
        viewpoints: How many of the scene's the arm visits, evenly spread; None: all of them.
        told: As for `WorldCell`.

    Raises:
        ConfigurationError: If the scene is unknown or a number outside its range.
    """
    world = SimWorld(
        scene,
        seed,
        SimClock(of_host=True),
        scale=scale,
        program=scenes.spread(scene, viewpoints),
        dwell_s=_DWELL_S,
    )
    return WorldCell(world, told)
