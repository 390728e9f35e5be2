"""Opens everything once and says what works, what does not, and what to do about it."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from daemon import wiring
from daemon.config import Config
from drivers.errors import (
    CaptureRejectedError,
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from drivers.recording import Recording
from surfclass.errors import InputError
from surfclass.pipeline import Pipeline

PACKAGES = ("surfclass", "drivers", "calibration", "daemon")
_FRAMES = 5

_ADVICE: dict[type[DriverError], str] = {
    DeviceNotFoundError: "check power, cable, address and access rights (`systemd/60-surfclass.rules`)",
    DeviceLostError: "check the cable and the power supply; look for USB resets in `journalctl -k`",
    DeviceTimeoutError: "it is there but silent: is another program using it, or its trigger not wired?",
    DeviceFaultError: "read the fault at the device itself, mend it and switch the device off and on",
    DriverUnavailableError: "install the package that the message names into the service's environment",
}


class Verdict(StrEnum):
    """How a finding counts."""

    OK = "ok"
    WARNING = "warning"
    CONFIGURATION = "configuration"
    DEVICE = "device"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        subject: What, such as "colour" or "model".
        verdict: Whether it can work, and if not, whose fault that is.
        message: What was found.
        advice: What to do; empty where nothing is to be done.
    """

    subject: str
    verdict: Verdict
    message: str
    advice: str = ""

    def as_json(self) -> dict[str, str]:
        """Returns the finding for `--json`."""
        return asdict(self)


def check(config: Config) -> list[Finding]:
    """Looks at everything that the service will need; nothing is written, the light ends off.

    With all devices working it takes one capture and runs it through the pipeline, on a map of its
    own. Times are the host's.
    """
    findings: list[Finding] = []
    note = _Notes(findings)
    _check_packages(note)
    _check_paths(config, note)
    pipeline: Pipeline | None = None
    with note.faults_of("rig and model", "correct the file that the message names"):
        pipeline = wiring.build_pipeline(config)
        names = ", ".join(pipeline.model.classes.names)
        features = pipeline.rig.features
        note.ok("rig", f"{pipeline.rig.name}, voxels of {pipeline.rig.voxel_size_m * 1000:g} mm")
        note.ok("model", f"{features.colour} and {features.texture}; {names}")
    _check_zenoh(config, note)
    if config.replay is not None:
        with note.faults_of("recording", "`surfclass recover` mends one that was cut off"):
            note.ok("recording", f"{config.replay}: {len(Recording.open(config.replay))} captures")
    else:
        _check_devices(config, pipeline, note)
    return findings


def exit_code(findings: list[Finding]) -> int:
    """Returns 0, 78 where something is configured wrongly, else 69 where a device does not work."""
    verdicts = {finding.verdict for finding in findings}
    if Verdict.CONFIGURATION in verdicts:
        return os.EX_CONFIG
    return os.EX_UNAVAILABLE if Verdict.DEVICE in verdicts else os.EX_OK


class _Notes:
    def __init__(self, findings: list[Finding]) -> None:
        self._findings = findings

    def ok(self, subject: str, message: str) -> None:
        self._findings.append(Finding(subject, Verdict.OK, message))

    def warn(self, subject: str, message: str, advice: str) -> None:
        self._findings.append(Finding(subject, Verdict.WARNING, message, advice))

    def wrong(self, subject: str, message: str, advice: str) -> None:
        self._findings.append(Finding(subject, Verdict.CONFIGURATION, message, advice))

    @contextmanager
    def faults_of(self, subject: str, advice: str) -> Iterator[None]:
        """Turns what goes wrong inside into a finding."""
        try:
            yield
        except DriverUnavailableError as error:
            self.wrong(subject, str(error), _ADVICE[DriverUnavailableError])
        except DriverError as error:
            told = next((_ADVICE[kind] for kind in type(error).__mro__ if kind in _ADVICE), advice)
            self._findings.append(Finding(subject, Verdict.DEVICE, str(error), told))
        except (InputError, OSError) as error:
            self.wrong(subject, str(error), advice)


def _check_packages(note: _Notes) -> None:
    """The four folders are import names of their own, which another distribution may own too."""
    owners = importlib.metadata.packages_distributions()
    for name in PACKAGES:
        others = set(owners.get(name, [])) - {"surfclass"}
        if others:
            note.wrong(
                "installation",
                f"the package name {name!r} also belongs to {', '.join(sorted(others))}",
                "give surfclass an environment of its own",
            )
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("numpy", "opencv-python-headless")]
    note.ok("installation", ", ".join(versions))


