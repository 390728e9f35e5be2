"""The commands `surfclass show …`: pictures of results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daemon.cli_options import RecordingArgument

show = typer.Typer(no_args_is_help=True, help="Draw results: a map as picture or PLY, a capture's images.")


@show.command("map")
def show_map(
    map_: Annotated[Path, typer.Argument(metavar="MAP.npz")],
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it.")] = None,
    ply: Annotated[Path | None, typer.Option(metavar="FILE", help="Write it as coloured points.")] = None,
    classes: Annotated[
        Path | None, typer.Option(metavar="CLASSES.toml", help="Take the colours from here.")
    ] = None,
) -> None:
    """Draw a map as a picture, or write it as PLY."""
    from daemon import maps

    maps.show(map_, png, ply, classes)


@show.command("capture")
def show_capture(
    recording: RecordingArgument,
    png: Annotated[Path, typer.Option(metavar="FILE", help="Where the picture goes.")],
    name: Annotated[list[str] | None, typer.Option(help="Which captures; default: the first four.")] = None,
    model: Annotated[Path | None, typer.Option(metavar="MODEL", help="Classify them too.")] = None,
) -> None:
    """Draw captures: colour, depth, truth and, with a model, what each route makes of them."""
    from daemon import maps

    maps.show_captures(recording, png, name or [], model)
