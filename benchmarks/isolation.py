"""Times what a process of its own costs a camera, beside the same driver here and a pickled pipe.

Run it from the project's folder: `python -m benchmarks.isolation`. The driver has its frame in memory and
copies it out, as one must that gets it from a vendor's library; it waits for nothing, so that what is left
is the way to the caller. The pipe is that of the standard library: `multiprocessing`, started by spawn.
CPU is of both processes together.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from drivers.interfaces import Clock
from drivers.isolation.camera import IsolatedCamera
from surfclass.frames import ColourFrame, DepthFrame

FRAMES = 300
ROUNDS = 3
KINDS = {"depth": "640 × 480 depth and IR, 16 bit", "colour": "1280 × 960 colour, 8 bit"}
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class Still:
    """A camera with one picture."""

    def __init__(self, kind: str, clock: Clock) -> None:
        rng = np.random.default_rng(0)
        self.kind, self.clock, self.frames = kind, clock, 0
        self.depth = rng.integers(0, 8000, (480, 640), np.uint16)
        self.rgb = rng.integers(0, 256, (960, 1280, 3), np.uint8)

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def grab(self, not_before_ns: int, timeout_s: float, with_ir: bool = False) -> ColourFrame | DepthFrame:
        self.frames += 1
        t_ns = self.clock.now_ns()
        if self.kind == "colour":
            return ColourFrame(t_ns, self.frames, 0.004, self.rgb.copy())
        return DepthFrame(t_ns, self.frames, None, self.depth.copy(), self.depth.copy() if with_ir else None)


def still(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> Still:
    return Still(options["kind"], clock)


def serve(kind: str, pipe: Connection) -> None:
    from drivers.clock import SystemClock

    camera = Still(kind, SystemClock())
    while (question := pipe.recv()) is not None:
        pipe.send(camera.grab(*question))


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def timed(grab: Callable[[], object], pid: int | None) -> tuple[float, float]:
    """Median wall time and mean CPU time of a frame, ms."""
    for _ in range(10):
        grab()
    walls, other = [], 0.0 if pid is None else cpu_s(pid)
    here = time.process_time()
    for _ in range(FRAMES):
        start = time.perf_counter()
        grab()
        walls.append(time.perf_counter() - start)
    cpu = time.process_time() - here + (0.0 if pid is None else cpu_s(pid) - other)
    return 1e3 * float(np.median(walls)), 1e3 * cpu / FRAMES


def compared(kind: str) -> dict[str, tuple[float, float]]:
    from drivers.clock import SystemClock

    question = (0, 1.0, True) if kind == "depth" else (0, 1.0)
    here = Still(kind, SystemClock())
    root = str(Path(__file__).parents[1])
    camera: IsolatedCamera[DepthFrame] = IsolatedCamera(
        "benchmarks.isolation:still", name=kind, options={"kind": kind}, environment={"PYTHONPATH": root}
    )
    spawn = multiprocessing.get_context("spawn")
    pipe, theirs = spawn.Pipe()
    process = spawn.Process(target=serve, args=(kind, theirs), daemon=True)
    process.start()

    def piped() -> object:
        pipe.send(question)
        assert pipe.poll(10.0), "the piped camera is silent"
        return pipe.recv()

    def one_round() -> dict[str, tuple[float, float]]:
        return {
            "in this process": timed(lambda: here.grab(*question), None),
            "isolated": timed(lambda: camera.grab(*question), camera.pid),
            "pickled pipe": timed(piped, process.pid),
        }

    with camera:
        rounds = [one_round() for _ in range(ROUNDS)]
    pipe.send(None)
    process.join(10.0)
    return {way: min(times[way] for times in rounds) for way in rounds[0]}


def opening() -> float:
    root = str(Path(__file__).parents[1])
    times = []
    for _ in range(5):
        camera: IsolatedCamera[ColourFrame] = IsolatedCamera(
            "benchmarks.isolation:still",
            name="colour",
            options={"kind": "colour"},
            environment={"PYTHONPATH": root},
        )
        start = time.perf_counter()
        with camera:
            times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def main() -> None:
    for kind, words in KINDS.items():
        print(f"{words}: {FRAMES} frames, the best of {ROUNDS} rounds")
        ways = compared(kind)
        base, ours = ways["in this process"], ways["isolated"]
        for way, (wall, cpu) in ways.items():
            print(
                f"  {way:<16} {wall:7.3f} ms  CPU {cpu:7.3f} ms   {wall - base[0]:+7.3f} ms,"
                f"  {wall / ours[0]:5.2f} × the time and {cpu / ours[1]:5.2f} × the CPU of isolated"
            )
    print(f"opening an isolated camera that needs no library: {opening():.0f} ms at best")


if __name__ == "__main__":
    main()
