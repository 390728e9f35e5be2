"""The IIDC driver through Debian's libdc1394: on a socket that stands in for USB, and on Linux's own USB."""

from __future__ import annotations

import atexit
import ctypes.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from bench import Backend, Bench, Trouble

from drivers.clock import SystemClock
from drivers.colour_iidc import in_process
from drivers.interfaces import ColourCamera
from drivers.isolation.colour import IsolatedColourCamera

OPTIONS = {
    "mode": "format7_0",
    "region_px": [64, 32, 320, 240],
    "exposure_us": 5000.0,
    "gain_db": 3.0,
}
_TROUBLES: frozenset[Trouble] = frozenset({"missing", "unplugged", "mute", "half"})
_FAULTS: dict[Trouble, dict[str, Any]] = {"mute": {"mute": True}, "half": {"short": 1_000_000}}
_VM = Path("/opt/vm/tests/vm/firefly_gadget.py")


def bench(
    camera: ColourCamera,
    slack_s: float,
    plug: Callable[[], None],
    unplug: Callable[[], None],
    faults: Callable[[dict[str, Any]], None],
) -> Bench:
    def fail(_: str, trouble: Trouble) -> None:
        if trouble in _FAULTS:
            faults(_FAULTS[trouble])
        else:
            unplug()

    def mend(_: str) -> None:
        faults({})
        plug()

    return Bench(SystemClock(), colour=camera, fail=fail, mend=mend, slack_s=slack_s)


@cache
def stand_in() -> Path:
    """The folder of the compiled stand-in for libusb."""
    from firefly_socket import build_libusb  # not in the virtual machine, which has no compiler

    folder = Path(tempfile.mkdtemp(prefix="iidc-libusb-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return build_libusb(folder)


@contextmanager
def on_a_socket(folder: Path) -> Iterator[Bench]:
    from firefly_socket import FireflySocket

    from drivers.emulators.firefly import Faults

    path = folder / "usb"
    environment = {"LD_LIBRARY_PATH": str(stand_in()), "IIDC_USB_SOCKET": str(path)}
    with FireflySocket(path) as firefly:

        def faults(changed: dict[str, Any]) -> None:
            firefly.camera.faults = Faults(**changed)

        camera = IsolatedColourCamera(
            "drivers.colour_iidc:in_process", name="colour", options=OPTIONS, environment=environment
        )
        yield bench(camera, 0.4, firefly.plug, firefly.unplug, faults)
        camera.close()


class Gadget:
    """The process that is the USB camera, one for all tests: it takes seconds to start."""

    def __init__(self) -> None:
        folder = Path(tempfile.mkdtemp(prefix="iidc-gadget-"))
        self._path = folder / "command"
        self._process = subprocess.Popen([sys.executable, str(_VM), str(self._path)])
        atexit.register(self._end)
        deadline = time.monotonic() + 60
        while True:
            assert self._process.poll() is None, "the gadget's process ended; see its output"
            assert time.monotonic() < deadline, "the gadget was not there in 60 s"
            try:
                self.ask(do="shots")
            except (FileNotFoundError, ConnectionRefusedError):  # not yet
                time.sleep(0.1)
            else:
                break

    def ask(self, **command: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(10)
            connection.connect(str(self._path))
            connection.sendall(json.dumps(command).encode() + b"\n")
            answer: dict[str, Any] = json.loads(connection.makefile().readline())
            return answer

    def plug(self) -> None:
        self.ask(do="plug")
        self._until(there=True)

    def unplug(self) -> None:
        self.ask(do="unplug")
        self._until(there=False)

    def faults(self, changed: dict[str, Any]) -> None:
        self.ask(faults=changed)

    def _until(self, there: bool) -> None:
        """Waits for the kernel's side of the plug."""
        deadline = time.monotonic() + 20
        while there != _plugged():
            assert time.monotonic() < deadline, f"USB has not noticed in 20 s (plugged in: {there})"
            time.sleep(0.05)

    def _end(self) -> None:
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()


def _plugged() -> bool:
    for vendor in Path("/sys/bus/usb/devices").glob("*/idVendor"):
        with suppress(OSError):  # it goes while it is read
            if vendor.read_text().strip() == "1e10":
                return True
    return False


@cache
def gadget() -> Gadget:
    return Gadget()


@contextmanager
def on_usb(_: Path) -> Iterator[Bench]:
    device = gadget()
    device.faults({})
    device.unplug()
    device.plug()
    # In this process: under emulation another one takes 10 s to start; guest_iidc.py does it once.
    camera = in_process(name="colour", clock=SystemClock(), options={**OPTIONS, "late_s": 2.0}, shared={})
    yield bench(camera, 1.5, device.plug, device.unplug, device.faults)
    camera.close()


def _missing_on_a_socket() -> str:
    if shutil.which("gcc") is None or not Path("/usr/include/libusb-1.0/libusb.h").exists():
        return "needs gcc and libusb-1.0-0-dev, to compile the stand-in for USB"
    if ctypes.util.find_library("dc1394") is None:
        return "needs libdc1394-25"
    return ""


BACKENDS = [
    Backend("libdc1394 on a socket", on_a_socket, {"colour": _TROUBLES}, missing=_missing_on_a_socket()),
    Backend(
        "iidc, emulated USB camera",
        on_usb,
        {"colour": _TROUBLES},
        missing="" if _VM.exists() and os.geteuid() == 0 else "needs the virtual machine: ./run test --vm",
    ),
]
