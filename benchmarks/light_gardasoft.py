"""Times switching the LED through the driver, beside bare pyserial and a loop on the file descriptor.

Run it from the project's folder: `python -m benchmarks.light_gardasoft`. The emulated controller answers
on a pseudo-terminal from a process of its own, so what is timed is software only: on a real wire of
115,200 baud the nine bytes of a command and the prompt take 0.9 ms more.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np
import serial

from drivers.backends import create
from drivers.clock import SystemClock

ROUNDS = 2000
EMULATOR = (
    "import sys; from drivers.emulators.led_controller import LedController as C; c = C(None, sys.argv[1]);"
    "c.start(); print('here', flush=True); c.wait()"
)
COMMANDS = (b"RS1,100\r", b"RS1,0\r")


def timed(calls: list[Callable[[], object]]) -> np.ndarray:
    """Milliseconds of each of `ROUNDS` calls, the given ones in turn."""
    took = np.empty(ROUNDS)
    for n in range(ROUNDS):
        start = time.perf_counter()
        calls[n % len(calls)]()
        took[n] = time.perf_counter() - start
    return took[ROUNDS // 10 :] * 1e3


def bare_pyserial(path: str) -> np.ndarray:
    with serial.Serial(path, 115200, timeout=0.3, write_timeout=0.3, exclusive=True) as port:

        def ask(command: bytes) -> None:
            port.write(command)
            assert port.read_until(b">") == b">"

        return timed([lambda command=command: ask(command) for command in COMMANDS])


def bare_descriptor(path: str) -> np.ndarray:
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(descriptor)  # pyserial leaves a terminal whose reads do not wait
    speed = termios.tcgetattr(descriptor)
    speed[4] = speed[5] = termios.B115200
    termios.tcsetattr(descriptor, termios.TCSANOW, speed)

    def ask(command: bytes) -> None:
        os.write(descriptor, command)
        assert os.read(descriptor, 64) == b">"

    took = timed([lambda command=command: ask(command) for command in COMMANDS])
    os.close(descriptor)
    return took


def driver(path: str) -> np.ndarray:
    options = {"port_path": path, "rating_a": 0.7, "settle_ms": 0.0}
    with create("light", "gardasoft", clock=SystemClock(), options=options) as light:
        return timed([lambda level=level: light.set_level(level) for level in (1.0, 0.0)])


def main() -> None:
    ways = {"the driver": driver, "bare pyserial": bare_pyserial, "bare descriptor": bare_descriptor}
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "led")
        led = subprocess.Popen([sys.executable, "-c", EMULATOR, path], stdout=subprocess.PIPE, text=True)
        try:
            assert led.stdout is not None
            led.stdout.readline()
            runs = {name: [way(path) for _ in range(3)] for name, way in ways.items()}
        finally:
            led.terminate()
            led.communicate()
    best = {name: min(times, key=np.median) for name, times in runs.items()}
    alternative = float(np.median(best["bare pyserial"]))
    print(f"one level set and confirmed over a pty, {ROUNDS} times, the best of 3 runs")
    for name, took in best.items():
        median, late = np.median(took), np.percentile(took, 99)
        ratio = f"{median / alternative:.2f} × bare pyserial"
        print(f"{name:16} median {median:.3f} ms, 99 % {late:.3f} ms, {ratio}")


if __name__ == "__main__":
    main()
