"""The IIDC driver on Debian's libdc1394, with a camera behind a socket that stands in for USB."""

import ctypes.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from firefly_socket import FireflySocket, build_libusb

from drivers.bayer import demosaic
from drivers.clock import SystemClock
from drivers.colour_iidc import colour
from drivers.emulators.firefly_registers import GAIN, GAMMA, SHUTTER, WHITE_BALANCE
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceTimeoutError
from drivers.isolation.colour import IsolatedColourCamera
from surfclass.errors import ConfigurationError

WAIT_S = 5.0  # for a frame that comes, on a busy computer
SMALL = {"mode": "format7_0", "region_px": [64, 32, 320, 240], "exposure_us": 5000.0, "gain_db": 3.0}

pytestmark = [
    pytest.mark.skipif(
        shutil.which("gcc") is None or not Path("/usr/include/libusb-1.0/libusb.h").exists(),
        reason="needs gcc and libusb-1.0-0-dev, to compile the stand-in for USB",
    ),
    pytest.mark.skipif(ctypes.util.find_library("dc1394") is None, reason="needs libdc1394-25"),
]


@pytest.fixture(scope="module")
def libusb(tmp_path_factory):
    return build_libusb(tmp_path_factory.mktemp("libusb"))


@pytest.fixture
def rig(libusb, tmp_path):
    """`rig(options, …)` gives a plugged-in camera and its driver, closed."""
    made = []

    def make(options=SMALL, environment=None, **firefly):
        usb = FireflySocket(tmp_path / f"usb{len(made)}", **firefly)
        usb.plug()
        places = {"LD_LIBRARY_PATH": str(libusb), "IIDC_USB_SOCKET": str(usb.path)}
        camera = IsolatedColourCamera(
            "drivers.colour_iidc:in_process",
            name="colour",
            options=options,
            environment={**places, **(environment or {})},
        )
        made.append((usb, camera))
        return usb, camera

    yield make
    for usb, camera in made:
        camera.close()
        usb.unplug()
        usb.camera.stop()


# Opens cameras one after the other in one process, which is quicker than one for each.
OPENER = """
import json, sys
from drivers.clock import SystemClock
from drivers.colour_iidc import in_process
for line in sys.stdin:
    camera = in_process(name="colour", clock=SystemClock(), options=json.loads(line), shared={})
    try:
        with camera:
            told = {"rgb": int(camera.grab(0, 5.0).rgb.max()), **camera.about()}
    except Exception as error:
        told = {"error": type(error).__name__, "text": str(error)}
    print(json.dumps({**told, "open": camera.is_open}), flush=True)
"""


class Opener:
    """`open(options)` says what a camera told, or how opening it or its first frame failed."""

    def __init__(self, libusb, path):
        self._path = path
        places = {"LD_LIBRARY_PATH": str(libusb), "IIDC_USB_SOCKET": str(path)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", OPENER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **places},
        )

    def camera(self, **firefly):
        return FireflySocket(self._path, **firefly)

    def open(self, options):
        self._process.stdin.write(json.dumps(options) + "\n")
        self._process.stdin.flush()
        told = json.loads(self._process.stdout.readline())
        assert not told.pop("open")
        return told

    def end(self):
        self._process.stdin.close()
        assert self._process.wait(20) == 0
        self._process.stdout.close()


@pytest.fixture(scope="module")
def opener(libusb, tmp_path_factory):
    made = Opener(libusb, tmp_path_factory.mktemp("opener") / "usb")
    yield made
    made.end()


def until_it_fails(call):
    for _ in range(200):
        call()
        time.sleep(0.02)


def now_ns():
    return time.monotonic_ns()


def shot_of(frame, usb):
    """The exposure that a frame shows, by the number in its first four pixels."""
    places = ((0, 0), (0, 1), (1, 0), (1, 1))
    low = [frame.rgb[*place, "RGB".index(c)] for place, c in zip(places, usb.camera.pattern, strict=True)]
    key = int.from_bytes(bytes(int(value) & 0xFF for value in low), "big")
    (shot,) = [shot for shot in usb.camera.shots if shot.key == key]
    return shot


def times_hold(frame, usb):
    shot = shot_of(frame, usb)
    middle = (shot.begin_ns + shot.end_ns) / 2
    return abs(frame.t_ns - middle) <= frame.t_sd_ns + 1000


def status(camera):
    return camera.about()["status"]


def only(options):
    """Without those that are None."""
    return {key: value for key, value in options.items() if value is not None}


