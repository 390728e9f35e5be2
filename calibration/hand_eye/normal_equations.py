"""Normal equations of the joint adjustment: robust, weighted, the poses' deviations eliminated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.adjustment_columns import (
    Free,
    Layout,
    Rows,
    State,
    pixel_rows,
    position_rows,
    probed_rows,
)
from calibration.hand_eye.problem import Problem
from surfclass.types import Bool, Float64

_CAUCHY = 25.0  # square of the Cauchy loss's width, in standard deviations of a single number
_LEAST_SIZE = 0.05  # of a deviation in standard deviations, for its weight in other than Gaussian noise
_NULL = 1e-13  # of the normal matrix's greatest eigenvalue; what lies below is not determined


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations.

    Attributes:
        pixel: px, of each coordinate of a pixel with `sd_px` 1.
        across: m, of a position with `sd_m` 1 across its ray.
        along: m, likewise along it.
        probed: Factor on the probed points' own.
        turn: rad, of an arm's pose about each axis; with joint angles: of each joint.
        shift: m, of an arm's pose along each axis; unused with joint angles.
        shape: Exponent of the deviations' distribution, exp(−|v|^shape): 2 is Gaussian, more has
            lighter tails (Subbotin 1923).
    """

    pixel: float = 0.3
    across: float = 3e-4
    along: float = 1e-3
    probed: float = 1.0
    turn: float = 2e-4
    shift: float = 2e-4
    shape: float = 2.0

    def deviation(self, joints: bool) -> Float64:
        """(6,) of a pose's deviation."""
        return np.array([self.turn] * 6 if joints else [self.turn] * 3 + [self.shift] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of one group of rows.

    Attributes:
        global_: (g, g).
        cross: (n, g, 6) for each pose.
        deviation: (n, 6, 6).
        right_global: (g,).
        right_deviation: (n, 6).
    """

    global_: Float64
    cross: Float64
    deviation: Float64
    right_global: Float64
    right_deviation: Float64

    def __add__(self, other: Normal) -> Normal:
        return Normal(
            self.global_ + other.global_,
            self.cross + other.cross,
            self.deviation + other.deviation,
            self.right_global + other.right_global,
            self.right_deviation + other.right_deviation,
        )


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """The normal equations at one place, and what they were made of.

    Attributes:
        total: Of all groups, weighted by the noise.
        inner: (n, 6, 6) inverses of the deviations' own blocks.
        reduced: (g, g) of the global parameters, the deviations eliminated.
        cost: Weighted robust sum of squares.
        groups: By group, of unit noise.
        squares: Weighted sums of squared residuals, and numbers of rows, by group.
        pixel_weight: (n,) robust weights; `position_weight` likewise.
    """

    total: Normal
    inner: Float64
    reduced: Float64
    cost: float
    groups: dict[str, Normal]
    squares: dict[str, tuple[float, float]]
    pixel_weight: Float64
    position_weight: Float64

    def step(self) -> tuple[Float64, Float64]:
        """Returns the Gauss–Newton step of the global parameters (g,) and of the deviations (n, 6)."""
        total = self.total
        eliminated = np.einsum("ngi,nij,nj->g", total.cross, self.inner, total.right_deviation)
        step = inverse_of(self.reduced) @ (total.right_global - eliminated)
        left = total.right_deviation - np.einsum("ngi,g->ni", total.cross, step)
        return step, np.einsum("nij,nj->ni", self.inner, left)


def system_of(
    problem: Problem,
    state: State,
    free: Free,
    places: Layout,
    noise: Noise,
    keep: Bool,
    weights: tuple[Float64, Float64] | None = None,
) -> System:
    """Returns the normal equations at one place.

    Args:
        problem: The observations.
        state: The place.
        free: What is estimated.
        places: Where it stands.
        noise: What to weight by.
        keep: (n,) poses to use.
        weights: Of the pixels and of the positions, instead of the robust ones.
    """
    poses, size = problem.poses, places.size
    groups: dict[str, Normal] = {}
    squares: dict[str, tuple[float, float]] = {}
    cost = 0.0
    pixel_weight, position_weight = np.zeros(0), np.zeros(0)
    if len(problem.pixels.pose):
        rows = pixel_rows(problem, state, free, places)
        unit = np.ones((len(rows.pose), 2)) / (rows.sd * noise.pixel)[:, None]
        pixel_weight, loss = _robust(rows.residual * unit, unit > 0, keep[rows.pose])
        pixel_weight = pixel_weight if weights is None else weights[0]
        cost += loss
        groups["pixel"], squares["pixel"] = _normal(rows, pixel_weight, np.ones(2, np.bool_), poses)
    if len(problem.positions.pose):
        rows = position_rows(problem, state, free, places)
        used = np.ones((len(rows.pose), 3), np.bool_)
        used[:, :2] = problem.new_across[:, None]
        sd = np.array([noise.across, noise.across, noise.along])
        whitened = rows.residual / (rows.sd[:, None] * sd)
        position_weight, loss = _robust(whitened, used, keep[rows.pose])
        position_weight = position_weight if weights is None else weights[1]
        cost += loss
        across = position_weight * problem.new_across
        groups["across"], squares["across"] = _normal(rows, across, np.array([True, True, False]), poses)
        groups["along"], squares["along"] = _normal(
            rows, position_weight, np.array([False, False, True]), poses
        )
    groups["probed"], squares["probed"] = _probed(problem, state, places)
    cost += squares["probed"][0] / noise.probed**2
    scales = {"pixel": noise.pixel, "across": noise.across, "along": noise.along, "probed": noise.probed}
    total = _nothing(poses, size)
    for name, group in groups.items():
        total = total + _scaled(group, 1 / scales[name] ** 2)
    if not free.deviations:
        total = replace(total, cross=0 * total.cross, right_deviation=0 * total.right_deviation)
    sd = noise.deviation(problem.jacobian is not None)
    size_of = np.abs(state.deviation / sd)
    weight = np.maximum(size_of, _LEAST_SIZE) ** (noise.shape - 2)
    prior = np.eye(6) * (weight / sd**2)[:, None, :]
    inner = np.asarray(np.linalg.inv(total.deviation + prior), np.float64)
    total = replace(total, right_deviation=total.right_deviation - weight * state.deviation / sd**2)
    cost += float(np.sum(2 / noise.shape * size_of**noise.shape))
    reduced: Float64 = total.global_ - np.einsum("ngi,nij,nhj->gh", total.cross, inner, total.cross)
    return System(total, inner, reduced, cost, groups, squares, pixel_weight, position_weight)


def _robust(whitened: Float64, used: Bool, keep: Bool) -> tuple[Float64, float]:
    """Cauchy weights (n,) by the mean square of each point's numbers, and the loss."""
    count = used.sum(axis=1)
    square = np.sum(np.where(used, whitened, 0) ** 2, axis=1) / np.maximum(count, 1)
    weight = np.where(keep, 1 / (1 + square / _CAUCHY), 0.0)
    loss = _CAUCHY * np.log1p(square / _CAUCHY) * count
    return weight, float(np.sum(loss[keep]))


def _normal(rows: Rows, weight: Float64, which: Bool, poses: int) -> tuple[Normal, tuple[float, float]]:
    """The normal equations of some of the columns of each point's residual, by unit noise."""
    root = (np.sqrt(weight) / rows.sd)[:, None]
    residual = rows.residual[:, which] * root
    by_global = rows.by_global[:, which] * root[..., None]
    by_deviation = rows.by_deviation[:, which] * root[..., None]
    size = by_global.shape[2]
    flat, right = by_global.reshape(-1, size), residual.ravel()
    cross, deviation = np.zeros((poses, size, 6)), np.zeros((poses, 6, 6))
    right_deviation = np.zeros((poses, 6))
    for pose, part in enumerate(parts_of(rows.pose, poses)):
        own = by_deviation[part].reshape(-1, 6)
        cross[pose] = by_global[part].reshape(-1, size).T @ own
        deviation[pose] = own.T @ own
        right_deviation[pose] = own.T @ residual[part].ravel()
    count = float(np.sum(weight) * which.sum())
    normal = Normal(flat.T @ flat, cross, deviation, flat.T @ right, right_deviation)
    return normal, (float(right @ right), count)


def _probed(problem: Problem, state: State, places: Layout) -> tuple[Normal, tuple[float, float]]:
    nothing = _nothing(problem.poses, places.size)
    if not len(problem.probed):
        return nothing, (0.0, 0.0)
    residual, columns = probed_rows(problem, state, places)
    right = (residual / problem.fixed_sd[:, None]).ravel()
    rows = (columns / problem.fixed_sd[:, None, None]).reshape(-1, places.size)
    normal = replace(nothing, global_=rows.T @ rows, right_global=rows.T @ right)
    return normal, (float(right @ right), float(len(right)))


def _nothing(poses: int, size: int) -> Normal:
    return Normal(
        np.zeros((size, size)),
        np.zeros((poses, size, 6)),
        np.zeros((poses, 6, 6)),
        np.zeros(size),
        np.zeros((poses, 6)),
    )


def _scaled(normal: Normal, factor: float) -> Normal:
    return Normal(
        factor * normal.global_,
        factor * normal.cross,
        factor * normal.deviation,
        factor * normal.right_global,
        factor * normal.right_deviation,
    )


def inverse_of(matrix: Float64) -> Float64:
    """Returns the inverse over what is determined; parameters are scaled to a unit diagonal first."""
    diagonal = np.sqrt(np.maximum(np.diag(matrix), 0))
    scale = np.where(diagonal > 0, 1 / np.maximum(diagonal, 1e-300), 0.0)
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    kept = values > _NULL * max(float(values[-1]), 1e-300)
    inverse: Float64 = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    inverse *= np.outer(scale, scale)
    return inverse


def parts_of(pose: NDArray[np.intp], poses: int) -> list[slice]:
    """Returns where each pose's rows are, of rows that are sorted by pose."""
    ends = np.searchsorted(pose, np.arange(poses + 1)).tolist()
    return [slice(first, last) for first, last in pairwise(ends)]
