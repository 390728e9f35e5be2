"""Captures that somebody asked for: a bounded queue whose entries are each answered exactly once."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import Field, Strict

from surfclass.schema import Table, validate

Answer = dict[str, Any]


class CommandError(Exception):
    """A command that was understood and cannot be carried out; the text is for the one who asked."""


class CaptureCommand(Table):
    """The parameters of `cmd/capture`.

    Attributes:
        name: What to call the capture, beginning with a letter; None: the next number.
        dark: Whether to take an unlit frame too; None: as configured.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.-]{0,63}$")] | None = None
    dark: Annotated[bool, Strict()] | None = None


@dataclass(eq=False)
class Request:
    """One command that waits for its capture; `answer` carries the reply or the CommandError."""

    command: CaptureCommand
    deadline_s: float
    answer: Future[Answer] = field(default_factory=Future)

    def reply(self, answer: Answer) -> None:
        """Answers, unless it was answered before (such as by the deadline)."""
        if not self.answer.done():
            self.answer.set_result(answer)

    def refuse(self, reason: str) -> None:
        """Answers with an error, unless it was answered before."""
        if not self.answer.done():
            self.answer.set_exception(CommandError(reason))


class RequestQueue:
    """Requests in order; a full queue refuses, a closed one gives its reason.

    Args:
        limit: How many may wait.
        patience_s: After this a request is answered with an error.
        monotonic_s: The host's clock.
    """

    def __init__(
        self, limit: int, patience_s: float, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._limit, self._patience, self._now = limit, patience_s, monotonic_s
        self._waiting: deque[Request] = deque()
        self._lock = threading.Lock()
        self._closed = ""
        self.refused = 0

    def offer(self, parameters: Mapping[str, Any]) -> Request:
        """Queues a capture and returns the request, whose `answer` the caller waits for.

        Raises:
            InputError: If the parameters are not `CaptureCommand`'s.
            CommandError: If too many wait, or captures cannot be had.
        """
        command = validate(CaptureCommand, parameters, "cmd/capture")
        with self._lock:
            if self._closed or len(self._waiting) >= self._limit:
                self.refused += 1
                raise CommandError(self._closed or f"busy: {self._limit} requests are waiting already")
            request = Request(command, self._now() + self._patience)
            self._waiting.append(request)
        return request

    def head(self) -> Request | None:
        """Returns the oldest unanswered request and leaves it waiting, so that a lost device keeps it."""
        with self._lock:
            while self._waiting and self._waiting[0].answer.done():
                self._waiting.popleft()
            return self._waiting[0] if self._waiting else None

    def take(self, request: Request) -> None:
        """Removes a request that was captured; from here the one who maps it answers."""
        with self._lock:
            if request in self._waiting:
                self._waiting.remove(request)

    def expire(self, why: str) -> None:
        """Answers every request whose time is over with an error that ends in `why`."""
        with self._lock:
            late = [request for request in self._waiting if request.deadline_s <= self._now()]
            self._waiting = deque(request for request in self._waiting if request not in late)
            self.refused += len(late)
        for request in late:
            request.refuse(f"no capture within {self._patience:g} s: {why}")

    def close(self, reason: str) -> None:
        """Refuses what waits and what comes, with `reason`."""
        with self._lock:
            self._closed = reason
            waiting, self._waiting = list(self._waiting), deque()
            self.refused += len(waiting)
        for request in waiting:
            request.refuse(reason)

    def reopen(self) -> None:
        """Takes requests again."""
        with self._lock:
            self._closed = ""

    def __len__(self) -> int:
        return len(self._waiting)


def wait_for(request: Request, timeout_s: float) -> Answer:
    """Blocks until `request` is answered; for threads that serve somebody outside.

    Raises:
        CommandError: As it was refused, or that nothing came within `timeout_s`.
    """
    try:
        return request.answer.result(timeout_s)
    except TimeoutError:
        raise CommandError(f"no answer within {timeout_s:g} s") from None