class TestImages:
    @pytest.mark.parametrize(
        ("options", "pattern", "bits"),
        [
            ({"exposure_us": 4000.0, "gain_db": 1.5}, "GRBG", 8),
            (SMALL, "RGGB", 8),
            ({**SMALL, "coding": "raw16"}, "BGGR", 16),
        ],
        ids=["1280x960 mono8", "region raw8", "region raw16"],
    )
    def test_are_what_the_camera_saw_bit_for_bit(self, rig, options, pattern, bits):
        usb, camera = rig(options, pattern=pattern)
        with camera:
            frame = camera.grab(now_ns(), WAIT_S)
        shape = (960, 1280) if "mode" not in options else (240, 320)
        kind = np.uint8 if bits == 8 else np.dtype(">u2")
        raw = np.frombuffer(usb.camera.image(shot_of(frame, usb)), kind).reshape(shape)
        expected = demosaic(raw.astype(kind.newbyteorder("=") if bits == 16 else kind), pattern, bits)
        assert np.array_equal(frame.rgb, expected)
        assert frame.rgb.std() > 5
        assert frame.exposure_s == pytest.approx(options["exposure_us"] / 1e6, rel=0.02)
        assert frame.gain_db == pytest.approx(options["gain_db"], abs=0.05)

    def test_are_linear_in_the_exposure_with_everything_automatic_off(self, rig):
        means = []
        for exposure_us in (2000.0, 4000.0):
            usb, camera = rig({**SMALL, "exposure_us": exposure_us})
            features = usb.camera.registers.features
            assert all(features[n].on for n in (WHITE_BALANCE, GAMMA))
            assert all(features[n].auto for n in (SHUTTER, GAIN))
            with camera:
                means.append(float(camera.grab(now_ns(), WAIT_S).rgb.mean()))
                assert not any(features[n].on for n in (WHITE_BALANCE, GAMMA, 1, 2))
                assert not any(feature.auto and feature.on for feature in features.values())
        assert means[1] / means[0] == pytest.approx(2, rel=0.1)

    def test_that_come_damaged_are_triggered_again_and_counted(self, rig):
        usb, camera = rig()
        with camera:
            camera.grab(now_ns(), WAIT_S)
            usb.camera.faults.short = 2
            asked_ns = now_ns()
            frame = camera.grab(asked_ns, WAIT_S)
            assert shot_of(frame, usb).begin_ns >= asked_ns
            assert "4 frames, 2 corrupt" in status(camera)
            usb.camera.faults.short = 1_000_000
            with pytest.raises(DeviceTimeoutError, match="damaged"):
                camera.grab(now_ns(), 1.0)
            usb.camera.faults.short = 0
            assert camera.grab(now_ns(), WAIT_S).rgb.shape == (240, 320, 3)

    def test_of_a_trigger_that_was_given_up_are_not_taken_for_the_next(self, rig):
        usb, camera = rig()
        with camera:
            camera.grab(now_ns(), WAIT_S)
            usb.camera.faults.delay_s = 0.5
            with pytest.raises(DeviceTimeoutError):
                camera.grab(now_ns(), 0.1)
            usb.camera.faults.delay_s = 0.0
            asked_ns = now_ns()
            frame = camera.grab(asked_ns, WAIT_S)
            assert shot_of(frame, usb).begin_ns >= asked_ns
            assert "1 too late" in status(camera)

    def test_that_got_lost_are_triggered_again_and_counted(self, rig):
        usb, camera = rig({**SMALL, "late_s": 0.2})
        with camera:
            usb.camera.faults.mute = True
            threading.Timer(0.3, setattr, (usb.camera.faults, "mute", False)).start()
            asked_ns = now_ns()
            frame = camera.grab(asked_ns, 30.0)
            assert shot_of(frame, usb).begin_ns >= asked_ns
            assert times_hold(frame, usb)
            assert re.search(r"[1-9] missing", status(camera))

    def test_that_nobody_asked_for_are_not_taken(self, rig):
        usb, camera = rig()
        with camera:
            camera.grab(now_ns(), WAIT_S)
            usb.camera.faults.extra = 3
            usb.camera.write(0xF0F0061C, 0)  # wakes it
            until = time.monotonic() + 10
            while usb.camera.faults.extra and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(0.2)
            asked_ns = now_ns()
            assert shot_of(camera.grab(asked_ns, WAIT_S), usb).begin_ns >= asked_ns
            assert re.search(r"[1-3] not asked for", status(camera))


