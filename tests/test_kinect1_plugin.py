"""The plug-in for the Kinect v1, on Debian's fakenect: libfreenect with recorded frames instead of USB."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceLostError, DeviceNotFoundError
from drivers.isolation.camera import IsolatedCamera
from drivers.openni2.build import build
from drivers.openni2.errors import PluginMissingError

FAKENECT = Path("/usr/lib/x86_64-linux-gnu/fakenect/libfreenect.so.0.5")
SERIAL = "A00366800000000A"
IMAGES = 5
FRAMES = 600  # 20 s; then the dump begins again, which looks like a device's restart
TICKS = 2_000_000  # a 30th of a second at 60 MHz
IR_LATE_TICKS = 60_000
FIRST_TICK = 2**32 - 12 * TICKS  # the 32 bits wrap after 0.4 s
ROWS, COLUMNS = np.mgrid[:488, :640]


def depth(image):
    return (900 + image + COLUMNS[:480] // 8 + 300 * (ROWS[:480] % 7 == 0)).astype("<u2")


def infrared(image):
    return ((3 * COLUMNS + 5 * ROWS + 7 * image) % 1024).astype("<u2")


@pytest.fixture(scope="module")
def plugin():
    if not FAKENECT.is_file():
        pytest.skip("fakenect is not installed: Debian package libfreenect-bin")
    try:
        build("kinect1")
    except PluginMissingError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    """A dump as fakenect reads it: an index of images, whose names give time and ticks."""
    folder = tmp_path_factory.mktemp("dump")
    for image in range(IMAGES):
        (folder / f"depth{image}").write_bytes(b"P5 640 480 65535\n" + depth(image).tobytes())
        pixels = infrared(image).tobytes().ljust(640 * 480 * 3, b"\0")
        (folder / f"ir{image}").write_bytes(b"P6 640 480 255\n" + pixels)
    names = []
    for frame in range(FRAMES):
        ticks = FIRST_TICK + frame * TICKS
        pairs = ((f"d-{frame / 30:.6f}-{ticks % 2**32}.pgm", "depth"),)
        pairs += ((f"r-{frame / 30 + 0.001:.6f}-{(ticks + IR_LATE_TICKS) % 2**32}.ppm", "ir"),)
        for name, kind in pairs:
            (folder / name).symlink_to(f"{kind}{frame % IMAGES}")
            names.append(name)
    (folder / "INDEX.txt").write_text("\n".join(names) + "\n")
    return folder


@pytest.fixture(scope="module")
def preload(plugin, tmp_path_factory):
    library = tmp_path_factory.mktemp("preload") / "fakenect_kinect.so"
    source = Path(__file__).with_name("fakenect_kinect.c")
    command = [shutil.which("gcc") or "gcc", "-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror"]
    command += ["-isystem/usr/include/libusb-1.0", "-o", library, source, "-lfreenect", "-ldl"]
    subprocess.run(command, check=True, timeout=60)
    return library


@pytest.fixture
def plugged(tmp_path):
    file = tmp_path / "plugged"
    file.touch()
    return file


@pytest.fixture
def environment(preload, dump, plugged):
    return {
        "FAKENECT_PATH": str(dump),
        "FAKENECT_PLUGGED": str(plugged),
        "LD_PRELOAD": str(preload),
        "LD_LIBRARY_PATH": str(FAKENECT.parent),
    }


@pytest.fixture
def kinect(environment):
    """Makes closed cameras, each with the options given."""
    made = []

    def make(**options):
        options = {"drivers": ["kinect1"], "latency_ms": 0.0, "latency_sd_ms": 5.0} | options
        camera = IsolatedCamera(
            "drivers.depth_openni2:in_process", name="depth", options=options, environment=environment
        )
        made.append(camera)
        return camera

    yield make
    for camera in made:
        camera.close()


def image_of(frame):
    return int(frame.depth_mm[1, 0]) - 900


def check_for(camera, seconds):
    give_up_s = time.monotonic() + seconds
    while time.monotonic() < give_up_s:
        camera.check()
        time.sleep(0.05)


def test_depth_and_infrared_come_through_bit_by_bit(kinect):
    with kinect() as camera:
        for _ in range(6):
            frame = camera.grab(time.monotonic_ns(), 3.0, with_ir=True)
            image = image_of(frame)
            assert np.array_equal(frame.depth_mm, depth(image))
            assert np.array_equal(frame.ir, infrared(image)[4:484])


def test_depth_in_tenths_is_ten_times_and_comes_back_as_whole_millimetres(kinect):
    with kinect(depth_unit="100um") as camera:
        assert "100 µm" in camera.about()["format"]
        frame = camera.grab(time.monotonic_ns(), 3.0)
    assert np.array_equal(frame.depth_mm, depth(image_of(frame)))


def test_stamps_are_the_devices_own_and_run_on_where_its_counter_wraps(environment):
    script = """
