"""The work on one capture: it is recorded, mapped and published, in that order, and its asker answered."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from daemon.acquisition import Shot
from daemon.logs import log
from daemon.requests import Answer
from daemon.sink import RecordingSink
from daemon.status import LastError, StageTimes
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.types import MapUpdate
from surfclass.voxel_map import VoxelMap

if TYPE_CHECKING:
    from surfclass.pipeline import FrameResult

_log = logging.getLogger("surfclass.mapping")


class Process(Protocol):
    """What the service needs of `surfclass.pipeline.Pipeline`."""

    map: VoxelMap

    def process(self, capture: Capture) -> FrameResult:
        """Adds one capture to the map."""


class Publisher(Protocol):
    """What the service needs of `daemon.publisher.MapPublisher`."""

    def publish(self, update: MapUpdate) -> None:
        """Sends a delta; never blocks on a slow console."""

    def publish_status(self, status: Mapping[str, Any]) -> None:
        """Sends the status."""

    def close(self) -> None:
        """Says goodbye."""


class Mapper:
    """Takes captures one by one; used from the service's thread only.

    A capture is on its way to disk before it is published. One that cannot be recorded is held, and
    nothing may be taken after it until `unblock` has let it be tried again.

    Args:
        pipeline: Turns captures into map updates.
        publisher: Sends those out.
        sink: Keeps captures; None: recording is off.
        encode: Encodes a map update for the recording; None: updates are not recorded.

    Attributes:
        blocked: Why nothing can be recorded; empty where it can, or where recording is off.
        unmapped: Why the last capture could not be mapped; empty where it could.
        held: The capture that could not be recorded, while `blocked`.
        counts: recorded, mapped, unmapped, lost.
    """

    def __init__(
        self,
        pipeline: Process,
        publisher: Publisher,
        sink: RecordingSink | None = None,
        encode: Callable[[MapUpdate], bytes] | None = None,
    ) -> None:
        self._pipeline, self._publisher = pipeline, publisher
        self._sink, self._encode = sink, encode
        self.blocked = ""
        self.unmapped = ""
        self.held: Shot | None = None
        self.counts: Counter[str] = Counter(recorded=0, mapped=0, unmapped=0, lost=0)
        self.times = StageTimes()
        self.last_error = LastError()

    def take(self, shot: Shot) -> None:
        """Records, maps and publishes one capture, and answers who asked for it."""
        name, request = shot.capture.name, shot.request
        stage_ms = {"capture": shot.capture_ms}
        try:
            with _timed(stage_ms, "record"):
                self._record(shot.capture)
        except OSError as error:
            self._hold(shot, error)
            return
        except InputError as error:
            self._refuse(shot, error)
            return
        try:
            with _timed(stage_ms, "process"):
                result = self._pipeline.process(shot.capture)
        except InputError as error:
            self._refuse(shot, error)
            return
        except Exception:
            if request is not None:
                request.refuse(f"capture {name} broke the pipeline; the service ends")
            raise
        self.unmapped = ""
        with _timed(stage_ms, "publish"):
            self._publisher.publish(result.update)
        self.counts["mapped"] += 1
        self._keep_update(result.update)
        self.times.add(stage_ms | result.stage_ms)
        world = self._pipeline.map
        answer: Answer = {
            "name": name,
            "epoch": result.update.epoch,
            "sequence": result.update.sequence,
            "voxels": len(world),
            "touched": len(result.update.index),
            "recorded": self._sink is not None,
            "stage_ms": {stage: round(value, 3) for stage, value in (stage_ms | result.stage_ms).items()},
        }
        if request is not None:
            request.reply(answer)
        told = {key: answer[key] for key in ("name", "sequence", "touched", "voxels")}
        log(_log, logging.INFO, "capture mapped", **told, ms=stage_ms["process"])

    def keep(self, shot: Shot) -> None:
        """Records a capture for which there is no time any more to map it; a loss is counted and logged."""
        try:
            self._record(shot.capture)
        except (OSError, InputError) as error:
            self.counts["lost"] += 1
            log(_log, logging.CRITICAL, "capture lost", name=shot.capture.name, error=error)
        if shot.request is not None:
            shot.request.refuse("the service is stopping; the capture was not mapped")

    def unblock(self) -> Shot | None:
        """Returns what was held, if anything, to be taken again."""
        self.blocked = ""
        shot, self.held = self.held, None
        return shot

    def _record(self, capture: Capture) -> None:
        if self._sink is not None:
            self._sink.write(capture)
            self.counts["recorded"] += 1

    def _refuse(self, shot: Shot, error: InputError) -> None:
        """What does not fit the rig, or lacks a pose or a calibration, will not fit later either."""
        self.counts["unmapped"] += 1
        self.unmapped = f"capture {shot.capture.name} could not be mapped: {error}"
        self.last_error.note(self.unmapped)
        log(_log, logging.ERROR, "capture not mapped", name=shot.capture.name, error=error)
        if shot.request is not None:
            shot.request.refuse(self.unmapped)

    def _hold(self, shot: Shot, error: OSError) -> None:
        self.held = shot
        self.blocked = f"recording: {error}"
        self.last_error.note(self.blocked)
        log(_log, logging.ERROR, "recording failed; captures are held until a reload", error=error)
        if shot.request is not None:
            shot.request.refuse(self.blocked)

    def _keep_update(self, update: MapUpdate) -> None:
        """The capture is on disk and reproduces the update, so a failure here loses nothing."""
        if self._sink is None or self._encode is None:
            return
        try:
            self._sink.write_update(self._encode(update), update.t_ns)
        except OSError as error:
            self.last_error.note(f"recording a map update: {error}")
            log(_log, logging.ERROR, "map update not recorded", sequence=update.sequence, error=error)


@contextmanager
def _timed(stage_ms: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    try:
        yield
    finally:
        stage_ms[stage] = (time.perf_counter() - start) * 1e3
