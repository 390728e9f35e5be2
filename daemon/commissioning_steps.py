"""The commissioning steps, each with its solver, its guide and the targets that it looks at."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tomli_w

from calibration.cameras.pairs import ImagePairs
from calibration.gates import Gates
from calibration.outcome import Kind, Note, Outcome
from calibration.source import Source
from calibration.store import KINDS
from calibration.verify.report import About, html, report_of
from daemon.commissioning import Call, Ended, commission, store_of
from daemon.commissioning_live import Texts, Wanted
from daemon.config import Config
from daemon.offline import console, open_recording
from drivers.files import check_output, read_file, write_atomically
from drivers.recordings.board import Board, parse_board
from drivers.recordings.plate import Plate, parse_plate
from surfclass.errors import ConfigurationError
from surfclass.rig import DepthRig, parse_classes
from surfclass.schema import validate
from surfclass.training import TrainingSettings

if TYPE_CHECKING:
    from calibration.hand_eye.spheres_command import SpheresOptions

Given = Source | ImagePairs | None
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
    page: bool = True,
    idle_s: float = 900.0,
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
    joint_offsets: bool = False,
    flange_offset: bool = False,
) -> int:
    """Runs `calibrate hand-eye` and returns the exit code."""
    from calibration.hand_eye.command import Options, calibrate
    from calibration.hand_eye.guide import HandEyeGuide

    board = told.board()
    known = {} if observations is not None else _camera_sd(call)
    options = Options(observations, target, board, None, joint_offsets, flange_offset, known)
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

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert source is None or isinstance(source, Source)
        return calibrate(source, options, gates.hand_eye, note)

    def targets(config: Config, rig: DepthRig) -> tuple[Sequence[Wanted], Texts]:
        if target == "discs":
            text, plate = plate_of(config)
            return [Wanted(HandEyeGuide(rig, plate))], Texts(plate=text)
        text, seen = board_of(config, board)
        return [Wanted(HandEyeGuide(rig, seen))], Texts(board=text)

    return commission(call, solve, None if observations is not None else targets)


def cameras(call: Call, told: BoardTold) -> int:
    """Runs `calibrate cameras` and returns the exit code."""
    from calibration.cameras.command import Options, calibrate
    from calibration.cameras.guide import CamerasGuide

    board = told.board()
    options = Options(board=board)

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert source is not None  # there are captures, or the call has failed
        return calibrate(source, options, gates.cameras, note)

    def targets(config: Config, rig: DepthRig) -> tuple[Sequence[Wanted], Texts]:
        text, seen = board_of(config, board)
        return [Wanted(CamerasGuide(rig, seen))], Texts(board=text)

    options_told = {"board": None if board is None else str(board)}
    return commission(replace(call, options=options_told), solve, targets)


def _camera_sd(call: Call) -> dict[Literal["rgb", "depth"], list[float]]:
    """How well fx, fy, cx, cy of each camera are known, by the result in use."""
    store = store_of(call)
    in_use = None if store is None else store.current("cameras")
    cameras_told = {} if in_use is None else in_use.told.get("cameras", {})
    names: tuple[Literal["rgb"], Literal["depth"]] = ("rgb", "depth")
    return {
        name: [cameras_told[name]["sd"][key] for key in ("fx", "fy", "cx", "cy")]
        for name in names
        if "sd" in cameras_told.get(name, {})
    }


def _between_sd(call: Call) -> tuple[float, ...] | None:
    """How well `rgb_T_depth` is known, rotation (rad) and translation (m), by the result in use."""
    store = store_of(call)
    in_use = None if store is None else store.current("cameras")
    sd = None if in_use is None else in_use.told.get("extrinsic_sd")
    return None if sd is None else (*sd["rotation_rad"], *sd["translation_m"])


def rod(radii_mm: tuple[float, float], distance_mm: float) -> SpheresOptions:
    """Returns the rod with two spheres, of which the first one is nearer to its tip."""
    from calibration.hand_eye.spheres_command import SpheresOptions

    return SpheresOptions((radii_mm[0] / 1e3, radii_mm[1] / 1e3), distance_mm / 1e3)


def spheres(call: Call, options: SpheresOptions) -> int:
    """Runs `calibrate hand-eye --target spheres` on a folder of captures and returns the exit code."""
    from calibration.hand_eye.spheres_command import calibrate_spheres

    if len(call.from_) != 1 or not call.from_[0].is_dir():
        raise ConfigurationError("--target spheres: --from a folder with ir/, clouds.npz, marker_base_m.csv")
    folder = call.from_[0]

    def solve(_: Given, gates: Gates, note: Note) -> Outcome:
        return calibrate_spheres(folder, options, gates.hand_eye, note)

    # A fixed camera is no part of the package on the arm: the result is told, and never put into use.
    files = tuple(sorted(path for path in folder.rglob("*") if path.is_file()))
    options_told = {"target": "spheres", **asdict(options)}
    alone = replace(call, from_=(), directory=None, config=None, overrides=())
    return commission(replace(alone, options=options_told, files=files), solve)


def response(
    call: Call, series: Literal["auto", "exposure", "distance"] = "auto", thesis: bool = False
) -> int:
    """Runs `calibrate response` and returns the exit code."""
    from calibration.response.command import Options, calibrate
    from calibration.response.guide import ResponseGuide

    options = Options(source=series, thesis=thesis)

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert isinstance(source, Source)  # there are captures, or the call has failed
        return calibrate(source, options, gates.response, note)

    def targets(config: Config, rig: DepthRig) -> tuple[Sequence[Wanted], Texts]:
        return [Wanted(ResponseGuide(rig, "distance" if series == "distance" else "exposure"))], Texts()

    return commission(replace(call, options=asdict(options)), solve, targets)


def verify(
    call: Call, model: Path | None, report: Path | None, told: BoardTold, require: Sequence[str] = ()
) -> int:
    """Runs `verify`, writes its report, and returns the exit code."""
    from calibration.verify.command import VerifyOptions
    from calibration.verify.command import verify as check

    check_output(report)
    options = VerifyOptions(model, told.board(), tuple(require))
    if model is not None:
        call = replace(call, options={"model": str(model)}, files=(model,))

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert isinstance(source, Source)  # there are captures, or the call has failed
        return check(source, options, gates.verify, note)

    def write_report(ended: Ended) -> None:
        _warn_of_old_captures(ended)
        if report is not None:
            write_atomically(report, html(report_of(ended.outcome, about(ended))).encode())
            console.print(f"{report}: to read, to print, or to send", highlight=False)

    return commission(call, solve, None, write_report)


def _warn_of_old_captures(ended: Ended) -> None:
    """Says where the captures are those that a result in use was found from: they check nothing then."""
    results = [] if ended.store is None else [ended.store.current(kind) for kind in KINDS]
    seen = set(ended.told["inputs"].values())
    for one in results:
        if one is not None and seen & set(one.told.get("inputs", {}).values()):
            console.print(f"  {one.path} was found from these very captures: take new ones", style="yellow")


def about(ended: Ended) -> About:
    """Returns what a report says beside the result."""
    in_use = {} if ended.store is None else {kind: ended.store.current(kind) for kind in KINDS}
    return About(
        written=str(ended.told["written"])[:19].replace("T", " ") + " UTC",
        robot=ended.robot or "–",
        rig=ended.source.rig.name if isinstance(ended.source, Source) else "–",
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


def light(
    call: Call,
    use: Literal["all", "boards", "lambertian"],
    thesis: bool = False,
    also: Sequence[Path] = (),
) -> int:
    """Runs `calibrate light` and returns the exit code."""
    from calibration.light.command import Options, calibrate
    from calibration.light.guide import LightGuide
    from calibration.response.guide import ResponseGuide

    options = Options(use=use, thesis=thesis, between_sd=_between_sd(call))

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert isinstance(source, Source)  # there are captures, or the call has failed
        return calibrate(source, options, gates.light, note)

    def targets(config: Config, rig: DepthRig) -> tuple[Sequence[Wanted], Texts]:
        boards, card = Wanted(LightGuide(rig)), Wanted(ResponseGuide(rig, "distance"))
        wanted = {"boards": [boards], "lambertian": [card], "all": [boards, card]}
        return wanted[use], Texts()

    return commission(replace(call, options=asdict(options), also=tuple(also)), solve, targets)


def limits(
    call: Call, model: Path | None, classes_path: Path | None = None, surfaces: Sequence[str] = ()
) -> int:
    """Runs `calibrate limits` and returns the exit code."""
    from calibration.limits.command import Options, calibrate
    from calibration.live.labelled import LIMITS_STANDS, LabelledGuide

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert isinstance(source, Source)  # there are captures, or the call has failed
        return calibrate(source, Options(model=model), gates.limits, note)

    def targets(config: Config, rig: DepthRig) -> tuple[Sequence[Wanted], Texts]:
        if classes_path is None or not surfaces:
            raise ConfigurationError("which boards? give --classes CLASSES.toml and --surface NAME for each")
        text = read_file(classes_path, "classes").decode(errors="replace")
        names = parse_classes(text, str(classes_path)).names
        wanted = []
        for surface in surfaces:
            if surface not in names:
                raise ConfigurationError(f"--surface {surface}: {classes_path} has {', '.join(names)}")
            guide = LabelledGuide("test", surface, names.index(surface) + 1, rig.whole(), LIMITS_STANDS)
            wanted.append(Wanted(guide, guide.labelled))
        return wanted, Texts(classes=text)

    if model is not None:
        call = replace(call, options={"model": str(model)}, files=(model,))
    return commission(call, solve, targets)


def train(call: Call, out: Path, settings: TrainingSettings) -> int:
    """Runs `train`, writes the model, and returns the exit code; what misses a limit is written too."""
    from calibration.training.command import train_model

    check_output(out)
    models = []

    def solve(source: Given, gates: Gates, note: Note) -> Outcome:
        assert isinstance(source, Source)  # there are captures, or the call has failed
        result = train_model(source, settings, gates.train, note)
        models.append(result.model)
        return result.outcome

    def write_model(_: Ended) -> None:
        for model in models:
            write_atomically(out, model.to_bytes())
            console.print(f"{out}: {', '.join(model.colour)}, {model.texture.feature}", highlight=False)

    return commission(replace(call, options=asdict(settings)), solve, None, write_model)
