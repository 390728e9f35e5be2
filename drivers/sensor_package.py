"""Takes one capture: light on, colour and depth, arm at rest before and after, light off on every path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import TracebackType
from typing import Self

import numpy as np

from drivers.errors import (
    CaptureRejectedError,
    DeviceFaultError,
    DeviceLostError,
    DriverError,
    DriverUnavailableError,
)
from drivers.interfaces import (
    Arm,
    Clock,
    ColourCamera,
    DepthCamera,
    Device,
    ExposureControl,
    Light,
    exposure_control,
)
from surfclass.errors import ConfigurationError
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState

_NEEDS_SOMEBODY = (DriverUnavailableError, DeviceFaultError)
_ROUNDING_NS = 1_000  # of mid-exposure and exposure time, when the start is computed back from them


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """How captures are taken, and what makes one good enough; no call waits longer than these add up to.

    Attributes:
        light_level: 0…1, during the lit frames.
        light_settle_s: The light must hold its level within this time of being told.
        colour_timeout_s: For one colour frame, from when the light holds.
        depth_timeout_s: The same for depth.
        joints_timeout_s: For one reading of the joints.
        max_skew_s: Colour and depth may be this far apart, mid-exposure to mid-exposure.
        max_joint_motion_rad: A joint may go this far between the readings before and after.
        with_ir: Whether the IR image of the depth exposure is kept.
    """

    light_level: float = 1.0
    light_settle_s: float = 1.0
    colour_timeout_s: float = 2.0
    depth_timeout_s: float = 2.0
    joints_timeout_s: float = 0.5
    max_skew_s: float = 0.15
    max_joint_motion_rad: float = 0.001
    with_ir: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.light_level <= 1:
            raise ConfigurationError(f"light_level {self.light_level}, allowed is 0 to 1")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("light_level", "with_ir") and not 0 < value < float("inf"):
                raise ConfigurationError(f"{field.name} {value}, allowed is above 0 and finite")


class SensorPackage:
    """The cameras, the light and the arm as one device that takes captures; used from one thread.

    Retries are the caller's: the class of an error says what to do (`drivers.errors`).

    Args:
        clock: The clock that all frames are stamped with.
        colour: The colour camera.
        depth: The depth camera.
        light: The LED, or None where light is not controlled.
        arm: The arm, or None where captures get no joints.
        settings: Timeouts and limits.
    """

    name = "sensors"

    def __init__(
        self,
        clock: Clock,
        colour: ColourCamera,
        depth: DepthCamera,
        light: Light | None,
        arm: Arm | None,
        settings: SensorSettings | None = None,
    ) -> None:
        self.settings = settings or SensorSettings()
        self._clock, self._colour, self._depth, self._light, self._arm = clock, colour, depth, light, arm

    @property
    def is_open(self) -> bool:
        """Whether every device is."""
        return all(device.is_open for device in self._devices)

    def open(self) -> None:
        """Opens the devices that are not open, the light first.

        What opens stays open where another fails, so that only the missing one is waited for.

        Raises:
            DeviceNotFoundError, DeviceFaultError, DriverUnavailableError: The first that failed, of
                those that waiting cannot mend if there is one.
        """
        errors: list[DriverError] = []
        for device in self._devices:
            if not device.is_open:
                try:
                    device.open()
                except DriverError as error:
                    errors.append(error)
        if errors:
            raise min(errors, key=lambda error: not isinstance(error, _NEEDS_SOMEBODY))

    def close(self) -> None:
        """Turns the light off and releases all devices; never raises."""
        for device in self._devices:
            device.close()

    def release(self, name: str) -> None:
        """Closes the device of that name, so that open() starts it anew; all where there is none of it."""
        named = [device for device in self._devices if device.name == name]
        for device in named or self._devices:
            device.close()

    def __enter__(self) -> Self:
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def check(self) -> None:
        """Says what became of the devices while nothing was captured; about 0.3 s a device at most.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the first that fails.
        """
        self._must_be_open()
        for device in self._devices:
            device.check()

    def about(self) -> dict[str, Mapping[str, str]]:
        """Returns by name what each open device tells about itself.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the first that fails.
        """
        self._must_be_open()
        return {device.name: device.about() for device in self._devices}

    def exposure_control(self) -> ExposureControl | None:
        """Returns the colour camera as one whose exposure can be changed, or None where it cannot.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
        self._must_be_open()
        return exposure_control(self._colour)

    @property
    def has_arm(self) -> bool:
        """Whether captures get joint angles."""
        return self._arm is not None

    def read_joints(self) -> JointState | None:
        """Returns the joint angles as of now, or None without an arm.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
            CaptureRejectedError: If the reading was not taken during the call.
        """
        if self._arm is None:
            return None
        self._must_be_open()
        asked_ns = self._clock.now_ns()
        joints = self._arm.read_joints(self.settings.joints_timeout_s)
        early_ns, late_ns = asked_ns - joints.t_ns, joints.t_ns - self._clock.now_ns()
        if max(early_ns, late_ns) > joints.t_sd_ns:
            raise CaptureRejectedError(
                f"{self._arm.name}: the joint angles are {max(early_ns, late_ns) / 1e6:.1f} ms "
                f"{'older than the question' if early_ns > late_ns else 'ahead of the clock'}",
                "stale",
            )
        return joints

    def capture(self, name: str, role: str = "map", with_dark: bool = False) -> Capture:
        """Takes one capture from where the arm stands.

        Args:
            name: The capture's name.
            role: Its role.
            with_dark: Whether to add a colour frame exposed wholly after the light went off.

        Raises:
            DriverError: One of the five. If the light cannot be turned off that error is raised, with
                whatever happened before as its context, and the light is closed.
            CaptureRejectedError: If the arm moved, or the frames do not belong together.
        """
        self._must_be_open()
        readings = [self.read_joints()]
        try:
            lit_ns = self._light_on()
            colour = self._grab_colour(lit_ns)
            depth = self._grab_depth(lit_ns)
            readings.append(self.read_joints())
            joints = None if self._arm is None else self._joints_at(self._arm, colour.t_ns)
        finally:
            off_ns = self._light_off()
        dark = None
        if with_dark:
            dark = self._grab_colour(off_ns)
            readings.append(self.read_joints())
        skew_ns = depth.t_ns - colour.t_ns
        if abs(skew_ns) > self.settings.max_skew_s * 1e9:
            raise CaptureRejectedError(
                f"capture {name}: depth and colour are {abs(skew_ns) / 1e6:.0f} ms apart, allowed are "
                f"{self.settings.max_skew_s * 1e3:.0f} ms",
                "skew",
            )
        motion = self._motion(name, [reading for reading in (*readings, joints) if reading is not None])
        return Capture(
            name=name,
            role=role,
            depth=depth,
            colour=colour,
            dark=dark,
            joints=joints,
            light_level=None if self._light is None else self.settings.light_level,
            joint_motion_rad=motion,
            skew_ns=skew_ns,
            light_timing=None if self._light is None else self._light.timing,
        )

    @property
    def _devices(self) -> list[Device]:
        # The light comes first in opening and closing: it is off before anything else is touched.
        every = (self._light, self._arm, self._depth, self._colour)
        return [device for device in every if device is not None]

    def _must_be_open(self) -> None:
        for device in self._devices:
            if not device.is_open:
                raise DeviceLostError(device.name, "it is not open")

    def _light_on(self) -> int:
        """Returns the time from which frames are lit as they should be."""
        if self._light is None:
            return self._clock.now_ns()
        return self._set_light(self._light, self.settings.light_level)

    def _light_off(self) -> int:
        """Returns the time from which it is dark; a light that does not obey is closed, too."""
        if self._light is None:
            return self._clock.now_ns()
        try:
            return self._set_light(self._light, 0.0)
        except BaseException:
            self._light.close()  # the last thing that can be tried: close() leaves a light off
            raise

    def _set_light(self, light: Light, level: float) -> int:
        holds_ns = light.set_level(level)
        wait_s = (holds_ns - self._clock.now_ns()) / 1e9
        if wait_s > self.settings.light_settle_s:
            raise DeviceFaultError(
                light.name,
                f"level {level:g} would hold in {wait_s:.1f} s, allowed: {self.settings.light_settle_s:g} s",
            )
        return holds_ns

    def _grab_colour(self, not_before_ns: int) -> ColourFrame:
        frame = self._colour.grab(not_before_ns, self.settings.colour_timeout_s)
        self._must_be_of_now(self._colour.name, frame, not_before_ns)
        return frame

    def _grab_depth(self, not_before_ns: int) -> DepthFrame:
        frame = self._depth.grab(not_before_ns, self.settings.depth_timeout_s, self.settings.with_ir)
        self._must_be_of_now(self._depth.name, frame, not_before_ns)
        return frame

    def _must_be_of_now(self, device: str, frame: ColourFrame | DepthFrame, not_before_ns: int) -> None:
        began_ns = frame.t_ns - frame.t_sd_ns - round((frame.exposure_s or 0.0) * 5e8) + _ROUNDING_NS
        if began_ns < not_before_ns or frame.t_ns - frame.t_sd_ns > self._clock.now_ns():
            raise CaptureRejectedError(
                f"{device}: frame {frame.sequence} began {(began_ns - not_before_ns) / 1e6:+.1f} ms from "
                "when it was allowed to, or lies in the future",
                "stale",
            )

    def _joints_at(self, arm: Arm, t_ns: int) -> JointState:
        joints = arm.joints_at(t_ns, self.settings.joints_timeout_s)
        if joints.t_ns != t_ns:
            raise CaptureRejectedError(
                f"{arm.name}: the joint angles are {(joints.t_ns - t_ns) / 1e6:+.1f} ms from when they "
                "were asked for",
                "stale",
            )
        return joints

    def _motion(self, name: str, joints: list[JointState]) -> float | None:
        if not joints:
            return None
        angles = np.array([reading.q for reading in joints])
        motion = float(np.ptp(angles, axis=0).max())
        if motion > self.settings.max_joint_motion_rad:
            axis = int(np.ptp(angles, axis=0).argmax()) + 1
            raise CaptureRejectedError(
                f"capture {name}: joint {axis} moved {motion:.4f} rad meanwhile, allowed are "
                f"{self.settings.max_joint_motion_rad:g} rad",
                "motion",
            )
        return motion
