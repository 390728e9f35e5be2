"""The part of `surfclass check` that opens the devices, all at once, and takes one capture with them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np

from daemon import wiring
from daemon.config import Config
from daemon.findings import Notes
from drivers.errors import CaptureRejectedError
from surfclass.pipeline import Pipeline

_FRAMES = 5
_IMAGE = {"colour": "rgb", "depth": "depth_mm"}


def check_devices(config: Config, pipeline: Pipeline | None, note: Notes) -> None:
    """Opens every device and keeps it open, asks what it is, uses it, and captures with all of them."""
    advice = "see the keys of the device's table"
    sensors: wiring.Sensors | None = None
    with note.faults_of("devices", advice):
        sensors = wiring.build_sensors(config)
    if sensors is None:
        return
    works = True
    with ExitStack() as opened:
        for kind, device in sensors.devices.items():
            told = ""
            with note.faults_of(kind, advice):
                opened.enter_context(device)
                told = _probe(kind, device, sensors)
                facts = device.about()
                note.ok(kind, "\n".join([f"{config.devices[kind].backend}: {told}", *_lines(facts)]), facts)
            works = works and bool(told)
        if works:
            _check_capture(config, sensors, pipeline, note)


def _lines(facts: Mapping[str, str]) -> list[str]:
    """What a device tells of itself, in reading order."""
    order = ("library", "model", "serial", "firmware", "address", "format", "settings", "clock", "status")
    return [f"{name}: {facts[name]}" for name in order if name in facts]


def _probe(kind: str, device: Any, sensors: wiring.Sensors) -> str:
    if kind in _IMAGE:
        return _probe_camera(device, sensors, _IMAGE[kind])
    if kind == "light":
        device.set_level(0.0)
        return "answers, and is off"
    readings = [device.read_joints(sensors.device_s) for _ in range(_FRAMES)]
    q = np.degrees(readings[-1].q)
    uncertain_ms = max(reading.t_sd_ns for reading in readings) / 1e6
    return f"joints at {', '.join(f'{angle:.1f}' for angle in q)}°, read to ±{uncertain_ms:.1f} ms"


def _probe_camera(device: Any, sensors: wiring.Sensors, image: str) -> str:
    start = time.monotonic()
    frames: list[Any] = []
    for _ in range(_FRAMES):
        since = frames[-1].t_ns + 1 if frames else sensors.clock.now_ns()
        frames.append(device.grab(since, sensors.device_s))
    height, width = getattr(frames[-1], image).shape[:2]
    pixel = getattr(frames[-1], image).dtype
    apart = (frames[-1].t_ns - frames[0].t_ns) / 1e9 / (_FRAMES - 1)
    took = (time.monotonic() - start) / _FRAMES
    uncertain_ms = max(frame.t_sd_ns for frame in frames) / 1e6
    return (
        f"{width} × {height} {pixel}, {1 / apart:.1f} frames/s, {took * 1e3:.0f} ms each, "
        f"times to ±{uncertain_ms:.1f} ms"
    )


def _check_capture(config: Config, sensors: wiring.Sensors, pipeline: Pipeline | None, note: Notes) -> None:
    with note.faults_of("capture", "the devices work one by one, but not together; the message says what"):
        try:
            capture = sensors.package.capture("check", with_dark=config.capture.dark)
        except CaptureRejectedError as error:
            note.warn("capture", str(error), "keep the arm still and check again")
            return
        note.ok(
            "capture",
            f"depth {capture.skew_ns / 1e6:+.1f} ms from colour, to ±{capture.skew_sd_ns / 1e6:.1f} ms",
        )
        if pipeline is None:
            return
        result = pipeline.process(capture)
        total = sum(result.stage_ms.values())
        voxels = len(result.update.index)
        if voxels == 0:
            note.warn("pipeline", "the capture gave no voxels", "is a surface in view, 0.3 to 1.5 m away?")
        else:
            note.ok("pipeline", f"{voxels:,} voxels in {total:.0f} ms")
