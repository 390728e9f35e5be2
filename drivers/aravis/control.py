"""The one thread that talks to an open Aravis camera, so that nobody waits for a camera that is gone."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Generic, TypeVar, cast

from drivers.aravis.library import GenicamError

T = TypeVar("T")

_END_S = 1.0  # what a camera that answers needs to be stopped and released
_log = logging.getLogger("surfclass.aravis")


class _Job(Generic[T]):
    """A call and its outcome."""

    def __init__(self, call: Callable[[], T]) -> None:
        self._call = call
        self._lock = threading.Lock()
        self._given_up = False
        self._done = threading.Event()
        self._result: T | None = None
        self.error: BaseException | None = None

    def run(self) -> None:
        """Makes the call, unless it was given up before it could begin."""
        with self._lock:
            if self._given_up:
                return
        try:
            self._result = self._call()
        except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
            self.error = error
        self._done.set()

    def result(self, until_ns: int) -> T:
        """Returns or raises what the call did; TimeoutError if that has not ended by then."""
        if not self._done.wait(_seconds_to(until_ns)):
            with self._lock:
                self._given_up = True
            raise TimeoutError
        if self.error is not None:
            raise self.error
        return cast(T, self._result)


class ControlThread:
    """Runs calls one after the other, and looks after the camera in between.

    Aravis notices by itself that a GigE camera is gone, but only after about 6 s. Here it is `lost` as
    soon as a call has waited `silence_s` for its answer, or the look after it has failed.

    Args:
        name: Of the device.
        period_s: Between two looks.
        silence_s: A camera that leaves a call unanswered for so long is gone.

    Attributes:
        lost: How the camera was lost; "" while it is there.
    """

    def __init__(self, name: str, period_s: float = 0.25, silence_s: float = 1.0) -> None:
        self.lost = ""
        self._period_s, self._silence_s = period_s, silence_s
        self._jobs: queue.Queue[_Job[Any] | None] = queue.Queue(1)  # its callers wait, one at a time
        self._look: Callable[[], str] | None = None
        self._release: Callable[[bool], None] | None = None
        self._since_ns: int | None = None  # when the call began that has not been answered yet
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name}: Aravis", daemon=True)
        self._thread.start()

    def look_after(self, look: Callable[[], str] | None, release: Callable[[bool], None]) -> None:
        """From now on the camera is looked after.

        Args:
            look: Asks the camera something; returns what is wrong with it, or "". None: not yet.
            release: Called once at the end, with whether the camera is still there.
        """
        self._look, self._release = look, release

    def mark_lost(self, how: str) -> None:
        """Takes note that the camera is gone; may be called from any thread."""
        self.lost = self.lost or how

    def how_lost(self, silence_s: float | None = None) -> str:
        """Returns `lost`, after a look at how long a call has been waiting.

        Args:
            silence_s: The longest that it may have; None: as the camera's own `silence_s`.
        """
        since_ns = self._since_ns
        if self._look is not None and since_ns is not None:
            silent_s = (time.monotonic_ns() - since_ns) / 1e9
            if silent_s > (self._silence_s if silence_s is None else silence_s):
                self.mark_lost(f"it has not answered for {silent_s:.1f} s")
        return self.lost

    def call(self, what: Callable[[], T], until_ns: int) -> T:
        """Returns what `what()` returns, or raises what it raises.

        Raises:
            TimeoutError: If it has not returned by then; it may still be under way.
        """
        job = _Job(what)
        try:
            self._jobs.put(job, timeout=_seconds_to(until_ns))
        except queue.Full:
            raise TimeoutError from None
        return job.result(until_ns)

    def end(self) -> None:
        """Releases the camera; one that does not answer is left to the thread, which ends by itself."""
        self._ending.set()
        with suppress(queue.Full):
            self._jobs.put_nowait(None)  # only to wake it up
        if not self.how_lost():
            self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                job = self._jobs.get(timeout=self._period_s)
            except queue.Empty:
                job = _Job(self._looked)
            if job is not None:
                self._since_ns = time.monotonic_ns()
                job.run()
                self._since_ns = None
            job = None  # it may hold on to the camera
        if self._release is not None:
            self._release(not self.how_lost())
        self._look = self._release = None

    def _looked(self) -> None:
        if self._look is None or self.lost:
            return
        try:
            wrong = self._look()
        except GenicamError as error:
            wrong = f"it no longer answers ({error})"
        except Exception:  # noqa: BLE001 - this thread has no caller that could be told
            _log.exception("looking after the camera failed")
            wrong = "looking after it failed; see the log"
        if wrong:
            self.mark_lost(wrong)


def _seconds_to(until_ns: int) -> float:
    return max(0.0, (until_ns - time.monotonic_ns()) / 1e9)
