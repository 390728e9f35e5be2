"""The commands `surfclass calibrate …`: commissioning, one step at a time, live or from a recording."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from daemon.cli_options import CalibrationOption, ConfigOption, JsonOption, RecordingArgument, SetOption

FromOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--from",
        metavar="REC.mcap|DIR",
        help="A recording or data folder; may be repeated; else --config's devices.",
    ),
]
DirectoryOption = Annotated[
    Path | None,
    typer.Option("--calibration", metavar="DIR", help="Keep the result there, and use those that are there."),
]
PicturesOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Draw pictures into this directory.")
]
NewDevicesOption = Annotated[
    bool, typer.Option("--new-devices", help="It is another camera than before, and that is meant.")
]

calibrate = typer.Typer(
    invoke_without_command=True,
    no_args_is_help=True,
    help="Commission the sensor package: cameras, hand-eye, response, light, limits; and what is in use.",
)
PageOption = Annotated[
    bool, typer.Option("--page/--no-page", help="Show live captures on a page in the browser.")
]
IdleOption = Annotated[
    float, typer.Option("--idle-s", min=1, help="A live capture ends after so long without a view.")
]


@calibrate.callback()
def overview(
    context: typer.Context,
    status: Annotated[
        bool, typer.Option("--status", help="What is in use, what rests on what, and what is stale.")
    ] = False,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    maps: Annotated[
        list[Path] | None, typer.Option("--map", metavar="MAP.npz", help="A map to judge; may be repeated.")
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", metavar="RIG.toml", help="What the results are put on top of.")
    ] = None,
    write_rig: Annotated[
        Path | None, typer.Option("--write-rig", metavar="FILE", help="Write the rig in use.")
    ] = None,
    json_: JsonOption = None,
) -> None:
    """Commission the sensor package."""
    if context.invoked_subcommand is not None:
        if status or write_rig:
            raise typer.BadParameter("--status and --write-rig stand alone, without a step")
        return
    if not status and write_rig is None:
        raise typer.BadParameter("give a step, --status, or --write-rig FILE")
    from daemon import commissioning_status

    commissioning_status.run(config, set_ or [], calibration, maps or [], rig, write_rig, json_)


@calibrate.command()
def cameras(
    from_: FromOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
    new_devices: NewDevicesOption = False,
    page: PageOption = True,
    idle_s: IdleOption = 900.0,
    board: Annotated[
        str | None, typer.Option(metavar="9x6", help="Inner corners of the board, columns x rows.")
    ] = None,
    square_mm: Annotated[float | None, typer.Option(min=1, help="Side of a square.")] = None,
    charuco: Annotated[
        str | None,
        typer.Option(metavar="DICT", help="A ChArUco board's dictionary, DICT_5X5_100 say."),
    ] = None,
    marker_mm: Annotated[float | None, typer.Option(min=1, help="Side of a ChArUco marker.")] = None,
) -> None:
    """Both cameras' intrinsics, how they stand to each other, and the depth sensor's own errors."""
    from daemon import commissioning_steps

    told = commissioning_steps.BoardTold(board, square_mm, charuco, marker_mm)
    call = commissioning_steps.call(
        "cameras", config, set_, from_, calibration, json_, pictures, new_devices, page, idle_s
    )
    raise typer.Exit(commissioning_steps.cameras(call, told))


class Target(StrEnum):
    """What the hand-eye is found from."""

    discs = "discs"
    checkerboard = "checkerboard"
    charuco = "charuco"
    spheres = "spheres"


@calibrate.command("hand-eye")
def hand_eye(
    from_: FromOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
    new_devices: NewDevicesOption = False,
    page: PageOption = True,
    idle_s: IdleOption = 900.0,
    observations: Annotated[
        Path | None,
        typer.Option(metavar="OBS.json", help="Any target, found by any program: poses and points."),
    ] = None,
    target: Annotated[Target, typer.Option(help="What the camera looks at.")] = Target.discs,
    board: Annotated[
        str | None, typer.Option(metavar="9x6", help="Inner corners of the board, columns x rows.")
    ] = None,
    square_mm: Annotated[float | None, typer.Option(min=1, help="Side of a square.")] = None,
    charuco: Annotated[str | None, typer.Option(metavar="DICT", help="A ChArUco board's dictionary.")] = None,
    marker_mm: Annotated[float | None, typer.Option(min=1, help="Side of a ChArUco marker.")] = None,
    sphere_radii_mm: Annotated[tuple[float, float], typer.Option(help="Of the two spheres on a rod.")] = (
        12.0,
        10.0,
    ),
    sphere_distance_mm: Annotated[float, typer.Option(help="Between the spheres' centres.")] = 50.26,
    joint_offsets: Annotated[
        bool,
        typer.Option("--joint-offsets", help="Also find the joints' offsets that can be seen."),
    ] = False,
    flange_offset: Annotated[
        bool, typer.Option("--flange-offset", help="Also find the last D-H length.")
    ] = False,
) -> None:
    """Where the depth camera sits on the flange: one least squares over all poses."""
    from daemon import commissioning_steps

    told = commissioning_steps.BoardTold(board, square_mm, charuco, marker_mm)
    call = commissioning_steps.call(
        "hand-eye", config, set_, from_, calibration, json_, pictures, new_devices, page, idle_s
    )
    if target is Target.spheres:
        rod = commissioning_steps.rod(sphere_radii_mm, sphere_distance_mm)
        raise typer.Exit(commissioning_steps.spheres(call, rod))
    kinds: dict[Target, Literal["discs", "checkerboard", "charuco"]] = {
        Target.discs: "discs",
        Target.checkerboard: "checkerboard",
        Target.charuco: "charuco",
    }
    raise typer.Exit(
        commissioning_steps.hand_eye(call, observations, kinds[target], told, joint_offsets, flange_offset)
    )


class Series(StrEnum):
    """What the response is found from."""

    auto = "auto"
    exposure = "exposure"
    distance = "distance"


@calibrate.command()
def response(
    from_: FromOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
    new_devices: NewDevicesOption = False,
    page: PageOption = True,
    idle_s: IdleOption = 900.0,
    series: Annotated[
        Series, typer.Option(help="Exposures, or distances (weak); auto: exposures if there are any.")
    ] = Series.auto,
    thesis: Annotated[
        bool, typer.Option("--thesis", help="Only the distance polynomial of Eq. 4.4.")
    ] = False,
) -> None:
    """How the colour camera turns light into numbers, its dark level and its noise."""
    from daemon import commissioning_steps

    call = commissioning_steps.call(
        "response", config, set_, from_, calibration, json_, pictures, new_devices, page, idle_s
    )
    raise typer.Exit(commissioning_steps.response(call, series.value, thesis))


class Use(StrEnum):
    """What the light is found from."""

    all = "all"
    boards = "boards"
    lambertian = "lambertian"


@calibrate.command()
def light(
    from_: FromOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
    new_devices: NewDevicesOption = False,
    page: PageOption = True,
    idle_s: IdleOption = 900.0,
    use: Annotated[Use, typer.Option(help="Semi-gloss boards, the Lambertian series, or both.")] = Use.all,
    thesis: Annotated[
        bool, typer.Option("--thesis", help="Only the position, board by board, by Eq. 4.5-4.10.")
    ] = False,
    also: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC.mcap", help="Earlier captures that count, too."),
    ] = None,
) -> None:
    """Where the LED is, where it points, how it falls off, and the lens' vignetting, all at once."""
    from daemon import commissioning_steps

    call = commissioning_steps.call(
        "light", config, set_, from_, calibration, json_, pictures, new_devices, page, idle_s
    )
    raise typer.Exit(commissioning_steps.light(call, use.value, thesis, also or ()))


