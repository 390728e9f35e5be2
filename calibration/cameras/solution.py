"""From corners to cameras: guess, choose the distortion model, adjust, and leave out what does not fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.cameras.adjustment import Adjustment, State, adjust, corner_noise
from calibration.cameras.boards import Board
from calibration.cameras.initial import free_parameters, guess, joined
from calibration.cameras.observations import Observations
from calibration.cameras.resampling import jackknife
from calibration.projection import PARAMETERS
from surfclass.types import Bool, Float64

ORDERS = (0, 1, 2, 4, 5)
_OUTLIER = 6.0  # standard deviations: one corner in 10⁷ of a Gaussian
_OUTLYING_VIEW = 4.0  # times the median view's median residual, each camera's by its noise
_LEAST_OUTLIER_PX = 0.3
_SIGNIFICANT = 2.5  # standard deviations, by leaving out views
_SMALLEST = 2  # no lens is without k1 and k2, and a small one that is left out bends the focal length
_LEAST_VIEWS = 5  # to tell significance from


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The cameras, and what they were found from.

    Attributes:
        observations: The corners that were kept.
        adjustment: Of all cameras together.
        orders: Each camera's distortion model.
        outlier_corners: View, camera and corner, and how many pixels it was off.
        outlier_views: Names of the views that were left out, and their rms in px.
    """

    observations: Observations
    adjustment: Adjustment
    orders: tuple[int, ...]
    outlier_corners: tuple[tuple[str, str, int, float], ...]
    outlier_views: Mapping[str, float]


def solve(
    observations: Observations,
    board: Board,
    order: int | None = None,
    fixed: Mapping[str, Float64] | None = None,
) -> Solution:
    """Finds the cameras.

    Args:
        observations: Of one camera or two.
        board: What was looked at.
        order: The distortion model of all cameras; None: each one's is chosen (`chosen_order`).
        fixed: (9,) the whole camera, by name, for those that are not to be adjusted.
    """
    held = fixed or {}
    alone, orders, free = [], [], []
    for index, name in enumerate(observations.cameras):
        own = observations.of_camera(index)
        state = guess(own, held.get(name))
        if name in held:
            orders.append(5)
            free.append(np.zeros(len(PARAMETERS), bool))
        else:
            picked = chosen_order(own, state) if order is None else order
            orders.append(picked)
            free.append(free_parameters(picked))
            state = adjust(own, _within(state, picked), free[-1][None]).state
        alone.append((own, state))
    if len(alone) == 1:
        start = alone[0][1]
    else:
        observations, start = joined(observations, alone, board)
    return _cleaned(observations, start, np.stack(free), tuple(orders))


def chosen_order(observations: Observations, start: State) -> int:
    """Returns the smallest distortion model that lacks nothing the data show.

    From the largest on, the last parameters are dropped while none of them differs from 0 by more than
    its uncertainty, which leaving out views tells. What the data do not determine would only make the
    others uncertain.

    Args:
        observations: One camera's.
        start: Near enough, with at most k1 and k2.
    """
    if len(observations.views) < _LEAST_VIEWS:
        return _SMALLEST
    state = start
    for order, below in ((5, 4), (4, _SMALLEST)):
        fit = adjust(observations, _within(state, order), free_parameters(order)[None])
        sd = np.sqrt(np.maximum(np.diag(jackknife(fit)), np.diag(fit.covariance)))
        if (np.abs(fit.shared()[4 + below :]) > _SIGNIFICANT * sd[4 + below :]).any():
            return order
        state = fit.state
    return _SMALLEST


def _within(state: State, order: int) -> State:
    parameters = np.where(free_parameters(order), state.parameters, 0)
    return State(parameters, state.to_camera, state.poses)


def _cleaned(observations: Observations, start: State, free: Bool, orders: tuple[int, ...]) -> Solution:
    """Adjusts, leaves out views and then corners that do not fit, and adjusts the rest."""
    fit = adjust(observations, start, free)
    views: dict[str, float] = {}
    noise = corner_noise(observations, fit.residual)
    square = (fit.residual**2).sum(axis=1)
    away = square / noise[observations.camera] ** 2
    own = [observations.view == i for i in range(len(start.poses))]
    rms = np.array([np.sqrt(np.median(away[of])) for of in own])
    bad = rms > _OUTLYING_VIEW * np.median(rms)
    if bad.any() and (~bad).sum() >= 3:
        views = {observations.views[i]: float(np.sqrt(square[own[i]].mean())) for i in np.flatnonzero(bad)}
        kept = np.flatnonzero(~bad)
        observations = observations.of_views(kept.tolist())
        fit = adjust(
            observations, State(fit.state.parameters, fit.state.to_camera, fit.state.poses[kept]), free
        )
    away = np.linalg.norm(fit.residual, axis=1)
    far = away > np.maximum(_OUTLIER * _noise_around(observations, fit.residual), _LEAST_OUTLIER_PX)
    corners = tuple(
        (
            observations.views[observations.view[i]],
            observations.cameras[observations.camera[i]],
            int(observations.corner[i]),
            float(away[i]),
        )
        for i in np.flatnonzero(far)
    )
    if far.any():
        observations = observations.where(~far)
        fit = adjust(observations, fit.state, free)
    return Solution(observations, fit, orders, corners, views)


def _noise_around(observations: Observations, residual: Float64) -> Float64:
    """(n,) each corner's standard deviation: its camera's, or its own image's where that is blurred."""
    noise = corner_noise(observations, residual)[observations.camera]
    for index in range(len(observations.views)):
        own = observations.view == index
        image = corner_noise(observations.where(own), residual[own])
        noise[own] = np.maximum(noise[own], image[observations.camera[own]])
    return noise
