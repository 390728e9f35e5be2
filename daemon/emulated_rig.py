"""A simulated cell with all its devices as processes, and their supervisor: `surfclass sim cell`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from daemon.emulators import READY
from daemon.offline import console
from drivers.emulators.ports import free_port
from drivers.files import write_atomically
from drivers.sim.cell import WorldCell, host_cell
from drivers.sim.cell_server import CellServer
from surfclass.errors import InputError

SOCKET, DEVICES, PIDS = "cell.sock", "devices.toml", "pids.json"
CAMERA = "SIM01"
# What two cores can render while the daemon has some of them left.
KINECT_RATE_HZ = 4.0
KINECT_LATENCY_S = 0.2
_READY_S = 60.0
_STOP_S = 5.0
_LOOK_S = 0.1


def run_cell(
    folder: Path,
    scene: str,
    seed: int,
    scale: float,
    viewpoints: int | None,
    told: bool,
    restart_s: float,
) -> int:
    """Serves the cell and keeps its four devices running until SIGTERM or SIGINT.

    A device that ends, by whatever, comes back after `restart_s`, as somebody would plug it in again.
    `devices.toml` in the folder holds the tables that a configuration needs; it is written last, when
    everything answers. `pids.json` holds each device's process.

    Raises:
        InputError: If a device does not start.
    """

    def make(scene: str, seed: int) -> WorldCell:
        cell = host_cell(scene, seed, scale=scale, viewpoints=viewpoints, told=told)
        cell.bake()
        return cell

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    folder.mkdir(parents=True, exist_ok=True)
    (folder / DEVICES).unlink(missing_ok=True)
    with console.status(f"making the scene {scene}"):
        cell = make(scene, seed)
    places = Places(folder.resolve(), free_port())
    with CellServer(cell, places.socket, make) as server:
        devices = [Emulator(name, arguments) for name, arguments in places.commands().items()]
        try:
            for device in devices:
                device.start()
            _wait_ready(devices, stop)
            _tell(folder, devices)
            write_atomically(folder / DEVICES, places.tables().encode())
            while not stop.wait(_LOOK_S):
                server.cell.prepare()
                changed = [device.name for device in devices if device.revive(restart_s)]
                if changed:
                    _tell(folder, devices)
        finally:
            for device in devices:
                device.stop()
    return 0


@dataclass(frozen=True)
class Places:
    """Where the devices of one cell are found.

    Attributes:
        folder: Absolute; of their sockets and links.
        port: Of the robot controller.
    """

    folder: Path
    port: int

    @property
    def socket(self) -> Path:
        """The cell's."""
        return self.folder / SOCKET

    def commands(self) -> dict[str, list[str]]:
        """Each device's name and what `surfclass sim` is called with."""
        cell = ["--cell", str(self.socket)]
        paced = ["--rate-hz", f"{KINECT_RATE_HZ:g}", "--latency-s", f"{KINECT_LATENCY_S:g}"]
        return {
            "light": ["led", *cell, "--link", str(self.folder / "led")],
            "arm": ["arm", *cell, "--port", str(self.port)],
            "depth": ["kinect", *cell, "--memory", str(self.folder / "kinect"), *paced],
            "colour": ["camera", *cell, "--serial", CAMERA],
        }

    def tables(self) -> str:
        """The devices' tables for a configuration."""
        return _TABLES.format(
            folder=self.folder, port=self.port, camera=CAMERA, latency_ms=KINECT_LATENCY_S * 1e3
        )


class Emulator:
    """One device's process."""

    def __init__(self, name: str, arguments: list[str]) -> None:
        self.name = name
        self._arguments = [sys.executable, "-m", "daemon", "sim", *arguments]
        self._process: subprocess.Popen[str] | None = None
        self._gone_s: float | None = None
        self.ready = threading.Event()

    @property
    def pid(self) -> int | None:
        """Of the process; None while it is gone."""
        return None if self._process is None or self._process.poll() is not None else self._process.pid

    def start(self) -> None:
        """Starts it; `ready` is set when it answers."""
        self._gone_s = None
        self.ready.clear()
        self._process = subprocess.Popen(
            self._arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, env=os.environ
        )
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def revive(self, after_s: float) -> bool:
        """Starts it again if it has been gone for so long; returns whether it came or went."""
        if self.pid is not None:
            return False
        if self._gone_s is None:
            self._gone_s = time.monotonic()
            code = None if self._process is None else self._process.returncode
            console.print(f"{self.name}: ended with {code}, back in {after_s:g} s", highlight=False)
            return True
        if time.monotonic() < self._gone_s + after_s:
            return False
        self.start()
        return True

    def stop(self) -> None:
        """Ends it, orderly if it will."""
        process = self._process
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                if line.strip() == READY:
                    self.ready.set()


def _wait_ready(devices: list[Emulator], stop: threading.Event) -> None:
    until = time.monotonic() + _READY_S
    while not all(device.ready.wait(_LOOK_S) for device in devices):
        gone = [device.name for device in devices if device.pid is None]
        if stop.is_set() or gone or time.monotonic() > until:
            waited = [device.name for device in devices if not device.ready.is_set()]
            raise InputError(f"the emulated {', '.join(gone or waited)} did not start")


def _tell(folder: Path, devices: list[Emulator]) -> None:
    write_atomically(folder / PIDS, json.dumps({device.name: device.pid for device in devices}).encode())
    table = Table("device", "process")
    for device in devices:
        table.add_row(device.name, "gone" if device.pid is None else str(device.pid))
    console.print(table)


_TABLES = """\
[colour]
backend = "aravis"
serial = "{camera}"
address = "127.0.0.1"
exposure_us = 10000.0
gain_db = 0.0
packet_bytes = 8000

[depth]
backend = "openni2"
device = "virtual://{folder}/kinect"
exposure_ms = 10.0
latency_ms = {latency_ms:.1f}

[light]
backend = "gardasoft"
port_path = "{folder}/led"
rating_a = 0.7
reply_timeout_s = 1.0

[arm]
backend = "bcap"
host = "127.0.0.1"
port = {port}
max_gap_s = 1.0  # a computer that renders and classifies on the same cores may be late
"""
