"""Changing a camera's exposure where the contract's benches cannot look: V4L2, and across processes."""

import errno
import time
from pathlib import Path

import numpy as np
import pytest
from v4l2_fake import AUTO_EXPOSURE, EXPOSURE, MS, FakeCamera, FakeClock, picture

from drivers.bayer import demosaic
from drivers.colour_v4l2 import V4l2ColourCamera
from drivers.errors import DeviceFaultError, DeviceLostError
from drivers.exposure import check_exposure
from drivers.interfaces import exposure_control
from drivers.isolation.camera import IsolatedCamera
from drivers.isolation.colour import IsolatedColourCamera
from drivers.v4l2.options import V4l2Options
from surfclass.errors import InputError
from surfclass.schema import validate

HERE = Path(__file__).parent
V4L2 = {"device_path": "/dev/video9", "width": 4, "height": 2, "pixel_format": "RGGB", "exposure_us": 10_000}


def v4l2(fake, **options):
    return V4l2ColourCamera("colour", fake.clock, validate(V4l2Options, V4L2 | options, "colour"), fake.open)


def began(fake, frame):
    """When the exposure of a frame really began, by what it shows."""
    for number, begin_ns in fake.begins.items():
        mosaic = np.frombuffer(picture(number, 4, 2), np.uint8).reshape(2, 4)
        if np.array_equal(frame.rgb, demosaic(mosaic, "RGGB", 8)):
            return begin_ns
    raise AssertionError("no such frame")


@pytest.fixture
def fake():
    return FakeCamera(FakeClock())


class TestV4l2:
    @pytest.mark.parametrize("at_start", [False, True])
    def test_frames_after_a_change_began_after_it_whatever_time_is_asked_for(self, fake, at_start):
        fake.at_start = at_start
        with v4l2(fake) as camera:
            start_ns = fake.clock.ns
            sequence = camera.grab(start_ns, 1.0).sequence
            for wanted_s, took_s in ((0.02, 0.02), (0.00313, 0.0031), (0.015, 0.015)):
                fake.clock.sleep(0.2)  # the buffers are full of frames of before
                set_ns = fake.clock.ns
                assert camera.set_exposure(wanted_s) == pytest.approx(took_s)
                frame = camera.grab(start_ns, 1.0)
                assert began(fake, frame) >= set_ns
                assert frame.exposure_s == pytest.approx(took_s)
                assert fake.values[EXPOSURE] == round(took_s * 1e4)
                assert frame.sequence > sequence
                sequence = frame.sequence
            assert not camera._stream.node.taken
            assert "missing" not in camera.about()["status"]

    def test_no_exposure_is_longer_than_a_frames_period(self, fake):
        with v4l2(fake) as camera:
            assert camera.exposure_range_s() == pytest.approx((1e-4, 0.030))
            assert exposure_control(camera) is camera

    def test_a_camera_that_does_not_tell_its_exposure_has_no_control_of_it(self):
        fake = FakeCamera(FakeClock(), tells_exposure=False)
        with v4l2(fake, exposure_us=None) as camera:
            assert camera.exposure_range_s() == (0, 0)
            assert exposure_control(camera) is None
            with pytest.raises(InputError, match="cannot be changed"):
                camera.set_exposure(0.01)

    def test_a_camera_whose_exposure_stays_automatic_has_no_control_of_it(self, fake):
        fake.controls = [control for control in fake.controls if control.id != AUTO_EXPOSURE]
        with v4l2(fake, exposure_us=None) as camera:
            assert camera.exposure_range_s() == pytest.approx((0.01, 0.01))
            assert exposure_control(camera) is None

    def test_another_value_than_was_set_is_a_fault(self, fake):
        with v4l2(fake) as camera:
            fake.rounds = lambda control, value: value + (control.id == EXPOSURE)
            with pytest.raises(DeviceFaultError, match=r"is 201, it was set to 200"):
                camera.set_exposure(0.02)

    @pytest.mark.parametrize("step", ["stop", "write", "read", "resume"])
    def test_a_camera_that_goes_away_meanwhile_is_lost(self, fake, step):
        with v4l2(fake) as camera:
            fake.fail = {step: errno.ENODEV}
            with pytest.raises(DeviceLostError, match="setting its exposure"):
                camera.set_exposure(0.02)
            fake.fail = {}


