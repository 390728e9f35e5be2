"""The service: one robot's captures become one published map, until somebody says stop."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from daemon.acquisition import Acquisition, Phase, Shot
from daemon.config import Limits
from daemon.logs import log
from daemon.mapper import Mapper, Process, Publisher
from daemon.notify import Watchdog, notify, reloading
from daemon.requests import Answer, RequestQueue, wait_for
from daemon.signals import SignalNotes
from daemon.sink import RecordingSink
from daemon.status import Health
from drivers.errors import DriverUnavailableError
from drivers.files import write_atomically
from surfclass.errors import InputError
from surfclass.types import MapUpdate
from surfclass.voxel_map import VoxelMap

_log = logging.getLogger("surfclass.service")

EXIT_OK, EXIT_FAILED, EXIT_CONFIGURATION = 0, 1, os.EX_CONFIG
_START_S = 4.0  # READY=1 comes after this at the latest, whatever the hardware does
_TICK_S = 0.1
_STATUS_S = 1.0


class Service:
    """Runs one robot's map in the foreground.

    This thread records, maps and publishes; the acquisition's thread owns the devices. A capture
    that was accepted is on its way to disk before it is published; what cannot be recorded is held,
    and nothing more is captured, until an operator has made room and reloads.

    Args:
        acquisition: Where captures come from; it puts them into `shots`.
        pipeline: Turns them into map updates.
        publisher: Sends those out.
        requests: Captures asked for over the network.
        shots: The bounded queue between acquisition and mapping.
        limits: Times and sizes.
        sink: Keeps captures; None: recording is off.
        encode: Encodes a map update for the recording.
        map_bytes: Encodes the map for its file.
        map_path: Where the map goes at the end; None: nowhere.
        devices: What each device is, for the status; None: captures come from a recording.
        program_done: Whether a simulated arm has finished its programme; None where it is not simulated.
        reload: Reads the configuration again, takes over what can be and says what cannot; raises
            InputError, and has then changed nothing.
        exit_when_done: Whether to stop when the recording is at its end.
    """

    def __init__(
        self,
        *,
        acquisition: Acquisition,
        pipeline: Process,
        publisher: Publisher,
        requests: RequestQueue,
        shots: queue.Queue[Shot],
        limits: Limits,
        robot: str = "robot",
        sink: RecordingSink | None = None,
        encode: Callable[[MapUpdate], bytes] | None = None,
        map_bytes: Callable[[VoxelMap], bytes] | None = None,
        map_path: Path | None = None,
        devices: Callable[[], dict[str, Any]] | None = None,
        program_done: Callable[[], bool] | None = None,
        reload: Callable[[], str] | None = None,
        exit_when_done: bool = False,
    ) -> None:
        self._acquisition, self._pipeline, self._publisher = acquisition, pipeline, publisher
        self._requests, self._shots, self._limits, self._robot = requests, shots, limits, robot
        self._sink = sink
        self._map_bytes, self._map_path = map_bytes, map_path
        self._devices, self._program_done, self._reload = devices, program_done, reload
        self._exit_when_done = exit_when_done
        self._stop = threading.Event()
        self._reload_asked = threading.Event()
        self._mapper = Mapper(pipeline, publisher, sink, encode)
        self._last_error = self._mapper.last_error
        self._notes = SignalNotes()
        self._map_is_kept = False
        self._failed_end = False
        self._watchdog = Watchdog()
        self._status_due_s = 0.0
        self._status_line = ""
        self._started_s = time.monotonic()

    # ---- what other threads call

    def stop(self) -> None:
        """Asks for an orderly end: the capture under way is finished, mapped and kept."""
        self._acquisition.stop()
        self._stop.set()

    def ask_reload(self) -> None:
        """Asks for the configuration to be read again, and for a fault to be retried."""
        self._reload_asked.set()

    def capture(self, parameters: Mapping[str, Any]) -> Answer:
        """Takes a capture, maps it and returns what became of it; blocks, for a command's thread.

        Args:
            parameters: As `daemon.requests.CaptureCommand`: `name`, `dark`, both optional.

        Returns:
            `name`, `epoch`, `sequence`, `voxels` (in the map), `touched` (by this capture),
            `recorded` and `stage_ms`.

        Raises:
            InputError: If the parameters are wrong.
            CommandError: If the capture could not be had; the text says why.
        """
        request = self._requests.offer(parameters)
        return wait_for(request, self._limits.request_s + self._limits.stop_s)

    def status(self) -> dict[str, Any]:
        """Returns what is published once a second; JSON."""
        health, detail = self._health()
        world, acquisition = self._pipeline.map, self._acquisition
        return {
            "schema": 1,
            "robot": self._robot,
            "health": health.value,
            "detail": detail,
            "t_unix_s": round(time.time(), 3),
            "uptime_s": round(time.monotonic() - self._started_s, 1),
            "acquisition": acquisition.phase.value,
            "devices": None if self._devices is None else self._devices(),
            "counts": {**acquisition.counts, "refused": self._requests.refused, **self._mapper.counts},
            "waiting": {
                "captures": self._shots.qsize() + (self._mapper.held is not None),
                "requests": len(self._requests),
            },
            "stage_ms": self._mapper.times.medians(),
            "last_error": self._last_error.told,
            "map": {
                "epoch": world.epoch,
                "sequence": world.sequence,
                "voxels": len(world),
                "voxel_size_m": world.size_m,
            },
            "recording": None if self._sink is None or self._sink.path is None else str(self._sink.path),
            "program_done": None if self._program_done is None else self._program_done(),
            "source_finished": acquisition.phase is Phase.FINISHED,
        }

    # ---- the loop

    def run(self) -> int:
        """Runs until it is stopped and returns the exit code; SIGTERM and SIGINT stop, SIGHUP reloads.

        Raises:
            InputError: If the recording it was to process, with `exit_when_done`, is damaged.
            Exception: A bug, after everything was flushed.
        """
        code = EXIT_OK
        with self._notes:
            try:
                self._start()
                while self._turn():
                    pass
            except DriverUnavailableError as error:
                log(_log, logging.CRITICAL, "not installed", error=error)
                notify(f"STATUS=not installed: {error}")
                code = EXIT_CONFIGURATION
            finally:
                self._finish()
        return code or (EXIT_FAILED if self._failed_end else EXIT_OK)

    def _start(self) -> None:
        self._acquisition.start()
        until = time.monotonic() + _START_S
        while not self._acquisition.settled.wait(_TICK_S) and time.monotonic() < until:
            if self._notes.stop or self._stop.is_set():
                break
        if isinstance(self._acquisition.error, DriverUnavailableError):
            raise self._acquisition.error
        health, detail = self._health()
        notify("READY=1", f"STATUS={_line(health, detail)}")
        log(_log, logging.INFO, "ready", health=health, detail=detail, epoch=self._pipeline.map.epoch)

    def _turn(self) -> bool:
        """Goes round once; False when everything that was accepted is done and a stop was asked."""
        self._tick()
        running = self._acquisition.alive  # before the queue is looked at: what it put in is there
        shot = self._next_shot()
        if shot is not None:
            self._take(shot)
            return True
        if self._acquisition.error is not None and not running:
            raise self._acquisition.error
        if self._acquisition.phase is Phase.FINISHED and not running and not self._mapper.blocked:
            self._conclude()
        if self._exit_when_done and not running:
            if self._acquisition.phase is Phase.FAILED:
                raise InputError(self._acquisition.detail)
            if self._acquisition.phase is Phase.FINISHED:
                self.stop()
        if not self._stop.is_set():
            return True
        return running and not self._mapper.blocked and not self._stalled()

    def _take(self, shot: Shot) -> None:
        self._mapper.take(shot)
        if self._mapper.blocked:
            self._requests.close(f"failed: {self._mapper.blocked}")

    def _next_shot(self) -> Shot | None:
        if self._mapper.blocked:
            time.sleep(_TICK_S)
            return None
        try:
            return self._shots.get(timeout=_TICK_S)
        except queue.Empty:
            return None

    # ---- once a tick

    def _tick(self) -> None:
        if self._notes.stop:
            name, self._notes.stop = self._notes.stop, None
            log(_log, logging.INFO, "stopping", signal=name)
            self.stop()
        if not self._stalled():
            self._watchdog.beat()
        if self._notes.reload or self._reload_asked.is_set():
            self._notes.reload = False
            self._reload_asked.clear()
            self._take_reload()
        health, detail = self._health()
        self._requests.expire(detail or health.value)
        self._say(_line(health, detail))
        if time.monotonic() < self._status_due_s:
            return
        self._status_due_s = time.monotonic() + _STATUS_S
        if health in (Health.FAILED, Health.WAITING):
            self._last_error.note(detail)
        self._publisher.publish_status(self.status())
        if self._sink is not None:
            try:
                self._sink.sync()
            except OSError as error:
                self._last_error.note(f"recording: {error}")

    def _stalled(self) -> bool:
        acquisition = self._acquisition
        return acquisition.alive and acquisition.silent_s > self._limits.heartbeat_s

    def _health(self) -> tuple[Health, str]:
        acquisition = self._acquisition
        if self._stop.is_set():
            return Health.STOPPING, ""
        if self._stalled():
            return Health.FAILED, f"the acquisition has been silent for {acquisition.silent_s:.0f} s"
        if self._mapper.blocked:
            return Health.FAILED, self._mapper.blocked
        if acquisition.phase is Phase.FAILED:
            return Health.FAILED, acquisition.detail
        if acquisition.phase is Phase.WAITING:
            return Health.WAITING, acquisition.detail
        if acquisition.phase is Phase.OPENING:
            return Health.STARTING, acquisition.phase.value
        if self._mapper.unmapped:
            return Health.DEGRADED, self._mapper.unmapped
        return (Health.FINISHED if acquisition.phase is Phase.FINISHED else Health.OK), ""

    def _take_reload(self) -> None:
        reloading()
        try:
            told = "" if self._reload is None else self._reload()
        except InputError as error:
            told = f"the configuration was not taken over: {error}"
            self._last_error.note(told)
            log(_log, logging.ERROR, "reload refused; everything stays as it was", error=error)
        else:
            log(_log, logging.INFO, "reloaded", changes=told or "none")
        if self._mapper.blocked:
            self._requests.reopen()
            held = self._mapper.unblock()
            if held is not None:
                self._take(held)
        self._acquisition.reload()
        self._status_line = told
        notify("READY=1", f"STATUS={told}" if told else "STATUS=reloaded")

    def _say(self, line: str) -> None:
        if line != self._status_line:
            self._status_line = line
            notify(f"STATUS={line}")

    # ---- the end

    def _conclude(self) -> None:
        """The recording is at its end: the map is kept now, and goes on being served."""
        if not self._map_is_kept:
            self._map_is_kept = True
            log(
                _log,
                logging.INFO,
                "all captures processed",
                **self._mapper.counts,
                voxels=len(self._pipeline.map),
            )
            self._save_map()

    def _finish(self) -> None:
        """Flushes everything; each step is taken whatever became of the one before."""
        self._stop.set()
        notify("STOPPING=1", "STATUS=flushing")
        with ExitStack() as steps:
            steps.callback(self._publisher.close)
            steps.callback(lambda: self._publisher.publish_status(self.status()))
            if not self._map_is_kept:
                steps.callback(self._save_map)
            if self._sink is not None:
                steps.callback(self._close_sink, self._sink)
            steps.callback(self._drain)
            self._requests.close("the service is stopping")
            self._acquisition.stop()

    def _drain(self) -> None:
        """Lets the acquisition end and keeps what it still had; after an orderly end that is nothing."""
        until = time.monotonic() + self._limits.stop_s
        while time.monotonic() < until:
            running = self._acquisition.alive
            try:
                shot = self._mapper.unblock() or self._shots.get(timeout=_TICK_S)
            except queue.Empty:
                if not running:
                    self._failed_end |= self._mapper.counts["lost"] > 0
                    return
                continue
            self._mapper.keep(shot)
        self._failed_end = True
        log(_log, logging.ERROR, "the acquisition does not end", silent_s=self._acquisition.silent_s)

    def _close_sink(self, sink: RecordingSink) -> None:
        try:
            sink.close()
        except OSError as error:
            self._failed_end = True
            log(_log, logging.CRITICAL, "recording left unfinished", path=sink.path, error=error)

    def _save_map(self) -> None:
        if self._map_path is None or self._map_bytes is None:
            return
        if not len(self._pipeline.map):
            # A run that saw nothing must not take the last good map away.
            log(_log, logging.WARNING, "map not written: it is empty", path=self._map_path)
            return
        try:
            write_atomically(self._map_path, self._map_bytes(self._pipeline.map))
        except (OSError, InputError) as error:
            self._failed_end = True
            self._last_error.note(f"map file: {error}")
            log(_log, logging.CRITICAL, "map not written", path=self._map_path, error=error)
        else:
            log(_log, logging.INFO, "map written", path=self._map_path, voxels=len(self._pipeline.map))


def _line(health: Health, detail: str) -> str:
    """One line for systemctl status."""
    return f"{health}: {detail}".replace("\n", " | ") if detail else health.value
