"""`calibrate cameras`: both cameras, where they are to each other, and the depth sensor's own errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from calibration.cameras.adjustment import rms_px
from calibration.cameras.boards import Board
from calibration.cameras.conditions import coverage, faults, square_fault, tilts_deg
from calibration.cameras.depth import DepthFit, DepthReadings, fit_depth, read_plane
from calibration.cameras.detection import grey_image, rough_size
from calibration.cameras.observations import observations_of
from calibration.cameras.pairs import ImagePairs
from calibration.cameras.report import figures, pictures
from calibration.cameras.resampling import held_out_rms, jackknife
from calibration.cameras.solution import ORDERS, Solution, solve
from calibration.cameras.uncertainty import ProjectionUncertainty, projection_uncertainty
from calibration.cameras.views import Views, read_views
from calibration.gates import CamerasGates
from calibration.outcome import SCHEMA, Note, Outcome, RefusedError
from calibration.projection import PARAMETERS, parameters_of
from calibration.source import Source
from surfclass.errors import ConfigurationError
from surfclass.rig import Camera
from surfclass.types import Float64

_LEAST_DEPTH_VIEWS = 4
_LOOKS = 6  # image pairs, for a board that was not told
_ASSUMED_SQUARE_M = 0.025


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line tells.

    Attributes:
        board: What was looked at; None: as the captures' `board.toml` says.
        order: Distortion model of both cameras: 0 none, 1 k1, 2 k1 k2, 4 and p1 p2, 5 and k3; None: chosen.
        fixed: Cameras whose intrinsics are held as the rig has them: "rgb", "depth".
        correct_depth: Whether the depth sensor's scale and distortion are looked for.
    """

    board: Board | None = None
    order: int | None = None
    fixed: tuple[str, ...] = ()
    correct_depth: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Everything that is reported.

    Attributes:
        solution: Cameras and poses.
        cameras: By name.
        covariance: By leaving out views, of what all views share.
        uncertainty: Of the projection, by camera.
        held_out_px: (views,).
        depth: What was found of the depth sensor, or None.
        readings: What that was found from.
    """

    solution: Solution
    cameras: Mapping[str, Camera]
    covariance: Float64
    uncertainty: Mapping[str, ProjectionUncertainty]
    held_out_px: Float64
    depth: DepthFit | None
    readings: tuple[DepthReadings, ...]


def calibrate(source: Source | ImagePairs, options: Options, gates: CamerasGates, note: Note) -> Outcome:
    """Finds the cameras from views of a board.

    Args:
        source: `board` captures with IR, colour or both; or a folder of image pairs.
        options: Board and model.
        gates: What the result has to keep.
        note: Called at each step.

    Raises:
        RefusedError: If the board is not found, the views cannot determine the cameras, or the squares
            have another size than told.
        ConfigurationError: If no board is told, or an option does not fit.
    """
    board = _board(source, options, note)
    views = read_views(source, board, note)
    observations = observations_of(views.views, board, views.sizes)
    missing = faults(observations)
    if missing:
        raise RefusedError(*missing, *([views.other_board] if views.other_board else []))
    note("adjusting")
    solution = solve(observations, board, options.order, _fixed(source, options))
    cameras = _cameras(solution)
    readings = _readings(views, solution, board, cameras) if options.correct_depth else ()
    depth = fit_depth(readings) if len(readings) >= _LEAST_DEPTH_VIEWS else None
    if depth is not None:
        wrong = square_fault(depth.scale, board.square_m)
        if wrong is not None:
            raise RefusedError(wrong, result={"depth_scale": depth.scale})
    # The larger of both: a formal covariance is too small on real data, a jackknife of few views uncertain.
    covariance = jackknife(solution.adjustment)
    grown = np.sqrt(
        np.maximum(1, np.diag(solution.adjustment.covariance) / np.maximum(np.diag(covariance), 1e-30))
    )
    covariance = covariance * np.outer(grown, grown)
    note("how uncertain that is")
    found = Found(
        solution,
        cameras,
        covariance,
        _uncertainty(solution, cameras, covariance),
        held_out_rms(solution.observations, solution.adjustment),
        depth,
        readings,
    )
    result = _result(found, views, board)
    reasons = _judged(result, gates)
    verdict = "fail" if reasons else "pass"
    told = {"schema": SCHEMA, "verdict": verdict, "reasons": reasons, **result}
    return Outcome(
        "cameras",
        "fail" if reasons else "pass",
        tuple(reasons),
        _sentence(result),
        told,
        {} if isinstance(source, ImagePairs) else _rig(found, source),
        figures(result),
        pictures(found),
    )


def _board(source: Source | ImagePairs, options: Options, note: Note) -> Board:
    board = options.board or (_seen_board(source, note) if isinstance(source, ImagePairs) else source.board)
    if board is None:
        raise ConfigurationError(
            f"{source.path}: which board? It has no board.toml: give --board 9x6 --square-mm 25 "
            "(inner corners, columns x rows)"
        )
    if options.order is not None and options.order not in ORDERS:
        raise ConfigurationError(f"distortion model {options.order}, allowed: {', '.join(map(str, ORDERS))}")
    return board


def _seen_board(source: ImagePairs, note: Note) -> Board | None:
    """The checkerboard that most of the first images show; of its squares' size only lengths depend."""
    seen: Counter[tuple[int, int]] = Counter()
    for _, images in islice(source.images(), _LOOKS):
        sizes = [rough_size(grey_image(image)) for image in images.values()]
        seen.update(size for size in sizes if size is not None)
    if not seen:
        return None
    columns, rows = seen.most_common(1)[0][0]
    board = Board(columns=columns, rows=rows, square_m=_ASSUMED_SQUARE_M)
    note(f"no board was told: {board}, as most images show; the size of the squares is assumed")
    return board


