"""Opens everything at once and says what works, what does not, and what to do about it."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
from pathlib import Path

from daemon import wiring
from daemon.check_calibration import check_calibration, check_serials
from daemon.check_devices import check_devices
from daemon.config import Config
from daemon.findings import Finding, Notes
from drivers.recordings import Recording
from surfclass.pipeline import Pipeline

PACKAGES = ("surfclass", "drivers", "calibration", "daemon")


def check(config: Config) -> list[Finding]:
    """Looks at everything that the service will need; nothing is written, the light ends off.

    With all devices working it takes one capture and runs it through the pipeline, on a map of its
    own. Times are the host's.
    """
    findings: list[Finding] = []
    note = Notes(findings)
    _check_packages(note)
    _check_paths(config, note)
    pipeline: Pipeline | None = None
    with note.faults_of("rig and model", "correct the file that the message names"):
        pipeline = wiring.build_pipeline(config)
        names = ", ".join(pipeline.model.classes.names)
        features = pipeline.rig.features
        note.ok("rig", f"{pipeline.rig.name}, voxels of {pipeline.rig.voxel_size_m * 1000:g} mm")
        note.ok("model", f"{features.colour} and {features.texture}; {names}")
    check_calibration(config, note)
    _check_zenoh(config, note)
    if config.replay is not None:
        with note.faults_of("recording", "`surfclass recover` mends one that was cut off"):
            note.ok("recording", f"{config.replay}: {len(Recording.open(config.replay))} captures")
    else:
        check_devices(config, pipeline, note)
        check_serials(config, findings, note)
    return findings


def _check_packages(note: Notes) -> None:
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


def _check_paths(config: Config, note: Notes) -> None:
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


def _check_folder(subject: str, directory: Path, note: Notes) -> bool:
    if not directory.is_dir():
        note.wrong(subject, f"{directory} is no folder", f"mkdir -p {directory}")
        return False
    if not os.access(directory, os.W_OK | os.X_OK):
        note.wrong(subject, f"{directory} cannot be written to", "give it to the service's user or group")
        return False
    note.ok(subject, f"{directory} can be written to")
    return True


def _check_zenoh(config: Config, note: Notes) -> None:
    where = ", ".join(config.zenoh.listen or config.zenoh.connect)
    advice = "is the service running already, or the address another machine's? see [zenoh]"
    with note.faults_of("zenoh", advice):
        with wiring.open_zenoh(config):
            pass
        note.ok("zenoh", f"{config.zenoh.mode} at {where}")
