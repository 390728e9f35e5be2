"""What makes sets of joint angles out of a bus's frames, and whom it tells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from drivers.canbus.bus import CanBus, CanFrame
from drivers.canbus.joints import JointSet, SetCounts


class JointListener(Protocol):
    """What a source of joints tells; from any thread."""

    def heard(self, joints: JointSet) -> None:
        """Six angles of one moment came."""

    def impossible(self, reason: str) -> None:
        """What came cannot be an arm's angles."""

    def failed(self, reason: str) -> None:
        """A device on the bus reports a fault."""

    def lost(self, reason: str) -> None:
        """The bus takes nothing any more."""


class JointSource(Protocol):
    """Turns the frames of a bus into sets of joint angles."""

    @property
    def counts(self) -> SetCounts:
        """What became of the frames."""

    @property
    def wanted(self) -> frozenset[tuple[int, bool]] | None:
        """The frames that it needs; None: all."""

    @property
    def may_send(self) -> bool:
        """Whether it has to ask."""

    def begin(self, bus: CanBus, listener: JointListener) -> None:
        """Starts on an open bus whose frames another thread is handing to `add`.

        Raises:
            DeviceNotFoundError, DeviceFaultError, DeviceLostError: As the class says.
        """

    def add(self, frame: CanFrame) -> None:
        """Takes a frame, and tells the listener what follows from it."""

    def end(self) -> None:
        """Stops asking; never raises, may be called twice."""

    def about(self) -> Mapping[str, str]:
        """Returns "library" and "format"."""
