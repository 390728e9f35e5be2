"""Texture windows of labelled captures: from where each was seen, what it was taken for, and what it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.outcome import Note, RefusedError
from calibration.source import Source
from surfclass.classifiers import svm
from surfclass.classifiers.naive_bayes import NaiveBayes
from surfclass.frames import Capture
from surfclass.model import Model
from surfclass.rig import Rig
from surfclass.routes import Classifier
from surfclass.sampling import Samples, Sampling
from surfclass.types import Bool, Float64

_ROLES = ("train", "test")
_WINDOWS_PER_CLASS = 1000
_C = 0.1  # what training's cross-validation mostly chooses


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows that were classified by a machine that had not seen their place.

    Attributes:
        distance_m: (n,) viewing distance (Eq. 3.8).
        angle_rad: (n,) viewing angle (Eq. 3.7).
        result: (n,) the class that the classifier gave.
        truth: (n,) the class of the label.
        capture: (n,) number of the capture.
        names: Of the captures, by their number.
    """

    distance_m: Float64
    angle_rad: Float64
    result: NDArray[np.intp]
    truth: NDArray[np.intp]
    capture: NDArray[np.intp]
    names: tuple[str, ...]

    @property
    def right(self) -> Bool:
        """(n,) whether the class is right."""
        return np.asarray(self.result == self.truth)


def windows_of(
    source: Source, model: Model | None, window_px: int, place_px: int, seed: int, note: Note
) -> Windows:
    """Returns the windows of all labelled captures that can be judged fairly.

    With a model, captures that it was trained on are left out. Without one, a machine is trained on the
    captures of role "train"; these are then judged by machines that were trained without their places.

    Args:
        source: Captures of roles "train" and "test".
        model: Whose texture route is judged, or None.
        window_px: Side of a window where there is no model.
        place_px: Side of the square of pixels that is one place.
        seed: Of the drawing and the folds.
        note: Called with a sentence at each step.

    Raises:
        RefusedError: If there is nothing to train on, or nothing that was not trained on.
        InputError, MissingCalibrationError: If the captures cannot be used.
    """
    rig = source.rig.whole()
    if source.classes is None:
        raise RefusedError(f"{source.path}: has no classes.toml, so its labels mean nothing")
    count = len(source.classes.names)
    if model is not None:
        model.check(rig, source.classes)
        trained = frozenset(model.card.get("captures", ()))
        sampling = Sampling((), "thesis", count, 0, model.texture.window_px, place_px, seed)
        found = _gathered(sampling, _labelled(source, _ROLES, trained), rig, note)
        if found is None:
            raise RefusedError(
                f"every labelled capture of {source.path} is one that the model was trained on; texture's "
                "limits need labelled captures of role 'test', from other distances and angles"
            )
        return _judged([(found[0], _results(model.texture.classifier, found[0]))], found[1])
    sampling = Sampling((), "thesis", count, 0, window_px, place_px, seed)
    boards = _gathered(sampling, _labelled(source, ("train",)), rig, note)
    if boards is None:
        raise RefusedError(
            f"{source.path} has no labelled capture of role 'train' to train the texture route from; give a "
            "model (--model), or add training captures"
        )
    drawn = boards[0].drawn(_WINDOWS_PER_CLASS, "even", seed)
    lacking = [name for k, name in enumerate(source.classes.names) if not (drawn.label == k).any()]
    if lacking:
        raise RefusedError(
            f"the training captures show no window of {', '.join(lacking)}; give a model, or label some"
        )
    note("training the texture route, and judging its own captures by place")
    fit = svm.cross_fit(drawn.values, drawn.label, drawn.place, kernel="linear", C=_C, seed=seed)
    own = drawn.at(fit.rows)
    parts = [(own, fit.posterior.argmax(axis=1))]
    names = boards[1]
    others = _gathered(sampling, _labelled(source, ("test",)), rig, note)
    if others is not None:
        moved = Samples(
            others[0].values, others[0].label, others[0].place, others[0].capture + len(names),
            others[0].distance_m, others[0].angle_rad,
        )  # fmt: skip
        parts.append((moved, _results(fit.machine, moved)))
        names = (*names, *others[1])
    return _judged(parts, names)


def _labelled(
    source: Source, roles: tuple[str, ...], without: frozenset[str] = frozenset()
) -> Iterator[Capture]:
    for capture in source.captures(roles):
        if capture.label is not None and capture.label.any() and capture.name not in without:
            yield capture


def _gathered(
    sampling: Sampling, captures: Iterator[Capture], rig: Rig, note: Note
) -> tuple[Samples, tuple[str, ...]] | None:
    first = next(captures, None)
    if first is None:
        return None

    def all_of_them() -> Iterator[Capture]:
        yield first
        yield from captures

    gathered = sampling.gather(all_of_them(), rig, note)
    return gathered.texture, tuple(gathered.names)


def _results(classifier: Classifier, samples: Samples) -> NDArray[np.intp]:
    """(n,) the class that each window is given; -1 where it is rejected."""
    result = classifier.posterior(samples.values).argmax(axis=1)
    if isinstance(classifier, NaiveBayes):
        result = np.where(classifier.rejects(samples.values), -1, result)
    return np.asarray(result, np.intp)


def _judged(parts: list[tuple[Samples, NDArray[np.intp]]], names: tuple[str, ...]) -> Windows:
    """Joins them, without the windows that were rejected or whose surface was not measured.

    Captures are put into the order of their names, so that the order of the recording does not matter.
    """
    samples = Samples.joined([part for part, _ in parts])
    result = np.concatenate([found for _, found in parts])
    order = np.argsort(np.array(names), kind="stable")
    number = np.empty(len(names), np.intp)
    number[order] = np.arange(len(names))
    usable = (result >= 0) & np.isfinite(samples.distance_m) & np.isfinite(samples.angle_rad)
    rows = np.flatnonzero(usable)
    capture = number[samples.capture[rows]]
    rows = rows[np.lexsort((samples.angle_rad[rows], samples.distance_m[rows], capture))]
    return Windows(
        samples.distance_m[rows],
        samples.angle_rad[rows],
        result[rows],
        samples.label[rows],
        number[samples.capture[rows]],
        tuple(names[k] for k in order),
    )
