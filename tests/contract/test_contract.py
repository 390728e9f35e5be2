"""What every driver must keep (drivers/interfaces.py), one class for each kind of device."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)
from drivers.interfaces import exposure_control

KINDS = ("colour", "depth", "light", "arm")
CAMERAS = ("colour", "depth")
WAIT_S = 0.4  # what a mute device may take to say that it is mute
PATIENT_S = 2.0  # what a working one may take on a busy computer


def use(bench, kind, wait_s=PATIENT_S):
    """One ordinary call of the device."""
    device = bench.device(kind)
    if kind in CAMERAS:
        return device.grab(bench.clock.now_ns(), wait_s)
    if kind == "light":
        return device.set_level(0.5)
    return device.read_joints(wait_s)


def used_until_it_fails(bench, kind, within_s=2.0):
    """Uses the device until it raises: what was under way when it failed may still arrive."""
    until_ns = bench.clock.now_ns() + round(within_s * 1e9)
    while bench.clock.now_ns() < until_ns:
        use(bench, kind, WAIT_S)
        bench.clock.sleep(0.01)


def used_until_it_is_lost(bench, kind, within_s=3.0):
    """As above; a wire that only falls silent, as UDP may at first, times out before that."""
    until_ns = bench.clock.now_ns() + round(within_s * 1e9)
    while bench.clock.now_ns() < until_ns:
        with contextlib.suppress(DeviceTimeoutError):
            used_until_it_fails(bench, kind, within_s)


def checked_until_it_is_lost(bench, device, within_s=3.0):
    until_ns = bench.clock.now_ns() + round(within_s * 1e9)
    while (before_ns := bench.clock.now_ns()) < until_ns:
        with contextlib.suppress(DeviceTimeoutError):
            device.check()
        assert bench.clock.now_ns() - before_ns < (0.3 + bench.slack_s) * 1e9
        bench.clock.sleep(0.1)


ABOUT = {"library", "model", "serial", "firmware", "address", "format", "settings", "clock", "status"}


@pytest.mark.kinds(*KINDS)
class TestEveryDevice:
    def test_opens_closes_and_opens_again(self, bench, kind):
        device = bench.device(kind)
        assert not device.is_open
        for _ in range(2):
            device.open()
            assert device.is_open
            use(bench, kind)
            device.close()
            assert not device.is_open

    def test_close_may_be_called_at_any_time(self, bench, kind):
        device = bench.device(kind)
        device.close()
        device.open()
        device.close()
        device.close()
        assert not device.is_open

    def test_is_a_context_manager_that_closes_on_errors(self, bench, kind):
        device = bench.device(kind)
        opened = []

        def fail_inside():
            with device:
                opened.append(device.is_open)
                raise KeyError

        with pytest.raises(KeyError):
            fail_inside()
        assert opened == [True]
        assert not device.is_open

    def test_a_closed_device_refuses_with_a_driver_error(self, bench, kind):
        with pytest.raises(DriverError):
            use(bench, kind)

    def test_errors_name_the_device(self, bench, kind):
        with pytest.raises(DriverError) as caught:
            use(bench, kind)
        assert caught.value.device == bench.device(kind).name
        assert bench.device(kind).name in str(caught.value)

    @pytest.mark.trouble("missing")
    def test_a_missing_device_is_not_found_and_stays_closed(self, bench, kind):
        bench.fail(kind, "missing")
        with pytest.raises(DeviceNotFoundError):
            bench.device(kind).open()
        assert not bench.device(kind).is_open

    @pytest.mark.trouble("unplugged")
    def test_an_unplugged_device_is_lost_and_then_not_found(self, bench, kind):
        with bench.device(kind) as device:
            use(bench, kind)
            bench.fail(kind, "unplugged")
            with pytest.raises(DeviceLostError):
                used_until_it_is_lost(bench, kind)
            device.close()
            with pytest.raises(DeviceNotFoundError):
                device.open()
            assert not device.is_open

    @pytest.mark.trouble("unplugged")
    def test_a_device_that_is_plugged_in_again_works_again(self, bench, kind):
        with bench.device(kind) as device:
            use(bench, kind)
            bench.fail(kind, "unplugged")
            with pytest.raises(DriverError):
                used_until_it_fails(bench, kind)
            device.close()
            bench.mend(kind)
            device.open()
            asked_ns = bench.clock.now_ns()
            result = use(bench, kind)
            assert (result if kind == "light" else result.t_ns) >= asked_ns

    @pytest.mark.trouble("unplugged")
    def test_an_idle_device_that_went_away_is_noticed_by_a_check(self, bench, kind):
        with bench.device(kind) as device:
            use(bench, kind)
            device.check()
            bench.fail(kind, "unplugged")
            with pytest.raises(DeviceLostError):
                checked_until_it_is_lost(bench, device)

    def test_it_tells_about_itself(self, bench, kind):
        with bench.device(kind) as device:
            about = device.about()
        assert "library" in about
        assert set(about) <= ABOUT
        assert all(isinstance(value, str) and value for value in about.values())

    @pytest.mark.trouble("mute")
    def test_a_mute_device_times_out_in_time(self, bench, kind):
        with bench.device(kind):
            bench.fail(kind, "mute")
            before = bench.clock.now_ns()
            with pytest.raises(DeviceTimeoutError):
                use(bench, kind, WAIT_S)
            assert (bench.clock.now_ns() - before) / 1e9 < WAIT_S + bench.slack_s

    @pytest.mark.trouble("mute")
    def test_a_device_that_wakes_up_works_again(self, bench, kind):
        with bench.device(kind) as device:
            bench.fail(kind, "mute")
            with pytest.raises(DeviceTimeoutError):
                use(bench, kind, WAIT_S)
            bench.mend(kind)
            try:
                use(bench, kind)
            except DriverError:  # a wire whose answers can no longer be told apart is opened anew
                device.close()
                device.open()
                use(bench, kind)

    @pytest.mark.trouble("faulty")
    def test_a_faulty_device_says_so(self, bench, kind):
        with bench.device(kind):
            bench.fail(kind, "faulty")
            with pytest.raises(DeviceFaultError):
                used_until_it_fails(bench, kind)

    @pytest.mark.trouble("garbage")
    def test_garbage_on_the_wire_is_a_driver_error_and_no_reading(self, bench, kind):
        with bench.device(kind):
            bench.fail(kind, "garbage")
            with pytest.raises(DriverError):
                used_until_it_fails(bench, kind)

    @pytest.mark.trouble("half")
    def test_half_a_message_is_a_driver_error_and_no_reading(self, bench, kind):
        with bench.device(kind):
            bench.fail(kind, "half")
            with pytest.raises(DriverError):
                used_until_it_fails(bench, kind)

    @pytest.mark.trouble("frozen")
    def test_a_device_whose_clock_stands_still_gives_nothing_old(self, bench, kind):
        with bench.device(kind) as device:
            use(bench, kind)
            bench.fail(kind, "frozen")
            bench.clock.sleep(0.3)
            asked_ns = bench.clock.now_ns()
            try:
                result = use(bench, kind, WAIT_S)
            except DriverError:
                return
            assert result.t_ns + result.t_sd_ns >= asked_ns
            assert device.is_open


@pytest.mark.kinds(*CAMERAS)
class TestCamera:
    def exposure_begin(self, frame):
        return frame.t_ns - frame.t_sd_ns - round((frame.exposure_s or 0) * 1e9 / 2)

    def test_the_exposure_began_at_or_after_the_time_asked_for(self, bench, kind):
        with bench.device(kind) as camera:
            for ahead_ms in (0, 1, 20, 33, 70, 150):
                not_before = bench.clock.now_ns() + ahead_ms * 1_000_000
                frame = camera.grab(not_before, PATIENT_S)
                assert self.exposure_begin(frame) + 1000 >= not_before
                assert frame.t_ns - frame.t_sd_ns <= bench.clock.now_ns()

    def test_frames_never_age(self, bench, kind):
        with bench.device(kind) as camera:
            camera.grab(bench.clock.now_ns(), PATIENT_S)
            bench.clock.sleep(0.3)
            now = bench.clock.now_ns()
            assert self.exposure_begin(camera.grab(now, PATIENT_S)) + 1000 >= now

    def test_times_and_sequence_numbers_rise(self, bench, kind):
        with bench.device(kind) as camera:
            frames = [camera.grab(bench.clock.now_ns(), PATIENT_S) for _ in range(4)]
        assert np.all(np.diff([frame.t_ns for frame in frames]) > 0)
        assert np.all(np.diff([frame.sequence for frame in frames]) > 0)

    def test_a_time_far_ahead_is_waited_for(self, bench, kind):
        with bench.device(kind) as camera:
            not_before = bench.clock.now_ns() + 400_000_000
            camera.grab(not_before, 0.2 + bench.slack_s)  # the timeout counts from not_before
            assert bench.clock.now_ns() >= not_before

    def test_too_short_a_timeout_is_a_timeout_error(self, bench, kind):
        with bench.device(kind) as camera, pytest.raises(TimeoutError):
            camera.grab(bench.clock.now_ns(), 0.0005)

    def test_a_frame_comes_after_a_timeout(self, bench, kind):
        with bench.device(kind) as camera:
            with pytest.raises(DeviceTimeoutError):
                camera.grab(bench.clock.now_ns(), 0.0005)
            now = bench.clock.now_ns()
            assert self.exposure_begin(camera.grab(now, PATIENT_S)) + 1000 >= now


@pytest.mark.kinds("colour")
class TestColourCamera:
    def test_images_are_whole_and_cannot_be_written(self, bench):
        with bench.device("colour") as camera:
            first, second = (camera.grab(bench.clock.now_ns(), PATIENT_S).rgb for _ in range(2))
        assert first.shape == second.shape
        assert first.dtype in (np.uint8, np.uint16)
        with pytest.raises(ValueError, match="read-only"):
            first[0, 0, 0] = 1


@pytest.fixture
def exposing(bench):
    """The open camera with its light on, if its exposure can be changed, and the exposure as configured."""
    with contextlib.ExitStack() as stack:
        camera = stack.enter_context(bench.device("colour"))
        control = exposure_control(camera)
        if control is None:
            pytest.skip("this camera's exposure cannot be changed")
        lit_ns = bench.clock.now_ns()
        if bench.light is not None:
            lit_ns = stack.enter_context(bench.light).set_level(0.5)
        yield control, camera.grab(lit_ns, PATIENT_S).exposure_s


@pytest.mark.kinds("colour")
class TestExposureControl:
    def brightness(self, bench):
        return float(bench.device("colour").grab(bench.clock.now_ns(), PATIENT_S).rgb.mean())

    def test_images_are_as_bright_as_their_exposure_is_long(self, bench, exposing):
        control, configured_s = exposing
        seen = []
        for factor in (0.5, 1.0, 2.0):
            took_s = control.set_exposure(factor * configured_s)
            assert took_s == pytest.approx(factor * configured_s, rel=0.06, abs=50e-6)
            frame = bench.device("colour").grab(bench.clock.now_ns(), PATIENT_S)
            assert frame.exposure_s == took_s
            seen.append(float(frame.rgb.mean()))
        assert seen[1] > 1.15 * seen[0]
        assert seen[2] > 1.15 * seen[1]

    def test_no_frame_of_the_exposure_before_comes_whatever_time_is_asked_for(self, bench, exposing):
        control, configured_s = exposing
        began_ns = bench.clock.now_ns()
        for factor in (2.0, 0.5, 2.0):
            took_s = control.set_exposure(factor * configured_s)
            frame = bench.device("colour").grab(began_ns, PATIENT_S)
            assert frame.exposure_s == took_s
            assert float(frame.rgb.mean()) == pytest.approx(self.brightness(bench), rel=0.05)

    def test_it_can_be_set_after_a_frame_was_given_up(self, bench, exposing):
        control, configured_s = exposing
        with pytest.raises(DeviceTimeoutError):
            bench.device("colour").grab(bench.clock.now_ns(), 0.0005)
        took_s = control.set_exposure(2.0 * configured_s)
        frame = bench.device("colour").grab(bench.clock.now_ns(), PATIENT_S)
        assert frame.exposure_s == took_s
        assert float(frame.rgb.mean()) == pytest.approx(self.brightness(bench), rel=0.05)

    def test_a_small_change_is_made_too(self, bench, exposing):
        control, configured_s = exposing
        steps = {control.set_exposure(configured_s * (1 + 0.004 * n)) for n in range(60)}
        assert len(steps) > 1
        assert max(steps) > 1.1 * configured_s

    def test_both_ends_of_the_range_can_be_set(self, exposing):
        control, configured_s = exposing
        low_s, high_s = control.exposure_range_s()
        assert low_s <= configured_s <= high_s
        for end_s in (low_s, high_s):
            assert control.set_exposure(end_s) == pytest.approx(end_s, rel=0.06, abs=50e-6)

    def test_an_exposure_outside_the_range_is_refused_and_changes_nothing(self, bench, exposing):
        control, configured_s = exposing
        low_s, high_s = control.exposure_range_s()
        for wrong_s in (0.9 * low_s, 1.1 * high_s, 0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(ValueError, match=r"allow"):
                control.set_exposure(wrong_s)
        assert bench.device("colour").grab(bench.clock.now_ns(), PATIENT_S).exposure_s == configured_s

    def test_opening_sets_the_configured_exposure_again(self, bench, exposing):
        control, configured_s = exposing
        control.set_exposure(2.0 * configured_s)
        camera = bench.device("colour")
        camera.close()
        camera.open()
        assert camera.grab(bench.clock.now_ns(), PATIENT_S).exposure_s == configured_s

    def test_a_closed_camera_refuses_with_a_driver_error(self, bench, exposing):
        control, configured_s = exposing
        bench.device("colour").close()
        with pytest.raises(DriverError):
            control.set_exposure(configured_s)
        with pytest.raises(DriverError):
            control.exposure_range_s()


@pytest.mark.kinds("depth")
class TestDepthCamera:
    def test_infrared_comes_only_when_asked_for(self, bench):
        with bench.device("depth") as camera:
            assert camera.grab(bench.clock.now_ns(), PATIENT_S).ir is None
            frame = camera.grab(bench.clock.now_ns(), 1.0, with_ir=True)
        assert frame.ir is not None
        assert frame.ir.shape == frame.depth_mm.shape

    def test_depth_is_millimetres_with_zero_for_no_return(self, bench):
        with bench.device("depth") as camera:
            depth = camera.grab(bench.clock.now_ns(), PATIENT_S).depth_mm
        assert depth.dtype == np.uint16
        assert np.all((depth == 0) | ((depth > 300) & (depth < 10_000)))
        assert (depth > 0).any()


@pytest.mark.kinds("light")
class TestLight:
    def test_is_off_after_open_and_after_close(self, bench):
        light = bench.device("light")
        with light:
            off = bench.brightness(bench.clock.now_ns())
            on = bench.brightness(light.set_level(1.0))
            assert on > 2 * off + 5
            light.close()
            assert abs(bench.brightness(bench.clock.now_ns()) - off) < 2
            light.open()
            assert abs(bench.brightness(bench.clock.now_ns()) - off) < 2

    def test_an_exposure_from_the_returned_time_on_has_the_whole_level(self, bench):
        with bench.device("light") as light:
            at_once = bench.brightness(light.set_level(1.0))
            settled = bench.brightness(bench.clock.now_ns() + 100_000_000)
            assert abs(at_once - settled) < 2
            half = bench.brightness(light.set_level(0.5))
            assert 5 < half < settled - 5

    def test_an_exposure_after_off_has_none_of_it(self, bench):
        with bench.device("light") as light:
            never_lit = bench.brightness(bench.clock.now_ns())
            bench.brightness(light.set_level(1.0))
            assert abs(bench.brightness(light.set_level(0.0)) - never_lit) < 2

    def test_the_returned_time_is_not_in_the_past(self, bench):
        with bench.device("light") as light:
            before = bench.clock.now_ns()
            assert light.set_level(0.7) >= before

    def test_its_timing_is_known(self, bench):
        assert bench.device("light").timing in ("software", "hardware")

    @pytest.mark.parametrize("level", [-0.01, 1.01, float("nan"), float("inf")])
    def test_a_level_outside_its_range_is_refused(self, bench, level):
        with bench.device("light") as light, pytest.raises(ValueError, match="0"):
            light.set_level(level)


@pytest.mark.kinds("arm")
class TestArm:
    def test_a_reading_was_taken_during_the_call(self, bench):
        with bench.device("arm") as arm:
            for _ in range(3):
                before = bench.clock.now_ns()
                reading = arm.read_joints(PATIENT_S)
                after = bench.clock.now_ns()
                assert before <= reading.t_ns - reading.t_sd_ns
                assert reading.t_ns + reading.t_sd_ns <= after

    def test_angles_are_six_radians(self, bench):
        with bench.device("arm") as arm:
            q = arm.read_joints(PATIENT_S).q
        assert q.shape == (6,)
        assert np.abs(q).max() <= 2 * np.pi

    def test_an_arm_at_rest_reads_the_same(self, bench):
        with bench.device("arm") as arm:
            first = arm.read_joints(PATIENT_S).q
            bench.clock.sleep(0.05)
            assert np.abs(arm.read_joints(PATIENT_S).q - first).max() < 1e-3

    def test_joints_at_a_time_are_of_that_time(self, bench):
        with bench.device("arm") as arm:
            first = arm.read_joints(PATIENT_S)
            bench.clock.sleep(0.1)
            for t_ns in (first.t_ns + 50_000_000, bench.clock.now_ns() + 5_000_000):
                there = arm.joints_at(t_ns, PATIENT_S)
                assert there.t_ns == t_ns
                assert np.abs(there.q - first.q).max() < 1e-3

    @pytest.mark.trouble("mute")
    def test_a_mute_arm_does_not_know_the_joints_of_now(self, bench):
        with bench.device("arm") as arm:
            arm.read_joints(PATIENT_S)
            bench.fail("arm", "mute")
            bench.clock.sleep(0.1)
            with pytest.raises(DeviceTimeoutError):
                arm.joints_at(bench.clock.now_ns(), WAIT_S)
