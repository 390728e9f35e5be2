"""Minimal devices that do what they are told, on a clock that jumps; they log every call in order."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from surfclass.frames import ColourFrame, DepthFrame, JointState

EXPOSURE_NS = 8_000_000
READOUT_NS = 20_000_000
SETTLE_NS = 3_000_000
READ_NS = 2_000_000


class FakeClock:
    def __init__(self, now_ns: int = 1_000_000_000) -> None:
        self.t_ns = now_ns

    def now_ns(self) -> int:
        return self.t_ns

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.t_ns += round(seconds * 1e9)


class FakeDevice:
    """`fail[call]` is an exception that the next such call raises."""

    def __init__(self, name: str, clock: FakeClock, log: list[str]) -> None:
        self.name, self.clock, self.log = name, clock, log
        self.is_open = False
        self.fail: dict[str, BaseException] = {}

    def did(self, call: str) -> None:
        self.log.append(f"{self.name} {call}")
        error = self.fail.pop(call.split()[0], None)
        if error is not None:
            raise error

    def open(self) -> None:
        self.did("open")
        self.is_open = True

    def close(self) -> None:
        self.log.append(f"{self.name} close")
        self.is_open = False

    def check(self) -> None:
        self.did("check")

    def about(self) -> dict[str, str]:
        return {"library": "fake"}

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class FakeLight(FakeDevice):
    timing: Literal["software", "hardware"] = "software"
    level = 0.0
    settle_ns = SETTLE_NS

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.history: list[tuple[int, float]] = [(0, 0.0)]

    def set_level(self, level: float) -> int:
        self.did(f"{'on' if level else 'off'} {level:g}")
        self.level = level
        holds_ns = self.clock.now_ns() + self.settle_ns
        self.history.append((holds_ns, level))
        return holds_ns

    def close(self) -> None:
        self.level = 0.0
        super().close()

    def constant(self, begin_ns: int, end_ns: int) -> float | None:
        """The level during an exposure, or None where it changed or was changing."""
        changes = [t for t, _ in self.history if begin_ns < t <= end_ns + 1]
        return None if changes else [level for t, level in self.history if t <= begin_ns][-1]


class FakeColour(FakeDevice):
    """Pixels are the light's level during the exposure: 200 lit, 10 dark, 99 where it was changing."""

    light: FakeLight | None = None
    early_ns = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.count = itertools.count()

    def grab(self, not_before_ns: int, timeout_s: float) -> ColourFrame:
        assert 0 < timeout_s < 10
        self.did("grab")
        begin_ns = max(not_before_ns, self.clock.now_ns()) + 100_000 - self.early_ns
        end_ns = begin_ns + EXPOSURE_NS
        self.clock.t_ns = end_ns + READOUT_NS
        level = None if self.light is None else self.light.constant(begin_ns, end_ns)
        value = 99 if level is None else 10 + round(190 * level)
        pixels = np.full((6, 8, 3), value, np.uint8)
        return ColourFrame(begin_ns + EXPOSURE_NS // 2, next(self.count), EXPOSURE_NS / 1e9, pixels)


class FakeDepth(FakeDevice):
    delay_ns = 5_000_000
    early_ns = 0

    def grab(self, not_before_ns: int, timeout_s: float, with_ir: bool = False) -> DepthFrame:
        assert 0 < timeout_s < 10
        self.did(f"grab{' with IR' * with_ir}")
        t_ns = max(not_before_ns, self.clock.now_ns()) + self.delay_ns - self.early_ns
        self.clock.t_ns = max(self.clock.t_ns, t_ns) + READOUT_NS
        ir = np.ones((5, 7), np.uint16) if with_ir else None
        return DepthFrame(t_ns, 7, None, np.full((5, 7), 800, np.uint16), ir)


class FakeArm(FakeDevice):
    """`path` gives the joint angles at a time."""

    lag_ns = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.path: Callable[[int], Any] = lambda _: np.zeros(6)

    def read_joints(self, timeout_s: float) -> JointState:
        assert 0 < timeout_s < 10
        self.did("read")
        t_ns = self.clock.now_ns() + READ_NS // 2 - self.lag_ns
        self.clock.t_ns += READ_NS
        return JointState(t_ns, READ_NS // 2, self.path(t_ns))

    def joints_at(self, t_ns: int, timeout_s: float) -> JointState:
        assert 0 < timeout_s < 10
        self.did("interpolate")
        return JointState(t_ns - self.lag_ns, READ_NS // 2, self.path(t_ns - self.lag_ns))
