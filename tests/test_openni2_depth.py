"""The OpenNI2 depth driver on the real runtime, against a virtual Kinect whose truth is known."""

import os
import signal
import threading
import time
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from openni2_cells import Counting, ended, until, writer

from drivers import depth_openni2
from drivers.clock import SystemClock
from drivers.emulators.virtual_kinect import VirtualKinect
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverUnavailableError,
)
from drivers.openni2 import build, plugins
from drivers.openni2.api import Sensor
from drivers.openni2.device import Device, Image, Stream
from drivers.openni2.errors import PluginMissingError
from drivers.openni2.pairs import Pairing, whole_millimetres
from drivers.openni2.reader import KEPT, Reader
from drivers.openni2.virtual_file import VirtualFile
from surfclass.errors import ConfigurationError, InputError

try:
    plugins.system_folder()
    build.build("virtual")
except PluginMissingError as missing:
    pytest.skip(str(missing), allow_module_level=True)

PATIENT_S = 5.0


def camera(device, isolated=False, **options):
    make = depth_openni2.depth if isolated else depth_openni2.in_process
    options = {"device": getattr(device, "uri", device), "latency_sd_ms": 2.0} | options
    return make(name="depth", clock=SystemClock(), options=options, shared={})


def now_ns():
    return time.monotonic_ns()


@pytest.fixture
def kinect(tmp_path):
    with VirtualKinect(Counting(), tmp_path / "kinect") as made:
        yield made


class TestImages:
    @pytest.mark.parametrize("size", [(1, 1), (33, 17), (640, 480)])
    def test_depth_and_infrared_of_one_exposure_come_bit_by_bit_whatever_the_size(self, tmp_path, size):
        with VirtualKinect(Counting(size), tmp_path / "kinect") as kinect, camera(kinect) as opened:
            for _ in range(3):
                frame = opened.grab(now_ns(), PATIENT_S, with_ir=True)
                depth, ir = Counting(size).depth(0, frame.sequence)
                assert np.array_equal(frame.depth_mm, depth)
                assert np.array_equal(frame.ir, ir)

    def test_tenths_of_a_millimetre_come_back_as_whole_ones(self, kinect):
        with camera(kinect, depth_unit="100um") as opened:
            assert "100 µm" in opened.about()["format"]
            frame = opened.grab(now_ns(), PATIENT_S)
        assert np.array_equal(frame.depth_mm, Counting().depth(0, frame.sequence)[0])

    @given(st.integers(0, 65535))
    def test_tenths_are_rounded_to_the_nearest_millimetre(self, tenths):
        rounded = int(whole_millimetres(np.array([[tenths]], np.uint16), 100)[0, 0])
        assert abs(rounded - tenths / 10) <= 0.5
        assert whole_millimetres(np.array([[tenths]], np.uint16), 1000)[0, 0] == tenths

    def test_a_device_without_infrared_images_asked_for_gives_none(self, kinect):
        with camera(kinect, infrared=False) as opened:
            assert opened.grab(now_ns(), PATIENT_S).ir is None
            with pytest.raises(DeviceFaultError, match="infrared"):
                opened.grab(now_ns(), PATIENT_S, with_ir=True)

    def test_half_written_frames_never_come_out(self, kinect):
        with camera(kinect) as opened:
            opened.grab(now_ns(), PATIENT_S)
            for _ in range(3):
                kinect.tear(0.05, value=4321)
                frame = opened.grab(now_ns(), PATIENT_S, with_ir=True)
                depth, ir = Counting().depth(0, frame.sequence)
                assert np.array_equal(frame.depth_mm, depth)
                assert np.array_equal(frame.ir, ir)

    def test_a_writer_that_never_pauses_tears_no_frame(self, tmp_path):
        file = VirtualFile(tmp_path / "kinect", (320, 240), 1000, (1.0, 0.8), "1")
        file.plug(True, 1)
        ending = threading.Event()

        def write():
            number = 0
            while not ending.is_set():
                number += 1
                image = np.full((240, 320), 1 + number % 1000, np.uint16)
                file.publish(image, image, number * 1000, number)
                time.sleep(0.0002)

        thread = threading.Thread(target=write)
        thread.start()
        try:
            with camera(f"virtual://{tmp_path}/kinect") as opened:
                until_s = time.monotonic() + 1.5
                seen = 0
                while time.monotonic() < until_s:
                    frame = opened.grab(0, PATIENT_S, with_ir=True)
                    assert np.all(frame.depth_mm == 1 + frame.sequence % 1000)
                    assert np.all(frame.ir == 1 + frame.sequence % 1000)
                    seen += 1
            assert seen > 20
        finally:
            ending.set()
            thread.join()
            file.close()


