"""Data folders and processes for tests that run the real command."""

import contextlib
import csv
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2

from drivers.recordings import Recording, RecordingWriter
from drivers.recordings.captures_csv import COLUMNS
from drivers.sensor_package import SensorPackage
from drivers.sim import truth
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld
from surfclass.rig import parse_classes

SCALE = 0.25  # images of 320 × 240
CLASSES = ("rusted", "blasted", "painted", "timber", "cardboard")
VIEWS = {"view_0": ("test", 0), "view_5": ("test", 5), "view_2": ("map", 2)}
# Wide enough that rich breaks no line, and without colours.
_ENVIRONMENT = os.environ | {"NO_COLOR": "1", "COLUMNS": "250", "TERM": "dumb"}


def surfclass(*arguments, cwd, timeout_s=60, code=0, wrapper=()):
    """Runs the command to its end, which has to have the exit code `code`, and returns it."""
    done = subprocess.run(
        [*wrapper, sys.executable, "-m", "daemon", *map(str, arguments)],
        cwd=cwd,
        env=_ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == code, f"{arguments}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    return done


@contextlib.contextmanager
def running(log, *arguments, cwd):
    """Runs the command beside the test; whatever happens, it is gone at the end."""
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "daemon", *map(str, arguments)],
            cwd=cwd,
            env=_ENVIRONMENT,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def ended(process, log, code=0, timeout_s=60):
    """Waits for the end of a process that `running` started."""
    try:
        found = process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        found = "none, it still runs"
    said = log.read_text()
    assert found == code, f"exit code {found}\n{said}"
    assert "Traceback" not in said


def terminated(process, log, code=0):
    """Tells a process to stop and waits for its end."""
    process.send_signal(signal.SIGTERM)
    ended(process, log, code)


def endpoint_in(folder):
    """An address of this machine alone, which no other test has; a socket's path may not be long."""
    return f"unixsock-stream/{folder}/z"


def state_of(folder):
    """Every file below a folder with its bytes: equal before and after means that nothing was written."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_png(path, image):
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_cell(folder):
    """Makes a data folder of the simulated cell: a board of every surface, two test views and a map view."""
    for kind in ("colour", "depth", "label"):
        (folder / kind).mkdir(parents=True)
    world = SimWorld("cell", scale=SCALE)
    (folder / "rig.toml").write_text(truth.rig(world))
    (folder / "classes.toml").write_text(truth.classes_toml())
    assert parse_classes(truth.classes_toml(), "classes").names == CLASSES
    rows = []
    for number, name in enumerate(CLASSES):
        board = SimWorld(f"board:{name}", number + 1, scale=SCALE)
        rows.append(_written(folder, board, f"train_{name}", "train"))
    for name, (role, number) in VIEWS.items():
        world.place(world.viewpoints[number].q)
        rows.append(_written(folder, world, name, role))
    write_rows(folder, rows)


def _written(folder, world, name, role):
    devices = SimColourCamera(world), SimDepthCamera(world), SimLight(world), SimArm(world)
    with SensorPackage(world.clock, *devices) as package:
        capture = package.capture(name, role)
    write_png(folder / "colour" / f"{name}.png", capture.colour.rgb)
    write_png(folder / "depth" / f"{name}.png", capture.depth.depth_mm)
    if role != "map":
        write_png(folder / "label" / f"{name}.png", truth.label_image(world, capture.joints.q))
    angles = {f"q{axis + 1}": repr(angle) for axis, angle in enumerate(capture.joints.q.tolist())}
    return {
        "name": name,
        "role": role,
        "t_ns": capture.t_ns,
        "exposure_s": capture.colour.exposure_s,
        **angles,
    }


def rows_of(folder):
    """The rows of a captures.csv."""
    with (folder / "captures.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def write_rows(folder, rows):
    with (folder / "captures.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


@dataclass(frozen=True)
class Cell:
    """The simulated cell as a data folder, and what the commands made of it."""

    root: Path

    folder = property(lambda self: self.root / "cell")
    recording = property(lambda self: self.root / "cell.mcap")
    model = property(lambda self: self.root / "model.npz")
    map = property(lambda self: self.root / "map.npz")

    def variant(self, folder, edit):
        """Copies the data folder to `folder`, lets `edit` change the copy, and returns it."""
        shutil.copytree(self.folder, folder)
        edit(folder)
        return folder

    def configuration(self, folder):
        """Writes the configuration of a simulated service whose files are in `folder`; its socket too."""
        folder.mkdir(parents=True, exist_ok=True)
        text = (
            _SIMULATED.replace("SCALE", str(SCALE))
            .replace("CELL", str(self.root))
            .replace("OUT", str(folder))
        )
        path = folder / "surfclass.toml"
        path.write_text(text.replace("ENDPOINT", endpoint_in(folder)))
        return path


def rewritten(source, out, *, rig=None, classes=None, roles=None):
    """Copies a recording with another rig, other classes, or captures of some roles only."""
    recording = Recording.open(source)
    with RecordingWriter(out, rig or recording.rig_text, classes or recording.classes_text) as writer:
        for capture in recording.captures(roles):
            writer.write(capture)
    return out


_SIMULATED = """\
schema = 1
robot = "cell"
rig = "CELL/cell/rig.toml"
model = "CELL/model.npz"
map = "OUT/daemon.npz"
[trigger.rest]
[recording]
directory = "OUT/recordings"
min_free_mb = 1
[zenoh]
listen = ["ENDPOINT"]
[colour]
backend = "sim"
[depth]
backend = "sim"
[light]
backend = "sim"
[arm]
backend = "sim"
[sim]
viewpoints = 3
scale = SCALE
"""
