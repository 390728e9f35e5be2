"""What every driver provides; one Protocol for each kind of device.

Calls block, each with a timeout, and raise nothing but the five errors of `drivers.errors`. A device
is used from one thread at a time. `open()` leaves nothing open when it raises; `close()` never
raises and may be called twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Literal, Protocol, Self, runtime_checkable

from surfclass.frames import ColourFrame, DepthFrame, JointState


class Clock(Protocol):
    """The one host clock; the simulated one jumps instead of sleeping."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""

    def sleep(self, seconds: float) -> None:
        """Returns after `seconds` of this clock."""


class Device(Protocol):
    """What all devices share; also a context manager that opens and closes."""

    @property
    def name(self) -> str:
        """How messages call it, such as "colour"."""

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""

    def open(self) -> None:
        """Raises DeviceNotFoundError, DeviceFaultError or DriverUnavailableError."""

    def close(self) -> None:
        """Leaves the device safe (a light off) and released."""

    def check(self) -> None:
        """Says what became of an open device that nobody is using; takes 0.3 s at most.

        Called about once a second while nothing is captured, so that a loss is noticed before the
        next capture needs the device.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """

    def about(self) -> Mapping[str, str]:
        """Returns facts about an open device for `surfclass check` and for the log.

        The keys are of "library", "model", "serial", "firmware", "address", "format", "settings",
        "clock", "status"; a fact that the device does not tell is left out.
        """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class ColourCamera(Device, Protocol):
    """A colour camera with every automatic function off."""

    def grab(self, not_before_ns: int, timeout_s: float) -> ColourFrame:
        """Returns the first frame whose exposure BEGAN at or after `not_before_ns`.

        This is what removes stale frames: a triggered camera triggers inside, a free-running one
        discards until a frame qualifies.

        Raises:
            DeviceTimeoutError: If none came within `timeout_s` of `not_before_ns` (or of now, where
                that is later).
            DeviceLostError, DeviceFaultError: As the class says.
        """


@runtime_checkable
class ExposureControl(Protocol):
    """What a colour camera can do besides whose exposure time can be changed while it is open.

    Ask for it by `exposure_control`. open() sets the configured exposure again.
    """

    def exposure_range_s(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure; both the same where it cannot be changed.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """

    def set_exposure(self, exposure_s: float) -> float:
        """Sets the exposure time, and returns the one that the camera made of it.

        From then on `grab` gives no frame that was exposed with the one before, whatever time it is
        asked for; frames have the new one in `exposure_s`.

        Raises:
            ValueError: If it is outside the range; nothing has changed then.
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says; which exposure
                holds is not known then, until the camera is opened anew.
        """


def exposure_control(camera: ColourCamera) -> ExposureControl | None:
    """Returns an open camera as one whose exposure can be changed, or None where it cannot.

    Raises:
        DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the camera does.
    """
    if not isinstance(camera, ExposureControl):
        return None
    shortest_s, longest_s = camera.exposure_range_s()
    return camera if shortest_s < longest_s else None


class DepthCamera(Device, Protocol):
    """A depth camera; one read gives depth and IR of one exposure."""

    def grab(self, not_before_ns: int, timeout_s: float, with_ir: bool = False) -> DepthFrame:
        """As `ColourCamera.grab`."""


class Light(Device, Protocol):
    """The LED; off after open(), after close() and in every `finally`."""

    @property
    def timing(self) -> Literal["software", "hardware"]:
        """Whether a level shines until the next one, or only while the camera's strobe line asks for it."""

    def set_level(self, level: float) -> int:
        """Sets the level, 0…1, and returns the time from which it holds, ns.

        Raises:
            ValueError: If the level is outside 0…1.
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """


class Arm(Device, Protocol):
    """The arm's joint angles; nothing here moves it."""

    def read_joints(self, timeout_s: float) -> JointState:
        """Returns a reading taken during the call.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """

    def joints_at(self, t_ns: int, timeout_s: float) -> JointState:
        """Returns the joint angles at `t_ns`, interpolated between the readings around it.

        Waits for the reading after `t_ns` where that has not come yet. `t_ns` may lie ten seconds back.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the class says.
        """
