"""What has been drawn, kept beside the labelled recording: written whole after every change."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from calibration.label.shapes import Shape
from drivers.files import read_file, write_atomically
from surfclass.errors import InputError
from surfclass.schema import Table, validate

SCHEMA: Literal[1] = 1
Role = Literal["keep", "train", "test"]
LIMIT = 10_000
"""Shapes of one view."""


class ViewState(Table):
    """What was drawn on one capture.

    Attributes:
        shapes: Bottom to top.
        role: What the capture is to be for: "keep" leaves it as it is.
        below: Whether the capture's own label image lies under the shapes; else nothing does.
        revision: Counts the changes.
    """

    shapes: Annotated[tuple[Shape, ...], Field(max_length=LIMIT)] = ()
    role: Role = "keep"
    below: bool = True
    revision: Annotated[int, Field(ge=0, strict=True)] = 0


class LabelState(Table):
    """All of it.

    Attributes:
        recording: sha256 of the recording that it was drawn on.
        classes: Their names, in order: what the labels mean.
        views: By capture name; one that is not there has not been touched.
    """

    schema_version: Annotated[Literal[1], Field(alias="schema")] = SCHEMA
    recording: str
    classes: tuple[str, ...]
    views: dict[str, ViewState] = Field(default_factory=dict)

    def with_view(self, name: str, view: ViewState) -> LabelState:
        """Returns the same with one view replaced."""
        return self.model_copy(update={"views": {**self.views, name: view}})


def state_path(out: Path) -> Path:
    """Where the state of the labels that become `out` is kept."""
    return out.with_name(out.name + ".labels.json")


def load_state(path: Path, recording: str, classes: tuple[str, ...]) -> LabelState:
    """Returns what was drawn so far; nothing where there is no file.

    Args:
        path: Of the state.
        recording: sha256 of the recording that is to be labelled.
        classes: The names of its classes; those of the state may be fewer, from the first on.

    Raises:
        InputError: If the file is damaged, or belongs to another recording or to other classes.
    """
    if not path.exists():
        return LabelState(recording=recording, classes=classes)
    try:
        data = json.loads(read_file(path, "labels drawn so far"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a file of labels: {error}; move it away to begin anew") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: not a file of labels; move it away to begin anew")
    state = validate(LabelState, data, str(path))
    if state.recording != recording:
        raise InputError(f"{path}: was drawn on another recording; choose another --out, or move it away")
    if state.classes != classes[: len(state.classes)]:
        raise InputError(
            f"{path}: was drawn with the classes {', '.join(state.classes)}, now they are "
            f"{', '.join(classes)}; classes may be added at the end only"
        )
    return state.model_copy(update={"classes": classes})


def save_state(path: Path, state: LabelState) -> None:
    """Writes the state, whole or not at all.

    Raises:
        InputError, OSError: If it cannot be written.
    """
    write_atomically(path, state.model_dump_json(by_alias=True).encode() + b"\n")