class TestTimes:
    def test_of_software_triggers_hold(self, rig):
        usb, camera = rig()
        with camera:
            for _ in range(5):
                asked_ns = now_ns()
                frame = camera.grab(asked_ns + 5_000_000, WAIT_S)
                assert times_hold(frame, usb)
                assert shot_of(frame, usb).begin_ns >= asked_ns + 5_000_000

    def test_of_a_camera_that_takes_long_hold(self, rig):
        usb, camera = rig()
        with camera:
            usb.camera.faults.delay_s = 1.5  # longer than late_s, and it is not ready meanwhile
            frame = camera.grab(now_ns(), 30.0)
            assert times_hold(frame, usb)
            usb.camera.faults.delay_s = 0.0
            assert times_hold(camera.grab(now_ns(), WAIT_S), usb)

    def test_of_a_free_running_camera_hold_and_nothing_is_older_than_asked(self, rig):
        usb, camera = rig({**SMALL, "trigger": "free", "frame_rate_hz": 30.0, "readout_max_s": 0.3})
        with camera:
            for _ in range(3):
                asked_ns = now_ns()
                frame = camera.grab(asked_ns, WAIT_S)
                assert times_hold(frame, usb)
                assert shot_of(frame, usb).begin_ns >= asked_ns

    def test_hold_after_the_computer_stalled_so_long_that_the_ring_was_full(self, rig):
        usb, camera = rig({**SMALL, "trigger": "free", "frame_rate_hz": 30.0, "readout_max_s": 0.3})
        with camera:
            camera.grab(now_ns(), WAIT_S)
            os.kill(camera.pid, signal.SIGSTOP)
            try:
                time.sleep(1.0)
            finally:
                os.kill(camera.pid, signal.SIGCONT)
            for _ in range(8):  # with those that waited in the ring and in the camera
                assert times_hold(camera.grab(now_ns() - 2_000_000_000, WAIT_S), usb)
            asked_ns = now_ns()
            assert shot_of(camera.grab(asked_ns, WAIT_S), usb).begin_ns >= asked_ns

    def test_of_edges_on_the_line_hold(self, rig):
        usb, camera = rig({**SMALL, "trigger": "line", "readout_max_s": 0.3})
        with camera:
            with pytest.raises(DeviceTimeoutError):
                camera.grab(now_ns(), 0.2)
            asked_ns = now_ns()
            time.sleep(0.4)  # by its arrival it must be sure that the exposure began after this was asked
            usb.camera.edge()
            frame = camera.grab(asked_ns, WAIT_S)
            assert times_hold(frame, usb)


def seconds_of(shot):
    return (shot.end_ns - shot.begin_ns) / 1e9


class TestExposures:
    @pytest.mark.parametrize(
        "trigger",
        [{}, {"trigger": "free", "frame_rate_hz": 30.0, "readout_max_s": 0.05}],
        ids=["software", "free"],
    )
    def test_are_as_long_as_they_were_set_from_the_next_frame_on(self, rig, trigger):
        usb, camera = rig({**SMALL, **trigger})
        with camera:
            camera.grab(now_ns(), WAIT_S)
            began_ns = now_ns() - 1_000_000_000
            for exposure_s in (0.020, 0.002, 0.009):
                took_s = camera.set_exposure(exposure_s)
                assert took_s == pytest.approx(exposure_s, rel=0.03)
                for _ in range(2):
                    frame = camera.grab(began_ns, WAIT_S)
                    assert frame.exposure_s == took_s
                    assert seconds_of(shot_of(frame, usb)) == pytest.approx(took_s, rel=1e-3)
                    assert times_hold(frame, usb)
            assert f"shutter {took_s * 1e3:.3f} ms" in camera.about()["settings"]

    def test_a_frame_that_comes_too_late_is_not_taken_for_one_of_the_new_exposure(self, rig):
        usb, camera = rig()
        with camera:
            camera.grab(now_ns(), WAIT_S)
            usb.camera.faults.delay_s = 0.4
            with pytest.raises(DeviceTimeoutError):
                camera.grab(now_ns(), 0.1)
            usb.camera.faults.delay_s = 0.0
            took_s = camera.set_exposure(0.015)
            frame = camera.grab(0, WAIT_S)
            assert seconds_of(shot_of(frame, usb)) == pytest.approx(took_s, rel=1e-3)
            assert "1 too late" in status(camera)

    def test_without_absolute_registers_are_set_by_the_manuals_steps(self, rig):
        steps = {"shutter_step_us": 50.0, "gain_step_db": 0.05}
        usb, camera = rig({**SMALL, **steps}, absolute=False)
        with camera:
            assert camera.exposure_range_s()[0] == pytest.approx(50e-6)
            assert camera.set_exposure(0.0071) == pytest.approx(0.0071)
            assert usb.camera.registers.features[SHUTTER].raw == 142

    def test_that_the_camera_does_not_keep_are_a_fault(self, rig):
        usb, camera = rig()
        with camera:
            usb.camera.faults.stuck = set(range(0, 0x10000, 4))
            with pytest.raises(DeviceFaultError, match="kept"):
                camera.set_exposure(0.05)


