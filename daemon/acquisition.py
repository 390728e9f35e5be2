"""The thread that owns the devices: opens them, waits for triggers, captures, and recovers from errors."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from daemon.logs import log
from daemon.recovery import Backoff, Remedy, remedy
from daemon.requests import Request, RequestQueue
from drivers.capture_source import CaptureRequest, CaptureSource
from drivers.errors import CaptureRejectedError, DriverError
from surfclass.errors import InputError
from surfclass.frames import Capture

_log = logging.getLogger("surfclass.acquisition")

# A jumping clock returns at once where ours waits. An arm on its way is followed as fast as that goes;
# after so many polls without a capture there is nothing to follow, and they take their real time.
_FAST_POLLS = 200
_REPEAT_S = 10.0  # the same reason for rejections is logged again after this
_REPEAT_ERROR_S = 60.0  # and the same device error
POLL_S = 0.1  # the longest wait inside the source, and so the longest a request or a stop waits for it


class Phase(Enum):
    """What the acquisition is doing."""

    OPENING = "opening the devices"
    WAITING = "waiting for a device"
    RUNNING = "running"
    FAILED = "failed"
    FINISHED = "finished"


@dataclass(frozen=True, eq=False)
class Shot:
    """A capture that was accepted, how long it took, and the request that it answers, if any."""

    capture: Capture
    capture_ms: float
    request: Request | None


class Acquisition:
    """Captures from one source, put into a bounded queue; a full queue makes capturing wait.

    Nothing that was accepted is dropped: on a stop, the capture under way is finished and queued.

    Args:
        source: The sensors or a recording; used from this object's thread only.
        requests: Captures asked for.
        shots: Where captures go.
        dark: Whether to take an unlit frame where the request does not say.
        finite: Whether the source is a recording, which cannot be opened again after a fault.
        jump: Lets a jumping clock pass while a lost device is waited for; None: the clock is ours.
        backoff: The waits between attempts to open.
    """

    def __init__(
        self,
        source: CaptureSource,
        requests: RequestQueue,
        shots: queue.Queue[Shot],
        *,
        dark: bool = False,
        finite: bool = False,
        jump: Callable[[float], None] | None = None,
        backoff: Backoff | None = None,
    ) -> None:
        self._source, self._requests, self._shots = source, requests, shots
        self.dark = dark
        self._finite, self._jump = finite, jump
        self._backoff = backoff or Backoff()
        self._stop = threading.Event()
        self._retry = threading.Event()
        self._thread = threading.Thread(target=self._run, name="acquisition", daemon=True)
        self._beat_s = time.monotonic()
        self._names: set[str] = set()
        self._rejection, self._rejection_told_s = "", 0.0
        self._device_error, self._device_error_told_s = "", 0.0
        self._numbered = 0
        self._successor: Callable[[int], CaptureSource] | None = None
        self.settled = threading.Event()
        self.phase = Phase.OPENING
        self.detail = ""
        self.error: Exception | None = None
        self.counts = {"accepted": 0, "rejected": 0, "device_errors": 0, "reopened": 0}

    def start(self) -> None:
        """Begins; `settled` is set as soon as the first attempt to open is over."""
        self._thread.start()

    def stop(self) -> None:
        """Asks for the end; the capture under way is finished."""
        self._stop.set()

    def reload(self) -> None:
        """Clears a fault: the devices are opened again."""
        self._retry.set()

    def replace(self, make: Callable[[int], CaptureSource], dark: bool) -> None:
        """Goes on with another source of the same devices, after the capture under way.

        Args:
            make: Returns the source; its argument is the number of the next capture without a name.
            dark: As for the first one.
        """
        self.dark = dark
        self._successor = make
        self._retry.set()

    @property
    def alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    @property
    def silent_s(self) -> float:
        """For how long the thread has given no sign of life, s."""
        return time.monotonic() - self._beat_s

    def _run(self) -> None:
        try:
            while not self._stop.is_set() and self.phase is not Phase.FINISHED:
                try:
                    self._open_and_work()
                    self._source.close()
                except (DriverError, InputError) as error:
                    self._release(error)
                    if not self._recover(error):
                        return
        except Exception as error:  # noqa: BLE001 - handed to the service's loop, which ends with it
            self.error = error
        finally:
            self._source.close()
            self.settled.set()

    def _open_and_work(self) -> None:
        self._beat()
        if self._successor is not None:
            make, self._successor = self._successor, None
            self._source = make(self._numbered + 1)
        self._source.open()
        if self._backoff.attempts:
            self.counts["reopened"] += 1
            self._device_error = ""
        self._backoff.reset()
        self.phase, self.detail = Phase.RUNNING, ""
        log(_log, logging.INFO, "source open", source=self._source.name)
        self.settled.set()
        fruitless = 0
        while not self._stop.is_set() and self._successor is None:
            self._beat()
            start = time.monotonic()
            shot = self._next()
            fruitless += 1
            if shot is not None:
                fruitless = 0
                self._deliver(shot)
            elif self._source.finished:
                self.phase = Phase.FINISHED
                self._requests.close(f"{self._source.name} is at its end")
                return
            elif fruitless > _FAST_POLLS:
                self._stop.wait(max(0.0, POLL_S - (time.monotonic() - start)))

    def _next(self) -> Shot | None:
        """Takes a capture if one is due; a source that is silent is asked once more."""
        request = self._requests.head()
        wanted = None
        if request is not None:
            name, dark = request.command.name, request.command.dark
            if name in self._names:
                self._requests.take(request)
                request.refuse(f"there is a capture {name} already")
                return None
            wanted = CaptureRequest(name=name, with_dark=self.dark if dark is None else dark)
        start = time.monotonic()
        try:
            capture = self._twice(wanted)
        except CaptureRejectedError as error:
            self._reject(request, error)
            return None
        if request is not None and (capture is not None or self._source.finished):
            self._requests.take(request)
        if capture is None:
            return None
        self._names.add(capture.name)
        self._numbered += request is None or request.command.name is None
        self.counts["accepted"] += 1
        return Shot(capture, (time.monotonic() - start) * 1e3, request)

    def _twice(self, wanted: CaptureRequest | None) -> Capture | None:
        """Asks the source; where a device is silent, once more."""
        try:
            return self._source.next(POLL_S, wanted)
        except DriverError as error:
            if remedy(error) is not Remedy.RETRY:
                raise
            self._note(error, "trying once more")
            self._beat()
            if wanted is None and error.device != "arm":
                # Only the arm is asked while nothing is due: a capture was under way, whose tick is past.
                wanted = CaptureRequest(with_dark=self.dark)
        return self._source.next(POLL_S, wanted)

    def _reject(self, request: Request | None, error: CaptureRejectedError) -> None:
        self.counts["rejected"] += 1
        if request is not None:
            self._requests.take(request)
            request.refuse(f"capture rejected: {error}")
        now_s = time.monotonic()
        if error.reason != self._rejection or now_s >= self._rejection_told_s + _REPEAT_S:
            self._rejection, self._rejection_told_s = error.reason, now_s
            total = self.counts["rejected"]
            log(_log, logging.WARNING, "capture rejected", reason=error.reason, error=error, total=total)
        if request is None:
            self._stop.wait(POLL_S)  # a source that rejects at once must not keep the processor busy

    def _deliver(self, shot: Shot) -> None:
        while True:
            self._beat()
            try:
                self._shots.put(shot, timeout=POLL_S)
            except queue.Full:
                continue
            return

    def _release(self, error: DriverError | InputError) -> None:
        """Closes what has to be opened anew: one lost device, or everything where waiting is no remedy."""
        if isinstance(error, DriverError) and remedy(error) in (Remedy.REOPEN, Remedy.RETRY):
            self._source.release(error.device)
        else:
            self._source.close()

    def _recover(self, error: DriverError | InputError) -> bool:
        """Waits as the policy says and returns whether to open again; a wrong installation is raised."""
        action = remedy(error) if isinstance(error, DriverError) else Remedy.STOP
        self._retry.clear()
        if action is Remedy.EXIT:
            raise error
        if action is Remedy.STOP:
            return self._fail(str(error))
        wait_s = self._backoff.next_s()
        self.phase, self.detail = Phase.WAITING, str(error)
        self._note(error, f"opening again in {wait_s:g} s")
        self.settled.set()
        self._pause(wait_s)
        return True

    def _fail(self, reason: str) -> bool:
        self.phase, self.detail = Phase.FAILED, reason
        self.counts["device_errors"] += 1
        log(_log, logging.ERROR, "fault: nothing is captured until the service is reloaded", reason=reason)
        self._requests.close(f"failed: {reason}")
        self.settled.set()
        if self._finite:
            return False
        while not self._stop.is_set() and not self._retry.is_set():
            self._pause(POLL_S)
        self._requests.reopen()
        self.phase, self.detail = Phase.OPENING, ""
        return True

    def _pause(self, seconds: float) -> None:
        """Waits; a stop or a reload ends it."""
        left = seconds
        while left > 0 and not self._retry.is_set():
            self._beat()
            step = min(left, POLL_S)
            if self._jump is not None:
                self._jump(step)
            if self._stop.wait(0.01 if self._jump is not None else step):
                return
            left -= step

    def _note(self, error: Exception, next_step: str) -> None:
        self.counts["device_errors"] += 1
        now_s = time.monotonic()
        if str(error) == self._device_error and now_s < self._device_error_told_s + _REPEAT_ERROR_S:
            return  # a device that is away for days must not fill the journal
        self._device_error, self._device_error_told_s = str(error), now_s
        log(_log, logging.WARNING, "device error", error=error, kind=type(error).__name__, next=next_step)

    def _beat(self) -> None:
        self._beat_s = time.monotonic()
