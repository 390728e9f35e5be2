"""The whole method: labelled captures, classified by the model in use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.gates import VerifyGates
from calibration.outcome import Figures, Note, RefusedError
from calibration.plots import draw_confusion, drawing
from calibration.source import Source
from calibration.verify.part import Finding, Part
from drivers.files import read_file
from surfclass.errors import InputError
from surfclass.evaluation import accuracy
from surfclass.frames import Capture
from surfclass.model import Model
from surfclass.pipeline import Pipeline
from surfclass.pooling import fuse

KEY, TITLE = "boards", "Labelled captures"
ROLES = ("test", "train")


def check_boards(source: Source, model_path: Path | None, gates: VerifyGates, note: Note) -> Part:
    """Returns how many labelled pixels the model classifies right, class by class.

    Raises:
        RefusedError: If there is no labelled capture, or no model.
        InputError, ConfigurationError: If the model cannot be used with the rig.
    """
    if not any(source.count(role) for role in ROLES):
        raise RefusedError(f"no labelled capture of role {' or '.join(ROLES)}")
    if model_path is None:
        raise RefusedError("there are labelled captures, but no model was given")
    model = Model.from_bytes(read_file(model_path, "model"), str(model_path))
    rig = source.rig.whole()
    model.check(rig, source.classes)
    pipeline = Pipeline(rig, model)
    k = len(model.classes.names)
    confusion, total = np.zeros((k, k), np.int64), np.zeros(k, np.int64)
    rows = []
    for capture in source.captures(ROLES):
        try:
            truth, result, classified = _classified(capture, pipeline)
        except InputError as error:
            note(f"labelled captures: {capture.name} is left out: {error}")
            continue
        if not len(truth):
            note(f"labelled captures: {capture.name} is left out: no labelled pixel has a surface point")
            continue
        overall, _, one = accuracy(truth, result, classified, k)
        confusion += one
        total += np.bincount(truth, minlength=k)
        rows.append(
            [capture.name, str(len(truth)), f"{100 * overall:.1f}", f"{100 * (1 - classified.mean()):.1f}"]
        )
    if not total.any():
        raise RefusedError("no labelled capture can be classified; each was left out with a reason")
    return _judged(model.classes.names, confusion, total, rows, gates)


def _classified(
    capture: Capture, pipeline: Pipeline
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """True and found class of each labelled pixel that sees a surface, and whether any class was found."""
    if capture.label is None:
        raise InputError("it has no label image")
    feature = pipeline.rig.features.colour
    classified = pipeline.classify(capture, (feature,))
    label = capture.label[classified.view.has_point]
    said = pipeline.observe(classified, feature).of(label > 0)
    evidence = fuse(
        said.colour, said.texture, said.has_colour, said.has_texture, said.weight, pipeline.settings.pool
    )
    truth = label[label > 0].astype(np.intp) - 1
    return truth, evidence.argmax(axis=1), said.has_colour | said.has_texture


def _judged(
    names: tuple[str, ...],
    confusion: NDArray[np.int64],
    total: NDArray[np.int64],
    rows: list[list[str]],
    gates: VerifyGates,
) -> Part:
    seen = np.flatnonzero(total)
    share = {names[index]: float(confusion[index, index] / total[index]) for index in seen}
    worst = min(share, key=lambda name: share[name])
    overall = float(np.trace(confusion) / total.sum())
    right, of_worst = "pixels that are right", f"pixels that are right, worst class ({worst})"
    least = gates.class_accuracy
    findings = (
        Finding("accuracy", right, overall, gates.accuracy, "%", 100, at_least=True),
        Finding("worst_class_accuracy", of_worst, share[worst], least, "%", 100, at_least=True),
    )
    by_class = [
        [name, str(int(total[names.index(name)])), f"{100 * value:.1f}"] for name, value in share.items()
    ]
    return Part(
        KEY,
        TITLE,
        findings,
        suspect="the model does not fit these surfaces or this light: look at which class is taken for "
        "which, and train again with captures of them",
        result={"class_accuracy": share, "confusion": confusion.tolist(), "classes": list(names)},
        figures=(
            Figures("Labelled captures, by class", ("class", "pixels", "right, %"), by_class),
            Figures("Labelled captures", ("view", "pixels", "right, %", "rejected, %"), rows),
        ),
        pictures={"verify-confusion": lambda path: _draw(names, confusion, path)},
    )


def _draw(names: tuple[str, ...], confusion: NDArray[np.int64], path: Path) -> None:
    with drawing(path, figsize=(4, 3.4)) as (_, axes):
        draw_confusion(axes[0, 0], confusion.tolist(), names)
        axes[0, 0].set_title("truth (rows), result (columns)", fontsize=9)