def isolated(factory="exposing", kind=IsolatedColourCamera, **options):
    return kind(
        f"isolated_doubles:{factory}",
        name="colour",
        options={"kind": "colour", **options},
        environment={"PYTHONPATH": str(HERE)},
        open_timeout_s=20.0,
    )


class TestIsolated:
    def test_range_and_value_come_from_the_driver(self):
        with isolated(took=0.0123) as camera:
            assert exposure_control(camera) is camera
            assert camera.exposure_range_s() == (0.001, 0.1)
            assert camera.set_exposure(0.0125) == 0.0123

    def test_a_driver_without_control_has_none_here_either(self):
        with isolated("camera") as camera:
            assert exposure_control(camera) is None
            with pytest.raises(DeviceLostError, match="defect in its driver's set_exposure"):
                camera.set_exposure(0.01)
        with isolated(kind=IsolatedCamera) as camera:
            assert exposure_control(camera) is None

    def test_the_drivers_refusal_comes_through_and_the_camera_stays(self):
        refusal = "raise InputError colour: exposure 500 ms, the camera allows 1 to 100 ms"
        with isolated(deeds={"set_exposure": refusal}) as camera:
            with pytest.raises(InputError, match="allows 1 to 100 ms"):
                camera.set_exposure(0.5)
            assert camera.is_open
            camera.check()

    @pytest.mark.parametrize("exposure_s", [0.0, -1.0, float("nan"), float("inf")])
    def test_what_is_no_exposure_does_not_travel(self, exposure_s):
        with isolated() as camera, pytest.raises(InputError, match="allowed is above 0"):
            camera.set_exposure(exposure_s)

    @pytest.mark.parametrize("nonsense", [[0.1], [0.1, "1"], "long", None, [-1, 2], [0, True, 1]])
    def test_a_range_that_is_none_loses_the_camera(self, nonsense):
        with isolated(range_s=nonsense) as camera, pytest.raises(DeviceLostError, match="no range"):
            camera.exposure_range_s()

    @pytest.mark.parametrize("nonsense", [0, -1, "1", None])
    def test_a_value_that_is_none_loses_the_camera(self, nonsense):
        with isolated(took=nonsense) as camera, pytest.raises(DeviceLostError, match="no exposure time"):
            camera.set_exposure(0.01)

    def test_a_driver_that_hangs_is_lost_in_time(self, monkeypatch):
        monkeypatch.setattr("drivers.isolation.colour._SET_S", 0.5)
        with isolated(deeds={"set_exposure": "hang"}) as camera:
            start = time.monotonic()
            with pytest.raises(DeviceLostError, match="hung in set_exposure"):
                camera.set_exposure(0.01)
            assert time.monotonic() - start < 3


@pytest.mark.parametrize("exposure_s", [0.0009, 0.11, float("nan")])
def test_an_exposure_outside_the_range_is_refused_with_the_range(exposure_s):
    with pytest.raises(ValueError, match="the camera allows 1 to 100 ms"):
        check_exposure("colour", exposure_s, (0.001, 0.1))


def test_a_period_of_frames_leaves_room_for_the_longest_exposure(fake):
    fake.period_ns, fake.rate_hz = 8 * MS, 125.0
    with v4l2(fake, exposure_us=5000) as camera:
        low_s, high_s = camera.exposure_range_s()
        assert camera.set_exposure(high_s) == pytest.approx(0.008)
        with pytest.raises(InputError):
            camera.set_exposure(high_s + low_s)
