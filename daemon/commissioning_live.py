"""Live commissioning: the devices' views, judged one by one, become the recording that is solved."""

from __future__ import annotations

import contextlib
import datetime
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from calibration.guide import Guide
from calibration.live.devices import device_metadata
from calibration.live.loop import CaptureAbortedError, GuidedSettings, guided_all
from calibration.live.page import PageUi
from calibration.live.terminal import TerminalUi
from calibration.live.ui import ScopedUi, Several
from daemon import wiring
from daemon.config import Config
from daemon.offline import console
from drivers.recordings import RecordingWriter, unix_offset_ns
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture

CAPTURES = "captures"
"""Where recordings go, below the directory of the results."""


def _as_it_is(capture: Capture) -> Capture:
    return capture


@dataclass(frozen=True, slots=True)
class Wanted:
    """Views of one target.

    Attributes:
        guide: Judges them.
        finish: What an accepted view becomes before it is written, such as a labelled one.
    """

    guide: Guide
    finish: Callable[[Capture], Capture] = _as_it_is


@dataclass(frozen=True, slots=True)
class Texts:
    """Files that travel in the recording.

    Attributes:
        classes: `classes.toml`, or None.
        plate: `plate.toml`, or None.
        board: `board.toml`, or None.
    """

    classes: str | None = None
    plate: str | None = None
    board: str | None = None


def record(
    config: Config,
    what: str,
    wanted: Sequence[Wanted],
    texts: Texts,
    page: bool,
    idle_s: float,
) -> Path:
    """Captures what a step needs with the configured devices and returns the finished recording.

    Args:
        config: The devices, and where the recording goes: below the directory of the results.
        what: Of the file's name and for the person, such as "cameras".
        wanted: One after the other; between them the target is changed.
        texts: What travels in the recording besides the rig.
        page: Whether a page shows the views in a browser.
        idle_s: It ends after so long without a view.

    Raises:
        DriverError, CaptureRejectedError: As the devices do; what was accepted is a finished recording.
        SystemExit: If the person (1) or a signal (128 + its number) ended it; nothing is kept then.
        ConfigurationError: If there are no devices, or the configuration has no place for results.
        InputError: If nothing was accepted.
    """
    path = _place(config, what)
    rig_text, _ = wiring.depth_rig_of(config)
    sensors = wiring.build_sensors(config, with_ir=True)
    offset_ns = 0 if config.simulated else unix_offset_ns()
    settings = GuidedSettings(title=what, with_dark=config.capture.dark, idle_s=idle_s)
    with sensors.package as package, ExitStack() as shown, _signals() as stopped:
        typed = sys.stdin if sys.stdin.isatty() else None
        uis: list[ScopedUi] = [shown.enter_context(TerminalUi(console, typed))]
        if page:
            browser = shown.enter_context(PageUi())
            console.print(f"the views: {browser.url}", highlight=False)
            uis.append(browser)
        writer = RecordingWriter(
            path,
            rig_text,
            texts.classes,
            {"robot": config.robot, **device_metadata(package.about())},
            unix_offset_ns=offset_ns,
            plate_text=texts.plate,
            board_text=texts.board,
        )
        views = [(one.guide, one.finish) for one in wanted]
        try:
            guided_all(package, views, writer, settings, Several(uis), sensors.clock, stopped=stopped)
        except CaptureAbortedError as error:
            console.print(f"{error}; nothing was kept, and nothing in use has changed", highlight=False)
            name = stopped()
            sys.exit(1 if name is None else 128 + signal.Signals[name])
    return path


def _place(config: Config, what: str) -> Path:
    if config.calibration is None:
        raise ConfigurationError("[calibration] is missing: there is no place for captures and results")
    folder = config.calibration.directory / CAPTURES
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
    now = datetime.datetime.now(datetime.UTC)
    return folder / f"{what}-{now:%Y%m%dT%H%M%SZ}.mcap"


@contextlib.contextmanager
def _signals() -> Iterator[Callable[[], str | None]]:
    """Yields what says which signal came; it ends the capture where a view is whole, and not in between."""
    came: list[str] = []

    def note(number: int, _: FrameType | None) -> None:
        came.append(signal.Signals(number).name)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: came[0] if came else None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
