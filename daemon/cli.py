"""The command line; each command imports what it needs when it runs, so that --help answers at once."""

from __future__ import annotations

import os
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daemon.cli_calibrate import calibrate, label, train, verify
from daemon.cli_options import (
    EXIT_CONFIGURATION,
    EXIT_DEVICE,
    EXIT_GATE_FAILED,
    EXIT_USAGE,
    CalibrationOption,
    ConfigOption,
    JsonOption,
    ModelOption,
    RecordingArgument,
    SetOption,
    ThesisOption,
)
from daemon.cli_show import show
from daemon.cli_sim import sim

if TYPE_CHECKING:
    from surfclass.pipeline import PipelineSettings

app = typer.Typer(
    name="surfclass",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="rich",
    help="""
    What a blasting robot on a steel bridge is looking at: RGB-D captures become a classified 3D map.

    [bold]A first walk[/bold], without hardware:

    [cyan]surfclass import FOLDER rec.mcap[/cyan]

    [cyan]surfclass train rec.mcap --out model.npz[/cyan]

    [cyan]surfclass evaluate rec.mcap --model model.npz[/cyan]

    [cyan]surfclass replay rec.mcap --model model.npz --map map.npz[/cyan]

    [cyan]surfclass show map map.npz --png map.png[/cyan]

    On the robot: `surfclass check`, then `surfclass run`; at the console: `surfclass watch`.

    Exit codes: 0 pass, 1 a quality gate failed, 2 usage, 69 device unavailable, 78 configuration.
    """,
)
app.add_typer(calibrate, name="calibrate")
app.command()(train)
app.command()(label)
app.command()(verify)
app.add_typer(show, name="show")
app.add_typer(sim, name="sim")


class Update(StrEnum):
    """How a frame's pixels count."""

    frame = "frame"
    independent = "independent"


class Pool(StrEnum):
    """How the two layers are fused."""

    log_linear = "log-linear"
    linear = "linear"


class Route(StrEnum):
    """What is evaluated."""

    rgb = "rgb"
    ab = "ab"
    kd = "kd"
    texture = "texture"
    combined = "combined"
    all = "all"


UpdateOption = Annotated[
    Update | None, typer.Option(help="frame: one observation a voxel and frame; independent: Eq. 3.9.")
]
PoolOption = Annotated[Pool | None, typer.Option(help="log-linear, or linear: Eq. 3.11.")]


@app.command("import")
def import_(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="rig.toml, classes.toml, captures.csv, …")],
    out: Annotated[Path, typer.Argument(metavar="OUT.mcap")],
) -> None:
    """Turn a data folder into a recording; images keep their original bytes."""
    from daemon import offline

    count = offline.import_folder(folder, out)
    offline.console.print(f"{out}: {count} captures")


@app.command()
def recover(
    path: Annotated[Path, typer.Argument(metavar="REC.mcap[.active]", help="An unfinished recording.")],
) -> None:
    """Make a whole recording out of one that was cut off."""
    from daemon import offline
    from drivers.recordings import recover as recover_recording

    offline.console.print(f"{recover_recording(path)}")


@app.command()
def replay(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC.mcap", help="A recording, or its parts in order.")
    ],
    model: ModelOption,
    map_: Annotated[Path, typer.Option("--map", metavar="OUT.npz", help="Where the map goes.")],
    thesis: ThesisOption = False,
    update: UpdateOption = None,
    pool: PoolOption = None,
    calibration: CalibrationOption = None,
) -> None:
    """Run a recording's `map` and `test` captures through the pipeline; the same bytes every time."""
    from daemon import offline

    pipeline, stage_ms = offline.replay(recordings, model, map_, _settings(thesis, update, pool), calibration)
    offline.print_stages(stage_ms)
    offline.console.print(f"{map_}: {len(pipeline.map):,} voxels of {pipeline.map.size_m * 1000:g} mm")


