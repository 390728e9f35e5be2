"""The commands that work on files: import, train, replay, evaluate, and what they print."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from calibration.store import Store
from drivers.files import check_output, read_file, write_atomically
from drivers.recordings import Recording, RecordingWriter
from drivers.recordings.folder import read_folder
from surfclass.errors import ConfigurationError, InputError
from surfclass.evaluation import ROUTES, SCHEMA, benchmark_of, evaluate, score_layers
from surfclass.frames import MAP_ROLES
from surfclass.kinematics import depth_pose
from surfclass.map_file import MapFile, from_npz_bytes, to_npz_bytes
from surfclass.model import Model
from surfclass.pipeline import Pipeline, PipelineSettings

console = Console(stderr=True)


@contextmanager
def progress(total: int, what: str) -> Iterator[Any]:
    """Shows a bar on standard error; yields `advance(description)`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    # A log or a pipe gets no bar; the library would leave an empty line there.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)

        def advance(description: str) -> None:
            bar.update(task, advance=1, description=f"{what} {description}")

        yield advance


def write_json(path: str, result: Any) -> None:
    """Writes a result as JSON to a file, or to standard output for "-"."""
    text = json.dumps(result, indent=1, allow_nan=False)
    if path == "-":
        sys.stdout.write(text + "\n")
    else:
        write_atomically(Path(path), (text + "\n").encode())


def import_folder(directory: Path, out: Path) -> int:
    """Turns a data folder into a recording and returns the number of captures.

    Raises:
        InputError: Naming the file and what is wrong with it; nothing is written then.
    """
    check_output(out)
    folder = read_folder(directory)
    source = directory.resolve().name  # "." has none
    writer = RecordingWriter(
        out,
        folder.rig_text,
        folder.classes_text,
        {"source": source},
        plate_text=folder.plate_text,
        board_text=folder.board_text,
    )
    try:
        with progress(len(folder), "importing") as advance:
            for capture, encoded in folder.captures():
                both = capture.joints is not None and capture.base_T_depth is not None
                if both and folder.depth_rig.transforms.flange_T_depth is not None:
                    depth_pose(capture, folder.depth_rig)  # raises where pose and joints disagree
                writer.write(capture, encoded)
                advance(capture.name)
    except BaseException:
        writer.discard()
        raise
    writer.close()
    return len(folder)


def open_recording(path: Path, calibration: Path | None = None) -> Recording:
    """Returns a recording; its rig is the one that it was made with, unless results are put on top.

    Args:
        path: The recording.
        calibration: A directory of results of `calibrate`, or None.

    Raises:
        InputError, ConfigurationError: If one of them cannot be used.
    """
    recording = Recording.open(path)
    if calibration is None:
        return recording
    rig = recording.depth_rig.with_values(Store(calibration).values())
    return dataclasses.replace(recording, depth_rig=rig)


def load_model(path: Path) -> Model:
    """Returns the model in a file.

    Raises:
        InputError, ConfigurationError: If it cannot be read, or is not one.
    """
    return Model.from_bytes(read_file(path, "model"), str(path))


def replay(
    paths: Sequence[Path],
    model_path: Path,
    out: Path,
    settings: PipelineSettings,
    calibration: Path | None = None,
) -> tuple[Pipeline, dict[str, list[float]]]:
    """Runs the captures of a recording, or of the parts of one, through the pipeline and writes the map.

    Returns:
        The pipeline, and for each stage its milliseconds, capture by capture.

    Raises:
        InputError: If a file is no recording, the parts have different rigs, or nothing is to be mapped.
    """
    check_output(out)
    parts = [open_recording(path, calibration) for path in paths]
    for path, part in zip(paths, parts, strict=True):
        if (part.rig_text, part.classes_text) != (parts[0].rig_text, parts[0].classes_text):
            raise InputError(f"{path}: has another rig or other classes than {paths[0]}")
    model = load_model(model_path)
    model.check(parts[0].rig, parts[0].classes)
    pipeline = Pipeline(parts[0].rig, model, settings)
    stage_ms: dict[str, list[float]] = {}
    done = 0
    with progress(sum(map(len, parts)), "replaying") as advance:
        for capture in chain.from_iterable(part.captures() for part in parts):
            if capture.role in MAP_ROLES:
                for stage, ms in pipeline.process(capture).stage_ms.items():
                    stage_ms.setdefault(stage, []).append(ms)
                done += 1
            advance(capture.name)
    if not done:
        raise InputError(f"{paths[0]}: no capture of role {' or '.join(MAP_ROLES)} to make a map of")
    write_atomically(out, to_npz_bytes(pipeline.map, settings.pool))
    return pipeline, stage_ms