def _fixed(source: Source | ImagePairs, options: Options) -> dict[str, Float64]:
    if not options.fixed:
        return {}
    known = {} if isinstance(source, ImagePairs) else {"rgb": source.rig.rgb, "depth": source.rig.depth}
    held = {name: known.get(name) for name in options.fixed}
    missing = [name for name, camera in held.items() if camera is None]
    if missing:
        raise ConfigurationError(f"cameras to hold: {', '.join(missing)} not in the rig")
    return {name: parameters_of(camera) for name, camera in held.items() if camera is not None}


def _cameras(solution: Solution) -> dict[str, Camera]:
    sizes = zip(solution.observations.cameras, solution.observations.sizes, strict=True)
    made = {}
    for (name, size), values in zip(sizes, solution.adjustment.state.parameters.tolist(), strict=True):
        k1, k2, p1, p2, k3 = values[4:]
        made[name] = Camera(
            size=size, fx=values[0], fy=values[1], cx=values[2], cy=values[3], distortion=(k1, k2, p1, p2, k3)
        )
    return made


def _readings(
    views: Views, solution: Solution, board: Board, cameras: Mapping[str, Camera]
) -> tuple[DepthReadings, ...]:
    if "depth" not in cameras:
        return ()
    poses = zip(solution.observations.views, solution.adjustment.state.poses, strict=True)
    found = (
        read_plane(name, views.depth_mm[name], pose, board, cameras["depth"])
        for name, pose in poses
        if name in views.depth_mm
    )
    return tuple(one for one in found if one is not None)


def _uncertainty(
    solution: Solution, cameras: Mapping[str, Camera], covariance: Float64
) -> dict[str, ProjectionUncertainty]:
    observations, fit = solution.observations, solution.adjustment
    starts = np.cumsum([0, *fit.free.sum(axis=1)])
    result = {}
    for index, (name, camera) in enumerate(cameras.items()):
        own = slice(starts[index], starts[index + 1])
        seen = observations.pixel[observations.camera == index]
        result[name] = projection_uncertainty(
            camera, fit.state.parameters[index], fit.free[index], covariance[own, own], seen
        )
    return result


def _result(found: Found, views: Views, board: Board) -> dict[str, Any]:
    solution, fit = found.solution, found.solution.adjustment
    observations = solution.observations
    sd, formal = (np.sqrt(np.diag(matrix)) for matrix in (found.covariance, fit.covariance))
    starts = np.cumsum([0, *fit.free.sum(axis=1)])
    own = [observations.camera == index for index in range(len(found.cameras))]
    cameras = {}
    for index, (name, camera) in enumerate(found.cameras.items()):
        names = [PARAMETERS[i] for i in np.flatnonzero(fit.free[index])]
        part = slice(starts[index], starts[index + 1])
        infinity, metre = found.uncertainty[name].worst(camera)
        counts = coverage(observations, index)
        cameras[name] = {
            **camera.model_dump(exclude={"vignetting"}, mode="json"),
            "order": solution.orders[index],
            "sd": dict(zip(names, sd[part].tolist(), strict=True)),
            "formal_sd": dict(zip(names, formal[part].tolist(), strict=True)),
            "rms_px": rms_px(fit.residual[own[index]]),
            "corner_sd_px": float(fit.noise_px[index]),
            "views": len(np.unique(observations.view[own[index]])),
            "not_found": list(views.missed.get(name, ())),
            "corners": int(own[index].sum()),
            "coverage": float((counts > 0).mean()),
            "corners_by_part": counts.astype(int).tolist(),
            "projection_sd_px": {"infinity": infinity, "metre": metre},
        }
    tilts = tilts_deg(fit.state.poses)
    per_view = [
        {
            "name": name,
            "rms_px": {
                camera: rms_px(fit.residual[mine])
                for index, camera in enumerate(found.cameras)
                if (mine := own[index] & (observations.view == i)).any()
            },
            "held_out_px": float(found.held_out_px[i]),
            "tilt_deg": float(tilts[i]),
            "distance_m": float(np.linalg.norm(fit.state.poses[i, :3, 3])),
        }
        for i, name in enumerate(observations.views)
    ]
    result: dict[str, Any] = {
        "board": board.model_dump(exclude_none=True),
        "rms_px": {name: camera["rms_px"] for name, camera in cameras.items()},
        "held_out_px": float(np.sqrt(np.mean(found.held_out_px**2))),
        "cameras": cameras,
        "views": per_view,
        "outlier_views": dict(solution.outlier_views),
        "outlier_corners": [
            {"view": view, "camera": camera, "corner": corner, "px": off}
            for view, camera, corner, off in solution.outlier_corners
        ],
        "depth": _depth(found),
    }
    if len(found.cameras) == 2:
        first, second = found.cameras
        result["rms_stereo_px"] = rms_px(fit.residual)
        result[f"{second}_T_{first}"] = fit.state.to_camera[1].tolist()
        result["extrinsic_sd"] = {"rotation_rad": sd[-6:-3].tolist(), "translation_m": sd[-3:].tolist()}
    return result


