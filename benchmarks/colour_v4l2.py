"""Times a V4L2 frame from the kernel's buffer to an RGB array, beside linuxpy's own VideoCapture.

Needs the kernel's test camera: `tests/vm/run.sh --benchmark` runs it in the virtual machine. There the
processor is emulated, so that milliseconds mean nothing; the ratio does. The format is RGB3, which
needs no conversion: demosaicing would hide what the rest costs. linuxpy's frame has neither checked
flags nor times, nor are the controls read back.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from linuxpy.video.device import Device, VideoCapture
from numpy.typing import NDArray

from drivers.backends import create
from drivers.clock import SystemClock

WIDTH, HEIGHT = 1280, 960
FRAMES = 25


def cpu_ms(call: Callable[[], object]) -> float:
    """CPU time of one call by this thread, ms, the median; waiting for the camera costs none."""
    took = []
    for _ in range(FRAMES):
        start = time.thread_time()
        call()
        took.append(time.thread_time() - start)
    return 1e3 * float(np.median(took))


def by_driver(path: str) -> tuple[float, NDArray[Any]]:
    options = {"device_path": path, "width": WIDTH, "height": HEIGHT, "pixel_format": "RGB3"}
    with create("colour", "v4l2", clock=SystemClock(), options=options) as camera:
        return cpu_ms(lambda: camera.grab(0, 20.0)), camera.grab(0, 20.0).rgb


def by_linuxpy(path: str) -> tuple[float, NDArray[Any]]:
    with Device(path) as device:
        capture = VideoCapture(device, size=4)
        capture.set_format(WIDTH, HEIGHT, "RGB3")
        with capture:
            frames = iter(capture)

            def read() -> NDArray[Any]:
                return np.frombuffer(next(frames).data, np.uint8).reshape(HEIGHT, WIDTH, 3)

            return cpu_ms(read), read()


def main() -> None:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests/contract"))
    from vivid import Vivid, missing

    if missing():
        sys.exit(f"benchmarks.colour_v4l2: {missing()}, or rather tests/vm/run.sh --benchmark")
    written = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    with Vivid(WIDTH, HEIGHT, fps=30) as vivid:
        vivid.show(written.tobytes(), "RGB3")
        driver_ms, driver_rgb = by_driver(str(vivid.capture))
        linuxpy_ms, linuxpy_rgb = by_linuxpy(str(vivid.capture))
    print(f"{WIDTH} × {HEIGHT} RGB3 to an array, CPU time of a frame, median of {FRAMES}")
    for name, took_ms, rgb in (("driver", driver_ms, driver_rgb), ("linuxpy", linuxpy_ms, linuxpy_rgb)):
        print(f"  {name}: {took_ms:.2f} ms, the image is what was written: {np.array_equal(rgb, written)}")
    print(f"  driver / linuxpy: {driver_ms / linuxpy_ms:.2f}")


if __name__ == "__main__":
    main()
