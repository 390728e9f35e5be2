"""The Aravis driver when things go wrong: the camera's process killed, frozen, reset, and its wire bad."""

from __future__ import annotations

import os
import re
import signal
import threading
import time

import gige_process
import numpy as np
import pytest

from drivers.aravis.library import Found, Library
from drivers.clock import SystemClock
from drivers.colour_aravis import colour, in_process
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from surfclass.errors import ConfigurationError, InputError

pytestmark = pytest.mark.skipif(bool(gige_process.missing()), reason=gige_process.missing() or "it is here")

LOST_S = 4.0  # silence_s is 1 s; the rest is for other processes


@pytest.fixture
def process():
    shared = gige_process.shared()
    shared.as_new()
    yield shared
    shared.thaw()


def make(factory=in_process, **options):
    options = {"address": gige_process.ADDRESS, "exposure_us": 2000.0, "region": (0, 0, 32, 24), **options}
    return factory(name="colour", clock=SystemClock(), options=options, shared={})


def grab(camera, timeout_s=3.0):
    return camera.grab(time.monotonic_ns(), timeout_s)


def lost_within(call):
    """The error with which `call`, over and over, ends, and the seconds until then."""
    start = time.monotonic()
    while time.monotonic() < start + LOST_S:
        try:
            call()
        except DeviceTimeoutError:
            continue
        except DriverError as error:
            return error, time.monotonic() - start
        time.sleep(0.02)
    raise AssertionError("nothing was noticed")


def test_killed_between_two_frames_it_is_lost_and_resumes_with_frames_of_its_new_life(process):
    with make() as camera:
        grab(camera)
        killed_ns = time.monotonic_ns()
        process.kill()
        error, _ = lost_within(camera.check)
        assert isinstance(error, DeviceLostError)
        with pytest.raises(DeviceLostError):
            grab(camera, 0.2)
        camera.close()
        process.start()
        back_ns = time.monotonic_ns()
        camera.open()
        frame = grab(camera)
        assert (time.monotonic_ns() - back_ns) / 1e9 < 5
        assert frame.t_ns - frame.t_sd_ns > killed_ns


def test_killed_during_a_grab_it_is_lost_before_the_grab_is_over(process):
    with make(exposure_us=1_000_000.0) as camera:
        killer = threading.Timer(0.2, process.kill)
        killer.start()
        start = time.monotonic()
        with pytest.raises(DeviceLostError, match="not answered"):
            grab(camera, 10.0)
        assert time.monotonic() - start < LOST_S
        killer.join()


def test_a_camera_that_hangs_is_lost_too_and_can_be_opened_when_it_goes_on(process):
    with make() as camera:
        grab(camera)
        process.freeze()
        error, _ = lost_within(lambda: grab(camera, 0.3))
        assert isinstance(error, DeviceLostError)
        start = time.monotonic()
        camera.close()
        assert time.monotonic() - start < 1.5
        process.thaw()
        until = time.monotonic() + 15  # it holds on to its old controller until its heartbeat is due
        while not camera.is_open:
            try:
                camera.open()
            except DeviceNotFoundError:
                assert time.monotonic() < until
        grab(camera)


def test_a_camera_that_was_reset_behind_our_back_is_lost(process):
    with make() as camera:
        process.tell("power_cycle")
        error, _ = lost_within(camera.check)
        assert isinstance(error, DeviceLostError)
        assert "was reset: ExposureTime reads 5000" in str(error)


def test_lost_packets_cost_frames_but_no_frame_has_holes(process):
    with make(region=(0, 0, 64, 48), pixel_format="BayerRG16", packet_bytes=576) as camera:
        whole = grab(camera).rgb
        process.tell("lose 0.05")
        status, taken = "", 0
        while taken < 4 or (" 0 incomplete" in status and taken < 100):
            rgb = grab(camera, 20.0).rgb
            assert np.abs(rgb.astype(int).mean() - whole.astype(int).mean()) < 0.2 * whole.mean()
            assert (rgb.reshape(48, -1).max(axis=1) > 0).all()
            status, taken = camera.about()["status"], taken + 1
    assert re.fullmatch(r"\d+ frames, [1-9]\d* incomplete, 0 missing", status), status


def test_frames_of_another_size_are_a_fault(process):
    with make() as camera:
        process.tell("shrink")
        with pytest.raises(DeviceFaultError, match="32 × 12 pixels, 32 × 24 were set up"):
            grab(camera)


def test_a_device_clock_that_stands_still_is_a_fault(process):
    with make() as camera:
        process.tell("freeze")
        error, _ = lost_within(lambda: grab(camera))
        assert isinstance(error, DeviceFaultError)
        assert "clock stands still" in str(error)


@pytest.mark.parametrize("ahead_s", [-3, 1000])
def test_a_device_clock_that_was_set_changes_no_time(process, ahead_s):
    with make() as camera:
        for _ in range(8):  # before that a clock is not known well enough to be called another
            grab(camera)
        process.tell(f"clock {ahead_s}")
        for _ in range(3):
            asked_ns = time.monotonic_ns()
            frame = camera.grab(asked_ns, 3.0)
            assert frame.t_ns - frame.t_sd_ns - 1_000_000 + 1 >= asked_ns
            assert frame.t_ns + frame.t_sd_ns < time.monotonic_ns() + 1
        assert "1 jumps" in camera.about()["clock"]


def test_after_a_frame_that_came_too_late_the_next_one_is_a_new_one(process):
    with make(exposure_us=300_000.0) as camera:
        with pytest.raises(DeviceTimeoutError):
            grab(camera, 0.05)
        asked_ns = time.monotonic_ns()
        frame = camera.grab(asked_ns, 5.0)
        assert frame.t_ns - frame.t_sd_ns - 150_000_000 + 1 >= asked_ns