@app.command()
def evaluate(
    recording: RecordingArgument,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="MODEL", help="What `train` wrote.")
    ] = None,
    route: Annotated[Route, typer.Option(help="Which route's accuracy.")] = Route.all,
    json_: JsonOption = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the confusion matrices.")] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", metavar="MAP.npz", help="Score this map instead of a new one.")
    ] = None,
    require: Annotated[
        float | None,
        typer.Option(
            min=0, max=1, metavar="SHARE", help="Exit 1 if fewer of the fused map's voxels are right."
        ),
    ] = None,
    thesis: ThesisOption = False,
    update: UpdateOption = None,
    pool: PoolOption = None,
    calibration: CalibrationOption = None,
) -> None:
    """Accuracy against the labels of the `test` captures: voxels, pixels, calibration."""
    from daemon import offline
    from drivers.files import check_output

    settings = _settings(thesis, update, pool)
    if (model is None) == (map_ is None):
        raise typer.BadParameter(
            "give --model MODEL to make the map anew, or --map MAP.npz to score a finished one"
        )
    if map_ is not None and (thesis or update or pool or route is not Route.all):
        raise typer.BadParameter(
            "--map MAP.npz is scored as it is: without --route, --thesis, --update, --pool"
        )
    check_output(json_, png)
    if model is not None:
        result = offline.evaluate_recording(recording, model, route.value, settings, calibration)
        offline.print_evaluation(result)
    elif map_ is not None:
        result = offline.evaluate_map(recording, map_)
        offline.print_fused(result)
    if json_ is not None:
        offline.write_json(json_, result)
    if png is not None:
        from daemon.pictures import draw_confusions

        draw_confusions(png, result)
    if require is not None:
        routes = result["routes"]
        gate = "combined" if "combined" in routes else next(iter(routes))
        reached = routes[gate]["fused"]["overall"] or 0.0  # none where no labelled pixel has depth
        verdict = "PASS" if reached >= require else "FAIL"
        offline.console.print(f"{verdict}: {gate} {reached:.1%} of the voxels right, {require:.1%} required")
        raise typer.Exit(0 if reached >= require else EXIT_GATE_FAILED)


@app.command()
def capture(
    out: Annotated[Path, typer.Argument(metavar="OUT.mcap")],
    config: ConfigOption = None,
    set_: SetOption = None,
    count: Annotated[int, typer.Option(min=1, help="How many captures.")] = 1,
    role: Annotated[str, typer.Option(help="What they are for: map, train, test, light, …")] = "map",
    dark: Annotated[bool, typer.Option("--dark", help="Take an unlit frame with each.")] = False,
    classes: Annotated[
        Path | None,
        typer.Option(metavar="CLASSES.toml", help="What the labels mean; goes into the recording."),
    ] = None,
    surface: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A board of this surface fills the image; may be repeated."),
    ] = None,
) -> None:
    """Take captures with the configured devices and write a recording.

    To train: `--role train --classes classes.toml --surface rusted --surface timber …` asks for one
    board after the other and labels the whole image with it.
    """
    from daemon import live

    if surface and classes is None:
        raise typer.BadParameter("--surface needs --classes CLASSES.toml, which lists the surfaces")
    live.capture(out, config, set_ or [], count, role, dark, classes, surface or [])


@app.command()
def run(
    config: ConfigOption = None,
    set_: SetOption = None,
    from_: Annotated[
        Path | None, typer.Option("--from", metavar="REC.mcap", help="Take the captures from a recording.")
    ] = None,
    exit_when_done: Annotated[
        bool, typer.Option("--exit-when-done", help="Stop after the recording's last capture.")
    ] = False,
) -> None:
    """Run the service in the foreground: capture, classify, map, publish, record."""
    from daemon import live

    raise typer.Exit(live.run(config, set_ or [], from_, exit_when_done))


