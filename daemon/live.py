"""The commands that talk to devices or to a running service: capture, run, watch, check."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from daemon import wiring
from daemon.check import check as check_all
from daemon.config import Config, load_config
from daemon.console import MapClient
from daemon.findings import Verdict, exit_code
from daemon.offline import console, progress, write_json
from daemon.transport import TransportError, open_session
from drivers.files import check_output, read_file, write_atomically
from drivers.recordings import RecordingWriter, unix_offset_ns
from surfclass.errors import ConfigurationError, InputError
from surfclass.map_file import to_npz_bytes
from surfclass.pooling import Pool
from surfclass.rig import parse_classes
from surfclass.voxel_map import VoxelMap

_MARKS = {
    Verdict.OK: "[green]ok[/green]",
    Verdict.WARNING: "[yellow]look[/yellow]",
    Verdict.CONFIGURATION: "[red]wrong[/red]",
    Verdict.DEVICE: "[red]device[/red]",
}
_CONNECT_RETRY_S = 0.5


def _load(config: Path | None, overrides: Sequence[str], replay: Path | None = None) -> Config:
    if config is None and not overrides:
        raise ConfigurationError(
            "no configuration: give --config FILE (systemd/surfclass.toml is an example)"
        )
    return load_config(config, overrides, replay)


def run(config: Path | None, overrides: Sequence[str], replay: Path | None, exit_when_done: bool) -> int:
    """Runs the service in the foreground and returns its exit code."""
    return wiring.run(partial(_load, config, overrides, replay), exit_when_done=exit_when_done)


def capture(
    out: Path,
    config: Path | None,
    overrides: Sequence[str],
    count: int,
    role: str,
    dark: bool,
    classes_path: Path | None = None,
    surfaces: Sequence[str] = (),
) -> None:
    """Takes captures with the configured devices into a recording; all of them, or none is kept.

    Args:
        out: The recording.
        config: The configuration file.
        overrides: `--set` options.
        count: How many captures, of each surface if there are any.
        role: What they are for.
        dark: Whether to take an unlit frame with each.
        classes_path: A classes.toml for the recording.
        surfaces: Boards that fill the image one after the other; the whole image is labelled so.

    Raises:
        DriverError, CaptureRejectedError: As the devices do.
        ConfigurationError: If the configuration has no devices.
        InputError: If a surface is not one of the classes.
    """
    check_output(out)
    told = _load(config, overrides)
    rig_text, rig = wiring.rig_of(told)
    classes_text = (
        None if classes_path is None else read_file(classes_path, "classes").decode(errors="replace")
    )
    names = () if classes_text is None else parse_classes(classes_text, str(classes_path)).names
    for surface in surfaces:
        if surface not in names:
            raise InputError(f"--surface {surface}: {classes_path} has {', '.join(names)}")
    sensors = wiring.build_sensors(told)
    offset_ns = 0 if told.simulated else unix_offset_ns()
    writer = RecordingWriter(out, rig_text, classes_text, {"robot": told.robot}, unix_offset_ns=offset_ns)
    boards: list[str | None] = [*surfaces] or [None]
    try:
        with sensors.package as package:
            for board in boards:
                if board is not None and sys.stdin.isatty():
                    console.input(f"Put up a board of [bold]{board}[/bold] that fills the image; then Enter ")
                with progress(count, f"capturing {board or ''}") as advance:
                    for number in range(1, count + 1):
                        name = f"{role}_{board}_{number:04d}" if board else f"{role}_{number:04d}"
                        taken = package.capture(name, role, with_dark=dark)
                        rig.check(taken)
                        if board is not None:
                            label = np.full(rig.rgb.shape, names.index(board) + 1, np.uint8)
                            taken = replace(taken, label=label)
                        writer.write(taken)
                        advance(taken.name)
    except BaseException:
        writer.discard()
        raise
    writer.close()
    console.print(f"{out}: {count * len(boards)} captures")


def watch(
    connect: Sequence[str],
    robot: str,
    out: Path | None,
    until_gone: bool,
    captures: int | None,
    timeout_s: float | None,
    json_file: str | None,
    pool: Pool = "log-linear",
) -> int:
    """Keeps the map of a running service until it is told to stop, and returns the exit code.

    It ends by Ctrl-C or SIGTERM, when the service that it saw has gone (`until_gone`), when the map
    holds so many `captures`, or with exit code 69 when `timeout_s` is over before that.
    """
    check_output(out, json_file)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
    code = os.EX_OK
    with (
        _connected(connect, stop, deadline_s) as session,
        MapClient(session, robot) as client,
        console.status("waiting for the service") as line,
    ):
        seen = False
        while not stop.wait(0.1):
            seen = seen or client.state != "disconnected"
            line.update(_line(client))
            if captures is not None and _holds(client, captures):
                break
            if until_gone and seen and client.state == "disconnected":
                break
            if deadline_s is not None and time.monotonic() > deadline_s:
                code = os.EX_UNAVAILABLE
                break
        if captures is not None and _holds(client, captures):
            _await_status(client, deadline_s)
        found, told = client.map, _told(client)
    if code != os.EX_OK:
        console.print(f"surfclass: {_line_of(told)}: no complete map after {timeout_s:g} s")
    if found is None:
        if out is not None:
            console.print(f"surfclass: never had a map of {robot}, so {out} was not written")
        return code or os.EX_UNAVAILABLE
    if out is not None:
        write_atomically(out, to_npz_bytes(found, pool))
    if json_file is not None:
        write_json(json_file, told)
    console.print(f"{robot}: {_line_of(told)}" + (f"; {out}" if out is not None else ""))
    return code


def _connected(connect: Sequence[str], stop: threading.Event, deadline_s: float | None) -> Any:
    """Returns a session as soon as the service is there.

    Raises:
        TransportError: If it was told to stop before that, or the time is over.
    """
    while True:
        try:
            return open_session("client", connect=connect)
        except TransportError as error:
            late = deadline_s is not None and time.monotonic() > deadline_s
            if stop.wait(_CONNECT_RETRY_S) or late:
                raise TransportError(f"nothing answers at {', '.join(connect)}: {error}") from None


def _holds(client: MapClient, captures: int) -> bool:
    return client.state == "live" and client.map is not None and client.map.sequence >= captures


def _await_status(client: MapClient, deadline_s: float | None) -> None:
    """Waits for a status that knows of the whole map; it comes once a second."""
    give_up_s = min(time.monotonic() + 5.0, deadline_s or float("inf"))
    while time.monotonic() < give_up_s:
        found = client.map
        if found is not None and client.status.get("map", {}).get("sequence", -1) >= found.sequence:
            return
        time.sleep(0.1)


def _told(client: MapClient) -> dict[str, Any]:
    found: VoxelMap | None = client.map
    counters = client.counters
    return {
        "state": client.state,
        "epoch": None if found is None else found.epoch,
        "sequence": None if found is None else found.sequence,
        "voxels": 0 if found is None else len(found),
        "gaps": counters.gaps,
        "resyncs": counters.resyncs,
        "status": client.status,
    }


def _line(client: MapClient) -> str:
    return _line_of(_told(client))


def _line_of(told: dict[str, Any]) -> str:
    health = told["status"].get("health", "unknown")
    return (
        f"{told['state']}, {told['sequence'] or 0} captures, {told['voxels']:,} voxels, health {health}, "
        f"{told['gaps']} gaps, {told['resyncs']} resyncs"
    )


def check(config: Path | None, overrides: Sequence[str], json_file: str | None) -> int:
    """Looks at everything the service needs, prints what was found, and returns the exit code."""
    check_output(json_file)
    findings = check_all(_load(config, overrides))
    table = Table(show_header=True)
    for heading in ("", "what", "found", "what to do"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        told = (finding.subject, finding.message, finding.advice)
        table.add_row(_MARKS[finding.verdict], *map(escape, told))
    console.print(table)
    if json_file is not None:
        write_json(json_file, [finding.as_json() for finding in findings])
    code = exit_code(findings)
    console.print("PASS: everything works" if code == os.EX_OK else "FAIL: see the marked lines")
    return code


def light_off(config: Path | None, overrides: Sequence[str]) -> None:
    """Turns the configured light off.

    Raises:
        DriverError: If it cannot be reached.
    """
    wiring.lights_off(_load(config, overrides))