import json
from drivers.openni2.api import PixelFormat
from drivers.openni2.opening import ANY, open_streams
from drivers.openni2.pairs import Pairing
from drivers.openni2.runtime import Runtime

runtime = Runtime(["kinect1"])
streams = open_streams(runtime, ANY, None, PixelFormat.DEPTH_1_MM, True)
for stream in streams.all:
    stream.start()
seen = []
while len(seen) < 60:
    stream = streams.device.wait(streams.all, 5.0)
    image = stream.fetch()
    seen.append((stream.sensor.name, image.index, image.timestamp_us))
streams.device.close()
runtime.close()
print(json.dumps(seen))
"""
    run = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | environment,
        capture_output=True,
        timeout=60,
        check=True,
    )
    seen = json.loads(run.stdout.splitlines()[-1])
    first = {name: (index, stamp) for name, index, stamp in reversed(seen)}
    for name, index, stamp in seen:
        first_index, first_stamp = first[name]
        assert abs(stamp - first_stamp - (index - first_index) * TICKS / 60) <= 1
    assert seen[-1][2] * 60 > 2**32
    late_us = first["IR"][1] - first["DEPTH"][1]
    assert abs(late_us % (TICKS / 60) - IR_LATE_TICKS / 60) <= 1


def test_it_tells_model_serial_and_the_factorys_field_of_view(kinect):
    with kinect(serial=SERIAL) as camera:
        about = camera.about()
    assert about["model"] == "Microsoft Kinect v1"
    assert about["serial"] == SERIAL
    assert about["address"] == f"kinect1://{SERIAL}"
    angles = [float(angle) for angle in re.findall(r"([\d.]+)°", about["format"])]
    focal_px = 120 / (2 * 0.1042)
    expected = [math.degrees(2 * math.atan(half / focal_px)) for half in (320, 240)]
    assert np.allclose(angles, expected, atol=0.01)
    assert "registration off" in about["settings"]


def test_another_serial_number_is_not_this_camera(kinect):
    with pytest.raises(DeviceNotFoundError, match=SERIAL):
        kinect(serial="B0").open()


def test_unplugging_is_a_loss_and_plugging_in_again_mends_it(kinect, plugged):
    camera = kinect()
    with camera:
        camera.grab(time.monotonic_ns(), 3.0)
        plugged.unlink()
        with pytest.raises(DeviceLostError, match="unplugged"):
            check_for(camera, 5.0)
        camera.close()
        with pytest.raises(DeviceNotFoundError):
            camera.open()
        plugged.touch()
        camera.open()
        asked_ns = time.monotonic_ns()
        assert camera.grab(asked_ns, 3.0).t_ns >= asked_ns


def test_one_that_was_unplugged_for_a_moment_is_lost_too(kinect, plugged):
    with kinect() as camera:
        camera.grab(time.monotonic_ns(), 3.0)
        plugged.unlink()
        time.sleep(0.2)
        plugged.touch()
        with pytest.raises(DeviceLostError, match="unplugged"):
            check_for(camera, 5.0)


def test_without_any_kinect_there_is_no_crash(plugin):
    camera = IsolatedCamera(
        "drivers.depth_openni2:in_process", name="depth", options={"drivers": ["kinect1"]}
    )
    with pytest.raises(DeviceNotFoundError, match="none is connected"):
        camera.open()
