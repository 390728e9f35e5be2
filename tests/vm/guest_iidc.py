"""The IIDC driver as it is installed: in a process of its own, on Linux's USB, by whole frames."""

import time
from pathlib import Path

import numpy as np
import pytest
from bench_iidc import OPTIONS, gadget

from drivers import backends
from drivers.bayer import demosaic
from drivers.clock import SystemClock
from drivers.emulators.firefly import Ramps
from drivers.errors import DeviceLostError, DeviceNotFoundError
from drivers.isolation.camera import IsolatedCamera

WAIT_S = 20.0  # for a whole frame under emulation
PATTERN = "GRBG"


def test_a_frame_of_the_whole_sensor_comes_bit_for_bit_with_its_time():
    device = gadget()
    device.faults({})
    device.plug()
    options = {"exposure_us": 4000.0, "gain_db": 0.0}
    assert isinstance(backends.create("colour", "iidc", clock=SystemClock(), options=options), IsolatedCamera)
    camera = isolated(options)
    opened(camera)
    about = camera.about()
    frame = camera.grab(time.monotonic_ns(), WAIT_S)
    shots = {shot[0]: shot for shot in device.ask(do="shots")["shots"]}
    camera.close()
    assert about["address"].startswith("usb ")
    places = ((0, 0), (0, 1), (1, 0), (1, 1))
    low = [frame.rgb[*place, "RGB".index(c)] for place, c in zip(places, PATTERN, strict=True)]
    number = bytes(int(value) for value in low)
    _, begin_ns, end_ns = shots[int.from_bytes(number, "big")]
    assert abs(frame.t_ns - (begin_ns + end_ns) / 2) <= frame.t_sd_ns + 1000
    scene = Ramps().raw(begin_ns, end_ns, 0.0, 0) >> 8
    raw = np.empty(scene.shape[:2], np.uint8)
    for place, colour in enumerate(PATTERN):
        row, column = divmod(place, 2)
        raw[row::2, column::2] = scene[row::2, column::2, "RGB".index(colour)]
    raw[:2, :2] = np.frombuffer(number, np.uint8).reshape(2, 2)
    assert np.array_equal(frame.rgb, demosaic(raw, PATTERN, 8))


def test_unplugged_it_is_lost_and_plugged_in_again_it_works():
    device = gadget()
    device.faults({})
    device.plug()
    camera = isolated(OPTIONS)
    opened(camera)
    pid = camera.pid
    camera.grab(time.monotonic_ns(), WAIT_S)
    device.unplug()
    with pytest.raises(DeviceLostError) as caught:
        until_it_fails(camera.check)
    assert "SIG" not in str(caught.value)  # the process told it, and did not die of it
    camera.close()
    assert not Path(f"/proc/{pid}").exists()
    with pytest.raises(DeviceNotFoundError):
        camera.open()
    device.plug()
    opened(camera)
    assert camera.grab(time.monotonic_ns(), WAIT_S).rgb.any()
    camera.close()


def test_the_installed_udev_rule_opens_the_camera_to_a_group():
    gadget().plug()
    vendors = Path("/sys/bus/usb/devices").glob("*/idVendor")
    (place,) = [vendor.parent for vendor in vendors if vendor.read_text() == "1e10\n"]
    bus, number = (int((place / name).read_text()) for name in ("busnum", "devnum"))
    node = Path(f"/dev/bus/usb/{bus:03d}/{number:03d}")
    until = time.monotonic() + 10  # udev works after the kernel
    while node.group() == "root" and time.monotonic() < until:
        time.sleep(0.1)
    assert node.group() != "root"
    assert node.stat().st_mode & 0o777 == 0o660


def isolated(options):
    # Starting a process takes 10 s and more here.
    return IsolatedCamera(
        "drivers.colour_iidc:in_process",
        name="colour",
        options={**options, "late_s": 5.0},
        open_timeout_s=90.0,
    )


def opened(camera):
    """As the daemon does: libdc1394 gives a request a second, which is not always enough here."""
    for _ in range(4):
        try:
            camera.open()
        except DeviceNotFoundError:
            time.sleep(1.0)
        else:
            return
    camera.open()


def until_it_fails(call):
    for _ in range(200):
        call()
        time.sleep(0.1)
