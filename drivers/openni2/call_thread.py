"""The one thread of this process that calls libOpenNI2, until the process ends.

The library keeps its last error for each thread that ever called it. When a new thread comes it asks the
system which of the others still live, by handles that are void once a thread has ended, and crashes now
and then. So no thread that calls it may ever end, and it is simplest if there is one. It also bounds every
call: one that does not come back leaves that thread hanging, and nobody else.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any


class HungError(Exception):
    """A call has not come back in time, this one or an earlier one."""


class _Job:
    def __init__(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._function, self._arguments = function, arguments
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.result = self._function(*self._arguments)
        except BaseException as error:  # noqa: BLE001 - raised where the call was made
            self.error = error
        self.done.set()


class CallThread:
    """Runs functions one after another, each for a caller who waits for it.

    Attributes:
        hangs: Whether one has not come back in time.
    """

    def __init__(self) -> None:
        self._jobs = queue.SimpleQueue[_Job]()
        self.hangs = False
        threading.Thread(target=self._run, name="OpenNI2", daemon=True).start()

    def call(self, function: Callable[..., Any], *arguments: Any, timeout_s: float) -> Any:
        """Returns what the function returned, or raises what it raised.

        Raises:
            HungError: If it has not come back in time; after that, for every call at once.
        """
        if self.hangs:
            raise HungError
        job = _Job(function, arguments)
        self._jobs.put(job)
        if not job.done.wait(timeout_s):
            self.hangs = True
            raise HungError
        if job.error is not None:
            raise job.error
        return job.result

    def _run(self) -> None:
        while True:
            self._jobs.get().run()
