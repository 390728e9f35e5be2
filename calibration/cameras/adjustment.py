"""Bundle adjustment: cameras, where they are to each other, and every pose of the board, in one fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.cameras.observations import Observations
from calibration.projection import PARAMETERS, by_motion, moved, projected_with_jacobians
from surfclass.types import Bool, Float64

_HUBER = 3.0  # standard deviations of a corner, beyond which it counts linearly
_MOST_STEPS = 60
_SETTLED = 1e-10  # relative change of the cost
_LEAST_NOISE_PX = 1e-4
_SCALE_ROUNDS = 3
_P = len(PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What is adjusted.

    Attributes:
        parameters: (cameras, 9), in the order of `PARAMETERS`.
        to_camera: (cameras, 4, 4) `camera_T_first`; the first is the identity.
        poses: (views, 4, 4) `first_T_board`.
    """

    parameters: Float64
    to_camera: Float64
    poses: Float64


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The end of an adjustment.

    Attributes:
        state: What fits best.
        free: (cameras, 9) bool: what was adjusted of the cameras.
        residual: (n, 2) px, found minus computed.
        noise_px: (cameras,) standard deviation of a corner's coordinate.
        covariance: (s, s) formal, of what all views share: the free parameters of the first camera, of
            the second, …, then six numbers (rotation vector, translation) of each further camera.
        information: (views, s, s) what each view adds to its inverse.
        pull: (views, s) where each view would move that; together they are in balance.
    """

    state: State
    free: Bool
    residual: Float64
    noise_px: Float64
    covariance: Float64
    information: Float64
    pull: Float64

    def shared(self) -> Float64:
        """Returns (s,) what all views share, as in `covariance`; the six numbers are 0."""
        return np.concatenate([self.state.parameters[self.free], np.zeros(6 * (len(self.free) - 1))])


def adjust(
    observations: Observations, start: State, free: Bool, *, noise_px: Float64 | None = None
) -> Adjustment:
    """Minimises Huber's loss of the corners' residuals, by Levenberg and Marquardt's method.

    Each view's pose is eliminated (Schur), so that the work grows with the number of views only linearly.
    Each camera's corners are weighted by their noise, found from the residuals themselves unless told.

    Args:
        observations: Corners of one or more cameras.
        start: Near enough.
        free: (cameras, 9) which parameters are adjusted.
        noise_px: (cameras,) standard deviation of a coordinate.
    """
    noise = np.full(len(free), 1.0) if noise_px is None else np.asarray(noise_px, np.float64)
    state = start
    for _ in range(_SCALE_ROUNDS if noise_px is None else 1):
        state = _minimum(observations, state, free, noise)
        if noise_px is None:
            noise = corner_noise(observations, residuals(observations, state))
    equations = _Equations.of(observations, state, free, noise)
    information, pull = equations.reduced_by_view()
    covariance = np.linalg.pinv(information.sum(axis=0), hermitian=True)
    return Adjustment(state, free, equations.residual, noise, covariance, information, pull)


def resected(observations: Observations, start: State, noise_px: Float64) -> State:
    """Returns the state with each view's pose adjusted to its corners; the cameras stay as they are."""
    free = np.zeros((len(start.parameters), _P), bool)
    return _minimum(observations, start, free, np.asarray(noise_px, np.float64), only_poses=True)


def residuals(observations: Observations, state: State) -> Float64:
    """Returns (n, 2) px, found minus computed."""
    points = _in_first(observations, state)
    points = _in_camera(observations, state, points)
    pixels, _, _ = projected_with_jacobians(points, state.parameters[observations.camera])
    return observations.pixel - pixels


def corner_noise(observations: Observations, residual: Float64) -> Float64:
    """Returns (cameras,) the standard deviation of a coordinate, whatever outliers there are."""
    noise = []
    for index in range(len(observations.cameras)):
        own = np.abs(residual[observations.camera == index])
        noise.append(1.4826 * float(np.median(own)) if own.size else 1.0)
    return np.maximum(noise, _LEAST_NOISE_PX)


def rms_px(residual: Float64) -> float:
    """Returns the root mean square of the corners' distances (n, 2), as OpenCV's calibration reports it."""
    return float(np.sqrt((residual**2).sum(axis=1).mean())) if len(residual) else 0.0


def _in_first(observations: Observations, state: State) -> Float64:
    pose = state.poses[observations.view]
    return np.asarray(np.einsum("nij,nj->ni", pose[:, :3, :3], observations.point) + pose[:, :3, 3])


def _in_camera(observations: Observations, state: State, points: Float64) -> Float64:
    place = state.to_camera[observations.camera]
    return np.asarray(np.einsum("nij,nj->ni", place[:, :3, :3], points) + place[:, :3, 3])


def _minimum(
    observations: Observations, start: State, free: Bool, noise: Float64, only_poses: bool = False
) -> State:
    state, damping = start, 1e-4
    equations = _Equations.of(observations, state, free, noise)
    for _ in range(_MOST_STEPS):
        candidate = _stepped(state, free, *equations.solved(damping, only_poses))
        cost = _cost(observations, candidate, noise)
        if not cost < equations.cost:
            damping *= 8
            if damping > 1e10:
                break
            continue
        settled = equations.cost - cost <= _SETTLED * equations.cost
        state, damping = candidate, damping / 5
        if settled:
            break
        equations = _Equations.of(observations, state, free, noise)
    return state


