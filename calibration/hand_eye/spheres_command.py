"""`surfclass calibrate hand-eye --target spheres`: a fixed camera, and two spheres on the arm."""

from __future__ import annotations

import csv
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from calibration.gates import HandEyeGates
from calibration.hand_eye.spheres import SpherePair, find_pair, pinhole_of_cloud
from calibration.hand_eye.spheres_fit import SpheresFit, fit_spheres
from calibration.outcome import SCHEMA, Figures, Note, Outcome, RefusedError
from surfclass.errors import InputError
from surfclass.types import Float64

_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


@dataclass(frozen=True, slots=True)
class SpheresOptions:
    """The rod.

    Attributes:
        radii_m: Of the first and the second sphere, m.
        distance_m: Between their centres, m.
    """

    radii_m: tuple[float, float] = (0.012, 0.010)
    distance_m: float = 0.05026


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One pose.

    Attributes:
        name: Of its files.
        ir: (h, w) uint8 or uint16.
        pixels: (n, 2) column and row of each point.
        points_m: (n, 3) in the camera's frame.
        tool_base_m: (3,) what the arm read out.
    """

    name: str
    ir: Any
    pixels: Any
    points_m: Float64
    tool_base_m: Float64


def read_frames(folder: Path) -> list[Frame]:
    """Returns the poses of a folder.

    It holds `ir/NAME.png` (or jpg, tif), `clouds.npz` with `index_NAME` (flat pixel index into the image)
    and `xyz_mm_NAME` for each, and `marker_base_m.csv` with a row `x,y,z` for each, in the
    order of their names.

    Raises:
        InputError: Naming the file and what is wrong with it.
    """
    images = sorted(path for path in (folder / "ir").glob("*") if path.suffix.lower() in _SUFFIXES)
    if not images:
        raise InputError(f"{folder / 'ir'}: no images, needed is one for each pose")
    tool = _positions(folder / "marker_base_m.csv")
    if len(tool) != len(images):
        raise InputError(f"{folder / 'marker_base_m.csv'}: {len(tool)} rows, there are {len(images)} images")
    path = folder / "clouds.npz"
    frames = []
    try:
        with np.load(path, allow_pickle=False) as clouds:
            for image, place in zip(images, tool, strict=True):
                index = np.asarray(clouds[f"index_{image.stem}"])
                points = np.asarray(clouds[f"xyz_mm_{image.stem}"], np.float64) * 1e-3
                frames.append(_frame(image, index, points, place))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: {error}") from error
    return frames


def calibrate_spheres(folder: Path, options: SpheresOptions, gates: HandEyeGates, note: Note) -> Outcome:
    """Returns the pose of a fixed camera.

    Args:
        folder: As `read_frames` takes it.
        options: The rod.
        gates: Limits of the verdict.
        note: Is told of poses that are left out.

    Raises:
        RefusedError: If the poses cannot determine it.
        InputError: If a file cannot be read.
    """
    frames = read_frames(folder)
    seen: list[tuple[Frame, SpherePair]] = []
    for frame in frames:
        pair = find_pair(frame.ir, frame.pixels, frame.points_m, options.radii_m, options.distance_m)
        if isinstance(pair, str):
            note(f"pose {frame.name}: left out, {pair}")
        else:
            seen.append((frame, pair))
    if not seen:
        raise RefusedError("spheres: no pose shows both; check their radii and distance, and the light")
    pairs = [pair for _, pair in seen]
    names = [frame.name for frame, _ in seen]
    fit = fit_spheres(pairs, np.array([frame.tool_base_m for frame, _ in seen]))
    for name, used in zip(names, fit.used, strict=True):
        if not used:
            note(f"pose {name}: does not fit the others, left out")
    reasons = _failures(fit, gates)
    verdict: Literal["pass", "fail"] = "fail" if reasons else "pass"
    loo, rms = _rms(fit.left_out_m[fit.used]), _rms(np.linalg.norm(fit.residual_m[fit.used], axis=1))
    return Outcome(
        kind="hand-eye",
        verdict=verdict,
        reasons=tuple(reasons),
        sentence=(
            f"{int(fit.used.sum())} poses, leave-one-out {1e3 * loo:.2f} mm, rms {1e3 * rms:.2f} mm, "
            f"translation ± {1e3 * fit.translation_sd_m.max():.2f} mm, "
            f"rotation ± {np.degrees(fit.rotation_sd_rad.max()):.3f}°"
        ),
        result=_result(fit, seen, verdict, reasons, rms, loo),
        figures=(_figures(fit, pairs, names),),
    )


def _positions(path: Path) -> Float64:
    try:
        with path.open(newline="") as stream:
            rows = [[float(row[key]) for key in ("x", "y", "z")] for row in csv.DictReader(stream)]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {error!r}; needed are columns x,y,z of numbers in m") from error
    positions = np.array(rows, np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise InputError(f"{path}: some numbers are not finite")
    return positions


def _frame(image: Path, index: Any, points: Float64, place: Float64) -> Frame:
    ir = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    if ir is None or ir.ndim != 2:
        raise InputError(f"{image}: no grey image")
    if points.shape != (len(index), 3) or not np.isfinite(points).all():
        raise InputError(f"xyz_mm_{image.stem}: shape {points.shape}, needed are {len(index)} finite points")
    if index.dtype.kind not in "iu" or (len(index) and not 0 <= index.min() <= index.max() < ir.size):
        raise InputError(f"index_{image.stem}: not all are pixels of {image.name}")
    pixels = np.column_stack([index % ir.shape[1], index // ir.shape[1]]).astype(np.int64)
    return Frame(image.stem, ir, pixels, points, place)


def _failures(fit: SpheresFit, gates: HandEyeGates) -> list[str]:
    loo = _rms(fit.left_out_m[fit.used])
    shift, turn = float(fit.translation_sd_m.max()), float(fit.rotation_sd_rad.max())
    out = int((~fit.used).sum())
    reasons = []
    if loo > gates.leave_one_out_m:
        reasons.append(f"leave-one-out {1e3 * loo:.2f} mm, allowed {1e3 * gates.leave_one_out_m:.2f}")
    if shift > gates.translation_sd_m:
        reasons.append(f"translation ± {1e3 * shift:.2f} mm, allowed ± {1e3 * gates.translation_sd_m:.2f}")
    if turn > gates.rotation_sd_rad:
        allowed = np.degrees(gates.rotation_sd_rad)
        reasons.append(f"rotation ± {np.degrees(turn):.3f}°, allowed ± {allowed:.3f}; spread the poses more")
    if out > gates.outlier_poses:
        reasons.append(f"{out} poses do not fit the others, allowed {gates.outlier_poses}")
    return reasons


def _result(
    fit: SpheresFit,
    seen: list[tuple[Frame, SpherePair]],
    verdict: str,
    reasons: list[str],
    rms: float,
    loo: float,
) -> dict[str, Any]:
    camera = pinhole_of_cloud(
        np.concatenate([frame.pixels for frame, _ in seen]),
        np.concatenate([frame.points_m for frame, _ in seen]),
    )
    return {
        "schema": SCHEMA,
        "verdict": verdict,
        "reasons": reasons,
        "mounting": "eye_to_hand",
        "base_T_camera": fit.base_T_camera.matrix.tolist(),
        "intrinsics": {
            **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")},
            "distortion": list(camera.distortion),
        },
        "rms_m": rms,
        "leave_one_out_m": loo,
        "jackknife_sd": {
            "translation_m": fit.translation_sd_m.tolist(),
            "rotation_rad": fit.rotation_sd_rad.tolist(),
        },
        "tool_from_middle_m": fit.along_m,
        "tool_from_middle_sd_m": fit.along_sd_m,
        "outlier_poses": [frame.name for (frame, _), used in zip(seen, fit.used, strict=True) if not used],
        "poses": [
            {
                "name": frame.name,
                "distance_m": pair.distance_m,
                "residual_m": residual.tolist(),
                "left_out_m": float(missed),
            }
            for (frame, pair), residual, missed in zip(seen, fit.residual_m, fit.left_out_m, strict=True)
        ],
    }


def _figures(fit: SpheresFit, pairs: list[SpherePair], names: list[str]) -> Figures:
    rows = [
        (
            name,
            f"{1e3 * pair.distance_m:.2f}",
            f"{1e3 * np.linalg.norm(residual):.2f}",
            f"{1e3 * missed:.2f}",
            "" if used else "left out",
        )
        for name, pair, residual, missed, used in zip(
            names, pairs, fit.residual_m, fit.left_out_m, fit.used, strict=True
        )
    ]
    columns = ("pose", "spheres apart mm", "residual mm", "by the others mm", "")
    return Figures("Spheres on the arm", columns, rows)


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(values**2)))
