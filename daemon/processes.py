"""Other processes of this program: started with a log, gone at the end, and their last words for messages."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STOP_S = 30.0


@contextmanager
def process(log: Path, arguments: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Runs a command of this program; it is gone at the end, whatever happens."""
    with log.open("wb") as stream:
        running = subprocess.Popen(
            [sys.executable, "-m", "daemon", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            env=os.environ | {"NO_COLOR": "1"},
        )
        try:
            yield running
        finally:
            if running.poll() is None:
                running.terminate()
                try:
                    running.wait(STOP_S)
                except subprocess.TimeoutExpired:
                    running.kill()
                    running.wait()


def last_words(log: Path) -> str:
    """Returns the last three lines of a log in one."""
    return " / ".join(log.read_text(errors="replace").splitlines()[-3:])
