"""The simulated devices: thin, each asks the world what a real one would deliver at that time."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Literal, Self

from drivers.errors import DeviceFaultError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from drivers.exposure import check_exposure
from drivers.sim.faults import DeviceName
from drivers.sim.randomness import stream
from drivers.sim.world import SimWorld
from surfclass.errors import InputError
from surfclass.frames import ColourFrame, DepthFrame, JointState

TRIGGER_LATENCY_NS = 200_000
COLOUR_READOUT_NS = 30_000_000
DEPTH_PERIOD_NS = 33_333_333
DEPTH_EXPOSURE_NS = 10_000_000
DEPTH_READOUT_NS = 25_000_000
LIGHT_SETTLE_NS = 5_000_000
JOINT_READ_NS = 2_000_000
EXPOSURE_STEP_S = 10e-6  # a row of the sensor
SHORTEST_EXPOSURE_S, LONGEST_EXPOSURE_S = 50e-6, 0.5


class SimDevice:
    """What the simulated devices share: opening, closing, and the faults that any device can have."""

    kind: DeviceName

    def __init__(self, world: SimWorld) -> None:
        self.world = world
        self._open = False

    @property
    def name(self) -> str:
        """How messages call it."""
        return self.kind

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._open

    def open(self) -> None:
        """Finds the device.

        Raises:
            DeviceNotFoundError: While a fault "absent" holds.
            DeviceFaultError: While a fault "broken" holds.
        """
        if self.world.fault(self.kind, "absent"):
            raise DeviceNotFoundError(self.name, "nothing answers in the simulated world")
        if self.world.fault(self.kind, "broken"):
            raise DeviceFaultError(self.name, "it reports a fault")
        self._open = True

    def close(self) -> None:
        """Releases the device; may be called twice."""
        self._open = False

    def check(self) -> None:
        """Raises what a fault makes of the device now."""
        self._must_answer(self.world.clock.now_ns())

    def about(self) -> Mapping[str, str]:
        """Says that it is simulated."""
        return {
            "library": "drivers.sim",
            "model": f"simulated {self.kind}",
            "serial": f"SIM-{self.kind.upper()}",
            "clock": "the world's",
        }

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _must_answer(self, t_ns: int) -> None:
        """Raises what a fault at `t_ns` makes of a call."""
        if not self._open:
            raise DeviceLostError(self.name, "it is not open")
        if self.world.fault(self.kind, "absent", t_ns):
            raise DeviceLostError(self.name, "it went away")
        if self.world.fault(self.kind, "broken", t_ns):
            raise DeviceFaultError(self.name, "it reports a fault")

    def _waits_for(self, t_ns: int, deadline_ns: int, what: str) -> None:
        """Lets time pass until `t_ns`, when an answer is there, or raises at the deadline."""
        clock = self.world.clock
        if t_ns > deadline_ns or self.world.fault(self.kind, "silent", min(t_ns, deadline_ns)):
            clock.sleep_until(deadline_ns)
            self._must_answer(deadline_ns)
            raise DeviceTimeoutError(self.name, f"no {what} came in time")
        clock.sleep_until(t_ns)
        self._must_answer(t_ns)


def _allowed_wait_ns(timeout_s: float) -> int:
    if not timeout_s > 0:
        raise InputError(f"timeout {timeout_s} s, allowed is above 0")
    return round(timeout_s * 1e9)


class SimColourCamera(SimDevice):
    """A colour camera that triggers inside `grab`, and whose exposure can be changed."""

    kind = "colour"

    def __init__(self, world: SimWorld) -> None:
        super().__init__(world)
        self._frames = 0
        self._exposure_s = world.exposure_s

    def open(self) -> None:
        """Finds the camera and sets the world's exposure time."""
        super().open()
        self._exposure_s = self.world.exposure_s

    def exposure_range_s(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure.

        Raises:
            DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        self._must_answer(self.world.clock.now_ns())
        return SHORTEST_EXPOSURE_S, LONGEST_EXPOSURE_S

    def set_exposure(self, exposure_s: float) -> float:
        """Sets the exposure time, and returns it as a whole number of rows.

        Raises:
            InputError: If it is outside the range (a ValueError).
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        check_exposure(self.name, exposure_s, self.exposure_range_s())
        now_ns = self.world.clock.now_ns()
        self._waits_for(now_ns, now_ns + 100_000_000, "reply")
        self._exposure_s = round(exposure_s / EXPOSURE_STEP_S) * EXPOSURE_STEP_S
        return self._exposure_s

    def grab(self, not_before_ns: int, timeout_s: float) -> ColourFrame:
        """Returns a frame whose exposure began at or after `not_before_ns`.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If none came within `timeout_s` of `not_before_ns` or of now.
            DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        world, now_ns = self.world, self.world.clock.now_ns()
        self._must_answer(now_ns)
        start_ns = max(not_before_ns, now_ns)
        deadline_ns = start_ns + _allowed_wait_ns(timeout_s)
        exposure_ns = round(self._exposure_s * 1e9)
        begin_ns = start_ns + TRIGGER_LATENCY_NS
        while True:
            self._frames += 1
            end_ns = begin_ns + exposure_ns
            drop = world.fault(self.kind, "drop", end_ns)
            late = world.fault(self.kind, "late", end_ns)
            there_ns = end_ns + COLOUR_READOUT_NS + (round(late.delay_s * 1e9) if late else 0)
            if drop is None or self._frames % drop.every:
                break
            if there_ns > deadline_ns:
                break
            begin_ns = there_ns + TRIGGER_LATENCY_NS  # a lost frame is triggered again
        if drop is not None and not self._frames % drop.every:
            there_ns = deadline_ns + 1
        self._waits_for(there_ns, deadline_ns, "frame")
        level = world.light_level(begin_ns, end_ns)
        mid_ns = (begin_ns + end_ns) // 2
        image = world.render_colour(world.joints(mid_ns), level, self._frames, self._exposure_s)
        world.exposed(begin_ns, end_ns, level)
        return ColourFrame(mid_ns, self._frames, self._exposure_s, image)


class SimDepthCamera(SimDevice):
    """A depth camera that runs freely at 30 Hz; frames that began too early are discarded."""

    kind = "depth"

    def grab(self, not_before_ns: int, timeout_s: float, with_ir: bool = False) -> DepthFrame:
        """Returns the first frame whose exposure began at or after `not_before_ns`.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError: If none came within `timeout_s` of `not_before_ns` or of now.
            DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        world, now_ns = self.world, self.world.clock.now_ns()
        self._must_answer(now_ns)
        deadline_ns = max(not_before_ns, now_ns) + _allowed_wait_ns(timeout_s)
        # A frame still on its way when the call comes qualifies, unless it began too early.
        earliest_ns = max(not_before_ns, now_ns - DEPTH_EXPOSURE_NS - DEPTH_READOUT_NS)
        sequence = max(0, -((world.began_ns - earliest_ns) // DEPTH_PERIOD_NS))
        while True:
            begin_ns = world.began_ns + sequence * DEPTH_PERIOD_NS
            end_ns = begin_ns + DEPTH_EXPOSURE_NS
            drop = world.fault(self.kind, "drop", end_ns)
            late = world.fault(self.kind, "late", end_ns)
            there_ns = end_ns + DEPTH_READOUT_NS + (round(late.delay_s * 1e9) if late else 0)
            if there_ns > deadline_ns or drop is None or sequence % drop.every:
                break
            sequence += 1
        self._waits_for(there_ns, deadline_ns, "frame")
        mid_ns = (begin_ns + end_ns) // 2
        depth_mm, ir = world.render_depth(world.joints(mid_ns), sequence)
        return DepthFrame(mid_ns, sequence, DEPTH_EXPOSURE_NS / 1e9, depth_mm, ir if with_ir else None)


class SimLight(SimDevice):
    """The LED's controller."""

    kind = "light"
    timing: Literal["software", "hardware"] = "software"

    def open(self) -> None:
        """Finds the light and turns it off."""
        super().open()
        self.world.set_light(0.0, self.world.clock.now_ns())

    def close(self) -> None:
        """Turns the light off and releases it."""
        if self._open:
            self.world.set_light(0.0, self.world.clock.now_ns())
        super().close()

    def set_level(self, level: float) -> int:
        """Sets the level, 0…1, and returns the time from which it holds, ns.

        Raises:
            InputError: If the level is outside 0…1 (a ValueError).
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        if not 0 <= level <= 1:
            raise InputError(f"light level {level}, allowed is 0 to 1")
        now_ns = self.world.clock.now_ns()
        self._must_answer(now_ns)
        self._waits_for(now_ns, now_ns + 100_000_000, "reply")
        holds_ns = now_ns + LIGHT_SETTLE_NS
        self.world.set_light(float(level), holds_ns)
        return holds_ns


class SimArm(SimDevice):
    """The arm's controller, read only."""

    kind = "arm"

    def read_joints(self, timeout_s: float) -> JointState:
        """Returns a reading taken during the call.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        before_ns = self.world.clock.now_ns()
        self._must_answer(before_ns)
        deadline_ns = before_ns + _allowed_wait_ns(timeout_s)
        self._waits_for(before_ns + JOINT_READ_NS, deadline_ns, "joint angles")
        return self._state(before_ns + JOINT_READ_NS // 2, JOINT_READ_NS // 2)

    def joints_at(self, t_ns: int, timeout_s: float) -> JointState:
        """Returns the joint angles at `t_ns`, as a reader that polls without a pause would know them.

        Raises:
            InputError: If the timeout is not above 0.
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the world's faults say.
        """
        now_ns = self.world.clock.now_ns()
        self._must_answer(now_ns)
        deadline_ns = max(now_ns, t_ns) + _allowed_wait_ns(timeout_s)
        self._waits_for(max(now_ns, t_ns + JOINT_READ_NS), deadline_ns, "joint angles")
        return self._state(t_ns, JOINT_READ_NS // 2)

    def _state(self, t_ns: int, t_sd_ns: int) -> JointState:
        """The read-out at `t_ns`, with its noise."""
        world = self.world
        stale = world.fault(self.kind, "stale", t_ns)
        q = world.joints(world.began_ns + round(stale.from_s * 1e9) if stale else t_ns)
        if world.joint_noise_rad > 0:
            noise = stream(world.seed, "joints", t_ns // 1000)
            q = q + world.joint_noise_rad * noise.standard_normal(6)
        return JointState(t_ns, t_sd_ns, q)
