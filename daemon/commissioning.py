"""Runs one commissioning step: reads, solves, prints, draws, keeps the result, and says the verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from calibration.cameras.conditions import serial_faults
from calibration.cameras.pairs import ImagePairs, holds_pairs
from calibration.gates import Gates
from calibration.outcome import Kind, Note, Outcome, RefusedError, refused
from calibration.source import Source, sha256
from calibration.store import KINDS, Provenance, Store, described
from daemon.config import Config, load_config
from daemon.offline import console, write_json
from daemon.wiring import depth_rig_of
from drivers.files import check_output
from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import DepthRig

if TYPE_CHECKING:
    from daemon.commissioning_live import Texts, Wanted

Targets = Callable[[Config, DepthRig], tuple["Sequence[Wanted]", "Texts"]]
Solve = Callable[[Source | ImagePairs | None, Gates, Note], Outcome]
_STYLE = {"pass": "bold green", "fail": "bold red", "refused": "bold yellow"}


@dataclass(frozen=True, slots=True)
class Call:
    """How a step was called.

    Attributes:
        kind: Which step.
        config: The configuration file; it names the directory of the results, and the devices.
        overrides: `--set` options.
        from_: Recordings or data folders; none: captures are taken with the devices.
        directory: Of the results, where there is no configuration; None: the result is not kept.
        json_file: Where the result goes besides; "-" is standard output.
        pictures: A directory for the pictures.
        options: What the step was told, for the record.
        new_devices: Whether another camera than the one of the result in use is expected.
        page: Whether live captures are shown on a page in the browser.
        idle_s: A live capture ends after so long without a view.
        also: Earlier recordings that are solved with the live one.
        files: What else is read, such as observations or a model.
    """

    kind: Kind
    config: Path | None
    overrides: Sequence[str]
    from_: tuple[Path, ...]
    directory: Path | None
    json_file: str | None
    pictures: Path | None
    options: Mapping[str, Any] = field(default_factory=dict)
    new_devices: bool = False
    page: bool = True
    idle_s: float = 900.0
    also: tuple[Path, ...] = ()
    files: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """A step that has come to its end, for what is made of it besides.

    Attributes:
        outcome: How it ended.
        told: What is written of it.
        source: The captures, or None.
        store: Where the results in use are, or None.
        robot: Its name; empty where no configuration says.
    """

    outcome: Outcome
    told: Mapping[str, Any]
    source: Source | ImagePairs | None
    store: Store | None
    robot: str


def commission(
    call: Call,
    solve: Solve,
    targets: Targets | None = None,
    besides: Callable[[Ended], None] = lambda _: None,
) -> int:
    """Runs a step and returns the exit code: 0 if it passed, 1 if it failed or refused.

    Whatever stops it, the results that were there stay as they were.

    Args:
        call: How it was called.
        solve: The step, given the captures.
        targets: What is captured live: the guides, and what travels in the recording; None: nothing is.
        besides: Makes something more of it, such as a report, before the verdict is said.

    Raises:
        InputError, ConfigurationError: If what it is given cannot be read; nothing is written then.
        DriverError, CaptureRejectedError: As the devices do.
    """
    check_output(call.json_file)
    config = load_config(call.config, call.overrides) if call.config or call.overrides else None
    store, gates = _place(call, config)
    paths = call.from_
    if not paths and targets is not None:
        paths = (_captured(call, config, targets), *call.also)
    source = None if not paths else _opened(call.kind, paths, store)
    with console.status(f"{call.kind}: reading") as status:

        def note(sentence: str) -> None:
            status.update(escape(sentence))
            console.print(f"  {escape(sentence)}", highlight=False)

        try:
            if isinstance(source, Source) and store is not None and not call.new_devices:
                _same_devices(source, store)
            outcome = solve(source, gates, note)
        except RefusedError as error:
            outcome = refused(call.kind, error)
    _print(outcome)
    told = described(outcome, _provenance(call, source, gates), _rig_after(source, outcome))
    _draw(outcome, call.pictures)
    # What was found of bare image pairs is of no package that is known.
    kept = outcome.kind in KINDS and outcome.verdict != "refused" and not isinstance(source, ImagePairs)
    if store is not None and kept:
        path = store.add(call.kind, told)
        in_use = "in use from now on" if outcome.verdict == "pass" else "kept, and not in use"
        console.print(f"{path}: {in_use}", highlight=False, soft_wrap=True)
    if call.json_file is not None:
        write_json(call.json_file, told)
    besides(Ended(outcome, told, source, store, "" if config is None else config.robot))
    console.print(
        f"{outcome.verdict.upper()}: {call.kind}: {escape(outcome.sentence)}",
        style=_STYLE[outcome.verdict],
        highlight=False,
        soft_wrap=True,  # one line, however narrow the terminal
    )
    return 0 if outcome.verdict == "pass" else 1


def overlay(recording_rig: DepthRig, directory: Path | None) -> DepthRig:
    """Returns a recording's rig with the results in use in `directory` on top, if there is one."""
    return recording_rig if directory is None else recording_rig.with_values(Store(directory).values())


