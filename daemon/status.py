"""What the service tells about itself once a second: health, counts, stage times, errors, map."""

from __future__ import annotations

import statistics
import time
from collections import deque
from enum import StrEnum
from typing import Any

_KEPT = 64  # the medians are over this many captures


class Health(StrEnum):
    """One word for the operator's lamp."""

    STARTING = "starting"
    OK = "ok"
    WAITING = "waiting"  # for a device; nobody has to do anything but plug it in
    DEGRADED = "degraded"  # captures are taken and kept, but the last one could not be mapped
    FAILED = "failed"  # somebody has to act; the map is still served
    FINISHED = "finished"  # the recording is at its end; the map is still served
    STOPPING = "stopping"


class StageTimes:
    """The median milliseconds of each stage over the last captures."""

    def __init__(self) -> None:
        self._ms: dict[str, deque[float]] = {}

    def add(self, stage_ms: dict[str, float]) -> None:
        """Takes the times of one capture."""
        for stage, value in stage_ms.items():
            self._ms.setdefault(stage, deque(maxlen=_KEPT)).append(value)

    def medians(self) -> dict[str, float]:
        """Returns the medians, ms."""
        return {stage: round(statistics.median(values), 3) for stage, values in self._ms.items()}


class LastError:
    """The last thing that went wrong, and when."""

    def __init__(self) -> None:
        self._told: dict[str, Any] | None = None

    def note(self, message: str) -> None:
        """Remembers `message`, unless it is the last one already."""
        if self._told is None or self._told["message"] != message:
            self._told = {"message": message, "t_unix_s": round(time.time(), 3)}

    @property
    def told(self) -> dict[str, Any] | None:
        """`{"message", "t_unix_s"}`, or None."""
        return self._told
