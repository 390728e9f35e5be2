"""Both cameras and what is between them: a board seen by IR, depth and colour at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import Board, Found, find_board, symmetries
from calibration.gates import VerifyGates
from calibration.outcome import Figures, Note, RefusedError
from calibration.plots import drawing
from calibration.rotations import rotation_matrix
from calibration.source import Source
from calibration.verify.part import Finding, Part
from surfclass.frames import Capture
from surfclass.geometry import corrected_depth, depth_to_points, project
from surfclass.rig import Camera, Rig
from surfclass.types import Bool, Float64, Transform

KEY, TITLE = "cameras", "Cameras"
_LEAST_READINGS = 200
_ENLARGED = 50


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """One capture of the board.

    Attributes:
        name: Of the capture.
        ir_px: (n, 2) corners in the IR image less where the board's pose puts them.
        rgb_px: (m, 2) corners in the colour image less where that pose and `rgb_T_depth` put them.
        corners: (m, 2) px, those corners.
        depth_error: Median relative error of the depth readings on the board; None where they are few.
    """

    name: str
    ir_px: Float64
    rgb_px: Float64
    corners: Float64
    depth_error: float | None


def check_cameras(source: Source, board: Board | None, gates: VerifyGates, note: Note) -> Part:
    """Returns how well intrinsics, `rgb_T_depth` and depth agree on the board in captures of role `board`.

    The board's pose comes from the IR image alone; the colour image and the depth readings then have to
    show it where it is.

    Raises:
        RefusedError: If there is no capture, no board.toml, or the board is seen nowhere.
        MissingCalibrationError: If the rig lacks the colour camera or where it is.
    """
    if not source.count("board"):
        raise RefusedError("no capture of role board shows the checkerboard")
    if board is None:
        raise RefusedError("nothing says what board the captures of role board show: there is no board.toml")
    rig = source.rig.whole()
    views = []
    for capture in source.captures("board"):
        view = _look(capture, board, rig)
        if isinstance(view, str):
            note(f"board: capture {capture.name} is left out: {view}")
        else:
            views.append(view)
    if not views:
        raise RefusedError(f"no capture shows the {board} in IR and in colour")
    return _judged(views, gates)


def _look(capture: Capture, board: Board, rig: Rig) -> BoardView | str:
    if capture.depth.ir is None or capture.colour is None:
        return "it has no IR image" if capture.depth.ir is None else "it has no colour image"
    in_ir, in_rgb = find_board(capture.depth.ir, board), find_board(capture.colour.rgb, board)
    if in_ir is None or in_rgb is None:
        return f"the {board} is not seen in the {'IR' if in_ir is None else 'colour'} image"
    depth_T_board = pose_of(in_ir, board, rig.depth)
    ir_px = in_ir.corners - project(depth_T_board @ board.points_m[in_ir.ids], rig.depth)
    points_rgb = (rig.rgb_T_depth @ depth_T_board) @ board.points_m
    orders = [order[in_rgb.ids] for order in symmetries(board)]  # the two images may be numbered differently
    rgb_px = min((in_rgb.corners - project(points_rgb[order], rig.rgb) for order in orders), key=_rms)
    error = depth_error(capture.depth.depth_mm, _inside(in_ir.corners, rig.depth), depth_T_board, rig)
    return BoardView(capture.name, ir_px, rgb_px, in_rgb.corners, error)


def pose_of(found: Found, board: Board, camera: Camera) -> Transform:
    """Returns the board's pose in the depth camera's frame, by least squares of the reprojection."""
    _, rotation, translation = cv2.solvePnP(
        board.points_m[found.ids], found.corners, camera.matrix, np.array(camera.distortion)
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(rotation[:, 0])
    matrix[:3, 3] = translation[:, 0]
    return Transform("depth", "board", matrix)


def depth_error(
    depth_mm: NDArray[np.uint16], where: Bool, depth_T_board: Transform, rig: Rig
) -> float | None:
    """Returns the median of measured over true depth, less 1, of the board's pixels; None if they are few."""
    points = depth_to_points(corrected_depth(depth_mm, rig), rig.depth)[:, where].T.astype(np.float64)
    points = points[points[:, 2] > 0]
    if len(points) < _LEAST_READINGS:
        return None
    normal = depth_T_board.rotation[:, 2]
    true = (normal @ depth_T_board.translation) / (points / points[:, 2:] @ normal)
    return float(np.median(points[:, 2] / true) - 1)


def _inside(corners: Float64, camera: Camera) -> Bool:
    hull = cv2.convexHull(corners.astype(np.float32))
    mask = cv2.fillPoly(np.zeros(camera.shape, np.uint8), [np.rint(hull).astype(np.int32)], 1)
    inside: Bool = np.asarray(mask) > 0
    return inside


def _judged(views: list[BoardView], gates: VerifyGates) -> Part:
    ir, rgb = (np.concatenate([getattr(view, name) for view in views]) for name in ("ir_px", "rgb_px"))
    readings = [view.depth_error for view in views if view.depth_error is not None]
    depth = float(np.median(readings)) if readings else None
    in_ir, in_rgb = (
        "corners in IR off the board's pose, rms",
        "corners in colour off that pose by rgb_T_depth, rms",
    )
    findings = [
        Finding("ir_rms_px", in_ir, _rms(ir), gates.reprojection_px, "px"),
        Finding("rgb_rms_px", in_rgb, _rms(rgb), gates.transfer_px, "px"),
    ]
    if depth is not None:
        what = "depth on the board, median error"
        findings.append(Finding("depth_error", what, abs(depth), gates.depth_error, "%", 100))
    rows = [
        [
            view.name,
            f"{_rms(view.ir_px):.2f}",
            f"{_rms(view.rgb_px):.2f}",
            "–" if view.depth_error is None else f"{100 * view.depth_error:+.2f}",
        ]
        for view in views
    ]
    failed = [finding.key for finding in findings if not finding.kept]
    suspects = {
        "ir_rms_px": "the depth camera's intrinsics are wrong, or the board is another",
        "rgb_rms_px": "the colour camera's intrinsics or rgb_T_depth are wrong",
        "depth_error": "the depth readings' scale is wrong, or the board's squares have another size",
    }
    first = suspects[failed[0]] if failed else ""
    return Part(
        KEY,
        TITLE,
        tuple(findings),
        suspect=f"{first}: calibrate cameras again",
        result={"depth_bias": depth, "views": len(views)},
        figures=(Figures("Board", ("view", "IR, px", "colour, px", "depth, %"), rows),),
        pictures={"verify-cameras": lambda path: _draw(views, path)},
    )


def _rms(residual: Float64) -> float:
    return float(np.sqrt((residual**2).sum(axis=-1).mean()))


def _draw(views: list[BoardView], path: Path) -> None:
    with drawing(path, figsize=(4.2, 3.6)) as (_, axes):
        ax = axes[0, 0]
        for view in views:
            ax.quiver(
                *view.corners.T, *view.rgb_px.T, angles="xy", scale_units="xy", scale=1 / _ENLARGED,
                width=0.003, color="#2c6fbb",
            )  # fmt: skip
        ax.invert_yaxis()
        ax.set_aspect("equal")
        ax.set_xlabel(f"colour image, px; errors {_ENLARGED} times as long")
