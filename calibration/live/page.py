"""The guided capture on a page in the browser: the last picture, what to do next, and what is covered."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from http import HTTPStatus
from importlib.resources import files
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.live.ui import Command, Situation
from calibration.web import RefusedRequestError, Reply, Request, WebServer, json_reply
from surfclass.errors import InputError
from surfclass.schema import Table, validate

_POLL_S = 10.0  # what a request for news waits for some
_WIDTH_PX = 1280
_QUALITY = 85
_WAITING = 16  # commands that nobody has asked for yet
_SEEN_LIMIT = 1 << 53


class CommandRequest(Table):
    """What a button of the page says."""

    command: Command


class PageUi:
    """Serves the page while it is entered.

    Args:
        host: The address to listen at; the loopback interface, unless it is for another computer.
        port: The TCP port; 0 takes any that is free.

    Raises:
        InputError: If the address cannot be listened at.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self._changed = threading.Condition()
        self._version = self._picture_version = 0
        self._told: dict[str, Any] = {}
        self._picture: NDArray[np.uint8] | None = None
        self._jpeg = b""
        self._commands: list[Command] = []
        self._ended = False
        page = files("calibration.live").joinpath("page.html").read_text(encoding="utf-8")
        routes = {
            ("GET", "/state"): self._state,
            ("GET", "/picture.jpg"): self._last_picture,
            ("POST", "/command"): self._say,
        }
        self._server = WebServer(page, routes, host=host, port=port, body_limit=1024)

    @property
    def url(self) -> str:
        """What to open in the browser."""
        return self._server.url

    def __enter__(self) -> Self:
        self._server.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._ended = True
            self._version += 1
            self._changed.notify_all()
        self._server.close()

    def show(self, situation: Situation) -> None:
        """Tells the page."""
        told = {
            "title": situation.title,
            "doing": situation.doing,
            "next_step": situation.next_step,
            "taken": situation.taken,
            "needed": situation.needed,
            "judged": [
                {"number": one.number, "name": one.name, "verdict": one.verdict, "reasons": one.reasons}
                for one in situation.judged
            ],
            "coverage": {name: _plain(value) for name, value in situation.coverage.items()},
            "notice": situation.notice,
        }
        fresh = situation.picture is not None and situation.picture is not self._picture
        jpeg = _jpeg(situation.picture) if situation.picture is not None and fresh else b""
        with self._changed:
            self._told = told
            self._version += 1
            if fresh:
                self._picture, self._jpeg = situation.picture, jpeg
                self._picture_version = self._version
            self._changed.notify_all()

    def command(self) -> Command | None:
        """Returns what was pressed first of what was not asked for yet, or None."""
        with self._changed:
            return self._commands.pop(0) if self._commands else None

    def _state(self, request: Request) -> Reply:
        """Answers as soon as there is news since the version that the page has, or after a while."""
        text = request.query.get("seen", "0")
        if not (text.isascii() and text.isdigit() and int(text[:20]) < _SEEN_LIMIT):
            raise InputError(f"seen={text:.20}, allowed is a version")
        with self._changed:
            self._changed.wait_for(lambda: self._version != int(text) or self._ended, _POLL_S)
            told = {"version": self._version, "picture": self._picture_version, "closed": self._ended}
            return json_reply({**self._told, **told})

    def _last_picture(self, request: Request) -> Reply:
        with self._changed:
            if not self._jpeg:
                raise RefusedRequestError(HTTPStatus.NOT_FOUND, "there is no picture yet")
            return Reply(self._jpeg, "image/jpeg")

    def _say(self, request: Request) -> Reply:
        body = request.json()
        if not isinstance(body, dict):
            raise InputError('the body must be like {"command": "capture"}')
        said = validate(CommandRequest, body, "command").command
        with self._changed:
            if len(self._commands) >= _WAITING:
                raise RefusedRequestError(HTTPStatus.TOO_MANY_REQUESTS, "the last ones are not done yet")
            self._commands.append(said)
        return json_reply({})


def _plain(value: Any) -> float | list[list[float]]:
    """Returns a share or a grid of counts as JSON can hold it; what is no number is 0."""
    if isinstance(value, int | float | np.number):
        return float(np.nan_to_num(value))
    rows: Sequence[Any] = np.nan_to_num(np.atleast_2d(np.asarray(value, np.float64))).tolist()
    return [[float(cell) for cell in row] for row in rows]


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    shrink = _WIDTH_PX / picture.shape[1]
    if shrink < 1:
        size = (_WIDTH_PX, max(1, round(picture.shape[0] * shrink)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()
