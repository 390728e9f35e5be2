"""The emulated GigE camera, read by the real Aravis: what the client sets is what the pixels show."""

from __future__ import annotations

import time

import gige_process
import numpy as np
import pytest

from drivers.bayer import demosaic, mosaic, unpack
from drivers.clock import SystemClock
from drivers.colour_aravis import in_process
from drivers.emulators.gige_camera import GigeCamera, obey
from drivers.emulators.gige_image import FORMATS, Processing, encoded
from drivers.errors import DeviceTimeoutError
from surfclass.errors import InputError

WIDTH, HEIGHT = 32, 24


class Scene:
    """A cell that is lit evenly for ever, and remembers what was asked of it."""

    colour_size = (WIDTH, HEIGHT)

    def __init__(self):
        rng = np.random.default_rng(5)
        self.light = rng.integers(1_000, 9_000, (HEIGHT, WIDTH, 3)).astype(np.float64)
        self.asked = []

    def raw(self, begin_ns, end_ns, gain_db, key):
        time.sleep(max(0.0, (end_ns - time.monotonic_ns()) / 1e9))
        self.asked.append((begin_ns, end_ns, gain_db, key))
        level = (end_ns - begin_ns) / 5e6 * 10 ** (gain_db / 20)
        return np.minimum(self.light * level, 65535).astype(np.uint16)

    def rgb(self, begin_ns, end_ns, gain_db, key):
        return (self.raw(begin_ns, end_ns, gain_db, key) >> 8).astype(np.uint8)


@pytest.fixture(scope="module")
def port():
    if why := gige_process.missing():
        pytest.skip(why)
    gige_process.take_port()


@pytest.fixture
def scene(port):
    return Scene()


@pytest.fixture
def emulated(scene):
    with GigeCamera(scene, "T1", gige_process.ADDRESS) as camera:
        yield camera


def client(**options):
    options = {"address": gige_process.ADDRESS, "exposure_us": 5000.0, "pixel_format": "BayerRG8", **options}
    return in_process(name="colour", clock=SystemClock(), options=options, shared={})


def grab(camera, timeout_s=3.0):
    return camera.grab(time.monotonic_ns(), timeout_s)


@pytest.mark.parametrize("code", [code for code, one in FORMATS.items() if one.name.startswith("Bayer")])
def test_every_raw_format_arrives_bit_by_bit_with_nothing_automatic_left_on(scene, emulated, code):
    pixel_format = FORMATS[code]
    with client(pixel_format=pixel_format.name) as camera:
        rgb = grab(camera).rgb
    raw = mosaic(scene.light.astype(np.uint16), "RGGB") >> (16 - pixel_format.bits)
    raw = raw.astype(np.uint8 if pixel_format.bits == 8 else np.uint16)
    assert np.array_equal(rgb, demosaic(raw, "RGGB", pixel_format.bits))


def test_rgb_arrives_as_the_camera_made_it(scene, emulated):
    with client(pixel_format="RGB8") as camera:
        assert np.array_equal(grab(camera).rgb, scene.light.astype(np.uint16) >> 8)


def test_twelve_bits_are_chosen_where_nothing_is_said(emulated):
    with client(pixel_format=None) as camera:
        assert camera.about()["format"].startswith("BayerRG12,")
        assert grab(camera).rgb.dtype == np.uint16


def test_exposure_and_gain_of_the_client_change_the_light(scene, emulated):
    means = {}
    for exposure_us, gain_db in ((4000.0, 0.0), (8000.0, 0.0), (4000.0, 6.0)):
        with client(pixel_format="BayerRG16", exposure_us=exposure_us, gain_db=gain_db) as camera:
            frame = grab(camera)
        assert (frame.exposure_s, frame.gain_db) == (exposure_us / 1e6, gain_db)
        means[exposure_us, gain_db] = frame.rgb.mean()
    assert means[8000.0, 0.0] / means[4000.0, 0.0] == pytest.approx(2, rel=0.01)
    assert means[4000.0, 6.0] / means[4000.0, 0.0] == pytest.approx(10**0.3, rel=0.01)