def test_sequence_numbers_rise_over_the_end_of_the_device_counter(process):
    with make(region=(0, 0, 8, 8)) as camera:  # Aravis's emulator begins at 65400
        numbers = [grab(camera).sequence for _ in range(150)]
        assert "0 missing" in camera.about()["status"]
    assert np.array_equal(np.diff(numbers), np.ones(149))


def test_a_camera_that_another_application_controls_is_not_found(process):
    with make():
        other = make()
        with pytest.raises(DeviceNotFoundError, match="another application controls it"):
            other.open()
        assert not other.is_open


def test_a_camera_is_found_by_its_serial_number(process):
    with make(address=None, serial=gige_process.SERIAL) as camera:
        assert camera.about()["serial"] == gige_process.SERIAL
        assert camera.about()["model"] == "surfclass SimulatedCamera"
    with pytest.raises(DeviceNotFoundError, match=rf"number X1 .*SimulatedCamera {gige_process.SERIAL} at"):
        make(address=None, serial="X1").open()
    with pytest.raises(DeviceNotFoundError, match=f"has serial number {gige_process.SERIAL}, not X1"):
        make(serial="X1").open()


@pytest.mark.parametrize("cameras", [0, 1, 2])
def test_without_a_name_the_only_camera_is_meant(monkeypatch, process, cameras):
    where = [Found(gige_process.ADDRESS, f"S{n}", "Model", f"10.0.0.{n}") for n in range(cameras)]
    monkeypatch.setattr(Library, "search", lambda _: where)
    camera = make(address=None)
    if cameras == 1:
        camera.open()
        camera.close()
    else:
        message = (
            "no camera answers .found: no camera" if cameras == 0 else r"Model S0 at 10\.0\.0\.0, Model S1 at"
        )
        with pytest.raises(DeviceNotFoundError, match=message):
            camera.open()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exposure_us": 1e12}, r"exposure_us 1e\+12, this camera allows 29 to 3e\+07"),
        ({"exposure_us": 10.0}, "exposure_us 10, this camera allows 29"),
        ({"gain_db": 60.0}, "gain_db 60, this camera allows 0 to 48"),
        ({"region": (0, 0, 68, 24)}, "region 0, 0, 68, 24 leaves the 64 × 48 pixels of this camera"),
        ({"region": (0, 0, 30, 24)}, "region: Width 30, this camera takes multiples of 4"),
        ({"region": (3, 0, 32, 24)}, "region: OffsetX 3, this camera takes multiples of 2"),
        ({"region": (48, 0, 32, 24)}, "region 48, 0, 32, 24 leaves the 64 × 48"),
        ({"region": (0, 0, 0, 24)}, "region: Width 0, this camera allows 4 to 64"),
        ({"pixel_format": "Mono8"}, "'Mono8' is no colour format .* BayerRG8, BayerRG10"),
        ({"pixel_format": "BayerGB8"}, "pixel_format 'BayerGB8', this camera has Mono8, BayerRG8"),
        ({"trigger": "Line9"}, "trigger 'Line9', this camera has Line0, Software"),
        ({"strobe_lines": ["Line7"]}, "strobe_lines 'Line7', this camera has Line0"),
        ({"strobe_lines": ["Line2"], "strobe_source": "Sun"}, "strobe_source 'Sun', this camera has Off"),
        ({"balance_red": 20.0}, "balance of Red 20, this camera allows 0.25 to 8"),
        ({"trigger": "free", "rate_hz": 900.0}, "rate_hz 900, this camera allows 0.1 to 60"),
    ],
)
def test_what_the_camera_cannot_do_is_said_with_what_it_can(process, options, message):
    camera = make(**options)
    with pytest.raises(ConfigurationError, match=message):
        camera.open()
    assert not camera.is_open


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exposure": 5.0}, "did you mean 'exposure_us'"),
        ({"exposure_us": 0.0}, "exposure_us"),
        ({"trigger": "sometimes"}, "trigger"),
        ({"region": (0, 0, 32)}, "region"),
        ({"stamp_at": "noon"}, "exposure_start"),
        ({"packet_bytes": 100}, "packet_bytes"),
    ],
)
@pytest.mark.parametrize("factory", [in_process, colour])
def test_options_that_mean_nothing_are_refused_before_any_camera_is_asked(factory, options, message):
    with pytest.raises(ConfigurationError, match=message):
        make(factory, **options)


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_timeout_that_is_none_is_refused(timeout_s):
    with pytest.raises(InputError, match="timeout"):
        make().grab(0, timeout_s)


@pytest.mark.parametrize(
    ("module", "package"), [("gi", "surfclass\\[aravis\\]"), ("gi.repository.Aravis", "gir1.2-aravis-0.8")]
)
def test_a_missing_library_is_named(monkeypatch, module, package):
    import importlib

    real = importlib.import_module

    def without(name, *more):
        if name == module:
            error = ModuleNotFoundError if name == "gi" else ImportError
            raise error(f"no {name}")
        return real(name, *more)

    monkeypatch.setattr(importlib, "import_module", without)
    camera = make()
    with pytest.raises(DriverUnavailableError, match=package):
        camera.open()
    assert not camera.is_open


@pytest.mark.slow
def test_killing_the_driver_process_is_a_lost_device_and_no_more(process):
    with make(colour) as camera:
        grab(camera)
        os.kill(camera.pid, signal.SIGKILL)
        error, _ = lost_within(lambda: grab(camera, 0.3))
        assert isinstance(error, DeviceLostError)
        until = time.monotonic() + 15  # the camera waits for its old controller's heartbeat
        camera.close()
        while not camera.is_open:
            try:
                camera.open()
            except DeviceNotFoundError:
                assert time.monotonic() < until
        grab(camera)