def evaluate_recording(
    recording_path: Path,
    model_path: Path,
    route: str,
    settings: PipelineSettings,
    calibration: Path | None = None,
) -> dict[str, Any]:
    """Returns the figures of one route, or of all that the model has.

    Raises:
        ConfigurationError: If the model does not fit the recording, or has not the route.
    """
    recording = open_recording(recording_path, calibration)
    model = load_model(model_path)
    model.check(recording.rig, recording.classes)
    routes = list(ROUTES) if route == "all" else [route]
    lacking = [name for name in routes if (f := ROUTES[name]) is not None and f not in model.colour]
    if lacking and route != "all":
        raise ConfigurationError(
            f"{model_path}: has no {ROUTES[route]} route; it was trained on {', '.join(model.colour)}"
        )
    if lacking:
        console.print(f"left out, since the model has not been trained on them: {', '.join(lacking)}")
    routes = [name for name in routes if name not in lacking]
    pipeline = Pipeline(recording.rig, model, settings)
    with progress(len(recording), "evaluating") as advance:
        return evaluate(recording.captures("test"), pipeline, routes, advance)


def evaluate_map(recording_path: Path, map_path: Path) -> dict[str, Any]:
    """Returns the figures of a finished map on the benchmark of a recording's labels.

    Raises:
        InputError: If the map's voxel size or classes are not the recording's.
    """
    recording = Recording.open(recording_path)
    classes = recording.classes
    if classes is None:
        raise InputError(f"{recording_path}: has no classes.toml, so its labels mean nothing")
    found = load_map(map_path)
    if found.classes != classes.names or found.voxel_size_m != recording.rig.voxel_size_m:
        raise InputError(
            f"{map_path}: voxels of {found.voxel_size_m:g} m and classes {', '.join(found.classes)}; the "
            f"recording has {recording.rig.voxel_size_m:g} m and {', '.join(classes.names)}"
        )
    with progress(len(recording), "evaluating") as advance:
        benchmark = benchmark_of(recording.captures("test"), recording.rig, len(classes.names), advance)
    index, truth = benchmark.truth()
    layers = found.at(index)
    routes = ("colour", "texture", "combined")
    return {
        "schema": SCHEMA,
        "classes": list(classes.names),
        "routes": {route: {"fused": score_layers(layers, route, truth).to_json()} for route in routes},
    }


def load_map(path: Path) -> MapFile:
    """Returns the map in a file.

    Raises:
        InputError: If it cannot be read, or is not one.
    """
    return from_npz_bytes(read_file(path, "map"), str(path))


def print_fused(result: dict[str, Any]) -> None:
    """Prints the figures of the fused map, and each class's."""
    routes = result["routes"]
    table = Table(title="all test captures fused: share of voxels", title_justify="left")
    for heading in ("route", "right", "balanced", "rejected", "ECE", "NLL", "voxels"):
        table.add_column(heading, justify="left" if heading == "route" else "right")
    for route, figures in routes.items():
        fused = figures["fused"]
        table.add_row(
            route,
            *(share(fused[name]) for name in ("overall", "balanced", "rejected")),
            *("–" if fused[name] is None else f"{fused[name]:.3f}" for name in ("ece", "nll")),
            f"{fused['voxels']:,}",
        )
    console.print(table)
    print_per_class(result)


def print_per_class(result: dict[str, Any]) -> None:
    """Prints which share of each class's classified voxels is right, by every route."""
    table = Table(title="right, of each class's classified voxels", title_justify="left")
    table.add_column("surface")
    for route in result["routes"]:
        table.add_column(route, justify="right")
    for k, name in enumerate(result["classes"]):
        shares = [recalls(figures["fused"])[k] for figures in result["routes"].values()]
        table.add_row(name, *map(share, shares))
    console.print(table)


def print_evaluation(result: dict[str, Any]) -> None:
    """Prints the fused figures, and the pixel accuracy of every view."""
    print_fused(result)
    routes = result["routes"]
    views = Table(title="each test capture: share of pixels right", title_justify="left")
    views.add_column("capture")
    for route in routes:
        views.add_column(route, justify="right")
    for name in next(iter(routes.values()))["pixels"]:
        views.add_row(name, *(share(figures["pixels"][name]["overall"]) for figures in routes.values()))
    console.print(views)


def recalls(fused: dict[str, Any]) -> list[float | None]:
    """Returns for each class the share of its classified voxels that is right; None without any."""
    rows = fused["confusion"]
    return [row[k] / sum(row) if sum(row) else None for k, row in enumerate(rows)]


def share(value: float | None) -> str:
    """A share as percent, or a dash."""
    return "–" if value is None else f"{100 * value:.1f} %"


def print_stages(stage_ms: dict[str, list[float]]) -> None:
    """Prints the milliseconds that each stage of the pipeline took."""
    table = Table(title="milliseconds a capture", title_justify="left")
    for heading in ("stage", "median", "longest"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    total = [0.0] * len(next(iter(stage_ms.values())))
    for stage, times in stage_ms.items():
        total = [a + b for a, b in zip(total, times, strict=True)]
        table.add_row(stage, f"{_median(times):.0f}", f"{max(times):.0f}")
    table.add_row("all", f"{_median(total):.0f}", f"{max(total):.0f}", style="bold")
    console.print(table)


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
