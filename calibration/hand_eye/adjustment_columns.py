"""Residuals of the joint adjustment and their derivatives by every parameter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.problem import Problem, Seen
from calibration.projection import projected_with_jacobians
from calibration.rotations import rotation_matrix, skew
from surfclass.kinematics import forward_kinematics
from surfclass.types import Float64

_BEHIND_M = 1e-3  # a point nearer than this, or behind the camera, is projected from here


@dataclass(frozen=True, slots=True)
class Free:
    """Which parameters are estimated beside the hand-eye transform.

    Attributes:
        scale: One factor on the target's size.
        joints: Of the joint offsets, which (0…5).
        flange_offset: The last D-H length.
        intrinsics: How many of fx fy cx cy k1 k2 p1 p2 k3, from the first.
        deviations: Whether each pose of the arm may deviate from its read-out.
    """

    scale: bool = False
    joints: tuple[int, ...] = ()
    flange_offset: bool = False
    intrinsics: int = 0
    deviations: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """The parameters' values.

    Attributes:
        x: (4, 4) `flange_T_camera` (eye_in_hand) or `base_T_camera` (eye_to_hand).
        y: (4, 4) `base_T_target` (eye_in_hand) or `flange_T_target` (eye_to_hand).
        target: (k, 3) m, the target's points.
        intrinsics: (9,) fx fy cx cy k1 k2 p1 p2 k3; zeros without pixels.
        deviation: (n, 6) of each pose: of its joints (rad), or a twist of its flange.
        scale: Of the target.
        offsets: (6,) rad, of the joints.
        flange_offset_m: What is added to the last D-H length.
    """

    x: Float64
    y: Float64
    target: Float64
    intrinsics: Float64
    deviation: Float64
    scale: float
    offsets: Float64
    flange_offset_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where each kind of parameter stands in the vector of the global ones; an empty slice if it is fixed.

    The target is either one rigid body with a pose (`y`) or, if its shape is no better known than the
    probed points, free points.
    """

    size: int
    x: slice
    y: slice
    target: slice
    scale: slice
    joints: slice
    flange_offset: slice
    intrinsics: slice