def _depth(found: Found) -> dict[str, Any]:
    fit = found.depth
    if fit is None:
        return {
            "judged": False,
            "note": "without depth readings on four boards or more, neither the sensor's scale nor a wrong "
            "size of the squares can be seen",
        }
    return {
        "judged": True,
        "scale": fit.scale,
        "rms_relative": fit.before_rms,
        "corrected_rms_relative": fit.after_rms,
        "held_out_rms_relative": fit.held_out_rms,
        "needed": fit.needed,
        "correction": fit.correction.model_dump(mode="json"),
        "sd": list(fit.sd),
    }


def _judged(result: Mapping[str, Any], gates: CamerasGates) -> list[str]:
    reasons = []

    def limit(what: str, value: float, allowed: float, unit: str, scale: float = 1.0) -> None:
        if not value <= allowed:
            reasons.append(f"{what} is {scale * value:.3g} {unit}, allowed is {scale * allowed:.3g} {unit}")

    for name, camera in result["cameras"].items():
        limit(f"{name}: rms", camera["rms_px"], gates.rms_px, "px")
        worst = max(camera["projection_sd_px"].values())
        limit(f"{name}: uncertainty of the projection in the central 80 %", worst, gates.projection_px, "px")
        if camera["coverage"] < gates.coverage:
            reasons.append(
                f"{name}: corners in {camera['coverage']:.0%} of the image's parts, needed are "
                f"{gates.coverage:.0%}: hold the board into the corners of the image"
            )
    limit("held-out error", result["held_out_px"], gates.held_out_px, "px")
    if "extrinsic_sd" in result:
        sd = result["extrinsic_sd"]
        shift, turn = max(sd["translation_m"]), max(sd["rotation_rad"])
        limit("sd of the translation between the cameras", shift, gates.translation_sd_m, "mm", 1e3)
        degrees = float(np.degrees(1))
        limit("sd of the rotation between the cameras", turn, gates.rotation_sd_rad, "°", degrees)
    if len(result["outlier_views"]) > gates.outlier_views:
        names = ", ".join(result["outlier_views"])
        reasons.append(f"views that do not fit: {names}; allowed are {gates.outlier_views}")
    if result["depth"]["judged"]:
        limit(
            "depth readings against held-out boards",
            result["depth"]["held_out_rms_relative"],
            gates.depth_rms,
            "%",
            100,
        )
    return reasons


def _sentence(result: Mapping[str, Any]) -> str:
    parts = [f"{name} {value:.3f} px" for name, value in result["rms_px"].items()]
    said = (
        f"rms {', '.join(parts)}, held-out {result['held_out_px']:.3f} px over {len(result['views'])} views"
    )
    if "extrinsic_sd" in result:
        sd = result["extrinsic_sd"]
        said += (
            f"; between the cameras ±{1e3 * max(sd['translation_m']):.2f} mm and "
            f"±{np.degrees(max(sd['rotation_rad'])):.3f}°"
        )
    if result["depth"]["judged"]:
        said += f"; depth reads {result['depth']['scale'] - 1:+.2%}"
    return said


def _rig(found: Found, source: Source) -> dict[str, Any]:
    """Vignetting and all else that the rig has stays as it is."""
    rig: dict[str, Any] = {
        name: camera.model_dump(exclude={"vignetting"}, mode="json") for name, camera in found.cameras.items()
    }
    if len(found.cameras) == 2:
        rig["transforms"] = {"rgb_T_depth": found.solution.adjustment.state.to_camera[1].tolist()}
    if found.depth is not None:
        # None of its own would leave an older correction in use.
        identity = {"multiplier": [1.0], "inverse_offset_per_m": 0.0}
        if found.depth.needed:
            rig["depth_correction"] = found.depth.correction.model_dump(mode="json")
        elif source.rig.depth_correction is not None:
            rig["depth_correction"] = identity
    return rig
