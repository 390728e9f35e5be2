"""Captures of the sensors: their order in time, and that the light is off whatever happens."""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pytest
from fake_devices import (
    EXPOSURE_NS,
    READ_NS,
    FakeArm,
    FakeClock,
    FakeColour,
    FakeDepth,
    FakeDevice,
    FakeLight,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import (
    CaptureRejectedError,
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)
from drivers.sensor_package import SensorPackage, SensorSettings
from surfclass.errors import ConfigurationError
from surfclass.frames import ColourFrame


@dataclass
class Bench:
    clock: FakeClock
    colour: FakeColour
    depth: FakeDepth
    light: FakeLight
    arm: FakeArm
    log: list[str]
    package: SensorPackage

    def called(self, *calls: str) -> list[str]:
        return [call for call in self.log if call in calls]


def bench(limits: SensorSettings | None = None, light: bool = True, arm: bool = True) -> Bench:
    log: list[str] = []
    clock = FakeClock()
    colour, depth = FakeColour("colour", clock, log), FakeDepth("depth", clock, log)
    lamp, robot = FakeLight("light", clock, log), FakeArm("arm", clock, log)
    colour.light = lamp
    package = SensorPackage(clock, colour, depth, lamp if light else None, robot if arm else None, limits)
    return Bench(clock, colour, depth, lamp, robot, log, package)


@pytest.fixture
def b() -> Bench:
    made = bench()
    made.package.open()
    made.log.clear()
    return made


def test_a_capture_in_order(b: Bench) -> None:
    one = b.package.capture("a", role="test")
    assert b.log == [
        "arm read",
        "light on 1",
        "colour grab",
        "depth grab",
        "arm read",
        "arm interpolate",
        "light off 0",
    ]
    assert (one.name, one.role, one.light_level, one.dark) == ("a", "test", 1.0, None)
    assert one.colour is not None
    assert one.colour.rgb[0, 0, 0] == 200  # exposed wholly while the light held
    assert one.skew_ns == one.depth.t_ns - one.colour.t_ns > 0
    assert one.joint_motion_rad == 0.0


def test_a_dark_frame_is_exposed_after_the_light_went_off(b: Bench) -> None:
    one = b.package.capture("a", with_dark=True)
    assert b.log[-3:] == ["light off 0", "colour grab", "arm read"]
    assert one.dark is not None
    assert one.dark.rgb[0, 0, 0] == 10
    assert one.dark.t_ns - EXPOSURE_NS // 2 >= b.light.history[-1][0]


def test_the_light_level_and_ir_are_as_set() -> None:
    b = bench(SensorSettings(light_level=0.5, with_ir=True))
    with b.package:
        one = b.package.capture("a")
    assert one.colour is not None
    assert (one.light_level, one.colour.rgb[0, 0, 0]) == (0.5, 105)
    assert one.depth.ir is not None
    assert "depth grab with IR" in b.log


def test_without_light_and_arm() -> None:
    b = bench(light=False, arm=False)
    with b.package:
        one = b.package.capture("a", with_dark=True)
        assert b.package.read_joints() is None
    assert b.log == [
        "depth open",
        "colour open",
        "colour grab",
        "depth grab",
        "colour grab",
        "depth close",
        "colour close",
    ]
    assert (one.light_level, one.joints, one.joint_motion_rad) == (None, None, None)
    assert one.dark is not None


def test_joints_are_those_at_mid_exposure() -> None:
    b = bench(SensorSettings(max_joint_motion_rad=1.0))
    slope = np.array([0.1, -0.2, 0.3, 0.0, 1.0, -1.0])
    b.arm.path = lambda t_ns: slope * t_ns / 1e9
    with b.package:
        one = b.package.capture("a")
    assert one.joints is not None
    assert one.colour is not None
    np.testing.assert_allclose(one.joints.q, slope * one.colour.t_ns / 1e9, rtol=1e-12)
    assert (one.joints.t_ns, one.joints.t_sd_ns) == (one.colour.t_ns, READ_NS // 2)
    assert one.joint_motion_rad is not None
    assert 0.05 < one.joint_motion_rad < 0.1  # 1 rad/s over the reading interval


def test_a_moving_arm_is_rejected(b: Bench) -> None:
    b.arm.path = lambda t_ns: np.array([0, 0, 0, 0.1 * t_ns / 1e9, 0, 0])
    with pytest.raises(
        CaptureRejectedError, match=r"capture a: joint 4 moved 0\.00.. rad meanwhile"
    ) as caught:
        b.package.capture("a")
    assert caught.value.reason == "motion"
    assert not isinstance(caught.value, DriverError)
    assert b.light.level == 0


def test_an_arm_that_moves_before_the_dark_frame_is_rejected(b: Bench) -> None:
    def path(_: int) -> np.ndarray:
        return np.full(6, 0.5 if "light off 0" in b.log else 0.0)

    b.arm.path = path
    assert b.package.capture("a").joint_motion_rad == 0.0
    b.log.clear()
    with pytest.raises(CaptureRejectedError, match="moved"):
        b.package.capture("b", with_dark=True)


def test_frames_that_are_too_far_apart_are_rejected(b: Bench) -> None:
    b.depth.delay_ns = 140_000_000
    with pytest.raises(
        CaptureRejectedError, match=r"depth and colour are 1.. ms apart, allowed are 150 ms"
    ) as caught:
        b.package.capture("a")
    assert caught.value.reason == "skew"
    b.depth.delay_ns = 90_000_000
    assert 0.1e9 < b.package.capture("a").skew_ns < 0.15e9


@pytest.mark.parametrize("kind", ["colour", "depth", "arm", "ahead"])
def test_what_is_not_of_now_is_rejected(b: Bench, kind: str) -> None:
    if kind == "arm":
        b.arm.lag_ns = 50_000_000
    elif kind == "ahead":
        b.arm.lag_ns = -50_000_000
    else:
        getattr(b, kind).early_ns = 60_000_000
    with pytest.raises(CaptureRejectedError) as caught:
        b.package.capture("a")
    assert caught.value.reason == "stale"
    assert b.light.level == 0


FAILURES = [
    ("arm", "read"),
    ("light", "on"),
    ("colour", "grab"),
    ("depth", "grab"),
]


@pytest.mark.parametrize(("device", "call"), FAILURES)
@pytest.mark.parametrize(
    "kind", [DeviceTimeoutError, DeviceLostError, DeviceFaultError, KeyboardInterrupt, ZeroDivisionError]
)
def test_the_light_is_off_after_any_error(
    b: Bench, device: str, call: str, kind: type[BaseException]
) -> None:
    error = kind(device, "it failed") if issubclass(kind, DriverError) else kind()
    getattr(b, device).fail[call] = error
    with pytest.raises(kind) as caught:
        b.package.capture("a")
    assert caught.value is error
    assert b.light.level == 0
    # Before the light was told anything there is nothing to turn off.
    assert b.called("light off 0") == ["light off 0"] * (device != "arm")
    assert b.package.capture("a").light_level == 1.0  # and the next capture works


def test_a_late_reading_of_the_arm_leaves_the_light_off(b: Bench) -> None:
    reads = iter([False, True])
    original = b.arm.read_joints

    def read(timeout_s: float):
        if next(reads):
            raise DeviceTimeoutError("arm", "silent")
        return original(timeout_s)

    b.arm.read_joints = read
    with pytest.raises(DeviceTimeoutError):
        b.package.capture("a")
    assert b.log[-1] == "light off 0"


def test_a_light_that_stays_on_is_reported_and_closed(b: Bench) -> None:
    b.light.fail["off"] = DeviceTimeoutError("light", "no reply")
    with pytest.raises(DeviceTimeoutError, match="light: no reply"):
        b.package.capture("a")
    assert b.log[-1] == "light close"
    assert not b.package.is_open
    with pytest.raises(DeviceLostError, match="light: it is not open"):
        b.package.capture("b")
    b.package.open()  # only the light needs it
    assert b.log[-2:] == ["light close", "light open"]
    b.package.capture("c")


def test_both_errors_are_told_when_the_light_fails_too(b: Bench) -> None:
    first, second = DeviceLostError("depth", "unplugged"), DeviceTimeoutError("light", "no reply")
    b.depth.fail["grab"], b.light.fail["off"] = first, second
    with pytest.raises(DeviceTimeoutError) as caught:
        b.package.capture("a")
    assert caught.value is second
    assert caught.value.__context__ is first


def test_a_light_that_takes_too_long_is_a_fault(b: Bench) -> None:
    b.light.settle_ns = 5_000_000_000
    with pytest.raises(DeviceFaultError, match=r"light: level 0 would hold in 5\.0 s, allowed: 1 s"):
        b.package.capture("a")
    assert not b.light.is_open


def test_what_opens_stays_open_while_another_device_is_missing() -> None:
    b = bench()
    b.depth.fail["open"] = DeviceNotFoundError("depth", "nothing answers")
    with pytest.raises(DeviceNotFoundError, match="depth: nothing answers"):
        b.package.open()
    assert b.log == ["light open", "arm open", "depth open", "colour open"]
    assert not b.package.is_open
    b.package.open()
    assert b.log[4:] == ["depth open"]
    assert b.package.is_open


def test_what_waiting_cannot_mend_is_told_first() -> None:
    b = bench()
    b.light.fail["open"] = DeviceNotFoundError("light", "nothing answers")
    b.depth.fail["open"] = DeviceFaultError("depth", "too hot")
    with pytest.raises(DeviceFaultError, match="depth: too hot"):
        b.package.open()


def test_a_package_that_cannot_be_entered_leaves_nothing_open() -> None:
    b = bench()
    b.depth.fail["open"] = DeviceNotFoundError("depth", "nothing answers")
    with pytest.raises(DeviceNotFoundError), b.package:
        pass
    devices: list[FakeDevice] = [b.light, b.arm, b.depth, b.colour]
    assert not any(device.is_open for device in devices)


def test_one_device_is_released_and_opened_anew(b: Bench) -> None:
    b.package.release("depth")
    assert b.log == ["depth close"]
    b.package.open()
    assert b.log == ["depth close", "depth open"]
    b.package.release("something else")
    assert b.called("light close", "arm close", "colour close") == [
        "light close",
        "arm close",
        "colour close",
    ]


def test_a_check_asks_every_device(b: Bench) -> None:
    b.package.check()
    assert b.log == ["light check", "arm check", "depth check", "colour check"]
    b.colour.fail["check"] = DeviceLostError("colour", "unplugged")
    with pytest.raises(DeviceLostError, match="colour: unplugged"):
        b.package.check()


def test_a_frame_that_may_have_begun_too_early_is_stale(b: Bench) -> None:
    grab = b.colour.grab

    def uncertain(not_before_ns: int, timeout_s: float) -> ColourFrame:
        return replace(grab(not_before_ns, timeout_s), t_sd_ns=200_000)

    b.colour.grab = uncertain
    with pytest.raises(
        CaptureRejectedError, match=r"colour: frame 0 began -0\.1 ms from when it was allowed"
    ):
        b.package.capture("a")


def test_joint_angles_of_another_time_are_stale(b: Bench) -> None:
    at = b.arm.joints_at
    b.arm.joints_at = lambda t_ns, timeout_s: at(t_ns - 30_000_000, timeout_s)
    with pytest.raises(
        CaptureRejectedError, match=r"arm: the joint angles are -30\.0 ms from when"
    ) as caught:
        b.package.capture("a")
    assert caught.value.reason == "stale"
    assert b.light.level == 0


@pytest.mark.parametrize("timing", ["software", "hardware"])
def test_a_capture_knows_how_its_light_was_timed(b: Bench, timing: Literal["software", "hardware"]) -> None:
    b.light.timing = timing
    assert b.package.capture("a").light_timing == timing


def test_close_begins_with_the_light(b: Bench) -> None:
    b.package.close()
    b.package.close()
    assert b.log[0] == "light close"
    assert not b.package.is_open


def test_nothing_is_taken_while_closed() -> None:
    with pytest.raises(DeviceLostError, match="it is not open"):
        bench().package.capture("a")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("light_level", 1.5),
        ("light_level", float("nan")),
        ("colour_timeout_s", 0.0),
        ("joints_timeout_s", float("inf")),
        ("max_skew_s", -1.0),
    ],
)
def test_settings_say_what_is_allowed(field: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(f"{field} {value}, allowed is")):
        SensorSettings(**{field: value})


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["arm", "light", "colour", "depth"]),
            st.sampled_from(["read", "on", "off", "grab"]),
        ),
        max_size=3,
    ),
    st.booleans(),
)
def test_whatever_fails_it_is_dark_in_the_end(faults: list[tuple[str, str]], with_dark: bool) -> None:
    b = bench()
    b.package.open()
    for device, call in faults:
        getattr(b, device).fail[call] = DeviceTimeoutError(device, call)
    with contextlib.suppress(DeviceTimeoutError):
        b.package.capture("a", with_dark=with_dark)
    assert b.light.level == 0