@pytest.mark.parametrize("trigger", [{"trigger": "software"}, {"trigger": "free", "rate_hz": 40.0}])
def test_an_exposure_that_is_set_is_that_of_the_next_frame_and_of_all_after_it(scene, emulated, trigger):
    with client(pixel_format="BayerRG16", **trigger) as camera:
        began_ns = time.monotonic_ns()
        before = grab(camera)
        light_per_s = before.rgb.mean() / before.exposure_s
        for exposure_s in (0.012, 0.003, 0.0031, 0.012):
            assert camera.set_exposure(exposure_s) == pytest.approx(exposure_s)
            for _ in range(2):
                frame = camera.grab(began_ns, 3.0)
                assert frame.exposure_s == pytest.approx(exposure_s)
                assert frame.rgb.mean() / exposure_s == pytest.approx(light_per_s, rel=0.005)
        assert "exposure 12.000 ms" in camera.about()["settings"]


def test_a_camera_whose_exposure_was_set_is_not_taken_for_one_that_was_reset(scene, emulated):
    with client() as camera:
        camera.set_exposure(0.007)
        time.sleep(0.7)  # it has been looked after meanwhile
        camera.check()
        assert grab(camera).exposure_s == pytest.approx(0.007)


def test_an_exposure_that_the_camera_does_not_allow_is_refused_with_what_it_does(scene, emulated):
    with client() as camera:
        with pytest.raises(InputError, match=r"this camera allows 29 to 3e\+07"):
            camera.set_exposure(1e-6)
        assert grab(camera).exposure_s == 0.005


def test_a_region_is_a_part_of_the_whole_pixel_by_pixel(scene, emulated):
    with client(region=(8, 6, 16, 10)) as camera:
        rgb = grab(camera).rgb
    part = scene.light.astype(np.uint16)[6:16, 8:24] >> 8
    assert np.array_equal(mosaic(rgb, "RGGB"), mosaic(part, "RGGB").astype(np.uint8))


def test_frames_say_when_they_were_exposed(scene, emulated):
    with client(exposure_us=3000.0) as camera:
        for n in range(12):
            asked_ns = time.monotonic_ns() + (n % 3) * 7_000_000
            frame = camera.grab(asked_ns, 3.0)
            begin_ns, end_ns, _, _ = scene.asked[-1]
            assert begin_ns >= asked_ns
            assert abs(frame.t_ns - (begin_ns + end_ns) / 2) <= frame.t_sd_ns + 20_000
            assert frame.t_ns - frame.t_sd_ns - 1_500_000 + 1 >= asked_ns
        assert frame.t_sd_ns < 20_000_000


def test_a_camera_that_runs_freely_gives_frames_of_the_time_asked_for(scene, emulated):
    with client(trigger="free", rate_hz=40.0, exposure_us=2000.0) as camera:
        time.sleep(0.3)
        for ahead_ns in (0, 0, 30_000_000, 150_000_000):
            asked_ns = time.monotonic_ns() + ahead_ns
            frame = camera.grab(asked_ns, 3.0)
            begins = [begin_ns for begin_ns, *_ in scene.asked]
            nearest_ns = min(begins, key=lambda begin_ns: abs(begin_ns + 1_000_000 - frame.t_ns))
            assert nearest_ns >= asked_ns
            assert abs(nearest_ns + 1_000_000 - frame.t_ns) <= frame.t_sd_ns + 20_000
        assert "40.0" in camera.about()["settings"]


def test_a_line_triggers_and_nothing_else_does(scene, emulated):
    with client(trigger="Line0") as camera:
        del scene.asked[:]  # what the camera's clock was learnt from
        with pytest.raises(DeviceTimeoutError):
            grab(camera, 0.3)
        assert not scene.asked
        emulated.pulse("Line2")
        with pytest.raises(DeviceTimeoutError):
            grab(camera, 0.2)
        asked_ns = time.monotonic_ns()
        time.sleep(0.1)  # more than the frame's time is uncertain by: it must certainly have begun after
        emulated.pulse("Line0")
        frame = camera.grab(asked_ns, 3.0)
        assert len(scene.asked) == 1
        assert abs(frame.t_ns - 2_500_000 - scene.asked[0][0]) <= frame.t_sd_ns + 20_000


