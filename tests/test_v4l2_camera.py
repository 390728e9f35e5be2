"""The V4L2 camera on a kernel of the test's own: what it makes of times, gaps, flags, errors and controls."""

import errno

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from v4l2_fake import AUTO_GAIN, GAIN, GONE, MS, POWER_LINE, FakeCamera, FakeClock, picture

from drivers.bayer import demosaic
from drivers.colour_v4l2 import V4l2ColourCamera, colour
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from drivers.v4l2.options import V4l2Options
from surfclass.errors import ConfigurationError, InputError
from surfclass.schema import validate

OPENING = ("open", "facts", "set_format", "rate_hz", "controls", "read", "write", "start")
IN_USE = ("wait", "take", "data", "give_back", "read")
BASIC = {"device_path": "/dev/video9", "width": 4, "height": 2, "pixel_format": "RGGB"}


def driver(fake, **options):
    table = validate(V4l2Options, {**BASIC, **options}, "colour")
    return V4l2ColourCamera("colour", fake.clock, table, fake.open)


def shown(fake, frame):
    """Which of the camera's frames it is, by what it shows."""
    found = [
        number
        for number in fake.begins
        if np.array_equal(
            frame.rgb, demosaic(np.frombuffer(picture(number, 4, 2), np.uint8).reshape(2, 4), "RGGB", 8)
        )
    ]
    assert len(found) == 1, found
    return found[0]


@pytest.fixture
def fake():
    return FakeCamera(FakeClock())


class TestFrames:
    def test_a_frame_is_the_buffers_mosaic_with_what_is_known_of_its_exposure(self, fake):
        with driver(fake, exposure_us=5000, gain=20, gain_unit_db=0.5) as camera:
            frame = camera.grab(fake.clock.ns, 1.0)
        assert frame.sequence == shown(fake, frame) + 1
        assert (frame.exposure_s, frame.gain_db) == (0.005, 10.0)

    def test_a_camera_that_does_not_tell_its_exposure_has_none(self):
        fake = FakeCamera(FakeClock(), tells_exposure=False)
        with driver(fake) as camera:
            frame = camera.grab(fake.clock.ns, 1.0)
        assert (frame.exposure_s, frame.gain_db) == (None, None)
        assert frame.t_sd_ns > 0

    @given(
        period_ms=st.integers(5, 100),
        exposure_part=st.floats(0.01, 0.99),
        readout_part=st.floats(0.0, 0.99),
        ahead_ms=st.floats(-50, 300),
        idle_ms=st.floats(0, 500),
        stamped=st.sampled_from(["start", "end", "arrival"]),
        tells=st.booleans(),
    )
    @settings(max_examples=300, deadline=None)
    def test_the_exposure_really_was_then_and_began_no_earlier_than_asked(
        self, period_ms, exposure_part, readout_part, ahead_ms, idle_ms, stamped, tells
    ):
        units = max(1, round(period_ms * 10 * exposure_part))
        fake = FakeCamera(
            FakeClock(),
            period_ns=period_ms * MS,
            rate_hz=1e3 / period_ms,
            readout_ns=round(period_ms * MS * readout_part),
            at_start=stamped == "start",
            arrival=stamped == "arrival",
            tells_exposure=tells,
            exposure_units=units,
        )
        with driver(fake) as camera:
            fake.clock.sleep(idle_ms / 1e3)
            not_before = fake.clock.ns + round(ahead_ms * MS)
            frame = camera.grab(not_before, 2.0)
        begin = fake.begins[shown(fake, frame)]
        assert begin >= not_before
        assert abs(begin + fake.exposure_ns / 2 - frame.t_ns) <= frame.t_sd_ns + 1
        assert frame.t_ns <= fake.clock.ns
        if tells:
            assert frame.t_ns - frame.exposure_s * 5e8 - frame.t_sd_ns >= not_before - 1

    def test_a_stamp_of_the_exposures_start_leaves_no_more_than_the_clocks_resolution_open(self):
        fake = FakeCamera(FakeClock(), at_start=True)
        with driver(fake) as camera:
            assert camera.grab(fake.clock.ns, 1.0).t_sd_ns <= 1000

    def test_after_a_pause_old_buffers_are_gone_through_and_all_given_back(self, fake):
        with driver(fake, buffers=4) as camera:
            camera.grab(fake.clock.ns, 1.0)
            fake.clock.sleep(2.0)
            asked = fake.clock.ns
            frame = camera.grab(asked, 1.0)
            assert frame.t_ns - frame.t_sd_ns >= asked
            node = camera._stream.node
            assert not node.taken
            assert len(node.free) + len(node.filled) == 4
            assert "exposed too early" in camera.about()["status"]
            assert "missing" not in camera.about()["status"]  # nothing was lost that anybody waited for

    def test_sequence_numbers_rise_where_the_counter_wraps_or_starts_again(self, fake):
        fake.first_number = 0xFFFF_FFFD
        with driver(fake) as camera:
            numbers = [camera.grab(fake.clock.ns, 1.0).sequence for _ in range(3)]
            fake.first_number = 5
            numbers += [camera.grab(fake.clock.ns, 1.0).sequence for _ in range(2)]
        assert np.all(np.diff(numbers) > 0)
        assert numbers[-1] < 1000


