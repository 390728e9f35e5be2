"""`surfclass train` as one call: a recording becomes a model file, whole or not at all."""

from __future__ import annotations

from pathlib import Path

from calibration.gates import TrainGates
from calibration.outcome import Note
from calibration.source import Source
from calibration.training import command
from drivers.files import check_output, write_atomically
from surfclass.model import Model
from surfclass.training import TrainingSettings


def train_model(recording_path: Path, out: Path, settings: TrainingSettings, note: Note) -> Model:
    """Trains from a recording's `train` captures and writes the model.

    Args:
        recording_path: The recording; `exposure`, `light` and `response` captures are used where they are
            needed.
        out: The model file.
        settings: How to train.
        note: Called with a sentence at each step.

    Raises:
        InputError: If the recording or the place of the model cannot be used.
        MissingCalibrationError: If the rig lacks what its colour feature needs.
    """
    check_output(out)
    found = command.train_model(Source.open(recording_path), settings, TrainGates(), note)
    write_atomically(out, found.model.to_bytes())
    return found.model