def store_of(call: Call) -> Store | None:
    """Returns where results are kept, or None.

    Raises:
        ConfigurationError: If the configuration is not valid.
    """
    config = load_config(call.config, call.overrides) if call.config or call.overrides else None
    return _place(call, config)[0]


def _place(call: Call, config: Config | None) -> tuple[Store | None, Gates]:
    """Where results are kept, if anywhere, and the limits."""
    told = None if config is None else config.calibration
    if told is not None:
        return Store(call.directory or told.directory), told.gates
    return None if call.directory is None else Store(call.directory), Gates()


def _captured(call: Call, config: Config | None, targets: Targets) -> Path:
    """Returns the recording of the views that were captured for this call."""
    if config is None:
        raise ConfigurationError("give --from REC.mcap, or --config FILE whose devices capture now")
    from daemon.commissioning_live import record  # late: it brings every driver's options

    wanted, texts = targets(config, depth_rig_of(config)[1])
    path = record(config, call.kind, wanted, texts, call.page, call.idle_s)
    console.print(f"{path}: what was captured; `--from {path}` solves it again", highlight=False)
    return path


def _opened(kind: Kind, paths: Sequence[Path], store: Store | None) -> Source | ImagePairs:
    if kind == "cameras" and len(paths) == 1 and holds_pairs(paths[0]):
        return ImagePairs.open(paths[0])
    source = Source.open(*paths)
    return source if store is None else source.with_values(store.values())


def _same_devices(source: Source, store: Store) -> None:
    """Refuses captures of another camera than the one that the results in use are of."""
    in_use = store.current("cameras")
    if in_use is None:
        return
    calibrated = {
        device: in_use.devices[device] for device in ("colour", "depth") if device in in_use.devices
    }
    faults = serial_faults(calibrated, source.devices)
    if faults:
        raise RefusedError(
            *faults, f"{in_use.path} is in use: calibrate the cameras first, with --new-devices"
        )


def _provenance(call: Call, source: Source | ImagePairs | None, gates: Gates) -> Provenance:
    own = gates.model_dump().get(call.kind.replace("-", "_"), {})
    digests = {str(path): sha256(path) for path in call.files}
    if source is None:
        return Provenance(", ".join(digests), digests, call.options, own, {})
    devices = source.devices if isinstance(source, Source) else {}
    return Provenance(str(source.path), source.digests() | digests, call.options, own, devices)


def _rig_after(source: Source | ImagePairs | None, outcome: Outcome) -> DepthRig | None:
    return source.rig.with_values(outcome.rig) if isinstance(source, Source) else None


def _print(outcome: Outcome) -> None:
    for figures in outcome.figures:
        table = Table(title=escape(figures.title), title_justify="left")
        for number, heading in enumerate(figures.columns):
            table.add_column(escape(heading), justify="right" if number else "left", overflow="fold")
        for row in figures.rows:
            table.add_row(*map(escape, row))
        console.print(table)
    for reason in outcome.reasons:
        console.print(f"  {escape(reason)}", style="yellow", highlight=False)


def _draw(outcome: Outcome, directory: Path | None) -> None:
    if directory is None:
        return
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be made: {error.strerror}") from None
    for name, draw in outcome.pictures.items():
        draw(directory / f"{name}.png")
        console.print(f"{directory / f'{name}.png'}", highlight=False)