class TestWhatIsNoFrame:
    @pytest.mark.parametrize(
        ("quirk", "said"),
        [
            ("error", "1 with the kernel's error flag"),
            ("short", "1 not whole"),
            ("again", "1 with impossible times"),
            ("future", "1 with impossible times"),
            ("drop", "1 missing in the count"),
        ],
    )
    def test_is_left_out_and_counted(self, fake, quirk, said):
        with driver(fake) as camera:
            fake.quirks[8] = quirk
            frame = camera.grab(fake.clock.ns + 7 * fake.period_ns + 10 * MS, 1.0)
            assert said in camera.about()["status"]
        assert shown(fake, frame) == 9

    def test_a_mute_camera_is_a_timeout_in_time(self, fake):
        with driver(fake) as camera:
            fake.mute = True
            before = fake.clock.ns
            with pytest.raises(DeviceTimeoutError, match=r"no frame came in 0\.4 s"):
                camera.grab(before, 0.4)
            assert fake.clock.ns - before == 400 * MS

    def test_a_timeout_says_what_came_instead(self, fake):
        with driver(fake) as camera:
            fake.quirks = dict.fromkeys(range(1000), "error")
            with pytest.raises(DeviceTimeoutError, match="error flag"):
                camera.grab(fake.clock.ns, 0.4)

    def test_a_poll_that_lies_does_not_keep_the_driver_beyond_the_timeout(self, fake):
        with driver(fake) as camera:
            fake.poll_lies = True
            before = fake.clock.ns
            with pytest.raises(DeviceTimeoutError):
                camera.grab(before, 0.4)
            assert fake.clock.ns - before < 410 * MS

    def test_stamps_of_another_clock_are_a_fault(self, fake):
        fake.quirks = dict.fromkeys(range(1000), "realtime")
        with driver(fake) as camera, pytest.raises(DeviceFaultError, match="CLOCK_MONOTONIC"):
            camera.grab(fake.clock.ns, 1.0)

    def test_values_beyond_the_formats_bits_are_a_fault(self):
        fake = FakeCamera(FakeClock(), pixel_format="RG10", row_bytes=8)
        with (
            driver(fake, pixel_format="RG10") as camera,
            pytest.raises(DeviceFaultError, match="impossible data"),
        ):
            camera.grab(fake.clock.ns, 1.0)

    @given(
        st.dictionaries(
            st.integers(0, 40),
            st.sampled_from(["error", "short", "again", "future", "drop"]),
            max_size=30,
        ),
        st.lists(st.tuples(st.floats(0, 0.3), st.floats(0.01, 0.5)), min_size=1, max_size=6),
    )
    @settings(max_examples=150, deadline=None)
    def test_whatever_comes_frames_are_true_and_no_buffer_is_kept(self, quirks, calls):
        fake = FakeCamera(FakeClock())
        fake.quirks = quirks
        times = []
        with driver(fake) as camera:
            for idle_s, timeout_s in calls:
                fake.clock.sleep(idle_s)
                asked = fake.clock.ns
                try:
                    frame = camera.grab(asked, timeout_s)
                except DeviceTimeoutError:
                    assert fake.clock.ns <= asked + round(timeout_s * 1e9) + MS
                else:
                    times.append(frame.t_ns)
                    assert frame.t_ns - frame.t_sd_ns - fake.exposure_ns // 2 >= asked - 1
                assert not camera._stream.node.taken
        assert times == sorted(set(times))


