"""What the labelling page asks, and the answers: every request is checked before anything is done."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from importlib.resources import files
from typing import Annotated, Any

from pydantic import Field

from calibration.label.session import LabelSession, StaleViewError
from calibration.label.state import ViewState
from calibration.label.views import overlay_png
from calibration.web import Handler, RefusedRequestError, Reply, Request, json_reply
from surfclass.errors import InputError
from surfclass.schema import Table, validate

_INDEX = re.compile(r"\d{1,6}", re.ASCII)
Index = Annotated[int, Field(ge=0, le=999_999, strict=True)]


class SuggestionRequest(Table):
    """Asks what the labels of other views say about a view.

    Attributes:
        view: Its index.
        sources: The others' indices.
    """

    view: Index
    sources: Annotated[tuple[Index, ...], Field(min_length=1, max_length=10_000)]


def page() -> str:
    """Returns the HTML of the labelling page."""
    return files("calibration.label").joinpath("page.html").read_text(encoding="utf-8")


def routes(session: LabelSession, finished: Callable[[int], None]) -> Mapping[tuple[str, str], Handler]:
    """Returns the page's requests and who answers them.

    Args:
        session: What is labelled.
        finished: Is called with the number of labelled captures when the labelled recording is written.
    """

    def colour(request: Request) -> Reply:
        return Reply(session.view(_index(request)).jpeg, "image/jpeg")

    def thumbnail(request: Request) -> Reply:
        return Reply(session.view(_index(request)).thumbnail, "image/jpeg")

    def below(request: Request) -> Reply:
        return Reply(overlay_png(session.view(_index(request)).below, session.classes), "image/png")

    def draw(request: Request) -> Reply:
        index, drawn = _index(request), validate(ViewState, _object(request), "drawing")
        try:
            with _disk():
                kept = session.draw(index, drawn)
        except StaleViewError as error:
            raise RefusedRequestError(HTTPStatus.CONFLICT, str(error)) from None
        return json_reply({"revision": kept.revision})

    def suggest(request: Request) -> Reply:
        asked = validate(SuggestionRequest, _object(request), "suggestion")
        shapes = session.suggest(asked.view, asked.sources)
        return json_reply({"shapes": [shape.model_dump(mode="json") for shape in shapes]})

    def finish(request: Request) -> Reply:
        with _disk():
            count = session.finish()
        finished(count)
        return json_reply({"out": str(session.out), "labelled": count})

    return {
        ("GET", "/session"): lambda request: json_reply(_described(session)),
        ("GET", "/colour"): colour,
        ("GET", "/thumbnail"): thumbnail,
        ("GET", "/below"): below,
        ("POST", "/draw"): draw,
        ("POST", "/suggest"): suggest,
        ("POST", "/finish"): finish,
    }


def _described(session: LabelSession) -> dict[str, Any]:
    classes = zip(session.classes.names, session.classes.colours, strict=True)
    views = [
        {
            "name": view.name,
            "recorded_role": view.role,
            "has_below": bool(view.below.any()),
            "has_pose": view.base_T_depth is not None,
            **session.state_of(index).model_dump(mode="json"),
        }
        for index, view in enumerate(session.views)
    ]
    return {
        "recording": session.recording.path.name,
        "out": session.out.name,
        "classes": [{"name": name, "colour": colour} for name, colour in classes],
        "cannot_propagate": session.cannot_propagate,
        "views": views,
    }


@contextmanager
def _disk() -> Iterator[None]:
    """Tells the person at the page what the disk refused."""
    try:
        yield
    except OSError as error:
        raise RefusedRequestError(HTTPStatus.INSUFFICIENT_STORAGE, f"not written: {error}") from None


def _index(request: Request) -> int:
    text = request.query.get("view", "")
    if not _INDEX.fullmatch(text):
        raise InputError(f"view {text!r:.40}: needed is its number")
    return int(text)


def _object(request: Request) -> dict[str, Any]:
    data = request.json()
    if not isinstance(data, dict):
        raise InputError("the body must be a JSON object")
    return data
