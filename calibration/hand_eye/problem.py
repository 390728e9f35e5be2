"""The observations as arrays in an order that does not depend on the file's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.observations import Observations, View
from calibration.hand_eye.single_pose import align
from calibration.projection import projected
from surfclass.errors import InputError
from surfclass.kinematics import flange_jacobian, forward_kinematics, pose_difference
from surfclass.types import Bool, Float64

_SAME_SHAPE_M = 1e-6  # nearer than this, the target's own coordinates came from the probing
_NEW_ACROSS_PX = 0.01  # nearer to its pixel's ray than this, a position says nothing new across it


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One kind of measurement, sorted by pose, then by point.

    Attributes:
        pose: (n,) index of the view in canonical order.
        point: (n,) index into `Problem.target`.
        value: (n, 2) px or (n, 3) m in the camera's frame.
        sd: (n,) in the middle one's.
    """

    pose: NDArray[np.intp]
    point: NDArray[np.intp]
    value: Float64
    sd: Float64


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What the joint adjustment works on.

    Attributes:
        in_hand: Whether the camera is on the flange.
        flange: (n, 4, 4) `base_T_flange` in canonical order.
        q: (n, 6) rad, where every view has its joint angles and the arm's model agrees, else None.
        jacobian: (n, 6, 6) of the flange's twist in its own frame (rotation, then translation), with q.
        flange_offset_m: The last D-H length that `q` was read with.
        target: (k, 3) the target's points, sorted.
        pixels: Seen in the image.
        positions: Measured in space.
        rays: (m, 3, 3) for each position: rows across, across, along its ray.
        new_across: (m,) bool: whether a position says something across its ray that its pixel does not.
        probed: Index into `target`, (j,) where points are known in the frame the target is fixed in.
        fixed: (j, 3) where.
        fixed_sd: (j,) m.
        shape_from_probing: Whether the target's own shape is no better known than the probed points.
        order: (n,) of the observations' views, the canonical order: `flange[i]` is view `order[i]`.
        sizeless: Whether the points stand for known poses of the target.
    """

    in_hand: bool
    flange: Float64
    q: Float64 | None
    jacobian: Float64 | None
    flange_offset_m: float
    target: Float64
    pixels: Seen
    positions: Seen
    rays: Float64
    new_across: Bool
    probed: NDArray[np.intp]
    fixed: Float64
    fixed_sd: Float64
    shape_from_probing: bool
    order: NDArray[np.intp]
    sizeless: bool

    @property
    def poses(self) -> int:
        """How many."""
        return len(self.flange)


def problem_of(seen: Observations, flange_offset_m: float) -> Problem:
    """Returns the observations as arrays; any order of poses and points gives the same ones.

    Args:
        seen: The observations.
        flange_offset_m: The last D-H length that joint angles are to be read with.

    Raises:
        InputError: If no view has a point.
    """
    views = seen.views
    order = np.array(sorted(range(len(views)), key=lambda number: _key(views[number])), np.intp)
    ordered = [views[number] for number in order]
    parts = [part.target_m for view in ordered for part in (view.pixels, view.positions)]
    if seen.probed is not None:
        parts.append(seen.probed.target_m)
    everything = np.concatenate(parts)
    if not any(view.count for view in ordered):
        raise InputError("hand-eye: no view shows a point of the target")
    target = np.unique(everything, axis=0)
    index = {tuple(row): number for number, row in enumerate(target)}
    pixels = _gathered(
        [(view.pixels.target_m, view.pixels.pixel, view.pixels.sd_px) for view in ordered], index, 2
    )
    places = [(view.positions.target_m, view.positions.camera_m, view.positions.sd_m) for view in ordered]
    positions = _gathered(places, index, 3)
    q, jacobian = _arm(ordered, flange_offset_m)
    probed, fixed, fixed_sd = np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros(0)
    if seen.probed is not None:
        which = np.array([index[tuple(row)] for row in seen.probed.target_m], np.intp)
        by_point = np.argsort(which)
        probed, fixed, fixed_sd = which[by_point], seen.probed.fixed_m[by_point], seen.probed.sd_m[by_point]
    return Problem(
        in_hand=seen.mounting == "eye_in_hand",
        flange=np.stack([view.base_T_flange.matrix for view in ordered]),
        q=q,
        jacobian=jacobian,
        flange_offset_m=flange_offset_m,
        target=target,
        pixels=pixels,
        positions=positions,
        rays=ray_frames(positions.value),
        new_across=_new_across(seen, pixels, positions),
        probed=probed,
        fixed=fixed,
        fixed_sd=fixed_sd,
        shape_from_probing=_same_shape(target[probed], fixed),
        order=order,
        sizeless=all(view.sizeless for view in views),
    )


def ray_frames(points: NDArray[Any]) -> Float64:
    """Returns (n, 3, 3) whose rows are two unit vectors across the ray to each point, and one along it."""
    along = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    helper = np.where(np.abs(along[:, :1]) < 0.9, [[1.0, 0, 0]], [[0.0, 1, 0]])
    first = np.cross(along, helper)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    return np.stack([first, np.cross(along, first), along], axis=1)


def _key(view: View) -> tuple[Any, ...]:
    """Sorts by what was measured, never by name or place in the file."""
    parts = [view.base_T_flange.matrix.ravel()]
    for target, value in (
        (view.pixels.target_m, view.pixels.pixel),
        (view.positions.target_m, view.positions.camera_m),
    ):
        rows = np.concatenate([target, value], axis=1)
        parts.append(rows[np.lexsort(rows.T[::-1])].ravel())
    return tuple(np.concatenate(parts).tolist())


def _gathered(
    views: list[tuple[Float64, Float64, Float64]], index: dict[tuple[float, ...], int], width: int
) -> Seen:
    poses, points, values, sds = [], [], [np.zeros((0, width))], [np.zeros(0)]
    for number, (target, value, sd) in enumerate(views):
        which = np.array([index[tuple(row)] for row in target], np.intp)
        order = np.lexsort((*value.T[::-1], which))
        poses.append(np.full(len(which), number, np.intp))
        points.append(which[order])
        values.append(value[order])
        sds.append(sd[order])
    sd = np.concatenate(sds)
    level = float(np.median(sd)) if len(sd) else 1.0
    return Seen(np.concatenate(poses), np.concatenate(points), np.concatenate(values), sd / level)


def _arm(views: list[View], flange_offset_m: float) -> tuple[Float64 | None, Float64 | None]:
    """The joint angles and the arm's Jacobians, where the arm is the one whose model is here."""
    if any(view.q is None for view in views):
        return None, None
    q = np.stack([view.q for view in views if view.q is not None])
    for view, angles in zip(views, q, strict=True):
        away, turn = pose_difference(view.base_T_flange, forward_kinematics(angles, flange_offset_m))
        if away > 1e-4 or turn > 1e-4:
            return None, None
    return q, np.stack([flange_jacobian(angles, flange_offset_m) for angles in q])


def _same_shape(target: Float64, fixed: Float64) -> bool:
    if len(target) < 3:
        return len(target) > 0
    try:
        moved = align(target, fixed, "fixed", "target") @ target
    except InputError:  # on a line
        return bool(np.abs(np.diff(target, axis=0) - np.diff(fixed, axis=0)).max() < _SAME_SHAPE_M)
    return bool(np.abs(moved - fixed).max() < _SAME_SHAPE_M)


def _new_across(seen: Observations, pixels: Seen, positions: Seen) -> Bool:
    """False where a position is its own pixel's ray at some depth: across it, it would count twice."""
    new = np.ones(len(positions.pose), np.bool_)
    if seen.intrinsics is None or not len(pixels.pose):
        return new
    shown = {key: number for number, key in enumerate(zip(pixels.pose, pixels.point, strict=True))}
    partner = [shown.get(key, -1) for key in zip(positions.pose, positions.point, strict=True)]
    both = np.array(partner, np.intp)
    pairs = both >= 0
    if pairs.any():
        pixel = projected(positions.value[pairs], seen.intrinsics.vector)
        new[pairs] = np.linalg.norm(pixel - pixels.value[both[pairs]], axis=1) > _NEW_ACROSS_PX
    return new
