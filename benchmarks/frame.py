"""Times one 1280 × 960 frame through both routes into a map of 10⁶ voxels, beside the literal method.

Run it from the project's folder: `python -m benchmarks.frame`. The literal form (a neighbourhood and an
eigenproblem for each point, a kernel sum for each pixel, a histogram for each window, a product for each
pixel's voxel) is timed on a crop and scaled by the number of pixels. OpenCV may use both cores.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from benchmarks.literal import (
    literal_bayes,
    literal_histograms,
    literal_K_d,
    literal_normals,
    literal_posteriors,
)
from drivers.sensor_package import SensorPackage
from drivers.sim import truth
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld
from surfclass.frames import Capture
from surfclass.pipeline import Pipeline
from surfclass.rig import parse_classes, parse_rig
from surfclass.training import train
from surfclass.types import Observation

MAP_VOXELS = 1_000_000
FRAMES = 9


def captured(world: SimWorld, name: str, role: str) -> Capture:
    devices = SimColourCamera(world), SimDepthCamera(world), SimLight(world), SimArm(world)
    with SensorPackage(world.clock, *devices) as package:
        return package.capture(name, role)


def labelled(world: SimWorld, name: str) -> Capture:
    taken = captured(world, name, "train")
    return dataclasses.replace(taken, label=truth.label_image(world, taken.joints.q))


def filled(pipeline: Pipeline) -> None:
    """Gives the map a million voxels somewhere else."""
    k = len(pipeline.model.classes.names)
    side = round(MAP_VOXELS ** (1 / 3))
    place = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    point = ((place + 0.5 + 500) * pipeline.rig.voxel_size_m).astype(np.float32)
    nothing, none = np.zeros((len(point), k), np.float32), np.zeros(len(point), bool)
    colour = np.full((len(point), k), -0.5, np.float32)
    weight = np.zeros(len(point), np.float32)
    pipeline.map.add(Observation(point, colour, nothing, ~none, none, weight), 0)


def seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main() -> None:
    world = SimWorld("cell")
    rig = parse_rig(truth.rig(world), "rig")
    classes = parse_classes(truth.classes_toml(), "classes")
    print("training …", flush=True)
    boards = [labelled(SimWorld(f"board:{name}", 1 + n), name) for n, name in enumerate(classes.names)]
    model = train(boards, [], rig, classes)
    frame = captured(world, "frame", "map")
    pipeline = Pipeline(rig, model)
    filled(pipeline)
    runs = [pipeline.process(frame).stage_ms for _ in range(FRAMES)]
    medians = {stage: float(np.median([run[stage] for run in runs])) for stage in runs[0]}
    totals = [sum(run.values()) for run in runs]
    print(f"map of {len(pipeline.map):,} voxels, {FRAMES} frames of 1280 × 960")
    for stage, ms in medians.items():
        print(f"  {stage:<16} {ms:8.1f} ms")
    ours = float(np.median(totals))
    print(f"  {'whole frame':<16} {ours:8.1f} ms median, {min(totals):.1f} ms least")

    print("the literal method, on crops, scaled to the whole frame:")
    stages = {
        "normals": literal_normals(frame.depth.depth_mm, rig),
        "K_d": literal_K_d(frame, rig),
        "posteriors": literal_posteriors(frame, model),
        "LBP histograms": literal_histograms(frame),
        "voxels": literal_bayes(frame, len(classes.names)),
    }
    for stage, s in stages.items():
        print(f"  {stage:<16} {1e3 * s:10.0f} ms")
    literal = 1e3 * sum(stages.values())
    print(f"  {'whole frame':<16} {literal:10.0f} ms: {literal / ours:,.0f} times as long")


if __name__ == "__main__":
    main()
