"""V4L2 on the kernel's vivid: pixels bit for bit, and each fault that vivid can make."""

import errno

import numpy as np
import pytest
from vivid import Vivid, ctl

from drivers.backends import create
from drivers.bayer import demosaic
from drivers.clock import SystemClock
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceNotFoundError
from drivers.v4l2.pixels import layout

WIDTH, HEIGHT = 1280, 960
SMALL = (640, 480)
CLOCK = SystemClock()


def camera(vivid, pixel_format="RGB3", **options):
    width, height = vivid.size
    given = {"width": width, "height": height, "pixel_format": pixel_format, **options}
    return create("colour", "v4l2", clock=CLOCK, options={"device_path": str(vivid.capture), **given})


def image(pixel_format, size):
    """Noise: what a driver could do to it, it does not survive. (h, w) or (h, w, 3)."""
    of, (width, height) = layout(pixel_format), size
    shape = (height, width) if of.pattern else (height, width, 3)
    values = np.random.default_rng(3).integers(0, 2**of.bits, shape)
    return values.astype(np.uint8 if of.bits == 8 else np.uint16)


@pytest.fixture
def vivid():
    with Vivid(*SMALL, fps=40) as made:
        made.show(image("RGB3", SMALL).tobytes(), "RGB3")
        yield made


@pytest.mark.parametrize("pixel_format", ["RGB3", "BGR3", "RGGB", "BA81", "RG10", "BG12", "GB16"])
def test_pixels_come_out_of_the_kernel_as_they_went_in(pixel_format):
    size = (WIDTH, HEIGHT) if pixel_format in ("RGB3", "RGGB") else SMALL
    of, written = layout(pixel_format), image(pixel_format, size)
    with Vivid(*size, fps=40 if size == SMALL else 30) as vivid:
        vivid.show(written.tobytes(), pixel_format)
        with camera(vivid, pixel_format) as driver:
            frame = driver.grab(CLOCK.now_ns(), 20.0)
    wanted = written if of.pattern is None else demosaic(written, of.pattern, of.bits)
    np.testing.assert_array_equal(frame.rgb, wanted[..., ::-1] if of.order == "BGR" else wanted)


def test_a_buffer_with_the_error_flag_is_left_out_and_counted(vivid):
    with camera(vivid) as driver:
        driver.grab(CLOCK.now_ns(), 20.0)
        for _ in range(20):
            vivid.set(inject_v4l2_buf_flag_error=1)  # for one buffer, of this node or of the output's
            driver.grab(CLOCK.now_ns(), 20.0)
            if "with the kernel's error flag" in driver.about()["status"]:
                return
    pytest.fail("none was counted")


def test_frames_that_the_kernel_drops_are_missed_in_the_count(vivid):
    with camera(vivid) as driver:
        vivid.set(percentage_of_dropped_buffers=60)
        frames = [driver.grab(CLOCK.now_ns(), 20.0) for _ in range(4)]
        assert "missing in the count" in driver.about()["status"]
        assert np.all(np.diff([frame.sequence for frame in frames]) > 0)


def test_a_disconnected_camera_is_lost_and_comes_back(vivid):
    driver = camera(vivid)
    with driver:
        driver.grab(CLOCK.now_ns(), 20.0)
        vivid.set(disconnect=1)
        with pytest.raises(DeviceLostError, match=errno.errorcode[errno.ENODEV]):
            driver.grab(CLOCK.now_ns(), 20.0)
        with pytest.raises(DeviceLostError):
            driver.check()
        with pytest.raises(DeviceNotFoundError):  # the output still has the old one open
            driver.open()
    vivid.plug()
    with driver:
        asked_ns = CLOCK.now_ns()
        assert driver.grab(asked_ns, 20.0).t_ns > asked_ns


def test_a_stream_that_ends_in_the_kernel_is_lost_and_opens_again(vivid):
    driver = camera(vivid)
    with driver:
        driver.grab(CLOCK.now_ns(), 20.0)
        vivid.set(inject_fatal_streaming_error=1)
        with pytest.raises(DeviceLostError, match="EIO"):
            driver.grab(CLOCK.now_ns(), 20.0)
        driver.open()
        driver.grab(CLOCK.now_ns(), 20.0)


def test_a_camera_that_another_program_uses_is_not_found(vivid):
    first, second = camera(vivid), camera(vivid)
    with first:
        with pytest.raises(DeviceNotFoundError, match="another program uses it"):
            second.open()
        assert not second.is_open
        first.grab(CLOCK.now_ns(), 20.0)
    with second:
        second.grab(CLOCK.now_ns(), 20.0)


def test_a_format_that_it_lacks_is_a_fault_that_lists_what_it_has(vivid):
    with pytest.raises(DeviceFaultError, match="asked for pRAA 640 × 480, it gives") as caught:
        camera(vivid, "pRAA").open()
    assert "RGGB: " in str(caught.value)
    assert "YUYV (not supported): " in str(caught.value)
    with camera(vivid) as driver:
        driver.grab(CLOCK.now_ns(), 20.0)


def test_controls_are_set_and_kept(vivid):
    with camera(vivid, gain=33, gain_unit_db=0.1, controls={"contrast": 100}) as driver:
        assert driver.grab(CLOCK.now_ns(), 20.0).gain_db == pytest.approx(3.3)
        told = ctl(vivid.capture, "-C", "gain,gain_automatic,contrast")
        assert told.split() == ["gain:", "33", "gain_automatic:", "0", "contrast:", "100"]
        vivid.set(contrast=90)
        with pytest.raises(DeviceFaultError, match="contrast is 90"):
            driver.check()


@pytest.mark.parametrize(("source", "said"), [(0, "end of frame"), (1, "start of exposure")])
def test_the_kernels_stamps_are_used_for_what_they_are(vivid, source, said):
    vivid.set(timestamp_source=source)
    with camera(vivid) as driver:
        frames = [driver.grab(CLOCK.now_ns(), 20.0) for _ in range(3)]
        seen_ns = CLOCK.now_ns()
        assert said in driver.about()["clock"]
    assert np.all(np.diff([frame.t_ns for frame in frames]) > 0)
    assert 0 < seen_ns - frames[-1].t_ns < 2_000_000_000
    quarter_ns = 1e9 / 40 / 4  # of a period, within the 1 % that its timings are off
    assert all((frame.t_sd_ns < 1.02 * quarter_ns) == (source == 1) for frame in frames)