class TestSettings:
    def test_registration_and_mirroring_are_switched_off(self, kinect):
        assert kinect.registration is None
        with camera(kinect) as opened:
            assert kinect.registration == 0
            settings = opened.about()["settings"]
        assert "registration off" in settings
        assert "DEPTH mirroring off" in settings
        assert "IR mirroring off" in settings

    @pytest.mark.parametrize("setting", ["mirroring", "registration"])
    def test_a_setting_that_does_not_take_is_a_fault_and_leaves_the_device_closed(self, tmp_path, setting):
        path = tmp_path / "kinect"
        with VirtualKinect(Counting(), path, **{f"stubborn_{setting}": True}) as stubborn:
            refused = camera(stubborn)
            with pytest.raises(DeviceFaultError, match=f"{setting}.*cannot be switched off"):
                refused.open()
            assert not refused.is_open
        with VirtualKinect(Counting(), path) as kinect, camera(kinect) as opened:
            opened.grab(now_ns(), PATIENT_S)

    def test_it_tells_model_serial_and_the_factorys_field_of_view(self, tmp_path):
        told = {"fov_rad": (1.0, 0.5), "serial": "K-7"}
        with (
            VirtualKinect(Counting(), tmp_path / "k", **told) as kinect,
            camera(kinect, serial="K-7") as opened,
        ):
            about = opened.about()
        assert about["serial"] == "K-7"
        assert about["model"] == "surfclass Virtual Kinect"
        assert about["library"].startswith("OpenNI2 2.")
        assert "57.30° × 28.65°" in about["format"]
        assert "64 × 48 at 30 Hz" in about["format"]

    def test_another_serial_number_is_another_camera(self, kinect):
        with pytest.raises(DeviceNotFoundError, match="VIRTUAL-1"):
            camera(kinect, serial="K-8").open()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"uri": "any"}, "uri: unknown key"),
            ({"device": "any", "file_path": "a.oni", "serial": "1"}, "file_path goes without"),
            ({"drivers": []}, "drivers is empty"),
            ({"drivers": ["Kinect"]}, "drivers"),
            ({"depth_unit": "1cm"}, "depth_unit"),
            ({"latency_ms": -1.0}, "latency_ms"),
            ({"frame_timeout_s": 0.0}, "frame_timeout_s"),
            ({"exposure_ms": 0.0}, "exposure_ms"),
        ],
    )
    def test_options_are_checked_before_anything_is_opened(self, options, message):
        for make in (depth_openni2.depth, depth_openni2.in_process):
            with pytest.raises(ConfigurationError, match=message):
                make(name="depth", clock=SystemClock(), options=options, shared={})

    def test_a_plugin_that_is_not_built_is_unavailable_and_says_what_to_run(self, tmp_path, monkeypatch):
        monkeypatch.setattr(plugins, "build_folder", lambda: tmp_path)
        with pytest.raises(DriverUnavailableError, match=r"python -m drivers\.openni2\.build"):
            camera("virtual:///nowhere").open()

    @pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
    def test_a_timeout_that_is_none_is_refused(self, kinect, timeout_s):
        with camera(kinect) as opened, pytest.raises(InputError, match="above 0"):
            opened.grab(now_ns(), timeout_s)


