"""Times a depth and IR exposure from the device to numpy arrays, beside PyPI's `openni` binding.

Run it from the project's folder: `python -m benchmarks.depth_openni2`. A virtual Kinect in a process of
its own publishes 640 × 480 at 30 Hz through the real libOpenNI2. Each way of reading it takes every
exposure as it comes, in a fresh process: measured are the CPU time of the processes that read, and the
time from when the frame was handed over until both images are arrays of the caller's own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from drivers import depth_openni2
from drivers.clock import SystemClock
from drivers.emulators.virtual_kinect import VirtualKinect
from drivers.openni2 import api, plugins
from drivers.openni2.build import build

WIDTH, HEIGHT, RATE_HZ = 640, 480, 30
EXPOSURES, WARM_UP = 150, 15
LATENCY_S = 0.02


class Stamped:
    """Images of noise; the first four IR pixels are the exposure's time."""

    depth_size = WIDTH, HEIGHT

    def __init__(self):
        self.images = np.random.default_rng(1).integers(500, 4000, (2, HEIGHT, WIDTH), dtype=np.uint16)

    def depth(self, t_ns, key):
        self.images[1, 0, :4] = np.frombuffer(np.int64(t_ns).tobytes(), np.uint16)
        return self.images


def handed_over_ns(ir):
    return int(np.frombuffer(ir[0, :4].tobytes(), np.int64)[0]) + round(LATENCY_S * 1e9)


@contextmanager
def ours(uri: str, isolated: bool) -> Iterator[tuple[Callable[[], np.ndarray], list[int]]]:
    make = depth_openni2.depth if isolated else depth_openni2.in_process
    camera = make(name="depth", clock=SystemClock(), options={"device": uri}, shared={})
    with camera:
        children = [camera.pid] if isolated else []
        yield lambda: camera.grab(0, 5.0, with_ir=True).ir, children


@contextmanager
def theirs(uri: str) -> Iterator[tuple[Callable[[], np.ndarray], list[int]]]:
    from openni import openni2

    with tempfile.TemporaryDirectory() as folder:
        drivers = Path(folder, "OpenNI2", "Drivers")
        drivers.mkdir(parents=True)
        Path(folder, "libOpenNI2.so").symlink_to(plugins.system_folder() / api.LIBRARY)
        (drivers / "libvirtual.so.0").symlink_to(plugins.find("virtual"))
        openni2.initialize(folder)
    device = openni2.Device(uri.encode())
    streams = [device.create_depth_stream(), device.create_ir_stream()]
    for stream in streams:
        stream.set_mirroring_enabled(False)
        stream.start()
    waiting = {}

    def read():
        while True:
            stream = openni2.wait_for_any_stream(streams, 5.0)
            frame = stream.read_frame()
            pixels = np.frombuffer(frame.get_buffer_as_uint16(), np.uint16)
            waiting[stream] = frame.timestamp, pixels.reshape(frame.height, frame.width).copy()
            del frame, pixels
            if len(waiting) == 2 and len({stamp for stamp, _ in waiting.values()}) == 1:
                ir = waiting[streams[1]][1]
                waiting.clear()
                return ir

    try:
        yield read, []
    finally:
        for stream in streams:
            stream.stop()
        for stream in streams:
            stream.close()
        device.close()
        openni2.unload()


WAYS = {
    "in process": lambda uri: ours(uri, isolated=False),
    "in a process of its own": lambda uri: ours(uri, isolated=True),
    "PyPI openni": theirs,
}


def cpu_s(children: list[int]) -> float:
    """Of this process and those."""
    total = time.process_time()
    for child in children:
        fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def measure(way: str, uri: str) -> dict[str, float]:
    with WAYS[way](uri) as (read, children):
        for _ in range(WARM_UP):
            read()
        before_s, late_ms = cpu_s(children), []
        for _ in range(EXPOSURES):
            ir = read()
            late_ms.append((time.monotonic_ns() - handed_over_ns(ir)) / 1e6)
        used_ms = 1e3 * (cpu_s(children) - before_s) / EXPOSURES
    return {"cpu": used_ms, "median": float(np.median(late_ms)), "p95": float(np.quantile(late_ms, 0.95))}


def serve(path: str) -> None:
    with VirtualKinect(Stamped(), Path(path), fps=RATE_HZ, latency_s=LATENCY_S):
        print("ready", flush=True)
        threading.Event().wait()


def main() -> None:
    build("virtual")
    again = [sys.executable, "-m", "benchmarks.depth_openni2"]
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        path = f"{folder}/kinect"
        kinect = subprocess.Popen([*again, "serve", path], stdout=subprocess.PIPE, text=True)
        try:
            kinect.stdout.readline()
            results = {}
            for way in WAYS:
                command = [*again, "measure", way, f"virtual://{path}"]
                run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
                results[way] = json.loads(run.stdout.splitlines()[-1])
        finally:
            kinect.kill()
            kinect.wait()
    print(f"{WIDTH} × {HEIGHT} depth and IR at {RATE_HZ} Hz, {EXPOSURES} exposures")
    base = results["PyPI openni"]
    for way, result in results.items():
        print(
            f"  {way:<24} {result['cpu']:6.2f} ms CPU an exposure ({result['cpu'] / base['cpu']:.2f} of "
            f"PyPI openni's), arrays after {result['median']:5.2f} ms median, {result['p95']:5.2f} ms at 95 %"
        )


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["serve", path]:
            serve(path)
        case ["measure", way, uri]:
            print(json.dumps(measure(way, uri)))
        case _:
            main()
