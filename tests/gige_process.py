"""The emulated GigE camera of the tests: a process that may be killed, one for each network address.

GigE Vision has one port, so test runs take turns at 127.0.0.1, and skip these tests where something else has
it; $GIGE_TEST_ADDRESS names another address of this computer, such as one more of the loopback interface.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import IO

import pytest

from drivers.emulators.gige_library import GVCP_PORT

SERIAL = f"T{os.getpid()}"
ADDRESS = os.environ.get("GIGE_TEST_ADDRESS", "127.0.0.1")
_ROOT = Path(__file__).parents[1]
_PATIENCE_S = 60.0
_ARGUMENTS = ("--serial", SERIAL, "--address", ADDRESS, "--scale", "0.05", "--light", "0.5")


def missing() -> str:
    """Why no camera can be emulated or read here; empty where it can."""
    try:
        ctypes.CDLL("libaravis-0.8.so.0")
    except OSError:
        return "Aravis is not installed (libaravis-0.8-0)"
    if importlib.util.find_spec("gi") is None:
        return "PyGObject is not installed (surfclass[aravis])"
    try:
        import gi

        gi.require_version("Aravis", "0.8")
    except ValueError:
        return "Aravis cannot be loaded by PyGObject (gir1.2-aravis-0.8)"
    return ""


@cache
def _lock() -> IO[str]:
    """Whoever tests on this address waits for the others."""
    path = Path(tempfile.gettempdir()) / f"gige-camera-tests-{ADDRESS}.lock"
    lock = path.open("w")
    until = time.monotonic() + _PATIENCE_S
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            atexit.register(lock.close)
            return lock
        except BlockingIOError:
            if time.monotonic() > until:
                lock.close()
                pytest.skip(f"another process tests GigE cameras on this computer, for {_PATIENCE_S:g} s now")
            time.sleep(0.2)


class GigeProcess:
    """`python -m drivers.emulators.gige_camera`; stopped when it is not needed."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        _lock()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "drivers.emulators.gige_camera", *_ARGUMENTS],
            cwd=_ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        if self._process.stdout.readline() != "ready\n":
            _, why = self._process.communicate(timeout=10)
            self._process = None
            if "does another camera run there" in why:
                pytest.skip(f"something else emulates a GigE camera on {ADDRESS}")
            raise AssertionError(why)

    def tell(self, line: str) -> str:
        """Has the camera obey a line (drivers.emulators.gige_camera.obey), and returns its answer."""
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._process.stdout.readline().strip()

    def kill(self) -> None:
        """As when a cable is cut."""
        self._end(signal.SIGKILL)

    def freeze(self) -> None:
        """It stays, and answers nothing, until `thaw`."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)

    def stop(self) -> None:
        self._end(signal.SIGKILL)

    def as_new(self) -> None:
        """Runs, with no trouble left over from another test."""
        self.thaw()
        self.start()
        for line in ("lose 0", "clock 0", "power_cycle"):
            assert self.tell(line) == "done"

    def _end(self, number: int) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(number)
            process.communicate(timeout=10)


@cache
def shared() -> GigeProcess:
    """The one process of this test run; it takes a second to start."""
    process = GigeProcess()
    atexit.register(process.stop)
    return process


def take_port() -> None:
    """For a camera that is emulated in the test's own process."""
    _lock()
    shared().stop()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind((ADDRESS, GVCP_PORT))
        except OSError:
            pytest.skip(f"something else emulates a GigE camera on {ADDRESS}")