class TestLoss:
    def test_at_every_access_of_a_grab_is_told_as_one(self, rig):
        usb, camera = rig()
        for accesses in range(3):
            camera.open()
            camera.grab(now_ns(), WAIT_S)
            usb.camera.faults.accesses_left = accesses
            with pytest.raises(DeviceLostError):  # a grab asks whether it is ready, and triggers
                until_it_fails(lambda: camera.grab(now_ns(), WAIT_S))
            with pytest.raises(DeviceLostError):
                camera.check()
            camera.close()
            usb.plug()
        with camera:
            assert camera.grab(now_ns(), WAIT_S).rgb.any()

    @pytest.mark.parametrize("share", [0.0, 0.03, 0.1, 0.25, 0.5, 0.75, 0.9])
    def test_while_it_is_opened_leaves_it_closed_and_not_found(self, opener, share):
        with opener.camera() as usb:
            assert "error" not in opener.open(SMALL)
            usb.camera.faults.accesses_left = int(usb.camera.accesses * share)
            assert opener.open(SMALL)["error"] == "DeviceNotFoundError"
            usb.plug()
            assert opener.open(SMALL)["rgb"] > 0

    @pytest.mark.parametrize("how", [pytest.param("hang", marks=pytest.mark.slow), "crash"])
    def test_does_not_stop_the_capture_and_so_outlives_a_library_that_cannot(self, rig, how):
        usb, camera = rig(environment={"IIDC_USB_ON_RELEASE": how})
        camera.open()
        pid = camera.pid
        camera.grab(now_ns(), WAIT_S)
        usb.unplug()
        with pytest.raises(DeviceLostError) as caught:
            until_it_fails(camera.check)
        assert "SIG" not in str(caught.value)  # the process told it, and did not die of it
        camera.close()
        assert not Path(f"/proc/{pid}").exists()
        usb.plug()
        with camera:
            assert camera.grab(now_ns(), WAIT_S).rgb.any()

    @pytest.mark.parametrize("how", ["hang", "crash"])
    def test_of_the_library_itself_while_it_closes_costs_only_its_process(self, rig, how):
        _, camera = rig(environment={"IIDC_USB_ON_RELEASE": how})
        for _ in range(2):
            camera.open()
            pid = camera.pid
            assert camera.grab(now_ns(), WAIT_S).rgb.any()
            before = time.monotonic()
            camera.close()
            assert time.monotonic() - before < 5
            assert not camera.is_open
            assert not Path(f"/proc/{pid}").exists()

    def test_of_its_settings_by_a_reset_is_noticed_by_a_check(self, rig):
        usb, camera = rig()
        with camera:
            camera.check()
            usb.camera.reset()
            with pytest.raises(DeviceLostError, match="no longer transmits"):
                camera.check()