class TestTime:
    def test_the_true_exposure_lies_within_what_is_said_of_it(self, tmp_path):
        clock = {"drift_ppm": 150.0, "offset_us": 987_654_321, "latency_s": 0.03}
        with VirtualKinect(Counting(), tmp_path / "kinect", **clock) as kinect:
            with camera(kinect, latency_ms=30.0) as opened:
                frames = [opened.grab(now_ns(), PATIENT_S) for _ in range(15)]
            truths = {truth.index: truth.t_ns for truth in kinect.exposures()}
        for frame in frames:
            assert abs(frame.t_ns - truths[frame.sequence]) <= frame.t_sd_ns + 100_000

    def test_an_exposure_time_that_is_known_is_told_and_counted(self, kinect):
        with camera(kinect, exposure_ms=4.0) as opened:
            asked_ns = now_ns()
            frame = opened.grab(asked_ns, PATIENT_S)
        assert frame.exposure_s == 0.004
        assert frame.t_ns - 2_000_000 - frame.t_sd_ns >= asked_ns

    @pytest.mark.parametrize("by_us", [-500_000, 3_000_000])
    def test_after_the_devices_clock_has_jumped_no_frame_is_stamped_by_the_old_one(self, kinect, by_us):
        with camera(kinect) as opened:
            for _ in range(8):
                opened.grab(now_ns(), PATIENT_S)
            kinect.jump_clock(by_us)
            for _ in range(4):
                asked_ns = now_ns()
                frame = opened.grab(asked_ns, PATIENT_S)
                truths = {truth.index: truth.t_ns for truth in kinect.exposures()}
                assert abs(frame.t_ns - truths[frame.sequence]) <= frame.t_sd_ns + 100_000
            assert "1 jumps" in opened.about()["clock"]

    def test_a_clock_that_stands_still_is_a_timeout_until_it_goes_on(self, kinect):
        with camera(kinect, frame_timeout_s=0.3) as opened:
            opened.grab(now_ns(), PATIENT_S)
            kinect.freeze_clock(True)
            time.sleep(0.5)
            with pytest.raises(DeviceTimeoutError, match="stamps repeated"):
                opened.grab(now_ns(), 0.3)
            with pytest.raises(DeviceTimeoutError, match="stamps repeated"):
                opened.check()
            kinect.freeze_clock(False)
            opened.grab(now_ns(), PATIENT_S)
            opened.check()

    def test_only_the_newest_exposures_are_kept(self, kinect):
        with camera(kinect) as opened:
            opened.grab(now_ns(), PATIENT_S)
            time.sleep(0.5)
            frame = opened.grab(0, PATIENT_S)
            assert kinect.exposures()[-1].index - frame.sequence <= KEPT + 15  # and what comes meanwhile
            assert now_ns() - frame.t_ns < 0.45e9

    @given(st.lists(st.tuples(st.booleans(), st.integers(0, 40)), max_size=40))
    def test_only_images_of_one_time_are_paired(self, arrivals):
        pairing = Pairing(True, tolerance_us=2)
        given_images = 0
        pairs = []
        for is_depth, stamp in arrivals:
            given_images += 1
            image = Image(stamp, given_images, given_images, np.zeros((1, 1), np.uint16))
            pair = pairing.add(Sensor.DEPTH if is_depth else Sensor.IR, image)
            if pair is not None:
                pairs.append((pair, stamp))
        for pair, stamp in pairs:
            assert abs(pair.timestamp_us - stamp) <= 2
        assert 2 * len(pairs) + pairing.dropped <= given_images <= 2 * len(pairs) + pairing.dropped + 1


