"""The demo: everything once on the simulated cell, service and console as processes of their own."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from daemon import commissioning_steps, maps, offline, pictures
from daemon.console import MapClient
from daemon.demo_commissioning import commission_simulated
from daemon.demo_stages import EmulatedStage, SimulatedStage, Stage
from daemon.offline import console
from daemon.processes import STOP_S, last_words, process
from daemon.transport import TransportError, open_session
from drivers.files import write_atomically
from drivers.recordings import Recording, RecordingWriter
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.pipeline import PipelineSettings
from surfclass.rig import parse_classes
from surfclass.training import TrainingSettings

_WAIT_S = 240.0


def run_demo(
    out: Path, seed: int, viewpoints: int, real_drivers: bool = False, commission: bool = False
) -> int:
    """Runs the demo into `out` and returns the exit code: 0 if the console's map equals the service's.

    Args:
        out: Where everything goes.
        seed: Of the simulated cell.
        viewpoints: How many places are visited.
        real_drivers: Through OpenNI2, Aravis, the light's serial protocol and b-CAP, with an emulated
            device behind each, instead of simulated devices.
        commission: Find the rig by the commissioning steps instead of taking it from the simulation.

    Raises:
        InputError: If a step finds its input unusable; the message says which.
    """
    start = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    _clear(out)

    world = SimWorld("cell", seed)
    stage = EmulatedStage(out, seed, viewpoints) if real_drivers else SimulatedStage(seed, viewpoints)
    if real_drivers:
        console.rule("0  start the emulated devices")
    with stage:
        how = "by capturing its targets" if commission else "from the simulation's truth"
        console.rule(f"1  commission {how}")
        rig_text = commission_simulated(out, seed) if commission else stage.rig()
        classes_text = truth.classes_toml()
        write_atomically(out / "rig.toml", rig_text.encode())
        write_atomically(out / "classes.toml", classes_text.encode())
        console.print(f"rig.toml, classes.toml: {len(parse_classes(classes_text, 'classes').names)} surfaces")

        console.rule("2  train from one board of each surface, at 0.65 m and 0°")
        _capture_boards(out / "train.mcap", rig_text, classes_text, seed, stage)
        devices = stage.cell()
        call = commissioning_steps.call("train", None, None, [out / "train.mcap"], None, None, None)
        if commissioning_steps.train(call, out / "model.npz", TrainingSettings()):
            raise InputError("the model is of no use; see above")

        console.rule(f"3  map the cell from {viewpoints} viewpoints: service and console in two processes")
        recorded, stage_ms = _map_cell(out, viewpoints, devices, stage)

    console.rule("4  score the map against the simulation's truth")
    _label(recorded, out / "test.mcap", world)
    result = offline.evaluate_recording(out / "test.mcap", out / "model.npz", "all", PipelineSettings())
    offline.write_json(str(out / "evaluation.json"), result)
    offline.print_evaluation(result)
    _print_stages(stage_ms)

    console.rule("5  pictures")
    _draw(out, result)
    equal = (out / "console.npz").read_bytes() == (out / "daemon.npz").read_bytes()
    took = time.monotonic() - start
    fused = result["routes"]["combined"]["fused"]
    verdict = "equals" if equal else "DIFFERS FROM"
    console.print(
        f"\nThe console's map {verdict} the daemon's: {fused['voxels']:,} labelled voxels, "
        f"{fused['overall']:.1%} right, {viewpoints} viewpoints, {took:.0f} s; results in {out}/",
        style="bold green" if equal else "bold red",
        highlight=False,
    )
    return 0 if equal else 1


def _clear(out: Path) -> None:
    """Removes what an earlier demo left; nothing that a demo does not write."""
    for folder in ("recordings", "commissioned"):
        shutil.rmtree(out / folder, ignore_errors=True)
    for pattern in ("*.mcap", "*.mcap.active", "*.npz", "*.png", "*.ply", "*.json", "*.toml", "*.log"):
        for path in out.glob(pattern):
            path.unlink()


def _capture_boards(path: Path, rig_text: str, classes_text: str, seed: int, stage: Stage) -> None:
    """Captures one board of each surface, labelled by what was put there."""
    names = parse_classes(classes_text, "classes").names
    with (
        RecordingWriter(path, rig_text, classes_text, {"source": "simulated boards"}) as writer,
        offline.progress(len(names), "capturing") as advance,
    ):
        for number, name in enumerate(names):
            package, world = stage.board(f"board:{name}", seed + 1 + number)
            capture = package.capture(f"train_{name}", "train")
            writer.write(dataclasses.replace(capture, label=_truth_label(world, capture)))
            advance(name)


def _truth_label(world: SimWorld, capture: Capture) -> NDArray[np.uint8]:
    if capture.joints is None:
        raise InputError(f"capture {capture.name}: has no joint angles")
    return truth.label_image(world, capture.joints.q)


def _map_cell(out: Path, viewpoints: int, devices: str, stage: Stage) -> tuple[Path, dict[str, float]]:
    """Runs service and console until the console's map holds every viewpoint.

    Returns:
        The service's recording, and the median milliseconds of its stages.
    """
    with tempfile.TemporaryDirectory(prefix="surfclass-") as sockets:
        endpoint = f"unixsock-stream/{sockets}/z"
        config = out / "service.toml"
        write_atomically(config, f"{_CONFIG.format(endpoint=endpoint)}\n{devices}".encode())
        watch = ["watch", "--connect", endpoint, "--robot", "demo", "--captures", str(viewpoints)]
        watch += ["--timeout-s", str(_WAIT_S), "--map", str(out / "console.npz")]
        watch += ["--json", str(out / "console.json")]
        with (
            process(out / "daemon.log", ["run", "--config", str(config)]) as service,
            process(out / "console.log", watch) as watcher,
            console.status("the arm visits the cell"),
        ):
            _wait(watcher, service, out, endpoint, stage)
            service.send_signal(signal.SIGTERM)
            service.wait(STOP_S)
    (recording,) = (out / "recordings").glob("*.mcap")
    return recording, json.loads((out / "console.json").read_text())["status"]["stage_ms"]


def _wait(
    watcher: subprocess.Popen[bytes],
    service: subprocess.Popen[bytes],
    out: Path,
    endpoint: str,
    stage: Stage,
) -> None:
    """Returns when the console has its map; meanwhile the stage hears how far the service is.

    Raises:
        InputError: If either process ends badly; the message ends with what it said last.
    """
    with _session(endpoint, service, out) as session, MapClient(session, "demo") as client:
        while watcher.poll() is None:
            _must_run(service, out)
            if client.map is not None:
                stage.captured(client.map.sequence)
            time.sleep(0.1)
    if watcher.returncode != 0:
        raise InputError(f"the console ended with {watcher.returncode}: {last_words(out / 'console.log')}")


def _session(endpoint: str, service: subprocess.Popen[bytes], out: Path) -> zenoh.Session:
    """A session with the service as soon as it listens."""
    while True:
        try:
            return open_session("client", connect=[endpoint])
        except TransportError:
            _must_run(service, out)
            time.sleep(0.2)


def _must_run(service: subprocess.Popen[bytes], out: Path) -> None:
    if service.poll() is not None:
        raise InputError(f"the service ended with {service.returncode}: {last_words(out / 'daemon.log')}")


def _label(recorded: Path, out: Path, world: SimWorld) -> None:
    """Copies the service's captures, with the simulation's truth as their labels."""
    recording = Recording.open(recorded)
    assert recording.classes_text is not None
    with RecordingWriter(
        out, recording.rig_text, recording.classes_text, {"source": "simulated cell"}
    ) as writer:
        for capture in recording.captures():
            writer.write(dataclasses.replace(capture, role="test", label=_truth_label(world, capture)))


def _print_stages(stage_ms: dict[str, float]) -> None:
    console.print(
        "service, median milliseconds a capture: "
        + ", ".join(f"{stage} {ms:.0f}" for stage, ms in stage_ms.items()),
        highlight=False,
    )


def _draw(out: Path, result: dict[str, Any]) -> None:
    pictures.draw_confusions(out / "confusion.png", result)
    maps.show(out / "console.npz", out / "map.png", out / "map.ply", out / "classes.toml")
    names = list(result["routes"]["combined"]["views"])
    chosen = [names[i] for i in sorted({0, len(names) // 3, 2 * len(names) // 3, len(names) - 1})]
    maps.show_captures(out / "test.mcap", out / "views.png", chosen, out / "model.npz")


_CONFIG = """\
schema = 1
robot = "demo"
rig = "rig.toml"
model = "model.npz"
map = "daemon.npz"

[trigger.rest]

[recording]
directory = "recordings"

[zenoh]
listen = ["{endpoint}"]
"""