class TestErrors:
    @pytest.mark.parametrize("step", OPENING)
    @pytest.mark.parametrize("code", GONE)
    def test_a_device_that_goes_while_it_is_opened_is_not_found_and_nothing_stays_open(
        self, fake, step, code
    ):
        fake.fail[step] = code
        camera = driver(fake)
        with pytest.raises(DeviceNotFoundError, match=errno.errorcode[code]):
            camera.open()
        assert not camera.is_open
        assert fake.opened == fake.closed
        fake.fail.clear()
        camera.open()
        camera.grab(fake.clock.ns, 1.0)
        camera.close()

    @pytest.mark.parametrize("step", IN_USE)
    @pytest.mark.parametrize("code", GONE)
    def test_a_device_that_goes_while_it_is_used_is_lost_and_comes_back(self, fake, step, code):
        camera = driver(fake)
        camera.open()
        camera.grab(fake.clock.ns, 1.0)
        fake.fail[step] = code
        with pytest.raises(DeviceLostError, match=errno.errorcode[code]):
            camera.grab(fake.clock.ns, 1.0)
        assert camera.is_open
        camera.close()
        fake.fail.clear()
        fake.clock.sleep(1.0)
        with camera:
            asked = fake.clock.ns
            assert camera.grab(asked, 1.0).t_ns > asked
        assert fake.opened == fake.closed == 2

    @pytest.mark.parametrize("step", ["facts", "read"])
    def test_a_check_notices_that_an_idle_device_is_gone(self, fake, step):
        with driver(fake) as camera:
            camera.check()
            fake.fail[step] = errno.ENODEV
            with pytest.raises(DeviceLostError):
                camera.check()

    @pytest.mark.parametrize("step", ["open", "set_format", "set_rate", "start"])
    def test_a_device_that_another_program_uses_is_not_found_and_says_so(self, fake, step):
        fake.fail[step] = errno.EBUSY
        with pytest.raises(DeviceNotFoundError, match="another program uses it"):
            driver(fake, rate_hz=1e3 / 30).open()
        assert fake.opened == fake.closed

    def test_a_device_that_may_not_be_opened_says_which_group_may(self, fake):
        fake.fail["open"] = errno.EACCES
        with pytest.raises(DeviceNotFoundError, match="group"):
            driver(fake).open()

    @pytest.mark.parametrize("step", OPENING + IN_USE)
    def test_any_other_error_is_a_fault_that_names_it(self, fake, step):
        camera = driver(fake)
        fake.fail[step] = errno.ENOMEM
        with pytest.raises(DeviceFaultError, match="ENOMEM"), camera:
            camera.grab(fake.clock.ns, 1.0)
        assert fake.opened == fake.closed

    def test_a_missing_library_is_named_with_its_package(self, fake):
        def without_linuxpy(path):
            raise ModuleNotFoundError("No module named 'linuxpy'", name="linuxpy")

        table = validate(V4l2Options, BASIC, "colour")
        with pytest.raises(DriverUnavailableError, match="pip install linuxpy"):
            V4l2ColourCamera("colour", fake.clock, table, without_linuxpy).open()

    def test_a_closed_camera_is_not_open(self, fake):
        camera = driver(fake)
        for call in (camera.check, camera.about, lambda: camera.grab(0, 1.0)):
            with pytest.raises(DeviceLostError, match="not open"):
                call()

    @pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
    def test_a_timeout_that_is_none_is_refused(self, fake, timeout_s):
        with driver(fake) as camera, pytest.raises(InputError, match="timeout"):
            camera.grab(fake.clock.ns, timeout_s)

    def test_opening_an_open_camera_opens_it_anew(self, fake):
        camera = driver(fake)
        camera.open()
        camera.open()
        camera.close()
        camera.close()
        assert fake.opened == fake.closed == 2


