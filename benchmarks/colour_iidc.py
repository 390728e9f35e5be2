"""Times an IIDC frame from trigger to array: the driver, isolated and not, beside libdc1394 called directly.

Run it from the project's folder: `python -m benchmarks.colour_iidc`. The emulated Firefly MV stands behind
a socket in place of USB (needs gcc and libusb-1.0-0-dev), so what is timed is software only: over USB 2 the
1.2 MB of a frame take some 30 ms more. The ratio is of CPU time: called directly, the camera waits by its
own settings, which the driver changes, so that the waits of the two are not the same thing.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from drivers.clock import SystemClock
from drivers.colour_iidc import in_process
from drivers.iidc.dc1394 import Library
from drivers.iidc.dc1394_types import TRIGGER_MODE_0, TRIGGER_SOURCE_SOFTWARE
from drivers.isolation.camera import IsolatedCamera

ROOT = Path(__file__).resolve().parents[1]
ROUNDS = 60
OPTIONS = {"mode": "1280x960_mono8", "exposure_us": 1000.0, "gain_db": 0.0}
_MODE_1280X960_MONO8, _FRAMERATE_15, _SHUTTER, _MANUAL = 81, 35, 423, 736


def measured(grab: Callable[[], object]) -> dict[str, float]:
    """Milliseconds of `ROUNDS` calls; CPU is of this process and of its children that have ended."""
    for _ in range(5):
        grab()
    took, cpu = [], time.process_time()
    for _ in range(ROUNDS):
        start = time.perf_counter()
        grab()
        took.append(1e3 * (time.perf_counter() - start))
    used = 1e3 * (time.process_time() - cpu) / ROUNDS
    return {"median": float(np.median(took)), "least": min(took), "cpu": used}


def bare() -> dict[str, float]:
    library = Library()
    camera = library.camera(library.guids()[0])
    camera.call("video_set_transmission", 0)
    camera.call("video_set_mode", _MODE_1280X960_MONO8)
    camera.call("video_set_framerate", _FRAMERATE_15)
    camera.call("feature_set_mode", _SHUTTER, _MANUAL)
    camera.call("feature_set_absolute_control", _SHUTTER, 1)
    camera.call("feature_set_absolute_value", _SHUTTER, ctypes.c_float(0.001))
    camera.call("external_trigger_set_mode", TRIGGER_MODE_0)
    camera.call("external_trigger_set_source", TRIGGER_SOURCE_SOFTWARE)
    camera.call("external_trigger_set_power", 1)
    camera.call("capture_setup", 4, 4)
    camera.call("video_set_transmission", 1)

    def grab() -> object:
        while camera.number("software_trigger_get_power"):
            time.sleep(0.0005)
        camera.call("software_trigger_set_power", 1)
        while (image := camera.take()) is None:
            time.sleep(0.0005)
        return cv2.cvtColor(np.frombuffer(image, np.uint8).reshape(960, 1280), cv2.COLOR_BayerGB2RGB)

    result = measured(grab)
    camera.call("video_set_transmission", 0)
    camera.call("capture_stop")
    return result


def driver() -> dict[str, float]:
    clock = SystemClock()
    with in_process(name="colour", clock=clock, options=OPTIONS, shared={}) as camera:
        return measured(lambda: camera.grab(clock.now_ns(), 5.0))


def isolated() -> dict[str, float]:
    clock = SystemClock()
    with IsolatedCamera("drivers.colour_iidc:in_process", name="colour", options=OPTIONS) as camera:
        before = _cpu_ms(camera.pid)
        result = measured(lambda: camera.grab(clock.now_ns(), 5.0))
        result["cpu"] += (_cpu_ms(camera.pid) - before) / (ROUNDS + 5)
        return result


def _cpu_ms(pid: int | None) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return 1e3 * (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


CONTENDERS = {"libdc1394 called directly": bare, "driver": driver, "driver, isolated": isolated}


def main() -> None:
    if len(sys.argv) > 1:
        print(json.dumps(CONTENDERS[sys.argv[1]]()))
        return
    sys.path.insert(0, str(ROOT / "tests"))
    from firefly_socket import FireflySocket, build_libusb

    with tempfile.TemporaryDirectory() as folder:
        usb = Path(folder) / "usb"
        library = build_libusb(Path(folder))
        environment = os.environ | {"LD_LIBRARY_PATH": str(library), "IIDC_USB_SOCKET": str(usb)}
        print(f"{'1280 × 960, 1 ms exposure':28} {'median':>9} {'least':>9} {'CPU':>9}  against direct")
        with FireflySocket(usb):
            base = None
            for name in CONTENDERS:
                command = [sys.executable, "-m", "benchmarks.colour_iidc", name]
                done = subprocess.run(
                    command, env=environment, stdout=subprocess.PIPE, check=True, timeout=200, cwd=ROOT
                )
                found = json.loads(done.stdout)
                base = base or found
                ratio = f"{found['cpu'] / base['cpu']:.2f} of its CPU"
                times = " ".join(f"{found[key]:6.1f} ms" for key in ("median", "least", "cpu"))
                print(f"{name:28} {times}  {ratio}", flush=True)


if __name__ == "__main__":
    main()
