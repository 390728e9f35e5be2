"""One life of a device's own process: started, asked, watched and ended, leaving nothing behind."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from drivers.isolation.child_output import ChildOutput
from drivers.isolation.frame_memory import FrameMemory
from drivers.isolation.wire import WireError, encode, receive

_EXIT_S = 1.0  # from SIGKILL until the kernel has taken the process apart
_log = logging.getLogger("surfclass.isolation")


class ChildEndedError(Exception):
    """The process is no more, or was not to be trusted and is killed; the text says how it ended."""


class ChildProcess:
    """A running `drivers.isolation.child`.

    It is started by `exec` (a daemon with threads must not fork and go on), in a session of its own, so
    that Ctrl-C on the daemon's terminal reaches it only through the daemon. It ends with the daemon,
    however that ends: the daemon holds the writing end of a pipe, and the kernel kills the process when
    that closes. (PR_SET_PDEATHSIG would do so when the *thread* ends that started it.)

    Args:
        name: The device's, for the log and the list of processes.
        environment: Variables that it gets beyond the daemon's own.

    Raises:
        OSError: If the system refuses another process.
    """

    def __init__(self, name: str, environment: Mapping[str, str]) -> None:
        self._name = name
        self._asked = 0
        self._asked_since_ns: int | None = None  # when the first question without an answer was asked
        with ExitStack() as held:  # undone from the last to the first
            self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            held.callback(self._channel.close)
            lifeline, ours = os.pipe()
            held.callback(os.close, ours)
            with ExitStack() as given:  # what the process has of its own once it runs
                given.callback(theirs.close)
                given.callback(os.close, lifeline)
                memory = FrameMemory.descriptor("surfclass frames")
                given.callback(os.close, memory)
                self.memory = FrameMemory(memory, writable=False)
                held.callback(self.memory.close)
                self._output = ChildOutput(name)
                held.callback(self._output.close)
                passed = (theirs.fileno(), memory, lifeline)
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "drivers.isolation.child", *map(str, passed), name],
                    stdin=subprocess.DEVNULL,
                    stdout=self._output.writing_end,
                    stderr=self._output.writing_end,
                    pass_fds=passed,
                    start_new_session=True,
                    # A driver does no linear algebra: no pool of threads for it in every process.
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1", **environment},
                )
                held.callback(self._reap)
            self._exited = os.pidfd_open(self._process.pid)
            held.callback(os.close, self._exited)
            self._output.start()
            held.callback(self._reap)  # the first thing to do, and nothing the second time
            self._channel.setblocking(False)
            self._poll = select.poll()
            self._poll.register(self._channel, select.POLLIN)
            self._poll.register(self._exited, select.POLLIN)
            self._held = held.pop_all()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def ask(self, question: Mapping[str, Any], deadline_ns: int) -> dict[str, Any]:
        """Returns the answer to `question`; answers to earlier ones, that came too late, are dropped.

        Args:
            question: A message.
            deadline_ns: On the host's clock.

        Raises:
            TimeoutError: If there is no answer at the deadline.
            ChildEndedError: If it ended, or what it says makes no sense; it is gone then.
            WireError: If the question is no message.
        """
        self._asked += 1
        packet = encode({"id": self._asked, **question})
        if self._asked_since_ns is None:
            self._asked_since_ns = time.monotonic_ns()
        try:
            self._channel.send(packet)
        except BlockingIOError:
            raise TimeoutError from None  # it has not read for so long that the socket is full
        except ConnectionError:
            raise self._ended() from None
        while True:
            left_ms = max(0.0, (deadline_ns - time.monotonic_ns()) / 1e6)
            ready = [descriptor for descriptor, _ in self._poll.poll(left_ms)]
            if not ready:
                raise TimeoutError
            if self._channel.fileno() not in ready:
                raise self._ended()
            try:
                answer = receive(self._channel)
            except WireError as error:
                raise self._ended(f"its process said what is no message ({error})") from None
            if answer is None:
                raise self._ended()
            if answer.get("id") == self._asked:
                self._asked_since_ns = None
                return answer
            self._asked_since_ns = time.monotonic_ns()  # late, but not silent

    def silent_s(self) -> float:
        """Returns for how long it has owed answers, s; 0 where it owes none."""
        return 0.0 if self._asked_since_ns is None else (time.monotonic_ns() - self._asked_since_ns) / 1e9

    def close(self) -> None:
        """Kills the process, if it still lives, and gives back all that it took."""
        self._held.close()

    def wait(self, timeout_s: float) -> bool:
        """Returns whether it ended by itself within the time."""
        exited = select.poll()
        exited.register(self._exited, select.POLLIN)
        return bool(exited.poll(max(0.0, timeout_s * 1e3)))

    def last_words(self) -> str:
        """Returns the end of what it printed, for a message; empty where it printed nothing."""
        words = self._output.last_words()
        return f"; it said last: {words}" if words else ""

    def _ended(self, how: str = "") -> ChildEndedError:
        """Ends what is left of it and returns the error that says how it ended."""
        self.wait(_EXIT_S / 2)  # its socket closes a little before its exit status is there
        self.close()
        return ChildEndedError(how or _how(self._process.returncode))

    def _reap(self) -> None:
        """Kills it with all that it started, and collects it, so that no zombie is left."""
        if self._process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)  # not collected yet: the number is still its own
        try:
            self._process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            # Stuck inside the kernel, where no signal reaches it; Popen collects it when that is over.
            _log.error("%s: process %d does not end though it was killed", self._name, self._process.pid)


def _how(status: int | None) -> str:
    if status is None:
        return "its process does not end though it was killed"
    if status >= 0:
        return f"its process ended with status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    return f"its process was killed by {name}"
