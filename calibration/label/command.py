"""`surfclass label`: serves the labelling page until the labelled recording is written."""

from __future__ import annotations

import fcntl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from calibration.label.session import LabelSession
from calibration.label.site import page, routes
from calibration.outcome import Note
from calibration.web import WebServer
from surfclass.errors import InputError
from surfclass.rig import DepthRig

_BODY_LIMIT = 16 << 20  # a view of very many corners
_WAKE_S = 0.5  # so that Ctrl-C is heard


@dataclass(frozen=True, slots=True)
class LabelOptions:
    """How the page is served.

    Attributes:
        classes: A `classes.toml` in place of the recording's; it may add names.
        host: The address to listen at; anything but loopback lets others on the network label too.
        port: The TCP port; 0 takes any that is free.
    """

    classes: Path | None = None
    host: str = "127.0.0.1"
    port: int = 0


def label(
    recording: Path,
    out: Path,
    options: LabelOptions,
    note: Note,
    rig: DepthRig | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Serves the page and returns the number of labelled captures once they are written.

    What is drawn is on the disk after every change: an interruption loses nothing, and the same command
    goes on where it ended.

    Args:
        recording: What to label.
        out: The labelled recording.
        options: How to serve.
        note: Is told where to point the browser.
        rig: By which labels are carried between views; the recording's by default.
        stop: Ends it early; 0 is returned then.

    Raises:
        InputError, ConfigurationError: If a file or the address cannot be used.
    """
    stop = stop or threading.Event()
    written: list[int] = []

    def finished(count: int) -> None:
        written.append(count)
        stop.set()

    with _alone(recording):
        session = LabelSession(recording, out, options.classes, rig)
        answers = routes(session, finished)
        web = WebServer(page(), answers, host=options.host, port=options.port, body_limit=_BODY_LIMIT)
        with web:
            note(f"label {len(session.views)} captures at {web.url}")
            if session.cannot_propagate:
                note(f"labels cannot be carried to other views: {session.cannot_propagate}")
            while not stop.wait(_WAKE_S):
                pass
    return written[-1] if written else 0


@contextmanager
def _alone(recording: Path) -> Iterator[None]:
    """Keeps a second process from labelling the recording meanwhile; one that is killed lets go of it."""
    try:
        stream = recording.open("rb")
    except OSError as error:
        raise InputError(f"{recording}: cannot be read: {error.strerror}") from None
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{recording}: another surfclass label works on it; end that first") from None
        yield