class TestLoss:
    def test_a_writer_that_is_killed_is_lost_and_one_that_starts_again_is_found(self, tmp_path):
        path = tmp_path / "kinect"
        process = writer(path)
        opened = camera(f"virtual://{path}")
        try:
            with opened:
                opened.grab(now_ns(), PATIENT_S)
                process.kill()
                killed_s = time.monotonic()
                with pytest.raises(DeviceLostError):
                    until(lambda: opened.check() is not None)
                assert time.monotonic() - killed_s < 2.0
                with pytest.raises(DeviceLostError):
                    opened.grab(now_ns(), 1.0)
                opened.close()
                with pytest.raises(DeviceNotFoundError):
                    opened.open()
            ended(process)
            process = writer(path)
            with opened:
                asked_ns = now_ns()
                assert opened.grab(asked_ns, PATIENT_S).t_ns >= asked_ns
        finally:
            ended(process)

    def test_one_that_was_unplugged_for_a_moment_is_lost_too(self, kinect):
        with camera(kinect) as opened:
            opened.grab(now_ns(), PATIENT_S)
            kinect.unplug()
            kinect.plug()
            with pytest.raises(DeviceLostError):
                until(lambda: opened.check() is not None)

    def test_nothing_from_before_a_loss_comes_after_it(self, kinect):
        opened = camera(kinect)
        with opened:
            opened.grab(now_ns(), PATIENT_S)
            time.sleep(0.2)
            kinect.unplug()
            with pytest.raises(DeviceLostError):
                opened.grab(now_ns(), 5.0)
            with pytest.raises(DeviceLostError):
                opened.grab(0, 5.0)
        kinect.plug()
        last = kinect.exposures()[-1].index
        with opened:
            assert opened.grab(0, PATIENT_S).sequence > last

    def test_a_wait_ends_as_soon_as_the_device_is_gone(self, kinect):
        with camera(kinect) as opened:
            kinect.mute(True)
            threading.Timer(0.2, kinect.unplug).start()
            began_s = time.monotonic()
            with pytest.raises(DeviceLostError):
                opened.grab(now_ns(), 20.0)
            assert time.monotonic() - began_s < 5.0

    @pytest.mark.parametrize(
        "step",
        [(Device, "create"), (Stream, "start"), (Reader, "start"), (Stream, "fetch"), (Stream, "stop")],
    )
    def test_unplugging_at_any_step_is_an_error_of_the_driver_and_no_crash(self, kinect, monkeypatch, step):
        owner, name = step
        original = getattr(owner, name)

        def pull(self, *arguments):
            kinect.unplug()
            time.sleep(0.25)  # until the plug-in has noticed
            return original(self, *arguments)

        opened = camera(kinect)
        monkeypatch.setattr(owner, name, pull)
        with suppress(DeviceLostError, DeviceNotFoundError), opened:
            opened.grab(now_ns(), 1.0)
        assert not opened.is_open
        monkeypatch.undo()
        kinect.plug()
        with opened:
            opened.grab(now_ns(), PATIENT_S)

    def test_killing_its_process_is_a_loss_and_opening_again_mends_it(self, kinect):
        opened = camera(kinect, isolated=True)
        with opened:
            opened.grab(now_ns(), PATIENT_S)
            os.kill(opened.pid, signal.SIGKILL)
            killed_s = time.monotonic()
            with pytest.raises(DeviceLostError):
                opened.grab(now_ns(), PATIENT_S)
            assert time.monotonic() - killed_s < 2.0
            opened.open()
            assert opened.grab(now_ns(), PATIENT_S).sequence > 0

    def test_opening_and_closing_a_hundred_times_while_the_cable_is_loose_never_hangs(self, kinect):
        ending = threading.Event()

        def shake():
            moves = np.random.default_rng(1)
            while not ending.wait(moves.uniform(0, 0.15)):
                kinect.unplug()
                ending.wait(moves.uniform(0, 0.15))
                kinect.plug()

        thread = threading.Thread(target=shake)
        thread.start()
        frames = 0
        opened = camera(kinect, exposure_ms=1.0)
        try:
            for _ in range(100):
                with suppress(DeviceLostError, DeviceNotFoundError), opened:
                    opened.grab(now_ns(), 0.5)
                    frames += 1
        finally:
            ending.set()
            thread.join()
        assert frames > 0
        with opened:
            opened.grab(now_ns(), PATIENT_S)
