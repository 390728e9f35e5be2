"""The commissioning steps, each with its solver, its guide and the targets that it looks at."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tomli_w

from calibration.gates import Gates
from calibration.guide import Guide
from calibration.outcome import Kind, Note, Outcome
from calibration.source import Source
from calibration.store import KINDS
from calibration.verify.report import About, html, report_of
from daemon.commissioning import Call, Ended, commission
from daemon.commissioning_live import Texts
from daemon.config import Config
from daemon.offline import console, open_recording
from drivers.files import check_output, read_file, write_atomically
from drivers.recordings.board import Board, parse_board
from drivers.recordings.plate import Plate, parse_plate
from surfclass.errors import ConfigurationError
from surfclass.rig import DepthRig
from surfclass.schema import validate

_VERSIONS = ("surfclass", "numpy", "opencv-python-headless", "pin")


@dataclass(frozen=True, slots=True)
class BoardTold:
    """A board as the command line tells it.

    Attributes:
        corners: Inner corners, "9x6"; None: the recording's or the configuration's board.
        square_mm: Side of a square.
        dictionary: Of a ChArUco board.
        marker_mm: Side of its markers.
    """

    corners: str | None
    square_mm: float | None
    dictionary: str | None
    marker_mm: float | None

    def board(self) -> Board | None:
        """Returns the board, or None where nothing is told.

        Raises:
            ConfigurationError: If it is told in part, or cannot be.
        """
        told = (self.corners, self.square_mm, self.dictionary, self.marker_mm)
        if not any(told):
            return None
        columns, cross, rows = (self.corners or "").partition("x")
        if not (cross and columns.isdecimal() and rows.isdecimal()) or self.square_mm is None:
            raise ConfigurationError(
                f"--board {self.corners}, --square-mm {self.square_mm}: allowed are both, as "
                "--board 9x6 --square-mm 25 (inner corners, columns x rows)"
            )
        square_m = self.square_mm / 1e3
        values: dict[str, Any] = {"columns": int(columns), "rows": int(rows), "square_m": square_m}
        if self.dictionary is not None or self.marker_mm is not None:
            marker_m = None if self.marker_mm is None else self.marker_mm / 1e3
            values |= {"kind": "charuco", "dictionary": self.dictionary, "marker_m": marker_m}
        return validate(Board, values, "board")


def call(
    kind: Kind,
    config: Path | None,
    overrides: Sequence[str] | None,
    from_: Sequence[Path] | None,
    directory: Path | None,
    json_file: str | None,
    pictures: Path | None,
    new_devices: bool = False,
) -> Call:
    """Returns how a step was called."""
    return Call(
        kind, config, overrides or (), tuple(from_ or ()), directory, json_file, pictures, {}, new_devices
    )


def plate_of(config: Config) -> tuple[str, Plate]:
    """Returns the text of the configured plate of reflector discs, and the plate.

    Raises:
        ConfigurationError: If none is configured, or it is not one.
    """
    path = None if config.calibration is None else config.calibration.plate
    if path is None:
        raise ConfigurationError("[calibration] plate is missing: a plate.toml says where the discs are")
    text = read_file(path, "plate").decode(errors="replace")
    return text, parse_plate(text, str(path))


def board_of(config: Config, told: Board | None) -> tuple[str, Board]:
    """Returns the text of a `board.toml` and the board: the one that was told, else the configured one.

    Raises:
        ConfigurationError: If there is neither, or it is not one.
    """
    if told is not None:
        return tomli_w.dumps(told.model_dump(exclude_none=True)), told
    path = None if config.calibration is None else config.calibration.board
    if path is None:
        raise ConfigurationError(
            "which board? give --board 9x6 --square-mm 25, or [calibration] board a board.toml"
        )
    text = read_file(path, "board").decode(errors="replace")
    return text, parse_board(text, str(path))


def hand_eye(
    call: Call,
    observations: Path | None,
    target: Literal["discs", "checkerboard", "charuco"],
    told: BoardTold,
    joint_offsets: bool,
    flange_offset: bool,
) -> int:
    """Runs `calibrate hand-eye` and returns the exit code."""
    from calibration.hand_eye.command import Options, calibrate
    from calibration.hand_eye.guide import HandEyeGuide

    board = told.board()
    options = Options(observations, target, board, None, joint_offsets, flange_offset)
    call = replace(
        call,
        options={
            "observations": None if observations is None else str(observations),
            "target": target,
            "board": None if board is None else str(board),
            "joint_offsets": joint_offsets,
            "flange_offset": flange_offset,
        },
        files=() if observations is None else (observations,),
    )

    def solve(source: Source | None, gates: Gates, note: Note) -> Outcome:
        return calibrate(source, options, gates.hand_eye, note)

    def targets(config: Config, rig: DepthRig) -> tuple[Sequence[Guide], Texts]:
        if target == "discs":
            text, plate = plate_of(config)
            return [HandEyeGuide(rig, plate)], Texts(plate=text)
        text, seen = board_of(config, board)
        return [HandEyeGuide(rig, seen)], Texts(board=text)

    return commission(call, solve, None if observations is not None else targets)


def response(call: Call) -> int:
    """Runs `calibrate response` and returns the exit code."""
    from calibration.response.command import Options, calibrate

    def solve(source: Source | None, gates: Gates, note: Note) -> Outcome:
        assert source is not None  # there are captures, or the call has failed
        return calibrate(source, Options(), gates.response, note)

    return commission(call, solve)


def verify(call: Call, model: Path | None, report: Path | None) -> int:
    """Runs `verify`, writes its report, and returns the exit code."""
    from calibration.verify.command import VerifyOptions
    from calibration.verify.command import verify as check

    check_output(report)
    options = VerifyOptions(model)
    if model is not None:
        call = replace(call, options={"model": str(model)}, files=(model,))

    def solve(source: Source | None, gates: Gates, note: Note) -> Outcome:
        assert source is not None  # there are captures, or the call has failed
        return check(source, options, gates.verify, note)

    def write_report(ended: Ended) -> None:
        if report is not None:
            write_atomically(report, html(report_of(ended.outcome, about(ended))).encode())
            console.print(f"{report}: to read, to print, or to send", highlight=False)

    return commission(call, solve, None, write_report)


def about(ended: Ended) -> About:
    """Returns what a report says beside the result."""
    in_use = {} if ended.store is None else {kind: ended.store.current(kind) for kind in KINDS}
    return About(
        written=str(ended.told["written"])[:19].replace("T", " ") + " UTC",
        robot=ended.robot or "–",
        rig="–" if ended.source is None else ended.source.rig.name,
        source=str(ended.told["source"]),
        versions={name: importlib.metadata.version(name) for name in _VERSIONS},
        inputs=ended.told["inputs"],
        calibrations={
            kind: "from the rig file" if one is None else f"number {one.number}, {one.written[:10]}"
            for kind, one in in_use.items()
        },
    )


def label(recording: Path, out: Path, classes: Path | None, directory: Path | None, port: int) -> int:
    """Serves the labelling page and returns the exit code: 0 once the labelled recording is written."""
    from calibration.label.command import LabelOptions
    from calibration.label.command import label as serve

    check_output(out)
    rig = open_recording(recording, directory).depth_rig
    count = serve(recording, out, LabelOptions(classes, port=port), console.print, rig)
    ended = f"{out}: {count} labelled captures" if count else "ended early; nothing is lost"
    console.print(ended)
    return 0 if count else 1


def light(call: Call, use: Literal["all", "boards", "lambertian"], thesis: bool) -> int:
    """Runs `calibrate light` and returns the exit code."""
    from calibration.light.command import Options, calibrate

    options = Options(use=use, thesis=thesis)

    def solve(source: Source | None, gates: Gates, note: Note) -> Outcome:
        assert source is not None  # there are captures, or the call has failed
        return calibrate(source, options, gates.light, note)

    return commission(replace(call, options=asdict(options)), solve)
