"""What is in use, what rests on what, and what is stale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from calibration.rig_file import rig_text
from calibration.store import KINDS, Store
from daemon import wiring
from daemon.config import Config, load_config
from daemon.offline import console, load_map, load_model, write_json
from drivers.files import check_output, write_atomically
from surfclass.errors import ConfigurationError
from surfclass.fingerprint import DEPENDS, changed, fingerprints
from surfclass.rig import DepthRig, parse_depth_rig


def status(directory: Path, rig: DepthRig | None, model: Path | None, maps: list[Path]) -> dict[str, Any]:
    """Returns for each result what is in use and what has changed since it was made.

    Args:
        directory: Of the results.
        rig: The rig in use, these results on top; None: only the results are compared with each other.
        model: A model file, or None.
        maps: Benchmark maps and others.

    Raises:
        InputError: Naming a file that cannot be read.
    """
    store = Store(directory)
    now = store.fingerprints() if rig is None else fingerprints(rig)
    told: dict[str, Any] = {"schema": 1, "directory": str(directory), "results": {}, "made": {}}
    for kind in KINDS:
        results, current = store.results(kind), store.current(kind)
        newest = results[-1] if results else None
        stale = [] if current is None else changed(current.told["made_with"], now, kind)
        told["results"][kind] = {
            "file": None if current is None else str(current.path),
            "written": None if current is None else current.written,
            "sentence": None if current is None else current.told.get("sentence"),
            "rests_on": list(DEPENDS[kind]),
            "stale_since": stale,
            "older": len(results) - (current is not None),
            "newest_failed": newest is not None and not newest.passed,
        }
    if model is not None and model.exists():
        made_with = load_model(model).card.get("made_with", {})
        told["made"][str(model)] = _made("model", made_with, now)
    for path in maps:
        told["made"][str(path)] = _made("map", load_map(path).made_with, now)
    return told


def print_status(told: dict[str, Any]) -> None:
    """Prints the table, and one line that says what to do."""
    table = Table(title=escape(told["directory"]), title_justify="left")
    for heading in ("step", "in use since", "figures", "rests on", "state", "older"):
        table.add_column(heading, overflow="fold", justify="right" if heading == "older" else "left")
    todo: list[str] = []
    for kind, one in told["results"].items():
        state = _state(kind, one, todo)
        figures = one["sentence"] or "–"
        when = (one["written"] or "–")[:19].replace("T", " ")
        rests_on = ", ".join(one["rests_on"]) or "–"
        table.add_row(kind, when, escape(figures), rests_on, state, str(one["older"]))
    console.print(table)
    for path, one in told["made"].items():
        if one["stale_since"]:
            todo.append(f"{path} ({one['what']}) was made before the new {', '.join(one['stale_since'])}")
        console.print(f"{path}: {one['what']}, {_words(one)}", highlight=False)
    for line in todo:
        console.print(f"  {escape(line)}", style="yellow", highlight=False)
    console.print("everything is current" if not todo else f"{len(todo)} to do")


def status_of_config(config: Config) -> tuple[Path, DepthRig | None]:
    """Returns the directory of the results and the rig in use.

    Raises:
        ConfigurationError: If the configuration has no `[calibration]`.
    """
    if config.calibration is None:
        raise ConfigurationError("the configuration has no [calibration] directory")
    return config.calibration.directory, wiring.depth_rig_of(config)[1]


def _made(what: str, made_with: Mapping[str, str], now: Mapping[str, str]) -> dict[str, Any]:
    return {
        "what": what,
        "known": bool(made_with),
        "rests_on": list(DEPENDS[what]),
        "stale_since": changed(made_with, now, what),
    }


def _state(kind: str, one: dict[str, Any], todo: list[str]) -> str:
    if one["file"] is None:
        if one["newest_failed"]:
            todo.append(f"{kind}: no result passed; the newest failed")
        return "[dim]none[/dim]"
    if one["newest_failed"]:
        todo.append(f"{kind}: the newest attempt failed, and an older result is in use")
    if one["stale_since"]:
        changes = ", ".join(one["stale_since"])
        todo.append(f"{kind}: {changes} changed since; run `surfclass calibrate {kind}` again")
        return "[yellow]stale[/yellow]"
    return "[green]current[/green]"


def _words(one: dict[str, Any]) -> str:
    if not one["known"]:
        return "does not say what it was made with"
    return f"stale: {', '.join(one['stale_since'])} changed since" if one["stale_since"] else "current"


def run(
    config_path: Path | None,
    overrides: Sequence[str],
    directory: Path | None,
    maps: list[Path],
    base: Path | None,
    rig_out: Path | None,
    json_file: str | None,
) -> None:
    """Prints and writes what is in use.

    Raises:
        ConfigurationError: If there is neither a configuration nor a directory.
        InputError: Naming a file that cannot be read.
    """
    check_output(json_file, rig_out)
    model: Path | None = None
    rig: DepthRig | None = None
    if config_path is not None or overrides:
        config = load_config(config_path, overrides)
        directory, rig = status_of_config(config)
        model = config.model
        if config.map is not None and config.map.exists():
            maps = [config.map, *maps]
    if directory is None:
        raise ConfigurationError("give --config FILE, or --calibration DIR")
    if rig is None and base is not None:
        rig = parse_depth_rig(base.read_bytes(), str(base)).with_values(Store(directory).values())
    if rig_out is not None:
        if rig is None:
            raise ConfigurationError("the results alone are no rig: give --config FILE or --rig RIG.toml")
        write_atomically(rig_out, rig_text(rig).encode())
        console.print(f"{rig_out}: the rig in use", highlight=False)
    told = status(directory, rig, model, maps)
    print_status(told)
    if json_file is not None:
        write_json(json_file, told)
