"""What every driver must keep (drivers/interfaces.py), one class for each kind of device."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)

KINDS = ("colour", "depth", "light", "arm")
CAMERAS = ("colour", "depth")
WAIT_S = 0.4


def use(bench, kind):
    """One ordinary call of the device."""
    device = bench.device(kind)
    if kind in CAMERAS:
        return device.grab(bench.clock.now_ns(), WAIT_S)
    if kind == "light":
        return device.set_level(0.5)
    return device.read_joints(WAIT_S)


@pytest.mark.parametrize("kind", KINDS)
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

    def test_a_missing_device_is_not_found_and_stays_closed(self, bench, kind):
        bench.fail(kind, "missing")
        with pytest.raises(DeviceNotFoundError):
            bench.device(kind).open()
        assert not bench.device(kind).is_open

    def test_an_unplugged_device_is_lost_and_then_not_found(self, bench, kind):
        with bench.device(kind) as device:
            use(bench, kind)
            bench.fail(kind, "unplugged")
            with pytest.raises(DeviceLostError):
                use(bench, kind)
            device.close()
            with pytest.raises(DeviceNotFoundError):
                device.open()

    def test_a_mute_device_times_out_in_time(self, bench, kind):
        with bench.device(kind):
            bench.fail(kind, "mute")
            before = bench.clock.now_ns()
            with pytest.raises(DeviceTimeoutError):
                use(bench, kind)
            assert (bench.clock.now_ns() - before) / 1e9 < WAIT_S + 0.1

    def test_a_faulty_device_says_so(self, bench, kind):
        with bench.device(kind):
            bench.fail(kind, "faulty")
            with pytest.raises(DeviceFaultError):
                use(bench, kind)


@pytest.mark.parametrize("kind", CAMERAS)
class TestCamera:
    def exposure_begin(self, frame):
        return frame.t_ns - round((frame.exposure_s or 0) * 1e9 / 2)

    def test_the_exposure_began_at_or_after_the_time_asked_for(self, bench, kind):
        with bench.device(kind) as camera:
            for ahead_ms in (0, 1, 20, 33, 70, 150):
                not_before = bench.clock.now_ns() + ahead_ms * 1_000_000
                frame = camera.grab(not_before, 1.0)
                assert self.exposure_begin(frame) >= not_before
                assert frame.t_ns <= bench.clock.now_ns()

    def test_frames_never_age(self, bench, kind):
        with bench.device(kind) as camera:
            camera.grab(bench.clock.now_ns(), 1.0)
            bench.clock.sleep(0.3)
            now = bench.clock.now_ns()
            assert self.exposure_begin(camera.grab(now, 1.0)) >= now

    def test_times_and_sequence_numbers_rise(self, bench, kind):
        with bench.device(kind) as camera:
            frames = [camera.grab(bench.clock.now_ns(), 1.0) for _ in range(4)]
        assert np.all(np.diff([frame.t_ns for frame in frames]) > 0)
        assert np.all(np.diff([frame.sequence for frame in frames]) > 0)

    def test_a_time_far_ahead_is_waited_for(self, bench, kind):
        with bench.device(kind) as camera:
            not_before = bench.clock.now_ns() + 400_000_000
            camera.grab(not_before, 0.2)  # the timeout counts from not_before
            assert bench.clock.now_ns() >= not_before

    def test_too_short_a_timeout_is_a_timeout_error(self, bench, kind):
        with bench.device(kind) as camera, pytest.raises(TimeoutError):
            camera.grab(bench.clock.now_ns(), 0.0005)

    def test_a_frame_comes_after_a_timeout(self, bench, kind):
        with bench.device(kind) as camera:
            with pytest.raises(DeviceTimeoutError):
                camera.grab(bench.clock.now_ns(), 0.0005)
            now = bench.clock.now_ns()
            assert self.exposure_begin(camera.grab(now, 1.0)) >= now


class TestColourCamera:
    def test_images_are_whole_and_cannot_be_written(self, bench):
        with bench.device("colour") as camera:
            first, second = (camera.grab(bench.clock.now_ns(), 1.0).rgb for _ in range(2))
        assert first.shape == second.shape
        assert first.dtype in (np.uint8, np.uint16)
        with pytest.raises(ValueError, match="read-only"):
            first[0, 0, 0] = 1


class TestDepthCamera:
    def test_infrared_comes_only_when_asked_for(self, bench):
        with bench.device("depth") as camera:
            assert camera.grab(bench.clock.now_ns(), 1.0).ir is None
            frame = camera.grab(bench.clock.now_ns(), 1.0, with_ir=True)
        assert frame.ir is not None
        assert frame.ir.shape == frame.depth_mm.shape

    def test_depth_is_millimetres_with_zero_for_no_return(self, bench):
        with bench.device("depth") as camera:
            depth = camera.grab(bench.clock.now_ns(), 1.0).depth_mm
        assert depth.dtype == np.uint16
        assert np.all((depth == 0) | ((depth > 300) & (depth < 10_000)))
        assert (depth > 0).any()


class TestLight:
    def brightness(self, bench, not_before_ns):
        return float(bench.device("colour").grab(not_before_ns, 1.0).rgb.mean())

    def test_is_off_after_open_and_after_close(self, bench):
        light = bench.device("light")
        with bench.device("colour"), light:
            off = self.brightness(bench, bench.clock.now_ns())
            on = self.brightness(bench, light.set_level(1.0))
            assert on > 2 * off + 5
            light.close()
            assert abs(self.brightness(bench, bench.clock.now_ns()) - off) < 2
            light.open()
            assert abs(self.brightness(bench, bench.clock.now_ns()) - off) < 2

    def test_an_exposure_from_the_returned_time_on_has_the_whole_level(self, bench):
        with bench.device("colour"), bench.device("light") as light:
            at_once = self.brightness(bench, light.set_level(1.0))
            settled = self.brightness(bench, bench.clock.now_ns() + 100_000_000)
            assert abs(at_once - settled) < 2
            half = self.brightness(bench, light.set_level(0.5))
            assert 5 < half < settled - 5

    def test_an_exposure_after_off_has_none_of_it(self, bench):
        with bench.device("colour"), bench.device("light") as light:
            never_lit = self.brightness(bench, bench.clock.now_ns())
            self.brightness(bench, light.set_level(1.0))
            assert abs(self.brightness(bench, light.set_level(0.0)) - never_lit) < 2

    def test_the_returned_time_is_not_in_the_past(self, bench):
        with bench.device("light") as light:
            before = bench.clock.now_ns()
            assert light.set_level(0.7) >= before

    @pytest.mark.parametrize("level", [-0.01, 1.01, float("nan"), float("inf")])
    def test_a_level_outside_its_range_is_refused(self, bench, level):
        with bench.device("light") as light, pytest.raises(ValueError, match="0"):
            light.set_level(level)


class TestArm:
    def test_a_reading_was_taken_during_the_call(self, bench):
        with bench.device("arm") as arm:
            for _ in range(3):
                before = bench.clock.now_ns()
                reading = arm.read_joints(0.2)
                after = bench.clock.now_ns()
                assert before <= reading.t_ns - reading.t_sd_ns
                assert reading.t_ns + reading.t_sd_ns <= after

    def test_angles_are_six_radians(self, bench):
        with bench.device("arm") as arm:
            q = arm.read_joints(0.2).q
        assert q.shape == (6,)
        assert np.abs(q).max() <= 2 * np.pi

    def test_an_arm_at_rest_reads_the_same(self, bench):
        with bench.device("arm") as arm:
            first = arm.read_joints(0.2).q
            bench.clock.sleep(0.05)
            assert np.abs(arm.read_joints(0.2).q - first).max() < 1e-3
