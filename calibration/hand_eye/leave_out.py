"""Leaving out one pose at a time: how well the rest predicts it, and how much the answer moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.hand_eye.adjustment import Fit, adjust, deviations_of
from calibration.hand_eye.adjustment_columns import Free, State, layout, pixel_rows, position_rows, twists
from calibration.hand_eye.normal_equations import Noise
from calibration.hand_eye.problem import Problem
from calibration.resampling import jackknife_covariance
from calibration.rotations import difference, six_of
from surfclass.types import Bool, Float64, Transform

_FREE = Noise(turn=10.0, shift=10.0)
_GONE = 0.1  # of a robust weight: a point below it is a mistake, and no figure counts it


@dataclass(frozen=True, slots=True, eq=False)
class Misses:
    """How far the measurements are from what the arm's poses as read predict.

    Attributes:
        pixel: (n,) px, of each seen pixel, the length.
        position: (m,) m, of each measured position likewise.
    """

    pixel: Float64
    position: Float64


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """What leaving out each pose tells.

    Attributes:
        misses: Each pose predicted by the others.
        deviation: (n, 6) of each pose, as its own points show it: a twist of the flange.
        surprise: (n,) mean square of each pose's deviation in standard deviations.
        covariance: (6, 6) jackknife, of the hand-eye transform: rotation (rad) in the camera's frame, then
            translation (m); what probed points add is added.
        parameters: (g, g) likewise of all global parameters in their places, the two poses as six numbers.
    """

    misses: Misses
    deviation: Float64
    surprise: Float64
    covariance: Float64
    parameters: Float64


def misses_of(problem: Problem, state: State, deviated: bool = False) -> Misses:
    """Returns the misses of a solution; `deviated`: from where the poses of the arm were found to be."""
    free, places = Free(), layout(problem, Free())
    told = state if deviated else replace(state, deviation=0 * state.deviation)
    pixel, position = np.zeros(0), np.zeros(0)
    if len(problem.pixels.pose):
        pixel = np.linalg.norm(pixel_rows(problem, told, free, places).residual, axis=1)
    if len(problem.positions.pose):
        position = np.linalg.norm(position_rows(problem, told, free, places).residual, axis=1)
    return Misses(pixel, position)


def left_out(problem: Problem, fit: Fit) -> LeftOut:
    """Returns what the poses that a fit used say of each other, and of those that it did not use.

    Args:
        problem: The observations.
        fit: Of all poses that count. A pose that it left out is predicted by all that it used.
    """
    pixel, position = np.zeros(len(problem.pixels.pose)), np.zeros(len(problem.positions.pose))
    deviation, surprise = np.zeros((problem.poses, 6)), np.zeros(problem.poses)
    sd = fit.noise.deviation(problem.jacobian is not None)
    # Points that are mistakes by themselves say nothing of their pose.
    weights = whole_points(fit)
    x, parameters = [], []
    for pose in range(problem.poses):
        without = fit
        if fit.keep[pose]:
            keep = fit.keep.copy()
            keep[pose] = False
            without = adjust(problem, fit.state, fit.free, fit.noise, keep)
            x.append(difference(Transform("a", "b", without.state.x), Transform("a", "b", fit.state.x)))
            parameters.append(_vector(without))
        predicted = misses_of(problem, without.state)
        pixel[problem.pixels.pose == pose] = predicted.pixel[problem.pixels.pose == pose]
        position[problem.positions.pose == pose] = predicted.position[problem.positions.pose == pose]
        own = deviations_of(problem, without.state, fit.noise, weights)
        surprise[pose] = np.mean((own[pose] / sd) ** 2)
        if not fit.keep[pose]:  # one that is wrong is not held back by how good the others are
            own = deviations_of(problem, without.state, _FREE, weights)
        deviation[pose] = twists(problem, own)[pose]
    return LeftOut(
        Misses(pixel, position),
        deviation,
        surprise,
        jackknife_covariance(np.array(x)) + in_outer_frame(fit, fit.probed_share),
        jackknife_covariance(np.array(parameters)) + fit.probed_share,
    )


def whole_points(fit: Fit) -> tuple[Float64, Float64]:
    """Returns weights of the pixels and of the positions: 1, or 0 for those that are mistakes."""
    pixel, position = (~mistakes(weight) for weight in (fit.pixel_weight, fit.position_weight))
    return pixel.astype(np.float64), position.astype(np.float64)


def mistakes(weight: Float64) -> Bool:
    """Returns which points are mistakes by their robust weights; a pose that was left out has none."""
    return (weight > 0) & (weight < _GONE)


def in_outer_frame(fit: Fit, covariance: Float64) -> Float64:
    """Returns the (6, 6) covariance of the hand-eye transform with its translation in the outer frame.

    The adjustment turns and shifts in the camera's own frame; people read the translation in the frame
    that the camera is fixed to.
    """
    turn = np.eye(6)
    turn[3:, 3:] = fit.state.x[:3, :3]
    result: Float64 = turn @ covariance[:6, :6] @ turn.T
    return result


def _vector(fit: Fit) -> Float64:
    """The values of the global parameters in their places; the two poses as six numbers."""
    state, places = fit.state, fit.places
    vector = np.zeros(places.size)
    vector[places.x] = six_of(Transform("a", "b", state.x))
    if places.y.stop > places.y.start:
        vector[places.y] = six_of(Transform("a", "b", state.y))
    if places.target.stop > places.target.start:
        vector[places.target] = state.target.ravel()
    vector[places.scale] = state.scale
    vector[places.joints] = state.offsets[list(fit.free.joints)]
    vector[places.flange_offset] = state.flange_offset_m
    vector[places.intrinsics] = state.intrinsics[: fit.free.intrinsics]
    return vector
