"""First guesses for the adjustment: focal lengths from homographies, poses from one view each."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.adjustment import State, adjust
from calibration.cameras.boards import Board, symmetries
from calibration.cameras.observations import Observations
from calibration.projection import PARAMETERS, projected
from calibration.rotations import rotation_vector
from surfclass.types import Bool, Float64

_P = len(PARAMETERS)
_SANE = (0.3, 30.0)  # focal lengths, as multiples of the image's width
_TURN_WEIGHT_M = 0.5  # what a radian weighs against a metre, when relative poses are compared


def free_parameters(order: int) -> Bool:
    """Returns (9,) which parameters a distortion model of that order adjusts.

    0: none; 1: k1; 2: k1, k2; 4: and p1, p2; 5: and k3.
    """
    return np.arange(_P) < 4 + order


def guess(observations: Observations, fixed: Float64 | None = None) -> State:
    """Returns a state near the best one, for one camera.

    Args:
        observations: One camera's; every view has corners.
        fixed: (9,) the camera, if its parameters are not to be guessed.
    """
    parameters = _zhang(observations) if fixed is None else fixed
    state = State(parameters[None], np.eye(4)[None], poses_of(observations, parameters))
    if fixed is not None:
        return state
    for order in (1, 2):
        state = adjust(observations, state, free_parameters(order)[None]).state
    return state


def poses_of(observations: Observations, parameters: Float64) -> Float64:
    """Returns (views, 4, 4) the pose of the board in one known camera, view by view."""
    matrix = np.array([[parameters[0], 0, parameters[2]], [0, parameters[1], parameters[3]], [0, 0, 1]])
    poses = np.tile(np.eye(4), (len(observations.views), 1, 1))
    for index in range(len(observations.views)):
        own = observations.view == index
        poses[index] = _planar_pose(observations.point[own], observations.pixel[own], matrix, parameters)
    return poses


def _planar_pose(points: Float64, pixels: Float64, matrix: Float64, parameters: Float64) -> Float64:
    """The better of the two poses that a flat target leaves."""
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        points, pixels.reshape(-1, 1, 2), matrix, parameters[4:], flags=cv2.SOLVEPNP_IPPE
    )
    best, least = np.eye(4), np.inf
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
        place = points @ pose[:3, :3].T + pose[:3, 3]
        if (place[:, 2] <= 0).any():
            continue
        away = float(((projected(place, parameters) - pixels) ** 2).sum())
        if away < least:
            best, least = pose, away
    return best


def _zhang(observations: Observations) -> Float64:
    """Focal lengths with the principal point in the middle (Zhang 2000); the image's width where none."""
    width, height = observations.sizes[0]
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    rows, right = [], []
    for index in range(len(observations.views)):
        own = observations.view == index
        matrix, _ = cv2.findHomography(observations.point[own][:, :2], observations.pixel[own] - centre)
        if matrix is None:
            continue
        h = matrix / np.linalg.norm(matrix[:, :2])
        # The columns of K⁻¹ H are at right angles and of one length; the unknowns are 1/fx², 1/fy².
        a, b = h[:, 0], h[:, 1]
        rows += [[a[0] * b[0], a[1] * b[1]], [a[0] ** 2 - b[0] ** 2, a[1] ** 2 - b[1] ** 2]]
        right += [-a[2] * b[2], b[2] ** 2 - a[2] ** 2]
    inverse_square, *_ = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)
    focal = np.full(2, float(width))
    if (inverse_square > 0).all():
        focal = 1 / np.sqrt(inverse_square)
        if not ((focal > _SANE[0] * width) & (focal < _SANE[1] * width)).all():
            focal = np.full(2, float(width))
    return np.array([*focal, *centre, *np.zeros(_P - 4)])


def joined(
    observations: Observations, alone: list[tuple[Observations, State]], board: Board
) -> tuple[Observations, State]:
    """Returns a state of two cameras from each one's own, and the corners in an order that agrees.

    Where the colours of the board's squares do not tell its ends apart, the second camera may have
    numbered its corners from the other end. The numbering is chosen under which most views agree on
    where the cameras are to each other.

    Args:
        observations: Of both.
        alone: Each camera's own observations and state.
        board: What was looked at.
    """
    poses = [{name: state.poses[i] for i, name in enumerate(own.views)} for own, state in alone]
    both = [name for name in observations.views if all(name in own for own in poses)]
    turned = [(order, _renumbered(board, order)) for order in symmetries(board)]
    relations = np.array(
        [[poses[1][name] @ turn @ np.linalg.inv(poses[0][name]) for _, turn in turned] for name in both]
    )
    chosen, centre = _consensus(relations)
    corner = observations.corner.copy()
    for name, pick in zip(both, chosen, strict=True):
        own = (observations.view == observations.views.index(name)) & (observations.camera == 1)
        # A corner that was called i is the one that `order` puts at i.
        corner[own] = turned[pick][0][corner[own]]
    points = board.points_m[corner]
    state = State(
        np.concatenate([state.parameters for _, state in alone]),
        np.stack([np.eye(4), centre]),
        np.array(
            [
                poses[0][name] if name in poses[0] else np.linalg.inv(centre) @ poses[1][name]
                for name in observations.views
            ]
        ),
    )
    return replace(observations, corner=corner, point=points), state


def _renumbered(board: Board, order: NDArray[np.int64]) -> Float64:
    """(4, 4) `old_T_new`: the board's frame as it is against where the renumbering puts it."""
    old, new = board.points_m, board.points_m[order]
    # new = R old + t in the plane: from three corners.
    ends = [0, board.columns - 1, len(old) - board.columns]
    x, y = old[ends[1]] - old[ends[0]], old[ends[2]] - old[ends[0]]
    u, v = new[ends[1]] - new[ends[0]], new[ends[2]] - new[ends[0]]
    turn = np.column_stack([u, v, np.cross(u, v)]) @ np.linalg.inv(np.column_stack([x, y, np.cross(x, y)]))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.T, old[0] - turn.T @ new[0]
    return matrix


def _consensus(relations: Float64) -> tuple[list[int], Float64]:
    """Picks one of each view's candidates (views, k, 4, 4) so that they agree, and returns their middle."""
    flat = relations.reshape(-1, 4, 4)
    turn = rotation_vector(np.einsum("aij,bkj->abik", flat[:, :3, :3], flat[:, :3, :3]))
    shift = flat[:, None, :3, 3] - flat[None, :, :3, 3]
    apart = np.linalg.norm(shift, axis=-1) + _TURN_WEIGHT_M * np.linalg.norm(turn, axis=-1)
    by_view = apart.reshape(len(flat), *relations.shape[:2]).min(axis=2)
    best = int(np.median(by_view, axis=1).argmin())
    picks = apart[best].reshape(relations.shape[:2]).argmin(axis=1)
    return picks.tolist(), flat[best]