@calibrate.command()
def limits(
    from_: FromOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
    new_devices: NewDevicesOption = False,
    page: PageOption = True,
    idle_s: IdleOption = 900.0,
    model: Annotated[
        Path | None, typer.Option(metavar="MODEL", help="What `train` wrote; else one is trained here.")
    ] = None,
    classes: Annotated[
        Path | None, typer.Option(metavar="CLASSES.toml", help="Live: what the labels mean.")
    ] = None,
    surface: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Live: a board of this surface; may be repeated.")
    ] = None,
) -> None:
    """From where to where, and how obliquely, each surface's texture can be trusted."""
    from daemon import commissioning_steps

    call = commissioning_steps.call(
        "limits", config, set_, from_, calibration, json_, pictures, new_devices, page, idle_s
    )
    raise typer.Exit(commissioning_steps.limits(call, model, classes, surface or ()))


class ClassifierKind(StrEnum):
    """Kinds of classifiers."""

    svm = "svm"
    naive_bayes = "naive-bayes"


def train(
    recording: RecordingArgument,
    out: Annotated[Path, typer.Option("--out", metavar="MODEL", help="Where the model goes.")],
    thesis: Annotated[
        bool, typer.Option("--thesis", help="K_d by the printed polynomial even if the full model is there.")
    ] = False,
    classifier: Annotated[ClassifierKind, typer.Option(help="Of both routes.")] = ClassifierKind.svm,
    seed: Annotated[int, typer.Option(min=0, help="Of drawing samples and folds.")] = 0,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
) -> None:
    """Train both routes from a recording's labelled `train` captures, and say how good the model is."""
    from daemon import commissioning_steps
    from surfclass.training import TrainingSettings

    settings = TrainingSettings(
        classifier="svm" if classifier is ClassifierKind.svm else "naive_bayes",
        reflectance="thesis" if thesis else None,
        seed=seed,
    )
    call = commissioning_steps.call("train", config, set_, [recording], calibration, json_, pictures)
    raise typer.Exit(commissioning_steps.train(call, out, settings))


def verify(
    from_: FromOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: DirectoryOption = None,
    model: Annotated[
        Path | None, typer.Option(metavar="MODEL", help="What labelled boards are judged by.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="REPORT.html", help="One page, with pictures, to print or to send.")
    ] = None,
    board: Annotated[
        str | None, typer.Option(metavar="9x6", help="Inner corners of the board, columns x rows.")
    ] = None,
    square_mm: Annotated[float | None, typer.Option(min=1, help="Side of a square.")] = None,
    require: Annotated[
        list[str] | None,
        typer.Option(metavar="PART", help="Must be checked: cameras, discs, grey_card, boards."),
    ] = None,
    json_: JsonOption = None,
    pictures: PicturesOption = None,
) -> None:
    """Re-check the whole chain with fresh captures: discs, grey card, labelled boards."""
    from daemon import commissioning_steps

    told = commissioning_steps.BoardTold(board, square_mm, None, None)
    call = commissioning_steps.call("verify", config, set_, from_, calibration, json_, pictures)
    raise typer.Exit(commissioning_steps.verify(call, model, report, told, require or ()))


def label(
    recording: RecordingArgument,
    out: Annotated[Path, typer.Option("--out", metavar="OUT.mcap", help="The labelled recording.")],
    classes: Annotated[
        Path | None, typer.Option(metavar="CLASSES.toml", help="In place of the recording's own.")
    ] = None,
    calibration: CalibrationOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0: any.")] = 0,
) -> None:
    """Label captures on a page in the browser: polygons, carried to the other views through the map."""
    from daemon import commissioning_steps

    raise typer.Exit(commissioning_steps.label(recording, out, classes, calibration, port))
