"""The response without an exposure series: together with the light, from a grey card at several distances.

The inverse square says how much more light a near card sends, and so stands for known exposures; but where
the
light is has to be found from the same images. Weak (accuracy of the light: 2 cm), and better than nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.light import near_light
from calibration.light.levenberg import minimise
from calibration.light.near_light import EXPONENT, GLOBAL, POSITION, Observed
from calibration.light.samples import BoardSamples, enough, sample_board, too_bright
from calibration.outcome import RefusedError
from calibration.resampling import jackknife_covariance
from calibration.response.curve import SAMPLES, spline_argument, spline_argument_slope
from calibration.source import Source
from surfclass.rig import Rig
from surfclass.types import Float64

LEAST_VIEWS = 4
_LEAST_DISTANCE_RATIO = 1.3
_BENDS = 2  # coefficients of a curve
_MODEL_ERROR = 0.001
_ROUNDS = 3
_MOST_PLACES = 250  # of a view: the light is not known better by more
_EXPECTED_BEND = np.array([1.5, 0.0])
_BEND_SD = np.array([3.0, 2.0])
_WEAK_SD = np.array([0.5, 0.5, 0.5, 0.3, 0.3, 1.0, 5.0, 20.0, 60.0, 0.5])


@dataclass(frozen=True, slots=True, eq=False)
class DistanceResponse:
    """What a distance series tells.

    Attributes:
        inverse: (3, 256) g⁻¹ at even intensities, rising from 0 to 1.
        relative_sd: (3, 256) of g⁻¹, relative to its value in the middle of what was seen; jackknife over
            views.
        seen: The least and the greatest intensity of the places that were used.
        rms: Of all intensities about the fit, fraction of full scale.
        held_out: By view: rms error of predicting its intensities from the others.
        position: (3,) m, of the light, in `rgb`.
    """

    inverse: Float64
    relative_sd: Float64
    seen: tuple[float, float]
    rms: float
    held_out: dict[str, float]
    position: Float64

    @property
    def curve_sd(self) -> float:
        """The rms relative standard deviation of g⁻¹ between the intensities that were seen."""
        level = np.linspace(0, 1, SAMPLES)
        between = self.relative_sd[:, (level >= self.seen[0]) & (level <= self.seen[1])]
        return float(np.sqrt(np.mean(between**2)))

    @property
    def held_out_rms(self) -> float:
        """Over all views."""
        return float(np.sqrt(np.mean(np.square(list(self.held_out.values())))))


def response_from_distances(source: Source) -> DistanceResponse:
    """Returns the response that `response` captures show.

    Raises:
        RefusedError: If there are too few views of the card, or all from one distance.
    """
    rig = source.rig.whole()
    linear = np.tile(np.linspace(0, 1, SAMPLES), (3, 1))
    views = [sample_board(capture, rig, linear) for capture in source.captures("response")]
    usable = enough(views)
    if len(usable) < LEAST_VIEWS:
        raise RefusedError(
            f"response from distances: {len(usable)} views of the grey card are of use, needed are "
            f"{LEAST_VIEWS}: "
            + (too_bright(views) or "take captures of role 'response' or, better, 'exposure'")
        )
    distances = [abs(view.plane.offset) for view in usable]
    if max(distances) < _LEAST_DISTANCE_RATIO * min(distances):
        raise RefusedError(
            f"response from distances: all views are {min(distances):.2f} to {max(distances):.2f} m away, "
            f"the farthest must be {_LEAST_DISTANCE_RATIO} times as far as the nearest"
        )
    return _solved([_thinned(view) for view in usable], rig)


def _thinned(view: BoardSamples) -> BoardSamples:
    """At most `_MOST_PLACES` of a view's places, spread over it."""
    chosen = np.zeros(len(view.ray), bool)
    chosen[:: max(1, len(view.ray) // _MOST_PLACES)] = True
    return view.of(chosen)


def _solved(views: Sequence[BoardSamples], rig: Rig) -> DistanceResponse:
    observed = Observed.of(views)
    position = np.zeros(3) if rig.light is None else np.array(rig.light.position_rgb_m)
    problem = _Problem(observed, np.ones(len(observed.light)), np.concatenate([view.sd for view in views]))
    whole = problem.solve(problem.start(position))
    levels = np.linspace(0, 1, SAMPLES)
    seen = float(observed.level.min(axis=0).max()), float(observed.level.max(axis=0).min())
    rows, held_out = [], {}
    for view, name in enumerate(observed.names):
        share = (observed.view != view).astype(np.float64)
        part = _Problem(observed, share, problem.level_sd).solve(whole, 1)
        rows.append(part)
        away = problem.intensities(part) - observed.level
        held_out[name] = float(np.sqrt(np.mean(away[observed.view == view] ** 2)))
    left = problem.intensities(whole) - observed.level
    return DistanceResponse(
        np.stack([_inverse(levels, bend) for bend in problem.bends(whole)]),
        _relative_sd(problem, rows, levels, seen),
        seen,
        float(np.sqrt(np.mean(left**2))),
        held_out,
        whole[POSITION],
    )


def _relative_sd(
    problem: _Problem, rows: Sequence[Float64], levels: Float64, seen: tuple[float, float]
) -> Float64:
    middle = np.array(np.sqrt(seen[0] * seen[1]))
    channels = []
    for channel in range(3):
        logs = [
            _log_inverse(levels, bend) - _log_inverse(middle, bend)
            for bend in (problem.bends(row)[channel] for row in rows)
        ]
        channels.append(np.sqrt(np.diag(jackknife_covariance(np.array(logs)))))
    return np.stack(channels)


def _log_inverse(level: NDArray[Any], bend: Float64) -> Float64:
    """Returns ln g⁻¹ of intensities: a power law of the argument, and a bend of it."""
    beyond = spline_argument(level) - 1
    return np.asarray(np.log(np.maximum(level, 1e-9)) + bend[0] * beyond + bend[1] * beyond**2)


def _inverse(levels: Float64, bend: Float64) -> Float64:
    curve = np.exp(_log_inverse(levels, bend))
    curve[0] = 0.0
    rising = np.maximum.accumulate(curve) + 1e-9 * np.arange(len(levels))
    return np.asarray(rising / rising[-1], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """What is left of ln g⁻¹(I) less ln of the light, in three channels: light, lens, ln K_d and bends."""

    observed: Observed
    share: Float64
    level_sd: Float64

    def start(self, position: Float64) -> Float64:
        grey = near_light.starting_point(self.observed, position)
        start = np.concatenate([grey[:GLOBAL], np.full(3, grey[GLOBAL]), np.tile(_EXPECTED_BEND, 3)])
        logs = [np.median(_log_inverse(self.observed.level[:, c], _EXPECTED_BEND)) for c in range(3)]
        sent = np.median(np.log(near_light.geometry_factor(self._grey(start), self.observed)))
        start[GLOBAL : GLOBAL + 3] = np.array(logs) - sent
        return start

    def bends(self, parameters: Float64) -> Float64:
        return parameters[GLOBAL + 3 :].reshape(3, _BENDS)

    def solve(self, start: Float64, rounds: int = _ROUNDS) -> Float64:
        low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
        low[EXPONENT], high[EXPONENT] = 0.0, 30.0
        found = start
        for _ in range(rounds):
            sd = self._sd(found)

            def model(p: Float64, scale: Float64 = sd) -> tuple[Float64, Float64]:
                return self._residual(p, scale)

            found = minimise(model, found, low, high).parameters
        return found

    def intensities(self, parameters: Float64) -> Float64:
        """(n, 3) as the parameters have them."""
        sent = np.log(near_light.geometry_factor(self._grey(parameters), self.observed))
        levels = np.linspace(1e-3, 1, 2000)
        columns = []
        for channel, bend in enumerate(self.bends(parameters)):
            logs = np.maximum.accumulate(_log_inverse(levels, bend))
            columns.append(np.interp(sent + parameters[GLOBAL + channel], logs, levels))
        return np.stack(columns, axis=1)

    def _grey(self, parameters: Float64) -> Float64:
        return np.append(parameters[:GLOBAL], 0.0)

    def _sd(self, parameters: Float64) -> Float64:
        """(n, 3) of ln g⁻¹."""
        level = self.observed.level
        columns = []
        for channel, bend in enumerate(self.bends(parameters)):
            beyond = spline_argument(level[:, channel]) - 1
            slope = 1 / level[:, channel]
            slope += (bend[0] + 2 * bend[1] * beyond) * spline_argument_slope(level[:, channel])
            columns.append(np.hypot(_MODEL_ERROR, slope * self.level_sd[:, channel]))
        return np.stack(columns, axis=1)

    def _residual(self, parameters: Float64, sd: Float64) -> tuple[Float64, Float64]:
        diffuse, _, matrix = near_light.with_jacobian(self._grey(parameters), self.observed)
        by_light = matrix[:, :GLOBAL] / np.maximum(diffuse, 1e-12)[:, None]
        sent = np.log(np.maximum(diffuse, 1e-12))
        residuals, blocks = [], []
        for channel, bend in enumerate(self.bends(parameters)):
            level = self.observed.level[:, channel]
            weight = self.share / sd[:, channel]
            beyond = spline_argument(level) - 1
            away = _log_inverse(level, bend) - sent - parameters[GLOBAL + channel]
            block = np.zeros((len(level), len(parameters)))
            block[:, :GLOBAL] = -by_light
            block[:, GLOBAL + channel] = -1
            first = GLOBAL + 3 + _BENDS * channel
            block[:, first], block[:, first + 1] = beyond, beyond**2
            residuals.append(away * weight)
            blocks.append(block * weight[:, None])
        expected = np.concatenate([near_light.EXPECTED, np.zeros(3), np.tile(_EXPECTED_BEND, 3)])
        spread = np.concatenate([_WEAK_SD, np.full(3, 1e3), np.tile(_BEND_SD, 3)])
        residuals.append((parameters - expected) / spread)
        blocks.append(np.diag(1 / spread))
        return np.concatenate(residuals), np.concatenate(blocks)