def _check_paths(config: Config, note: _Notes) -> None:
    if config.map is not None:
        _check_folder("map", config.map.parent, note)
    if config.recording is None:
        if config.replay is None:
            note.warn("recording", "captures are not recorded", "add a [recording] table to keep them")
        return
    directory = config.recording.directory
    made = directory if directory.exists() else directory.parent  # the service makes the last folder
    if _check_folder("recording", made, note) and directory.exists():
        free_mb = shutil.disk_usage(directory).free >> 20
        if free_mb < config.recording.min_free_mb:
            note.wrong(
                "recording",
                f"{directory}: {free_mb} MB free, {config.recording.min_free_mb} must stay free",
                "make room, or lower recording.min_free_mb",
            )
        for path in sorted(directory.glob("*.active")):
            note.warn("recording", f"{path} was never finished", f"surfclass recover {path}")


def _check_folder(subject: str, directory: Path, note: _Notes) -> bool:
    if not directory.is_dir():
        note.wrong(subject, f"{directory} is no folder", f"mkdir -p {directory}")
        return False
    if not os.access(directory, os.W_OK | os.X_OK):
        note.wrong(subject, f"{directory} cannot be written to", "give it to the service's user or group")
        return False
    note.ok(subject, f"{directory} can be written to")
    return True


def _check_zenoh(config: Config, note: _Notes) -> None:
    where = ", ".join(config.zenoh.listen or config.zenoh.connect)
    advice = "is the service running already, or the address another machine's? see [zenoh]"
    with note.faults_of("zenoh", advice):
        with wiring.open_zenoh(config):
            pass
        note.ok("zenoh", f"{config.zenoh.mode} at {where}")


def _check_devices(config: Config, pipeline: Pipeline | None, note: _Notes) -> None:
    advice = "see the keys of the device's table"
    sensors: wiring.Sensors | None = None
    with note.faults_of("devices", advice):
        sensors = wiring.build_sensors(config)
    if sensors is None:
        return
    works = True
    probes: dict[str, Callable[[Any], str]] = {
        "colour": lambda device: _probe_camera(device, sensors, "rgb"),
        "depth": lambda device: _probe_camera(device, sensors, "depth_mm"),
        "light": _probe_light,
        "arm": lambda device: _probe_arm(device, config.limits.device_s),
    }
    for kind, device in sensors.devices.items():
        told = ""
        with note.faults_of(kind, advice), device:
            told = probes[kind](device)
            library = getattr(device, "library", "") or f"{type(device).__module__}"
            note.ok(kind, f"{config.devices[kind].backend} ({library}): {told}")
        works = works and bool(told)
    if works:
        _check_capture(config, sensors, pipeline, note)


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
    return f"{width} × {height} {pixel}, {1 / apart:.1f} frames/s, {took * 1e3:.0f} ms each"


def _probe_light(device: Any) -> str:
    device.set_level(0.0)
    return "answers, and is off"


def _probe_arm(device: Any, timeout_s: float) -> str:
    q = np.degrees(device.read_joints(timeout_s).q)
    return f"joints at {', '.join(f'{angle:.1f}' for angle in q)}°"


def _check_capture(config: Config, sensors: wiring.Sensors, pipeline: Pipeline | None, note: _Notes) -> None:
    advice = "the devices work one by one, but not together; the message says what"
    with ExitStack() as open_devices, note.faults_of("capture", advice):
        package = open_devices.enter_context(sensors.package)
        try:
            capture = package.capture("check", with_dark=config.capture.dark)
        except CaptureRejectedError as error:
            note.warn("capture", str(error), "keep the arm still and check again")
            return
        note.ok("capture", f"depth {capture.skew_ns / 1e6:+.1f} ms from colour")
        if pipeline is None:
            return
        result = pipeline.process(capture)
        total = sum(result.stage_ms.values())
        voxels = len(result.update.index)
        if voxels == 0:
            note.warn("pipeline", "the capture gave no voxels", "is a surface in view, 0.3 to 1.5 m away?")
        else:
            note.ok("pipeline", f"{voxels:,} voxels in {total:.0f} ms")
