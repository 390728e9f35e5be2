"""Hand-eye, arm and depth together: the disc plate from new poses, in the base frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.gates import VerifyGates
from calibration.hand_eye.discs import observe
from calibration.outcome import Figures, Note, RefusedError
from calibration.plots import drawing
from calibration.source import Source
from calibration.verify.part import Finding, Part
from surfclass.errors import MissingCalibrationError
from surfclass.types import Float64

KEY, TITLE = "discs", "Discs in base"
_CLEARLY = 0.6  # of the error must be left by the better explanation at most


@dataclass(frozen=True, slots=True, eq=False)
class DiscErrors:
    """How far discs are seen from where they were touched.

    Attributes:
        view: (n,) names of the captures.
        base_m: (n, 3) seen less touched, in `base`.
        depth_m: (n, 3) the same, turned into the depth camera's axes.
    """

    view: tuple[str, ...]
    base_m: Float64
    depth_m: Float64

    @property
    def distance_m(self) -> Float64:
        """(n,)."""
        return np.asarray(np.linalg.norm(self.base_m, axis=1))

    @property
    def rms_m(self) -> float:
        """Root of the mean square of the distances."""
        return _rms(self.base_m)


def check_discs(source: Source, gates: VerifyGates, note: Note) -> Part:
    """Returns the 3D error of the plate's discs, seen from the captures of role `hand_eye`.

    Which disc is which follows from the distances between them alone, so that a wrong hand-eye cannot
    hide itself.

    Raises:
        RefusedError: If there are no captures of it, or the discs cannot be told apart.
        MissingCalibrationError: If the rig has no hand-eye transform.
        InputError: As `observe`.
    """
    if not source.count("hand_eye"):
        raise RefusedError("no capture of role hand_eye shows the disc plate")
    if source.plate is None:
        raise RefusedError("there is no plate.toml that says where the discs are")
    if source.rig.transforms.flange_T_depth is None:
        raise MissingCalibrationError("the rig has no transforms.flange_T_depth: calibrate hand-eye first")
    observed = observe(source.captures("hand_eye"), source.rig, source.plate, note)
    flange_T_depth = source.rig.flange_T_depth
    names: list[str] = []
    base, depth = [], []
    for view in observed.views:
        base_T_depth = view.base_T_flange @ flange_T_depth
        error = base_T_depth @ view.positions.camera_m - view.positions.target_m
        names += [view.name] * len(error)
        base.append(error)
        depth.append(error @ base_T_depth.rotation)
    errors = DiscErrors(tuple(names), np.concatenate(base), np.concatenate(depth))
    return _judged(errors, gates)


def _judged(errors: DiscErrors, gates: VerifyGates) -> Part:
    by_view = {
        name: errors.base_m[[one == name for one in errors.view]] for name in dict.fromkeys(errors.view)
    }
    what = "distance seen from touched"
    greatest = float(errors.distance_m.max())
    findings = (
        Finding("point_rms_m", f"{what}, rms", errors.rms_m, gates.point_rms_m, "mm", 1e3),
        Finding("point_max_m", f"{what}, greatest", greatest, gates.point_max_m, "mm", 1e3),
    )
    rows = [
        [
            name,
            str(len(error)),
            f"{1e3 * _rms(error):.2f}",
            *(f"{1e3 * axis:+.2f}" for axis in error.mean(axis=0)),
        ]
        for name, error in by_view.items()
    ]
    mean_base, mean_depth = errors.base_m.mean(axis=0), errors.depth_m.mean(axis=0)
    return Part(
        KEY,
        TITLE,
        findings,
        suspect=explain(errors),
        result={
            "views": {name: {"discs": len(error), "rms_m": _rms(error)} for name, error in by_view.items()},
            "mean_base_m": mean_base.tolist(),
            "mean_depth_m": mean_depth.tolist(),
        },
        figures=(
            Figures(
                "Discs: seen less touched", ("view", "discs", "rms, mm", "x, mm", "y, mm", "z, mm"), rows
            ),
        ),
        pictures={"verify-discs": lambda path: _draw(errors, path)},
    )


def explain(errors: DiscErrors) -> str:
    """Returns what the errors' pattern points at: what moves with the camera is hand-eye, else the plate."""
    if len(set(errors.view)) > 1:
        left = {
            "hand-eye": _rms(errors.depth_m - errors.depth_m.mean(axis=0)),
            "plate": _rms(errors.base_m - errors.base_m.mean(axis=0)),
        }
        better, other = sorted(left, key=lambda name: left[name])
        if left[better] < _CLEARLY * min(errors.rms_m, left[other]):
            if better == "hand-eye":
                return (
                    "seen from the camera the error is the same in every view, so the hand-eye transform (or "
                    "the depth camera's scale) is wrong: calibrate hand-eye again"
                )
            return (
                "in base the error is the same in every view, so the plate was moved or touched wrong, or "
                "the base is another: touch the discs again"
            )
    return (
        "the error differs from view to view: the hand-eye transform's rotation, the joint offsets or the "
        "depth readings; calibrate hand-eye again and look at its outlier poses"
    )


def _rms(error: Float64) -> float:
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def _draw(errors: DiscErrors, path: Path) -> None:
    with drawing(path, 2, 1, figsize=(4.2, 3.6), sharex=True) as (_, axes):
        for ax, values, frame in zip(
            axes[:, 0], (errors.base_m, errors.depth_m), ("base", "depth"), strict=True
        ):
            for axis, colour in enumerate(("#c0392b", "#27ae60", "#2c6fbb")):
                ax.plot(1e3 * values[:, axis], ".", color=colour, ms=4, label="xyz"[axis])
            ax.axhline(0, color="grey", lw=0.5)
            ax.set_ylabel(f"in {frame}, mm")
        axes[0, 0].legend(ncols=3, fontsize=8)
        axes[1, 0].set_xlabel("discs, view after view: seen less touched")