def test_the_strobe_lines_are_those_that_the_client_has_set(scene, port):
    pulses = []
    with GigeCamera(
        scene, "T1", gige_process.ADDRESS, strobed=lambda *times: pulses.append(times)
    ) as emulated:
        with client(strobe_lines=["Line2", "Line3"]) as camera:
            assert emulated.strobe_lines == ("Line2", "Line3")
            grab(camera)
            assert "strobe on Line2" in camera.about()["settings"]
        assert pulses[-1] == scene.asked[-1][:2]
        emulated.power_cycle()
        assert emulated.strobe_lines == ()
        del pulses[:]
        with client() as camera:
            grab(camera)
    assert not pulses


def test_a_cell_that_fails_leaves_a_mute_camera_and_a_line_in_the_log(scene, emulated, caplog):
    with client() as camera:
        scene.light = None
        with pytest.raises(DeviceTimeoutError):
            grab(camera, 0.3)
    assert "an exposure failed" in caplog.text


def test_it_starts_once_and_its_port_is_its_own(scene, emulated):
    emulated.start()
    with pytest.raises(InputError, match="does another camera run there"):
        GigeCamera(scene, "T2", gige_process.ADDRESS).start()
    emulated.stop()
    emulated.stop()
    with GigeCamera(scene, "T2", gige_process.ADDRESS):
        pass


@pytest.mark.parametrize("serial", ["", "X" * 16])
def test_a_serial_number_that_has_no_room_is_refused(serial):
    with pytest.raises(InputError, match="1 to 15"):
        GigeCamera(Scene(), serial)


def test_an_address_of_another_computer_is_refused(port):
    with pytest.raises(InputError, match=r"198\.51\.100\.1"):
        GigeCamera(Scene(), "T1", "198.51.100.1").start()


def test_lines_of_text_are_obeyed(emulated):
    for line in ("lose 0.5", "lose 0", "freeze", "clock 3", "shrink", "pulse", "pulse Line2", "power_cycle"):
        assert obey(emulated, line) == "done"
    assert obey(emulated, "frames") == "0"
    assert obey(emulated, "strobes") == ""


@pytest.mark.parametrize("line", ["", "lose", "lose 2", "lose x", "pulse Line9", "jump", "pulse Line0 Line1"])
def test_other_lines_are_refused(emulated, line):
    with pytest.raises(ValueError, match=r"\w"):
        obey(emulated, line)


def test_a_camera_that_is_off_has_no_faults_to_make():
    with pytest.raises(InputError, match="not started"):
        GigeCamera(Scene()).shrink()


@pytest.mark.parametrize("code", [code for code, one in FORMATS.items() if one.packing])
def test_packed_formats_are_those_of_the_standard(code):
    image = np.random.default_rng(1).integers(0, 65536, (6, 8, 3)).astype(np.uint16)
    one = FORMATS[code]
    values = mosaic(image, "RGGB") >> (16 - one.bits)
    assert np.array_equal(unpack(encoded(image, one), 8, 6, one.packing), values)


def test_what_is_automatic_changes_the_image():
    image = np.random.default_rng(1).integers(2_000, 20_000, (16, 16, 3)).astype(np.uint16)
    region = (0, 0, 16, 16)
    assert np.array_equal(Processing(region).processed(image), image)
    for on in (
        {"automatic_level": True},
        {"automatic_white": True},
        {"balance": (1.4, 1.7)},
        {"gamma": 0.8},
        {"sharpen": True},
        {"reverse": (True, False)},
        {"reverse": (False, True)},
    ):
        assert not np.array_equal(Processing(region, **on).processed(image), image), on