class TestWhatWasNegotiated:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"width": 6, "row_bytes": 6}, r"gives RGGB 6 × 2; it has: RGGB: 4 × 2; YUYV \(not supported\)"),
            ({"height": 4}, "gives RGGB 4 × 4"),
            ({"pixel_format": "YUYV"}, "gives YUYV"),
            ({"progressive": False}, "interlaced"),
            ({"full_range": False}, "limited range"),
            ({"row_bytes": 3}, "rows of 3 bytes"),
            ({"captures": False}, "no single-planar"),
        ],
    )
    def test_another_format_than_asked_for_is_a_fault(self, change, said):
        fake = FakeCamera(FakeClock(), **change)
        with pytest.raises(DeviceFaultError, match=said):
            driver(fake).open()
        assert fake.opened == fake.closed

    def test_rows_may_have_padding(self):
        fake = FakeCamera(FakeClock(), row_bytes=16)
        with driver(fake) as camera:
            assert camera.grab(fake.clock.ns, 1.0).rgb.shape == (2, 4, 3)

    def test_a_rate_is_read_back(self, fake):
        fake.rates = (50.0,)
        with driver(fake, rate_hz=50.0) as camera:
            assert camera.grab(fake.clock.ns, 1.0).t_ns
            assert "50 Hz" in camera.about()["format"]
        with pytest.raises(DeviceFaultError, match="asked for 60 frames a second, it gives 50"):
            driver(fake, rate_hz=60.0).open()

    def test_a_rate_that_the_kernel_does_not_tell_must_be_given(self, fake):
        fake.rate_hz = None
        with pytest.raises(DeviceFaultError, match="set rate_hz"):
            driver(fake).open()
        with driver(fake, rate_hz=1e3 / 30) as camera:
            camera.grab(fake.clock.ns, 1.0)

    def test_it_tells_what_is_in_force(self, fake):
        with driver(fake, gain=20) as camera:
            camera.grab(fake.clock.ns, 1.0)
            about = camera.about()
        assert about["model"] == "Fake Camera"
        assert about["serial"] == "A1"
        assert about["address"] == "/dev/video9 at usb-1"
        assert about["format"] == "RGGB 4 × 2, 33.33 Hz"
        assert "gain = 20" in about["settings"]
        assert "auto_exposure = 1" in about["settings"]
        assert "end of frame" in about["clock"]
        assert about["status"].startswith("1 frame")
        assert "linuxpy" in about["library"]


