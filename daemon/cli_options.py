"""Options that several commands share, and the exit codes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXIT_GATE_FAILED, EXIT_USAGE, EXIT_DEVICE, EXIT_CONFIGURATION = 1, 2, 69, 78

RecordingArgument = Annotated[Path, typer.Argument(metavar="REC.mcap", help="A recording.")]
ModelOption = Annotated[Path, typer.Option("--model", metavar="MODEL", help="What `train` wrote.")]
ConfigOption = Annotated[Path | None, typer.Option("--config", "-c", metavar="FILE", help="The TOML file.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="TABLE.KEY=VALUE", help="One-off override; may be repeated."),
]
JsonOption = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help='Write the result as JSON; "-" is stdout.')
]
ThesisOption = Annotated[
    bool,
    typer.Option("--thesis", help="As in the thesis: every pixel an independent observation, linear pool."),
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration", metavar="DIR", help="Use the results of `calibrate` in this directory, too."
    ),
]