class TestSetUp:
    @pytest.mark.parametrize(
        ("offset", "named"),
        [
            (0x604, "mode"),  # and nothing else, for 0x608 is kept
            (0x80C, "white balance"),
            (0x81C, "shutter"),
            (0x3000 + 0x20 * GAIN + 8, "gain_db"),
            (0x830, "trigger"),
            (0x1050, "raw Bayer"),
        ],
    )
    def test_what_the_camera_does_not_keep_is_a_fault_that_names_it(self, opener, offset, named):
        with opener.camera() as usb:
            usb.camera.faults.stuck = {offset}
            told = opener.open({"exposure_us": 5000.0, "gain_db": 3.0, "mode": "1280x960_mono16"})
        assert told["error"] == "DeviceFaultError"
        assert named in told["text"]

    @pytest.mark.parametrize(
        ("changed", "told"),
        [
            ({"exposure_us": 200_000.0}, r"exposure_us 200000, .* 50 to 100000"),
            ({"gain_db": 24.5}, r"gain_db 24\.5, .* 0 to 24"),
            ({"gain_db": None, "gain_raw": 500}, r"gain_raw 500, .* 0 to 480"),
            ({"region_px": [1000, 0, 320, 240]}, r"1280 × 960"),
            ({"mode": "format7_1"}, r"format7_0"),
            ({"mode": "640x480_mono8", "region_px": None}, r"1280x960_mono8"),
            ({"mode": "1280x960_mono8", "region_px": None, "frame_rate_hz": 60.0}, r"7\.5, 15, 30"),
            ({"trigger": "line", "trigger_line": 2}, r"lines 0 and software"),
            ({"strobe_line": 2}, r"strobe_line 2"),
        ],
    )
    def test_what_the_camera_cannot_is_a_fault_that_says_what_it_can(self, opener, changed, told):
        with opener.camera():
            answer = opener.open(only({**SMALL, **changed}))
        assert answer["error"] == "DeviceFaultError"
        assert re.search(told, answer["text"])

    def test_a_strobe_and_registers_of_the_operators_are_set(self, opener):
        more = {"strobe_line": 1, "strobe_active": "low", "registers": {"0x610": 1 << 31}}
        with opener.camera() as usb:
            assert opener.open({**SMALL, **more})["serial"] == "00b09d0100abcdef"
            assert usb.camera.registers.strobe_lines[1] == 0x82000000
            usb.camera.faults.stuck = {0x600}
            assert "0x600" in opener.open({**SMALL, "registers": {"0x600": 0}})["text"]

    def test_without_absolute_registers_the_manuals_steps_count(self, opener):
        steps = {"shutter_step_us": 50.0, "shutter_offset_us": 1000.0, "gain_step_db": 0.05}
        with opener.camera(absolute=False) as usb:
            told = opener.open({**SMALL, **steps})
            assert "shutter 5.000 ms (raw 80), gain 3.00 dB (raw 60)" in told["settings"]
            assert usb.camera.registers.features[SHUTTER].raw == 80
            assert usb.camera.registers.features[GAIN].raw == 60
            assert "shutter_step_us" in opener.open(SMALL)["text"]
            raw = {"mode": "format7_0", "shutter_raw": 100, "gain_raw": 60}
            assert "shutter_step_us" in opener.open(raw)["text"]
            assert "frame rate" in opener.open({**SMALL, **steps, "trigger": "free"})["text"]

    def test_another_makers_camera_tells_its_pattern_by_format_7_only(self, opener):
        fixed = {"exposure_us": 5000.0, "gain_db": 3.0}
        with opener.camera(pattern="GBRG", point_grey=False):
            assert "GBRG" in opener.open(SMALL)["format"]
            assert opener.open({**fixed, "bayer": "GBRG"})["rgb"] > 0
            assert "option bayer" in opener.open(fixed)["text"]

    def test_another_guid_is_not_found(self, opener):
        with opener.camera():
            told = opener.open({**SMALL, "guid": "00b09d0100000001"})
        assert told["error"] == "DeviceNotFoundError"
        assert "00b09d0100abcdef" in told["text"]

    @pytest.mark.parametrize(
        ("changed", "told"),
        [
            ({"exposure_us": None}, "exposure_us and shutter_raw"),
            ({"shutter_raw": 3}, "exposure_us and shutter_raw"),
            ({"gain_db": float("nan")}, "gain_db"),
            ({"region_px": [1, 0, 320, 240]}, "even"),
            ({"region_px": [0, 0, 0, 240]}, "above 0"),
            ({"mode": "1280x960_mono8"}, "region_px"),
            ({"mode": "1280x960_rgb8"}, "mode"),
            ({"mode": "1280x960_mono8", "region_px": None, "frame_rate_hz": 25.0}, "1.875"),
            ({"registers": {"0x611": 1}}, "multiple of 4"),
            ({"registers": {"gpio": 1}}, "multiple of 4"),
            ({"readout_min_s": 0.2, "readout_max_s": 0.1}, "readout_max_s"),
            ({"buffers": 1}, "buffers"),
            ({"shuter_raw": 1}, "shutter_raw"),
        ],
    )
    def test_options_that_make_no_sense_are_refused_before_anything_is_opened(self, changed, told):
        with pytest.raises(ConfigurationError, match=told):
            colour(name="colour", clock=SystemClock(), options=only({**SMALL, **changed}), shared={})
