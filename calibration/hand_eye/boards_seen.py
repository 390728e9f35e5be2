"""A calibration board, seen by either camera on the flange: hand-eye without depth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import Board, find_board, symmetries
from calibration.hand_eye.observations import Intrinsics, Observations, Pixels, View
from calibration.hand_eye.problem import problem_of
from calibration.hand_eye.start import guess_of, moving, target_poses
from calibration.outcome import Note, RefusedError
from calibration.rotations import rotation_vector
from surfclass.frames import Capture
from surfclass.kinematics import corrected, flange_pose
from surfclass.rig import Camera, DepthRig
from surfclass.types import Float64

Eye = Literal["rgb", "depth"]


def observe_board(
    captures: Iterable[Capture], rig: DepthRig, board: Board, eye: Eye, note: Note
) -> Observations:
    """Returns the board's corners in every capture as hand-eye observations.

    Args:
        captures: With joint angles; those that do not show the board are left out, with a note.
        rig: The cameras and the arm.
        board: What to look for.
        eye: Which camera.
        note: Is told of what is left out and why.

    Raises:
        RefusedError: If no view shows the board.
        InputError: If a capture's images have not the camera's size.
    """
    camera = rig.rgb if eye == "rgb" else rig.depth
    assert camera is not None  # the caller chose it
    points = board.points_m
    views: list[View] = []
    for capture in captures:
        rig.check(capture)
        image = image_of(capture, eye)
        if capture.joints is None or image is None:
            lacks = "joint angles" if capture.joints is None else f"{eye} image"
            note(f"capture {capture.name}: left out, it has no {lacks}")
            continue
        found = find_board(image, board)
        if found is None:
            note(f"capture {capture.name}: left out, the board is not found in it")
            continue
        q = corrected(capture.joints.q, rig.arm)
        seen = Pixels(points[found.ids], found.corners)
        views.append(View(capture.name, flange_pose(capture.joints.q, rig.arm), seen, q=q))
    if not views:
        raise RefusedError(f"no view shows the {board} with joint angles; is it the right board?")
    intrinsics = Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)
    seen_by_all = Observations("eye_in_hand", tuple(views), intrinsics, camera.size)
    return in_one_order(seen_by_all, points, symmetries(board), rig.arm.flange_offset_m)


def image_of(capture: Capture, eye: Eye) -> NDArray[Any] | None:
    """Returns the image in which to look for the board, or None."""
    if eye == "rgb":
        return None if capture.colour is None else capture.colour.rgb
    return capture.depth.ir


def eye_of(rig: DepthRig, has_colour: bool) -> tuple[Eye, Camera]:
    """Returns the camera to look with: the colour camera, which is sharper, where its place is known."""
    if has_colour and rig.rgb is not None and rig.transforms.rgb_T_depth is not None:
        return "rgb", rig.rgb
    return "depth", rig.depth


def in_one_order(
    seen: Observations, points: Float64, orders: Sequence[NDArray[np.int64]], flange_offset_m: float
) -> Observations:
    """Returns the observations with the corners of a board that looks alike from several sides told apart.

    Which side is called the first is free; that all views say the same is what counts. Most views decide.

    Args:
        seen: The observations, each view in one of the orders.
        points: (n, 3) the board's corners.
        orders: (n,) each: `points[order]` looks like `points`.
        flange_offset_m: The last D-H length.
    """
    if len(orders) < 2 or len(seen.views) < 3:
        return seen
    index = {tuple(point): number for number, point in enumerate(points)}
    for _ in range(len(orders)):
        problem = problem_of(seen, flange_offset_m)
        if seen.intrinsics is None:
            return seen
        poses, known = target_poses(problem, seen.intrinsics.vector)
        guess, _ = guess_of(problem, poses, known)
        expected = np.linalg.inv(moving(problem) @ guess.x) @ guess.y
        views = list(seen.views)
        for place, number in enumerate(problem.order):
            view = views[number]
            which = np.array([index[tuple(point)] for point in view.pixels.target_m])
            asked = expected[place, :3, :3].T @ poses[place, :3, :3]
            turned = [_turn_of(points, order, asked) for order in orders]
            best = int(np.argmin(turned))
            if best:
                pixels = Pixels(points[orders[best][which]], view.pixels.pixel, view.pixels.sd_px)
                views[number] = replace(view, pixels=pixels)
        if all(new is old for new, old in zip(views, seen.views, strict=True)):
            return seen
        seen = replace(seen, views=tuple(views))
    return seen


def _turn_of(points: Float64, order: NDArray[np.int64], asked: Float64) -> float:
    """How far a turn of the board is from the one that takes each corner to the one it is called, rad."""
    middle = points.mean(axis=0)
    u, _, vt = np.linalg.svd((points - middle).T @ (points[order] - middle))
    rotation = vt.T @ np.diag([1, 1, np.linalg.det(vt.T @ u.T)]) @ u.T
    return float(np.linalg.norm(rotation_vector(rotation.T @ asked)))
