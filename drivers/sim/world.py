"""The one simulated world: surfaces, light, arm pose, clock and seed; the devices only ask it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.sim.arm import LIMITS, Motion, flange_pose
from drivers.sim.clock import SimClock
from drivers.sim.faults import DeviceName, Fault, FaultKind, Faults
from drivers.sim.package import Package, standard_package
from drivers.sim.raycast import Hits
from drivers.sim.renderer import Renderer
from drivers.sim.scenes import Scene, build, viewpoints
from drivers.sim.surfaces import Texture
from drivers.sim.views import Viewpoint
from surfclass.errors import ConfigurationError
from surfclass.types import Float32, Float64, Transform


@dataclass(frozen=True, slots=True)
class _LightChange:
    t_ns: int
    level: float


class SimWorld:
    """A scene in front of an arm that carries the sensor package.

    Args:
        scene: One of `scenes.SCENES`.
        seed: Decides textures and noise; nothing else is random.
        clock: Of all its devices; a new jumping one by default.
        faults: What goes wrong.
        scale: Of the images against 1280 × 960 and 640 × 480, 0.05…1; small ones are for fast tests.
        program: Viewpoints that the arm visits by itself: it starts at the first, and goes on when a
            lit colour exposure was taken at rest there, as a robot program waits for the sensor's
            handshake. None or empty: it stays at the scene's first viewpoint.
        dwell_s: How long it rests on after that exposure.
        joint_noise_rad: Standard deviation of each read-out joint angle.
        ambient: Linear fraction of full scale that a white surface gives without the LED.
        exposure_s: Of the colour camera.
        speed_rad_s: Top speed of the fastest joint.

    Raises:
        ConfigurationError: If the scene is unknown or a number outside its range.
    """

    def __init__(
        self,
        scene: str = "cell",
        seed: int = 0,
        clock: SimClock | None = None,
        faults: Faults | None = None,
        *,
        scale: float = 1.0,
        program: Sequence[Viewpoint] | None = None,
        dwell_s: float = 0.5,
        joint_noise_rad: float = 0.0,
        ambient: float = 0.0,
        exposure_s: float = 0.010,
        speed_rad_s: float = 0.8,
    ) -> None:
        numbers = {"dwell_s": dwell_s, "joint_noise_rad": joint_noise_rad, "ambient": ambient, "seed": seed}
        for name, number in numbers.items():
            if not number >= 0:
                raise ConfigurationError(f"simulated world: {name} is {number}, allowed is 0 or more")
        if not (exposure_s > 0 and speed_rad_s > 0):
            raise ConfigurationError("simulated world: exposure_s and speed_rad_s must be above 0")
        self.scene: Scene = build(scene)
        self.seed = seed
        self.clock = clock or SimClock()
        self.faults = faults or Faults()
        self.package: Package = standard_package(scale)
        self.viewpoints = viewpoints(scene)
        self.program = tuple(program or ())
        self.dwell_s = dwell_s
        self.joint_noise_rad = joint_noise_rad
        self.ambient = ambient
        self.exposure_s = exposure_s
        self.began_ns = self.clock.now_ns()
        self.renderer = Renderer(self.scene.surfaces, self.package, seed, scale)
        self._lock = threading.RLock()
        self._speed = speed_rad_s
        first = self.program[0] if self.program else self.viewpoints[0]
        self._motion = Motion(first.q, speed_rad_s)
        self._light = [_LightChange(self.began_ns, 0.0)]
        self._seen: list[int] = []  # ends of the exposures that the program waited for

    # ---- time, faults, light ----------------------------------------------------------------

    def seconds(self, t_ns: int) -> float:
        """Seconds since the world began."""
        return (t_ns - self.began_ns) / 1e9

    def fault(self, device: DeviceName, kind: FaultKind, t_ns: int | None = None) -> Fault | None:
        """Returns the fault that holds at `t_ns` (now by default), or None."""
        return self.faults.active(device, kind, self.seconds(self.clock.now_ns() if t_ns is None else t_ns))

    def inject(self, *faults: Fault) -> None:
        """Adds faults to a running world."""
        self.faults = Faults((*self.faults.faults, *faults))

    def set_light(self, level: float, holds_from_ns: int) -> None:
        """The LED gives `level` from that time on."""
        with self._lock:
            self._light.append(_LightChange(holds_from_ns, level))

    def light_level(self, begin_ns: int, end_ns: int) -> float:
        """Returns the LED's mean level over an exposure, 0…1."""
        with self._lock:
            changes = sorted(self._light, key=lambda change: change.t_ns)
        total = 0.0
        for change, following in zip(changes, [*changes[1:], None], strict=True):
            until = end_ns if following is None else min(end_ns, following.t_ns)
            since = max(begin_ns, change.t_ns)
            if until > since:
                dark = self.fault("light", "dark", since) or self.fault("light", "absent", since)
                total += 0.0 if dark else change.level * (until - since)
        return total / max(1, end_ns - begin_ns)

    # ---- arm --------------------------------------------------------------------------------

    def joints(self, t_ns: int | None = None) -> Float64:
        """Returns the true joint angles (6,) rad at `t_ns` (now by default)."""
        t_ns = self.clock.now_ns() if t_ns is None else t_ns
        frozen = self.faults.first("arm", "frozen")
        if frozen is not None:
            t_ns = min(t_ns, self.began_ns + round(frozen.from_s * 1e9))
        with self._lock:
            return self._motion.at(t_ns)

    def move_to(self, q: Float64) -> int:
        """Starts a move to `q` and returns when it will be there, ns.

        Raises:
            ConfigurationError: If a joint would leave its limits.
        """
        target = np.asarray(q, dtype=np.float64)
        if target.shape != (6,) or not ((target >= LIMITS[:, 0]) & (target <= LIMITS[:, 1])).all():
            allowed = np.degrees(LIMITS).round().astype(int).tolist()
            raise ConfigurationError(f"joint angles {target.tolist()} rad, allowed (degrees): {allowed}")
        with self._lock:
            return self._motion.move_to(target, self.clock.now_ns())

    def place(self, q: Float64) -> None:
        """Puts the arm at `q` at once: for tests and data sets that need no travel."""
        with self._lock:
            self._motion = Motion(np.asarray(q, dtype=np.float64), self._speed)

    @property
    def program_index(self) -> int:
        """The place in the program where the arm rests or to which it moves."""
        with self._lock:
            return min(len(self._seen), max(0, len(self.program) - 1))

    @property
    def program_done(self) -> bool:
        """Whether every viewpoint of the program has had its exposure; the arm stays at the last."""
        with self._lock:
            return len(self._seen) >= len(self.program)

    def exposed(self, begin_ns: int, end_ns: int, level: float) -> None:
        """Tells the robot program of a colour exposure; a lit one at rest lets it go on."""
        with self._lock:
            if self.program_done or level <= 0 or not self._motion.rests(begin_ns, end_ns):
                return
            if self._seen and begin_ns < self._seen[-1]:
                return  # the same stop, seen again before the arm has left it
            if self.fault("arm", "frozen", end_ns):
                return
            self._leave(end_ns + round(self.dwell_s * 1e9))

    def go_on(self) -> None:
        """Lets the robot program go on now, whatever was exposed."""
        with self._lock:
            if not self.program_done:
                self._leave(self.clock.now_ns())

    def _leave(self, t_ns: int) -> None:
        self._seen.append(t_ns)
        if not self.program_done:
            self._seen[-1] = self._motion.move_to(self.program[len(self._seen)].q, t_ns)

    def base_T_rgb(self, q: Float64) -> Transform:
        """The colour camera's pose."""
        return flange_pose(q, self.package.flange_offset_m) @ self.package.flange_T_rgb

    def base_T_depth(self, q: Float64) -> Transform:
        """The depth camera's pose."""
        return flange_pose(q, self.package.flange_offset_m) @ self.package.flange_T_depth

    # ---- images -----------------------------------------------------------------------------

    def hits(self, q: Float64, camera: str) -> Hits:
        """Returns what the pixels of camera "rgb" or "depth" see from `q` (6,) rad."""
        flange = flange_pose(q, self.package.flange_offset_m)
        mounted = {"rgb": self.package.flange_T_rgb, "depth": self.package.flange_T_depth}
        if camera not in mounted:
            raise ConfigurationError(f"camera {camera!r} of the simulated world, allowed: rgb, depth")
        return self.renderer.hits(flange @ mounted[camera])

    def texture(self, number: int) -> Texture:
        """Returns the baked look of surface `number`."""
        return self.renderer.texture(number)

    def irradiance(self, q: Float64, level: float = 1.0, exposure_s: float | None = None) -> Float32:
        """Returns (h, w, 3) linear light on the sensor as a fraction of full scale, without noise.

        Args:
            q: (6,) rad.
            level: Of the LED, 0…1.
            exposure_s: The world's by default.
        """
        with self.clock.held():
            exposure = self.exposure_s if exposure_s is None else exposure_s
            return self.renderer.irradiance(self.base_T_rgb(q), level, self.ambient, exposure)

    def render_colour(
        self, q: Float64, level: float, key: int, exposure_s: float | None = None, gain: float = 1.0
    ) -> NDArray[np.uint8]:
        """Returns the colour image (h, w, 3) of frame `key`, which only its noise depends on."""
        with self.clock.held():
            exposure = self.exposure_s if exposure_s is None else exposure_s
            return self.renderer.colour(self.base_T_rgb(q), level, self.ambient, exposure, key, gain)

    def render_raw(
        self, q: Float64, level: float, key: int, exposure_s: float | None = None, gain: float = 1.0
    ) -> NDArray[np.uint16]:
        """Returns the sensor's linear image (h, w, 3) of frame `key`, before the camera's processing."""
        with self.clock.held():
            exposure = self.exposure_s if exposure_s is None else exposure_s
            return self.renderer.raw(self.base_T_rgb(q), level, self.ambient, exposure, key, gain)

    def render_depth(self, q: Float64, key: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Returns depth (h, w) in mm and IR (h, w) in 0…1023 of frame `key`."""
        with self.clock.held():
            return self.renderer.depth(self.base_T_depth(q), key)
