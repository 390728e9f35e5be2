"""Times a 1280 × 960 frame from an emulated GigE camera on loopback to a numpy array, beside plain PyGObject.

Run it from the project's folder: `python -m benchmarks.colour_aravis [ADDRESS]`; the camera is emulated at
127.0.0.1, or at another address of this computer. Each frame is triggered; the camera takes up to 4 ms to
notice, exposes for 1 ms and sends over UDP. The alternative is what a short script does: pop a buffer,
`np.frombuffer`, OpenCV's default (bilinear) demosaicing. CPU is that of all threads of the driver's
process, of both processes where it is isolated; the camera's own process is not counted.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np

from drivers.bayer import demosaic
from drivers.clock import SystemClock
from drivers.colour_aravis import colour, in_process
from drivers.emulators.gige_camera import GigeCamera

SIZE = (1280, 960)
FRAMES = 60
EXPOSURE_US = 1000.0
PACKET_BYTES = 8000
ADDRESS = sys.argv[-1] if len(sys.argv) > 1 else "127.0.0.1"


class StillCell:
    """A cell whose image is ready at once."""

    colour_size = SIZE

    def __init__(self) -> None:
        self._raw = np.random.default_rng(0).integers(2_000, 60_000, (*SIZE[::-1], 3)).astype(np.uint16)
        self._rgb = (self._raw >> 8).astype(np.uint8)

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> np.ndarray:
        time.sleep(max(0.0, (end_ns - time.monotonic_ns()) / 1e9))
        return self._raw

    def rgb(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> np.ndarray:
        time.sleep(max(0.0, (end_ns - time.monotonic_ns()) / 1e9))
        return self._rgb


def serve() -> None:
    with GigeCamera(StillCell(), "BENCH", ADDRESS):
        print("ready", flush=True)
        sys.stdin.read()


@contextmanager
def camera_process() -> Iterator[None]:
    command = [sys.executable, "-m", "benchmarks.colour_aravis", "camera", ADDRESS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise SystemExit("the emulated camera did not start")
            yield
        finally:
            process.kill()


def cpu_s(pid: int) -> float:
    with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123 - no Path is worth its cost here
        fields = stat.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(grab: Callable[[], Any], pids: list[int]) -> tuple[float, float, float]:
    """Median and least ms of a grab, and CPU ms of one."""
    for _ in range(5):
        grab()
    before, times = sum(map(cpu_s, pids)), []
    for _ in range(FRAMES):
        start = time.perf_counter()
        grab()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times)), min(times), 1e3 * (sum(map(cpu_s, pids)) - before) / FRAMES


def driver(factory: Callable[..., Any], pixel_format: str) -> tuple[float, float, float]:
    options = {
        "address": ADDRESS,
        "exposure_us": EXPOSURE_US,
        "pixel_format": pixel_format,
        "packet_bytes": PACKET_BYTES,
    }
    with factory(name="colour", clock=SystemClock(), options=options, shared={}) as camera:
        pids = [os.getpid(), *([camera.pid] if hasattr(camera, "pid") else [])]
        return measured(lambda: camera.grab(time.monotonic_ns(), 5.0), pids)


def plain(pixel_format: str, convert: Callable[[bytes], Any]) -> tuple[float, float, float]:
    """What a script with PyGObject does."""
    import gi

    gi.require_version("Aravis", "0.8")
    from gi.repository import Aravis

    camera = Aravis.Camera.new(ADDRESS)
    camera.set_pixel_format_from_string(pixel_format)
    camera.set_exposure_time(EXPOSURE_US)
    camera.gv_set_packet_size(PACKET_BYTES)
    camera.set_trigger("Software")
    stream = camera.create_stream(None, None)
    for _ in range(4):
        stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
    camera.start_acquisition()

    def grab() -> Any:
        while True:
            camera.software_trigger()
            buffer = stream.timeout_pop_buffer(5_000_000)
            complete = buffer.get_status() == Aravis.BufferStatus.SUCCESS
            result = convert(buffer.get_image_data()) if complete else None
            stream.push_buffer(buffer)
            if complete:
                return result

    try:
        return measured(grab, [os.getpid()])
    finally:
        camera.stop_acquisition()


def bilinear(content: bytes) -> Any:
    raw = np.frombuffer(content, np.uint8).reshape(SIZE[::-1])
    return cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2RGB)


def conversion(bits: int) -> tuple[float, float, float]:
    """The demosaicing alone."""
    raw = np.random.default_rng(0).integers(0, 2**bits, SIZE[::-1])
    raw = raw.astype(np.uint8 if bits == 8 else np.uint16)
    return measured(lambda: demosaic(raw, "RGGB", bits), [os.getpid()])


def show(what: str, figures: tuple[float, float, float], base: tuple[float, float, float]) -> None:
    median, least, cpu = figures
    print(
        f"  {what:<52} {median:7.1f} ms median {least:7.1f} ms least {cpu:7.1f} ms CPU, "
        f"{median / base[0]:.2f} times as long, {cpu / base[2]:.2f} times the CPU"
    )


def main() -> None:
    print(f"{FRAMES} triggered frames of {SIZE[0]} × {SIZE[1]}, packets of {PACKET_BYTES} bytes")
    with camera_process():
        driver(in_process, "BayerRG8")  # leaves the camera with everything automatic off, for the script too
        base = plain("BayerRG8", bilinear)
        show("BayerRG8, plain PyGObject, bilinear (OpenCV)", base, base)
        show("BayerRG8, plain PyGObject, no RGB", plain("BayerRG8", lambda content: content), base)
        for pixel_format in ("BayerRG8", "BayerRG12", "BayerRG12p", "RGB8"):
            show(f"{pixel_format}, driver in this process", driver(in_process, pixel_format), base)
            show(f"{pixel_format}, driver isolated", driver(colour, pixel_format), base)
    for bits in (8, 12):
        show(f"raw of {bits} bits to RGB alone", conversion(bits), base)


if __name__ == "__main__":
    serve() if "camera" in sys.argv else main()
