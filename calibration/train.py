"""Commissioning of the classifiers: labelled captures of a recording become one model file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from drivers.files import check_output, write_atomically
from drivers.recordings import Recording
from surfclass.errors import InputError
from surfclass.model import Model
from surfclass.training import TrainingSettings, train


def train_model(
    recording_path: Path, out: Path, settings: TrainingSettings, note: Callable[[str], None]
) -> Model:
    """Trains from a recording's `train` captures and writes the model, whole or not at all.

    Args:
        recording_path: The recording; its `response` captures are used where they are needed.
        out: The model file.
        settings: How to train.
        note: Called with a sentence at each step.

    Raises:
        InputError: If the recording or the place of the model cannot be used.
        MissingCalibrationError: If the rig lacks what its colour feature needs.
    """
    check_output(out)
    recording = Recording.open(recording_path)
    if recording.classes is None:
        raise InputError(f"{recording_path}: has no classes.toml, so its labels mean nothing")
    model = train(
        recording.captures("train"),
        recording.captures("response"),
        recording.rig,
        recording.classes,
        settings,
        note,
    )
    write_atomically(out, model.to_bytes())
    return model