class TestControls:
    def test_everything_automatic_is_switched_off(self, fake):
        with driver(fake, exposure_us=2000) as camera:
            frame = camera.grab(fake.clock.ns, 1.0)
        assert fake.values[AUTO_GAIN] == 0
        assert fake.values[POWER_LINE] == 0
        assert frame.exposure_s == 0.002

    def test_what_only_corrects_may_be_wanted(self, fake):
        with driver(fake, controls={"power_line_frequency": 2, "gamma": 300}):
            assert fake.values[POWER_LINE] == 2

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            ({"gain": 101}, "gain = 101, allowed: 0 to 100 in steps of 2"),
            ({"gain": 11}, "gain = 11, allowed: 0 to 100 in steps of 2"),
            ({"exposure_us": 600_000}, "exposure_time_absolute = 6000, allowed: 1 to 5000"),
            ({"controls": {"gama": 100}}, "no control 'gama'; it has: auto_exposure.*gamma"),
            ({"controls": {"auto_exposure": 3}}, "auto_exposure = 3 is automatic, allowed is 1"),
            ({"controls": {"gain_automatic": True}}, "is automatic, allowed is 0"),
        ],
    )
    def test_what_the_camera_cannot_do_is_a_fault_that_says_what_it_can(self, fake, options, said):
        with pytest.raises(DeviceFaultError, match=said):
            driver(fake, **options).open()
        assert fake.opened == fake.closed

    def test_an_exposure_without_such_a_control_is_a_fault(self):
        fake = FakeCamera(FakeClock(), tells_exposure=False)
        with pytest.raises(DeviceFaultError, match="exposure_us is set, but the camera has no such control"):
            driver(fake, exposure_us=1000).open()

    def test_a_value_that_the_camera_rounds_is_a_fault(self, fake):
        fake.rounds = lambda control, value: value + 2 if control.id == GAIN else value
        with pytest.raises(DeviceFaultError, match="gain is 22, it was set to 20"):
            driver(fake, gain=20).open()

    def test_an_automatic_function_that_stays_on_is_a_fault(self, fake):
        fake.rounds = lambda control, value: 1 if control.id == AUTO_GAIN else value
        with pytest.raises(DeviceFaultError, match="gain_automatic is 1"):
            driver(fake).open()

    @pytest.mark.parametrize("code", [errno.EINVAL, errno.ERANGE, errno.EACCES])
    def test_a_control_that_refuses_is_named(self, fake, code):
        fake.fail["write"] = code
        with pytest.raises(DeviceFaultError, match="control auto_exposure refuses 1"):
            driver(fake).open()

    @pytest.mark.parametrize("set_by_us", [True, False])
    def test_a_control_that_another_program_changes_is_a_fault_and_no_frame(self, fake, set_by_us):
        with driver(fake, **({"gain": 20} if set_by_us else {})) as camera:
            camera.grab(fake.clock.ns, 1.0)
            fake.values[GAIN] = 90
            with pytest.raises(DeviceFaultError, match="another program"):
                camera.grab(fake.clock.ns, 1.0)
            with pytest.raises(DeviceFaultError, match="another program"):
                camera.check()


class TestOptions:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"pixel_format": "YUYV"}, "two pixels share their colour"),
            ({"pixel_format": "MJPG"}, "compressed with loss"),
            ({"pixel_format": "GREY"}, "no colour"),
            ({"pixel_format": "ABCD"}, "supported: RGGB"),
            ({"pixel_format": "pRAA", "width": 6}, "multiple of 4"),
            ({"exposure_us": 150.0}, "exposure_us"),
            ({"exposure_us": -100.0}, "exposure_us"),
            ({"buffers": 1}, "buffers"),
            ({"width": "640"}, "width"),
            ({"gain": 1.5}, "gain"),
            ({"exposure": 1}, "did you mean 'exposure_us'"),
            ({"controls": {"gamma": "high"}}, "controls.gamma"),
        ],
    )
    def test_a_wrong_one_is_refused_before_anything_is_opened(self, change, said):
        with pytest.raises(ConfigurationError, match=said):
            colour(name="colour", clock=FakeClock(), options={**BASIC, **change}, shared={})


class TestTheRealNode:
    def test_a_path_that_is_not_there_is_not_found(self, tmp_path):
        options = {**BASIC, "device_path": str(tmp_path / "video0")}
        with pytest.raises(DeviceNotFoundError, match="ENOENT"):
            colour(name="colour", clock=FakeClock(), options=options, shared={}).open()

    @pytest.mark.parametrize("path", ["/dev/null", "/dev/zero", "/dev/ptmx"])
    def test_a_device_that_is_no_camera_is_a_driver_error_and_is_closed(self, path, open_files):
        before = open_files()
        camera = colour(name="colour", clock=FakeClock(), options={**BASIC, "device_path": path}, shared={})
        with pytest.raises(DriverError, match=path):
            camera.open()
        assert open_files() == before

    @pytest.fixture
    def open_files(self):
        from pathlib import Path

        from drivers.v4l2.node import _linuxpy

        _linuxpy()
        return lambda: len(list(Path("/proc/self/fd").iterdir()))
