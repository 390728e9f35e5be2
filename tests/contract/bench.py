"""What the contract is tested on: a bench is one backend's devices and what can be done to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from drivers.interfaces import Arm, Clock, ColourCamera, DepthCamera, Device, Light

# missing: nothing at the address. unplugged: was there, went away. mute: there, and says nothing.
# faulty: reports a fault, or impossible data. garbage: bytes that are no message. half: a message that
# stops in the middle. frozen: its clock or its readings stand still.
Trouble = Literal["missing", "unplugged", "mute", "faulty", "garbage", "half", "frozen"]


@dataclass
class Bench:
    """One set of devices, closed.

    Attributes:
        clock: The one they stamp with.
        colour: None where a backend has no such device; likewise the others.
        fail: `fail(kind, trouble)` makes a device fail from now on.
        mend: `mend(kind)` undoes it: plugged in again, awake again.
        brightness: `brightness(not_before_ns)` is what the light really gives in an exposure that
            begins then, 0…255; for the contract of lights.
        slack_s: How much later than its timeout a call may return: other processes answer here.
    """

    clock: Clock
    colour: ColourCamera | None = None
    depth: DepthCamera | None = None
    light: Light | None = None
    arm: Arm | None = None
    fail: Callable[[str, Trouble], None] | None = None
    mend: Callable[[str], None] | None = None
    brightness: Callable[[int], float] | None = None
    slack_s: float = 0.1

    def device(self, kind: str) -> Device:
        device: Device | None = getattr(self, kind)
        assert device is not None, f"the backend is said to have a {kind} device"
        return device


@dataclass(frozen=True)
class Backend:
    """A row of the contract's table.

    Attributes:
        name: How the tests are called.
        make: `make(folder)` gives a bench in an empty folder, and cleans up after it.
        troubles: By kind of device that the bench has: what `Bench.fail` can do to it.
        missing: Why it cannot run here; empty where it can.
        slow: Whether only `./run test --slow` runs it.
    """

    name: str
    make: Callable[[Path], AbstractContextManager[Bench]]
    troubles: Mapping[str, frozenset[Trouble]] = field(default_factory=dict)
    missing: str = ""
    slow: bool = False

    def param(self, *more: str) -> object:
        marks = [pytest.mark.skip(reason=f"{self.name}: {self.missing}")] if self.missing else []
        marks += [pytest.mark.slow] if self.slow else []
        return pytest.param(self, *more, id="-".join((self.name, *more)), marks=marks)