@app.command()
def watch(
    connect: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Where the service listens.")
    ] = None,
    robot: Annotated[str, typer.Option(help="The robot's name in the keys.")] = "robot",
    map_: Annotated[
        Path | None, typer.Option("--map", metavar="OUT.npz", help="Write the map when it ends.")
    ] = None,
    until_gone: Annotated[
        bool, typer.Option("--until-gone", help="End when the service that was seen goes away.")
    ] = False,
    captures: Annotated[
        int | None, typer.Option(min=1, help="End when the map holds this many captures.")
    ] = None,
    timeout_s: Annotated[float | None, typer.Option(min=0, help="Give up after so long.")] = None,
    json_: JsonOption = None,
) -> None:
    """Keep the same map as the service, over Zenoh, and show how it grows."""
    from daemon import live

    raise typer.Exit(
        live.watch(connect or ["tcp/127.0.0.1:7447"], robot, map_, until_gone, captures, timeout_s, json_)
    )


@app.command()
def check(config: ConfigOption = None, set_: SetOption = None, json_: JsonOption = None) -> None:
    """Open everything once and say what works, what does not, and what to do about it."""
    from daemon import live

    raise typer.Exit(live.check(config, set_ or [], json_))


@app.command("light-off")
def light_off(config: ConfigOption = None, set_: SetOption = None) -> None:
    """Turn the light off, whatever became of the service; the unit calls this after every stop."""
    from daemon import live

    live.light_off(config, set_ or [])


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the results go.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated cell.")] = 0,
    viewpoints: Annotated[int, typer.Option(min=1, max=15, help="How many places to visit.")] = 10,
    real_drivers: Annotated[
        bool, typer.Option("--real-drivers", help="By OpenNI2, Aravis, serial line and b-CAP.")
    ] = False,
    commission: Annotated[
        bool, typer.Option("--commission", help="Find the rig by every commissioning step; 3 minutes more.")
    ] = False,
) -> None:
    """Everything once, on the simulated cell: commission, train, map with a service, watch it, score it."""
    from daemon.demo import run_demo

    if commission and real_drivers:
        raise typer.BadParameter("--commission is of the simulated devices; leave --real-drivers out")
    raise typer.Exit(run_demo(out, seed, viewpoints, real_drivers, commission))


def _settings(thesis: bool, update: Update | None, pool: Pool | None) -> PipelineSettings:
    from surfclass.pipeline import THESIS, PipelineSettings

    base = THESIS if thesis else PipelineSettings()
    return PipelineSettings(
        update.value if update is not None else base.update, pool.value if pool is not None else base.pool
    )


def main() -> None:
    """Runs the command line; errors that people can mend are one message, without a traceback."""
    from drivers.errors import CaptureRejectedError, DriverError, DriverUnavailableError
    from surfclass.errors import ConfigurationError, InputError

    # A stop from outside unwinds like an error does, so that nothing is left half-written.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        app()
    except ConfigurationError as error:
        sys.exit(_say(error, EXIT_CONFIGURATION))
    except InputError as error:
        sys.exit(_say(error, EXIT_USAGE))
    except DriverUnavailableError as error:
        sys.exit(_say(error, EXIT_CONFIGURATION))
    except (DriverError, CaptureRejectedError) as error:
        sys.exit(_say(error, EXIT_DEVICE))
    except BrokenPipeError:
        # The reader of our standard output has gone; nothing is left to say, to nobody.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_GATE_FAILED)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError) as error:
        sys.exit(_say(error, EXIT_USAGE))  # a path that was given; the message names it
    except OSError as error:  # a full disk
        sys.exit(_say(error, EXIT_DEVICE))


def _say(error: Exception, code: int) -> int:
    lines = str(error).splitlines()
    if len(lines) == 2:  # a heading and one fault below it
        lines = [f"{lines[0]} {lines[1].strip()}"]
    sys.stderr.write("\n".join([f"surfclass: {lines[0]}", *lines[1:]]) + "\n")
    return code
