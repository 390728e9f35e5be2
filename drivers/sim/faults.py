"""What can go wrong on purpose, from when to when."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from surfclass.errors import ConfigurationError

DeviceName = Literal["colour", "depth", "light", "arm"]
FaultKind = Literal["absent", "silent", "broken", "drop", "late", "frozen", "stale", "dark"]

_ALLOWED: dict[str, tuple[FaultKind, ...]] = {
    "colour": ("absent", "silent", "broken", "drop", "late"),
    "depth": ("absent", "silent", "broken", "drop", "late"),
    "light": ("absent", "silent", "broken", "dark"),
    "arm": ("absent", "silent", "broken", "frozen", "stale"),
}


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong with one device.

    Attributes:
        device: "colour", "depth", "light" or "arm".
        kind: "absent": unplugged (lost while open, then not found until `to_s`). "silent": open but
            no answer. "broken": it reports a fault. Cameras: "drop": each `every`-th frame is lost;
            "late": frames come `delay_s` late. Arm: "frozen": it stands still, and its program
            with it; "stale": it moves, but its read-out repeats one old value. Light: "dark": it
            takes the command and stays off.
        from_s: Seconds of the world's clock since the world began; the fault holds from here…
        to_s: …until here.
        every: For "drop": 1 drops every frame, 3 each frame whose number is divisible by 3.
        delay_s: For "late".
    """

    device: DeviceName
    kind: FaultKind
    from_s: float = 0.0
    to_s: float = math.inf
    every: int = 1
    delay_s: float = 0.5

    def __post_init__(self) -> None:
        if self.device not in get_args(DeviceName):
            allowed = ", ".join(get_args(DeviceName))
            raise ConfigurationError(f"fault of device {self.device!r}, allowed: {allowed}")
        if self.kind not in _ALLOWED[self.device]:
            allowed = ", ".join(_ALLOWED[self.device])
            raise ConfigurationError(f"fault {self.kind!r} of the {self.device}, allowed: {allowed}")
        if not 0 <= self.from_s < self.to_s:
            raise ConfigurationError(f"fault from {self.from_s} s to {self.to_s} s: allowed is 0 ≤ from < to")
        if self.every < 1 or self.delay_s < 0:
            raise ConfigurationError(
                f"fault with every {self.every}, delay {self.delay_s} s: allowed are ≥ 1 and ≥ 0"
            )


@dataclass(frozen=True, slots=True)
class Faults:
    """All that goes wrong in one run; none by default."""

    faults: tuple[Fault, ...] = ()

    def active(self, device: str, kind: FaultKind, t_s: float) -> Fault | None:
        """Returns the first fault of that kind that holds at `t_s`, or None."""
        for fault in self.faults:
            if fault.device == device and fault.kind == kind and fault.from_s <= t_s < fault.to_s:
                return fault
        return None

    def first(self, device: str, kind: FaultKind) -> Fault | None:
        """Returns the earliest fault of that kind, whenever it holds, or None."""
        found = [fault for fault in self.faults if fault.device == device and fault.kind == kind]
        return min(found, key=lambda fault: fault.from_s, default=None)
