"""One labelling of one recording: its views in memory, what is drawn on them, and the labelled recording."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.label.propagation import LabelVoxels, SeenPoints, seen_points, suggested_labels
from calibration.label.shapes import Shape, outlines, rasterise
from calibration.label.state import LabelState, ViewState, load_state, save_state, state_path
from calibration.label.views import ROLES, View, view_of
from drivers.files import check_output, read_file
from drivers.recordings import Recording, RecordingWriter
from surfclass.errors import InputError
from surfclass.rig import DepthRig, Rig, SurfaceClasses, parse_classes

_SMOOTH_PX = 1.0  # how far a suggestion's outline may be from its pixels
_LEAST_SHARE = 1e-4  # of the image: regions of a suggestion below it are noise
_LEAST_HOLE = 5e-4  # of the image: holes below it are where depth was not seen


class StaleViewError(InputError):
    """The view was changed by another page since it was loaded."""


class LabelSession:
    """Opens a recording to be labelled; all methods may be called from any thread.

    Args:
        recording_path: The recording; it is not touched.
        out: The labelled recording to be; what is drawn is kept beside it until and after it is written.
        classes_path: A `classes.toml` that takes the place of the recording's; it may add names.
        rig: By which labels are carried between views; the recording's by default, and the labelled
            recording keeps that one.

    Raises:
        InputError, ConfigurationError: If a file cannot be used, or there is nothing to label.
    """

    def __init__(
        self,
        recording_path: Path,
        out: Path,
        classes_path: Path | None = None,
        rig: DepthRig | None = None,
    ) -> None:
        check_output(out)
        if out.resolve() == recording_path.resolve():
            raise InputError(f"{out}: is the recording itself; the labelled one is a file of its own")
        self.out = out
        self.recording = Recording.open(recording_path)
        self.classes_text, self.classes = _classes(self.recording, classes_path)
        rig = rig or self.recording.depth_rig
        views = (view_of(capture, rig) for capture in self.recording.captures(ROLES))
        self.views: tuple[View, ...] = tuple(view for view in views if view is not None)
        if not self.views:
            raise InputError(
                f"{recording_path}: no capture with colour and of role {', '.join(ROLES)} to label"
            )
        self._rig: Rig | None = None if rig.missing else rig.whole()
        self.cannot_propagate = _why_not(rig, self.views)
        self._state_path = state_path(out)
        self._state = load_state(self._state_path, _sha256(recording_path), self.classes.names)
        self._check_state()
        self._lock = threading.RLock()
        self._seen = lru_cache(maxsize=32)(self._see)
        self._said = lru_cache(maxsize=8)(self._say)

    def view(self, index: int) -> View:
        """Returns a view.

        Raises:
            InputError: If there is none of this index.
        """
        if not 0 <= index < len(self.views):
            raise InputError(f"view {index}: there are {len(self.views)}, from 0 on")
        return self.views[index]

    def state_of(self, index: int) -> ViewState:
        """Returns what is drawn on a view.

        Raises:
            InputError: If there is no such view.
        """
        return self._state.views.get(self.view(index).name, ViewState())

    def draw(self, index: int, view: ViewState) -> ViewState:
        """Replaces what is drawn on a view, and returns it once it is on the disk, with its new revision.

        Raises:
            StaleViewError: If `view.revision` is not the current one.
            InputError: If there is no such view or class.
        """
        name = self.view(index).name
        self._check_labels(name, view)
        with self._lock:
            current = self.state_of(index).revision
            if view.revision != current:
                raise StaleViewError(f"view {name} was changed in another window; load the page again")
            kept = view.model_copy(update={"revision": current + 1})
            state = self._state.with_view(name, kept)
            save_state(self._state_path, state)
            self._state = state
        return kept

    def label_of(self, index: int) -> NDArray[np.uint8]:
        """Returns the label image (h, w) of a view as it is drawn."""
        return self._label(self.view(index), self.state_of(index))

    def suggest(self, index: int, sources: Sequence[int]) -> tuple[Shape, ...]:
        """Returns what the labels of other views say about this one, as shapes; nothing is kept of it.

        Args:
            index: The view.
            sources: The other views; those without labels say nothing.

        Raises:
            InputError: If there is no such view, one of them is the view itself, or labels cannot be
                carried between views: the message says what is missing.
        """
        if self._rig is None or self.cannot_propagate:
            raise InputError(f"labels cannot be carried to other views: {self.cannot_propagate}")
        if index in sources:
            raise InputError(f"view {self.view(index).name} cannot say anything about itself")
        view = self.view(index)
        target = self._seen(index)
        said = [self._said(source, self.state_of(source)) for source in sorted(set(sources))]
        label = suggested_labels(target, said, view.below.shape)
        if not label.any():
            return ()
        if self.state_of(index).below:  # what was recorded stays: a suggestion is put on top of it
            label = np.where(view.below > 0, view.below, label)
        least = (round(share * label.size) for share in (_LEAST_SHARE, _LEAST_HOLE))
        return outlines(label, _SMOOTH_PX, *least)

    def finish(self) -> int:
        """Writes the labelled recording, whole or not at all, and returns how many captures have labels.

        It has every capture of the recording, in order, with rig, classes, plate and board; map updates,
        which the labels are to judge, stay behind. What is drawn stays on the disk too.

        Raises:
            InputError: If a view is to be for training or testing and has no labels.
            OSError: If the disk refuses.
        """
        with self._lock:
            state = self._state
            labels = {
                view.name: self._label(view, state.views.get(view.name, ViewState())) for view in self.views
            }
            bare = [
                name for name, view in state.views.items() if view.role != "keep" and not labels[name].any()
            ]
            if bare:
                raise InputError(f"to train or to test, but without labels: {', '.join(bare)}")
            self._write(state, labels)
        return sum(bool(label.any()) for label in labels.values())

    def _write(self, state: LabelState, labels: dict[str, NDArray[np.uint8]]) -> None:
        part = self.out.with_name(f".{self.out.name}.part")
        part.with_name(part.name + ".active").unlink(
            missing_ok=True
        )  # what a kill left; the drawing is whole
        recording = self.recording
        writer = RecordingWriter(
            part,
            recording.rig_text,
            self.classes_text,
            recording.metadata,
            plate_text=recording.plate_text,
            board_text=recording.board_text,
            unix_offset_ns=recording.unix_offset_ns,
        )
        try:
            for capture in recording.captures():
                label = labels.get(capture.name)
                if label is not None:
                    role = state.views.get(capture.name, ViewState()).role
                    capture = replace(
                        capture,
                        label=label if label.any() or capture.label is not None else None,
                        role=capture.role if role == "keep" else role,
                    )
                writer.write(capture)
        except BaseException:
            writer.discard()
            raise
        writer.close()
        part.replace(self.out)

    def _label(self, view: View, state: ViewState) -> NDArray[np.uint8]:
        return rasterise(state.shapes, view.below if state.below else np.zeros_like(view.below))

    def _see(self, index: int) -> SeenPoints:
        view = self.view(index)
        if view.base_T_depth is None or self._rig is None:
            raise InputError(f"view {view.name} has no pose: nothing can be carried to it or from it")
        return seen_points(view.depth, view.base_T_depth, self._rig)

    def _say(self, index: int, state: ViewState) -> LabelVoxels:
        assert self._rig is not None  # suggest() has seen it
        return LabelVoxels(self._seen(index), self._label(self.view(index), state), self._rig.voxel_size_m)

    def _check_state(self) -> None:
        known = {view.name for view in self.views}
        for name, view in self._state.views.items():
            if name not in known:
                raise InputError(f"{self._state_path}: view {name!r} is not in the recording")
            self._check_labels(name, view)

    def _check_labels(self, name: str, view: ViewState) -> None:
        highest = max((shape.label for shape in view.shapes), default=0)
        if highest > len(self.classes.names):
            raise InputError(f"view {name}: label {highest}, allowed are 0 to {len(self.classes.names)}")


def _why_not(rig: DepthRig, views: Sequence[View]) -> str:
    """What stands in the way of carrying labels between views; empty if nothing."""
    if rig.missing:
        return f"the rig lacks {' and '.join(rig.missing)}"
    if all(view.base_T_depth is None for view in views):
        return "the captures have neither poses, nor joint angles and a hand-eye transform in the rig"
    return ""


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _classes(recording: Recording, path: Path | None) -> tuple[str, SurfaceClasses]:
    if path is None:
        if recording.classes is None or recording.classes_text is None:
            raise InputError(f"{recording.path}: has no classes.toml; give one with --classes")
        return recording.classes_text, recording.classes
    text = read_file(path, "classes").decode("utf-8", "replace")
    classes = parse_classes(text, str(path))
    old = () if recording.classes is None else recording.classes.names
    if classes.names[: len(old)] != old:
        raise InputError(
            f"{path}: the recording's labels mean {', '.join(old)}; other names may only follow these"
        )
    return text, classes