def layout(problem: Problem, free: Free) -> Layout:
    """Returns the places of the global parameters."""
    points = problem.shape_from_probing
    sizes = (
        6,
        0 if points else 6,
        3 * len(problem.target) if points else 0,
        int(free.scale and not points),
        len(free.joints),
        int(free.flange_offset),
        free.intrinsics,
    )
    ends = np.cumsum(sizes).tolist()
    return Layout(ends[-1], *(slice(end - size, end) for size, end in zip(sizes, ends, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Residuals of one kind of measurement (measured minus predicted) and their derivatives.

    Attributes:
        residual: (n, r).
        by_global: (n, r, g) of the prediction.
        by_deviation: (n, r, 6) of the prediction, by its own pose's deviation.
        pose: (n,).
        sd: (n,) relative.
    """

    residual: Float64
    by_global: Float64
    by_deviation: Float64
    pose: NDArray[np.intp]
    sd: Float64


def pixels_of(points: Float64, intrinsics: Float64) -> tuple[Float64, Float64, Float64]:
    """Returns `projected_with_jacobians` of points (n, 3), those behind the camera drawn before it."""
    before = points.copy()
    before[:, 2] = np.maximum(before[:, 2], _BEHIND_M)
    return projected_with_jacobians(before, intrinsics)


def flange_poses(problem: Problem, state: State) -> Float64:
    """Returns (n, 4, 4) `base_T_flange` as read, with joint offsets and flange offset, but no deviations."""
    if problem.q is None or not (state.offsets.any() or state.flange_offset_m):
        return problem.flange
    length = problem.flange_offset_m + state.flange_offset_m
    return np.stack([forward_kinematics(q + state.offsets, length).matrix for q in problem.q])


def twists(problem: Problem, deviation: Float64) -> Float64:
    """Returns (n, 6) the flange's twists by the poses' deviations."""
    if problem.jacobian is None:
        return deviation
    flange: Float64 = np.einsum("nij,nj->ni", problem.jacobian, deviation)
    return flange


def camera_points(
    problem: Problem, state: State, free: Free, seen: Seen, places: Layout
) -> tuple[Float64, Float64, Float64]:
    """Returns where the points should be in the camera's frame, and the derivatives.

    The deviated flange is `base_T_flange @ exp(twist)`; `x` and `y` turn and shift in their own source
    frames, `x @ exp(step)`.

    Returns:
        (n, 3) m; by the global parameters (n, 3, g); by the deviation of the pose (n, 3, 6).
    """
    twist = twists(problem, state.deviation)
    flange = flange_poses(problem, state)
    turn, shift = rotation_matrix(twist[:, :3]), twist[:, 3:]
    rotation = flange[:, :3, :3] @ turn
    translation = flange[:, :3, 3] + np.einsum("nij,nj->ni", flange[:, :3, :3], shift)
    x_rotation, pose = state.x[:3, :3], seen.pose
    local = state.target[seen.point] * state.scale
    fixed = local @ state.y[:3, :3].T + state.y[:3, 3]
    by_twist = np.empty((len(pose), 3, 6))
    if problem.in_hand:  # camera ← flange ← base ← target
        held = np.einsum("nji,nj->ni", rotation[pose], fixed - translation[pose])
        point = (held - state.x[:3, 3]) @ x_rotation
        by_fixed = np.einsum("ji,nkj->nik", x_rotation, rotation[pose])
        by_twist[:, :, :3] = np.einsum("ji,njk->nik", x_rotation, skew(held))
        by_twist[:, :, 3:] = -x_rotation.T
    else:  # camera ← base ← flange ← target
        held = np.einsum("nij,nj->ni", rotation[pose], fixed) + translation[pose]
        point = (held - state.x[:3, 3]) @ x_rotation
        by_fixed = np.einsum("ji,njk->nik", x_rotation, rotation[pose])
        by_twist[:, :, :3] = -by_fixed @ skew(fixed)
        by_twist[:, :, 3:] = by_fixed
    columns = np.zeros((len(pose), 3, places.size))
    columns[:, :, places.x] = np.concatenate(
        [skew(point), np.broadcast_to(-np.eye(3), (len(pose), 3, 3))], axis=2
    )
    by_local = by_fixed @ state.y[:3, :3]
    if places.y.stop > places.y.start:
        columns[:, :, places.y] = np.concatenate([-by_local @ skew(local), by_local], axis=2)
    if places.target.stop > places.target.start:
        numbers = np.arange(len(pose))[:, None, None]
        where = places.target.start + 3 * seen.point[:, None, None] + np.arange(3)
        columns[numbers, np.arange(3)[:, None], where] = by_local * state.scale
    if free.scale and places.scale.stop > places.scale.start:
        columns[:, :, places.scale.start] = np.einsum("nij,nj->ni", by_local, state.target[seen.point])
    if problem.jacobian is not None:
        by_joints = by_twist @ problem.jacobian[pose]
        columns[:, :, places.joints] = by_joints[:, :, list(free.joints)]
        if free.flange_offset:
            columns[:, :, places.flange_offset.start] = by_twist[:, :, 5]
        return point, columns, by_joints
    return point, columns, by_twist


def pixel_rows(problem: Problem, state: State, free: Free, places: Layout) -> Rows:
    """Returns the pixels' residuals, px."""
    seen = problem.pixels
    point, by_global, by_deviation = camera_points(problem, state, free, seen, places)
    pixel, by_point, by_intrinsics = pixels_of(point, state.intrinsics)
    columns = by_point @ by_global
    columns[:, :, places.intrinsics] = by_intrinsics[:, :, : free.intrinsics]
    return Rows(seen.value - pixel, columns, by_point @ by_deviation, seen.pose, seen.sd)


def position_rows(problem: Problem, state: State, free: Free, places: Layout) -> Rows:
    """Returns the positions' residuals, m: two across the ray and one along it."""
    seen = problem.positions
    point, by_global, by_deviation = camera_points(problem, state, free, seen, places)
    turned = problem.rays
    residual = np.einsum("nij,nj->ni", turned, seen.value - point)
    return Rows(residual, turned @ by_global, turned @ by_deviation, seen.pose, seen.sd)


def probed_rows(problem: Problem, state: State, places: Layout) -> tuple[Float64, Float64]:
    """Returns the probed points' residuals (j, 3), m, and their derivatives (j, 3, g)."""
    local = state.target[problem.probed]
    residual = problem.fixed - local @ state.y[:3, :3].T - state.y[:3, 3]
    columns = np.zeros((len(local), 3, places.size))
    if places.y.stop > places.y.start:
        turn = -state.y[:3, :3] @ skew(local)
        columns[:, :, places.y] = np.concatenate(
            [turn, np.broadcast_to(state.y[:3, :3], (len(local), 3, 3))], axis=2
        )
    for number, point in enumerate(problem.probed if places.target.stop > places.target.start else ()):
        start = places.target.start + 3 * int(point)
        columns[number, :, start : start + 3] = state.y[:3, :3]
    return residual, columns


def moved(state: State, free: Free, places: Layout, step: Float64, deviation: Float64) -> State:
    """Returns the parameters after a step (g,) of the global ones, with the poses' new deviations."""
    offsets = state.offsets.copy()
    offsets[list(free.joints)] += step[places.joints]
    intrinsics = state.intrinsics.copy()
    intrinsics[: free.intrinsics] += step[places.intrinsics]
    return replace(
        state,
        x=_stepped(state.x, step[places.x]),
        y=_stepped(state.y, step[places.y]) if places.y.stop > places.y.start else state.y,
        target=state.target + step[places.target].reshape(-1, 3)
        if places.target.stop > places.target.start
        else state.target,
        scale=state.scale + float(step[places.scale].sum()),
        offsets=offsets,
        flange_offset_m=state.flange_offset_m + float(step[places.flange_offset].sum()),
        intrinsics=intrinsics,
        deviation=deviation,
    )


def _stepped(matrix: Float64, six: Float64) -> Float64:
    result = matrix.copy()
    result[:3, :3] = matrix[:3, :3] @ rotation_matrix(six[:3])
    result[:3, 3] += matrix[:3, :3] @ six[3:]
    u, _, vt = np.linalg.svd(result[:3, :3])  # rounding must not add up over many steps
    result[:3, :3] = u @ vt
    return result
