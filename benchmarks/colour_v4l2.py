"""Times a V4L2 frame from the kernel's buffer to an RGB array, beside OpenCV's VideoCapture.

Needs the kernel's test camera: `tests/vm/run.sh --benchmark` runs it in the virtual machine. There the
processor is emulated, so that milliseconds mean nothing; the ratio does. Both paths end in the same
demosaicing, which is timed by itself, too: what is left is what either costs.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.backends import create
from drivers.bayer import demosaic
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


def by_driver(path: str) -> tuple[float, NDArray[np.uint8]]:
    options = {"device_path": path, "width": WIDTH, "height": HEIGHT, "pixel_format": "RGGB"}
    with create("colour", "v4l2", clock=SystemClock(), options=options) as camera:
        rgb = camera.grab(0, 20.0).rgb
        return cpu_ms(lambda: camera.grab(0, 20.0)), rgb


def by_opencv(path: str) -> tuple[float, NDArray[np.uint8]]:
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"RGGB"))
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, WIDTH)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, HEIGHT)
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)

    def read() -> NDArray[np.uint8]:
        good, raw = capture.read()
        assert good, "OpenCV read no frame"
        return demosaic(raw.reshape(HEIGHT, WIDTH), "RGGB", 8)

    rgb = read()
    try:
        return cpu_ms(read), rgb
    finally:
        capture.release()


def main() -> None:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests/contract"))
    from vivid import Vivid, missing

    if missing():
        sys.exit(f"benchmarks.colour_v4l2: {missing()}, or rather tests/vm/run.sh --benchmark")
    cv2.setNumThreads(1)
    raw = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8)
    alone_ms = cpu_ms(lambda: demosaic(raw, "RGGB", 8))
    with Vivid(WIDTH, HEIGHT, fps=30) as vivid:
        vivid.show(raw.tobytes(), "RGGB")
        driver_ms, driver_rgb = by_driver(str(vivid.capture))
        opencv_ms, opencv_rgb = by_opencv(str(vivid.capture))
    same = np.array_equal(driver_rgb, opencv_rgb) and np.array_equal(driver_rgb, demosaic(raw, "RGGB", 8))
    print(f"{WIDTH} × {HEIGHT} RGGB to RGB, CPU time of a frame, median of {FRAMES}; images equal: {same}")
    for name, took_ms in (("driver", driver_ms), ("OpenCV VideoCapture", opencv_ms)):
        print(f"  {name:20s} {took_ms:8.2f} ms, without demosaicing {took_ms - alone_ms:8.2f} ms")
    print(f"  {'demosaicing alone':20s} {alone_ms:8.2f} ms")
    print(f"  driver / OpenCV: {driver_ms / opencv_ms:.2f}")


if __name__ == "__main__":
    main()