def _stepped(state: State, free: Bool, shared: Float64, poses: Float64) -> State:
    parameters = state.parameters.copy()
    count = int(free.sum())
    parameters[free] += shared[:count]
    to_camera = state.to_camera.copy()
    to_camera[1:] = moved(to_camera[1:], shared[count:].reshape(-1, 6))
    return replace(state, parameters=parameters, to_camera=to_camera, poses=moved(state.poses, poses))


def _cost(observations: Observations, state: State, noise: Float64) -> float:
    points = _in_camera(observations, state, _in_first(observations, state))
    if not (points[:, 2] > 0).all() or not (state.parameters[:, :2] > 0).all():
        return np.inf
    away = _whitened(observations, residuals(observations, state), noise)
    return float(_huber(away).sum())


def _whitened(observations: Observations, residual: Float64, noise: Float64) -> Float64:
    """(n,) how many standard deviations a corner is off."""
    return np.asarray(np.linalg.norm(residual, axis=1) / noise[observations.camera])


def _huber(away: Float64) -> Float64:
    return np.where(away <= _HUBER, away**2 / 2, _HUBER * away - _HUBER**2 / 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """The normal equations at one state, with a block for what is shared and one for each view's pose.

    Attributes:
        residual: (n, 2) px.
        cost: Huber's.
        shared: (views, s, s) and `shared_right` (views, s), each view's part.
        mixed: (views, s, 6).
        pose: (views, 6, 6) and `pose_right` (views, 6).
    """

    residual: Float64
    cost: float
    shared: Float64
    shared_right: Float64
    mixed: Float64
    pose: Float64
    pose_right: Float64

    @classmethod
    def of(cls, observations: Observations, state: State, free: Bool, noise: Float64) -> _Equations:
        first = _in_first(observations, state)
        points = _in_camera(observations, state, first)
        camera = observations.camera
        pixels, by_point, by_parameters = projected_with_jacobians(points, state.parameters[camera])
        residual = observations.pixel - pixels
        by_pose = by_point @ state.to_camera[camera][:, :3, :3] @ by_motion(first)
        by_place = by_point @ by_motion(points)
        counts = free.sum(axis=1)
        starts = np.concatenate([[0], np.cumsum(counts)])
        total = int(starts[-1])
        by_shared = np.zeros((len(camera), 2, total + 6 * (len(free) - 1)))
        for index in range(len(free)):
            own = camera == index
            by_shared[own, :, starts[index] : starts[index + 1]] = by_parameters[own][:, :, free[index]]
            if index:
                at = total + 6 * (index - 1)
                by_shared[own, :, at : at + 6] = by_place[own]
        away = _whitened(observations, residual, noise)
        weight = np.sqrt(np.minimum(1, _HUBER / np.maximum(away, 1e-12))) / noise[camera]
        s = by_shared * weight[:, None, None]
        v = by_pose * weight[:, None, None]
        r = residual * weight[:, None]
        ends = np.searchsorted(observations.view, np.arange(len(state.poses) + 1))
        blocks = [slice(ends[i], ends[i + 1]) for i in range(len(state.poses))]
        width = s.shape[2]
        rows = [(s[b].reshape(r[b].size, width), v[b].reshape(-1, 6), r[b].reshape(-1)) for b in blocks]
        return cls(
            residual,
            float(_huber(away).sum()),
            np.array([a.T @ a for a, _, _ in rows]),
            np.array([a.T @ c for a, _, c in rows]),
            np.array([a.T @ b for a, b, _ in rows]),
            np.array([b.T @ b for _, b, _ in rows]),
            np.array([b.T @ c for _, b, c in rows]),
        )

    def reduced_by_view(self) -> tuple[Float64, Float64]:
        """What each view says of what is shared, its pose eliminated: (views, s, s) and (views, s)."""
        gain = self.mixed @ np.linalg.inv(_damped(self.pose, 1e-12))
        matrix = self.shared - gain @ np.swapaxes(self.mixed, 1, 2)
        return matrix, self.shared_right - np.einsum("vsk,vk->vs", gain, self.pose_right)

    def solved(self, damping: float, only_poses: bool) -> tuple[Float64, Float64]:
        """Returns the step of what is shared (s,) and of the poses (views, 6)."""
        inverse = np.linalg.inv(_damped(self.pose, max(damping, 1e-12)))
        if only_poses:
            still = np.zeros(self.shared_right.shape[1])
            return still, np.einsum("vij,vj->vi", inverse, self.pose_right)
        gain = self.mixed @ inverse
        whole = _damped(self.shared.sum(axis=0), damping)
        matrix = whole - (gain @ np.swapaxes(self.mixed, 1, 2)).sum(axis=0)
        right = self.shared_right.sum(axis=0) - np.einsum("vsk,vk->s", gain, self.pose_right)
        shared = np.linalg.lstsq(matrix, right, rcond=None)[0]
        poses = np.einsum("vij,vj->vi", inverse, self.pose_right - np.einsum("vsk,s->vk", self.mixed, shared))
        return shared, poses


def _damped(matrices: Float64, damping: float) -> Float64:
    """With Marquardt's scaling of the diagonal; never singular by a block without corners."""
    result = matrices.copy()
    index = np.arange(matrices.shape[-1])
    diagonal = result[..., index, index]
    result[..., index, index] = diagonal * (1 + damping) + np.where(diagonal > 0, 0, 1e-12)
    return result
