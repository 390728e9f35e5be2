"""The commands `surfclass sim …`: emulated devices and a simulated cell, each a process of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

sim = typer.Typer(
    no_args_is_help=True,
    help="Emulated devices that speak the real ones' protocols, for trying drivers without hardware.",
)

CellOption = Annotated[
    Path | None,
    typer.Option("--cell", metavar="SOCKET", help="Of `sim cell`; without it each has a world of its own."),
]


@sim.command()
def cell(
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Sockets, devices.toml and pids.json go there.")
    ],
    scene: Annotated[str, typer.Option(help="What stands in front of the arm.")] = "cell",
    seed: Annotated[int, typer.Option(min=0, help="Of textures and noise.")] = 0,
    scale: Annotated[float, typer.Option(min=0.05, max=1, help="Of the images.")] = 1.0,
    viewpoints: Annotated[
        int | None, typer.Option(min=1, help="How many places the arm visits; all by default.")
    ] = None,
    told: Annotated[
        bool, typer.Option("--told", help="The arm leaves a place only when a client says that it may.")
    ] = False,
    restart_s: Annotated[
        float, typer.Option("--restart-s", min=0, help="An emulator that was killed comes back after this.")
    ] = 3.0,
) -> None:
    """Run a simulated cell with all its devices: depth and colour camera, light and arm."""
    from daemon.emulated_rig import run_cell

    raise typer.Exit(run_cell(folder, scene, seed, scale, viewpoints, told, restart_s))


@sim.command()
def led(
    link: Annotated[Path, typer.Option(metavar="PATH", help="Where its serial port appears.")] = Path("led"),
    tcp: Annotated[
        int | None, typer.Option(metavar="PORT", min=0, max=65535, help="Listen there too; 0: any.")
    ] = None,
    cell: CellOption = None,
) -> None:
    """Run a Gardasoft RT controller on a pseudo-terminal, and say what it is told."""
    from daemon.emulators import run_led

    raise typer.Exit(run_led(cell, link, tcp))


@sim.command()
def arm(
    host: Annotated[str, typer.Option(help="The address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of TCP and UDP; 0: any.")] = 5007,
    serial_link: Annotated[
        Path | None, typer.Option("--serial-link", metavar="PATH", help="Where a serial port appears.")
    ] = None,
    model: Annotated[str, typer.Option(help="RC7 or RC8.")] = "RC8",
    cell: CellOption = None,
) -> None:
    """Run a Denso controller that serves b-CAP over TCP, UDP and RS-232."""
    from daemon.emulators import run_arm

    raise typer.Exit(run_arm(cell, host, port, serial_link, model))


@sim.command()
def kinect(
    memory: Annotated[Path, typer.Option(metavar="FILE", help="The file that frames are shared in.")] = Path(
        "/dev/shm/surfclass-kinect"
    ),
    rate_hz: Annotated[
        float, typer.Option("--rate-hz", help="Frames a second, if they can be rendered.")
    ] = 30.0,
    latency_s: Annotated[
        float, typer.Option("--latency-s", help="From an exposure until its frame is there.")
    ] = 0.04,
    cell: CellOption = None,
) -> None:
    """Run a virtual Kinect, which OpenNI2 finds by its plug-in."""
    from daemon.emulators import run_kinect

    raise typer.Exit(run_kinect(cell, memory, rate_hz, latency_s))


@sim.command()
def camera(
    serial: Annotated[str, typer.Option(help="Its serial number.")] = "SIM01",
    address: Annotated[str, typer.Option(help="Of this host; one camera for each.")] = "127.0.0.1",
    cell: CellOption = None,
) -> None:
    """Run a GigE Vision camera, Aravis's own, that sees the simulated cell."""
    from daemon.emulators import run_camera

    raise typer.Exit(run_camera(cell, serial, address))
