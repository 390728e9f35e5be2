"""What leaving out one view changes: uncertainties from the data themselves, and held-out errors."""

from __future__ import annotations

import numpy as np

from calibration.cameras.adjustment import Adjustment, State, resected, residuals, rms_px
from calibration.cameras.observations import Observations
from calibration.projection import moved
from calibration.resampling import jackknife_covariance
from surfclass.types import Float64


def left_out(adjustment: Adjustment) -> Float64:
    """Returns (views, s) how what is shared changes when one view is left out.

    One step of Newton's method from the whole fit, which is right to first order of the change; a fit
    anew for each view would cost as many adjustments.
    """
    whole = adjustment.information.sum(axis=0)
    rest = whole - adjustment.information
    pairs = zip(rest, adjustment.pull, strict=True)
    return np.array([-np.linalg.lstsq(matrix, pull, rcond=None)[0] for matrix, pull in pairs])


def jackknife(adjustment: Adjustment) -> Float64:
    """Returns the covariance (s, s) of what is shared by leaving out each view once.

    Corners of one view err together (the board's shape, speckle, what the lens model lacks), so that
    the formal covariance is too small.
    """
    return jackknife_covariance(left_out(adjustment))


def held_out_rms(observations: Observations, adjustment: Adjustment) -> Float64:
    """Returns (views,) px, each view's rms with cameras that were adjusted without it.

    Only the board's pose is adjusted to the view; both cameras must agree on that.
    """
    free = adjustment.free
    count = int(free.sum())
    errors = np.zeros(len(observations.views))
    for index, change in enumerate(left_out(adjustment)):
        parameters = adjustment.state.parameters.copy()
        parameters[free] += change[:count]
        to_camera = adjustment.state.to_camera.copy()
        to_camera[1:] = moved(to_camera[1:], change[count:].reshape(-1, 6))
        own = observations.of_views([index])
        state = State(parameters, to_camera, adjustment.state.poses[[index]])
        errors[index] = rms_px(residuals(own, resected(own, state, adjustment.noise_px)))
    return errors
