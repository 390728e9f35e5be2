"""Emulated devices as processes: what `surfclass sim led`, `arm`, `kinect` and `camera` run."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from daemon.offline import console
from drivers.sim.cell import Cell, host_cell
from drivers.sim.cell_server import CellClient
from surfclass.errors import InputError

READY = "ready"
_LOOK_S = 0.5


def run_led(cell_socket: Path | None, link: Path, tcp_port: int | None) -> int:
    """Runs an LED controller on a pseudo-terminal, and says what it is told."""
    from drivers.emulators.led_controller import LedController

    with _cell(cell_socket) as cell:
        led = LedController(
            cell, link, tcp_port=tcp_port, on_command=lambda line: console.print(line, highlight=False)
        )
        places = f"serial port {link}" + ("" if tcp_port is None else f", TCP port {tcp_port}")
        return _run(cell, led, f"LED controller: {places}")


def run_arm(cell_socket: Path | None, host: str, port: int, serial_link: Path | None, model: str) -> int:
    """Runs a robot controller that serves b-CAP."""
    from drivers.emulators.bcap_controller import BcapController

    if model not in ("RC7", "RC8"):
        raise InputError(f"--model {model}: allowed are RC7 and RC8")
    with _cell(cell_socket) as cell:
        arm = BcapController(
            cell, host, port, serial_link=serial_link, model="RC7" if model == "RC7" else "RC8"
        )
        places = f"{host}:{port}, TCP and UDP" + (
            "" if serial_link is None else f", serial port {serial_link}"
        )
        return _run(cell, arm, f"robot controller {model}: {places}")


def run_kinect(cell_socket: Path | None, memory: Path, rate_hz: float, latency_s: float) -> int:
    """Runs a virtual Kinect, which OpenNI2 finds by its plug-in."""
    from drivers.emulators.virtual_kinect import VirtualKinect

    with _cell(cell_socket, images=True) as cell:
        kinect = VirtualKinect(cell, memory, fps=rate_hz, latency_s=latency_s)
        return _run(cell, kinect, f"virtual Kinect: {kinect.uri}")


def run_camera(cell_socket: Path | None, serial: str, address: str) -> int:
    """Runs a GigE Vision camera."""
    from drivers.emulators.gige_camera import GigeCamera

    with _cell(cell_socket, images=True) as cell:
        return _run(cell, GigeCamera(cell, serial, address), f"GigE Vision camera {serial} at {address}")


@contextmanager
def _cell(socket: Path | None, images: bool = False) -> Iterator[Cell]:
    """The cell of `surfclass sim cell`, or one of its own, with its textures made if it gives images."""
    if socket is None:
        made = host_cell()
        if images:
            with console.status("making the simulated cell"):
                made.bake()
        yield made
        return
    client = CellClient(socket)
    try:
        yield client
    finally:
        client.close()


def _run(cell: Cell, device: AbstractContextManager[object], told: str) -> int:
    """Runs the device until SIGTERM, SIGINT, or the end of its cell.

    Raises:
        InputError: If the cell is gone.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with device:
        console.print(told, highlight=False)
        print(READY, flush=True)
        while not stop.wait(_LOOK_S):
            cell.light_level(0, 1)  # raises when it is gone
    return 0
