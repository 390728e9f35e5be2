"""A recording as a source of captures, so that the service runs on it as on live sensors."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from drivers.capture_source import CaptureRequest
from drivers.interfaces import Clock
from drivers.recordings.reader import Recording
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import ROLES, Capture


class RecordingSource:
    """Gives a recording's captures in order, from the first one each time it is opened.

    Captures are given as they were recorded, with their own names, roles and times: they need no
    joints, and nothing is made to look as if it were taken now.

    Args:
        path: The recording.
        clock: What the pace is kept with.
        roles: Captures of other roles are left out.
        pace: "fast": a capture is due whenever one is asked for. "recorded": captures are as far
            apart as their times are, and only a request gets one earlier.
    """

    def __init__(
        self,
        path: str | Path,
        clock: Clock,
        roles: Collection[str] = ROLES,
        pace: Literal["fast", "recorded"] = "fast",
    ) -> None:
        if pace not in ("fast", "recorded"):
            raise ConfigurationError(f"pace {pace!r}, allowed: fast, recorded")
        self.path, self._clock, self._roles, self._pace = Path(path), clock, roles, pace
        self._recording: Recording | None = None
        self._captures: Iterator[Capture] | None = None
        self._waiting: Capture | None = None
        self._lead_ns: int | None = None  # this clock minus the recorded one
        self.finished = False

    @property
    def name(self) -> str:
        """The recording's path."""
        return str(self.path)

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close()."""
        return self._captures is not None

    @property
    def recording(self) -> Recording:
        """The recording, once open() has succeeded.

        Raises:
            InputError: Before.
        """
        if self._recording is None:
            raise InputError(f"{self.path}: not open")
        return self._recording

    def open(self) -> None:
        """Opens the recording and goes to its beginning.

        Raises:
            InputError: As `Recording.open`.
        """
        self._recording = Recording.open(self.path)
        self._captures = self._recording.captures(self._roles)
        self._waiting, self._lead_ns, self.finished = None, None, False

    def close(self) -> None:
        """Lets go of the file; never raises, may be called twice."""
        self._captures = self._waiting = None

    def release(self, device: str) -> None:
        """Closes it: a recording has no devices."""
        self.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def next(self, timeout_s: float, request: CaptureRequest | None = None) -> Capture | None:
        """As `CaptureSource.next`.

        Raises:
            InputError: If the recording is damaged or not open.
        """
        if self._captures is None:
            raise InputError(f"{self.path}: not open")
        if self._waiting is None:
            self._waiting = next(self._captures, None)
        if self._waiting is None:
            self.finished = True
            return None
        now_ns = self._clock.now_ns()
        if self._lead_ns is None:
            self._lead_ns = now_ns - self._waiting.t_ns
        wait_s = (self._waiting.t_ns + self._lead_ns - now_ns) / 1e9
        if request is None and self._pace == "recorded":
            self._clock.sleep(max(0.0, min(wait_s, timeout_s)))
            if wait_s > timeout_s:
                return None
        elif self._pace == "recorded":
            self._lead_ns = now_ns - self._waiting.t_ns  # those that follow keep their distance to this one
        capture, self._waiting = self._waiting, None
        return capture
