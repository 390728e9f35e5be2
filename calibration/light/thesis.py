"""The thesis' way beside the full model: the light from each board alone, and the polynomial of Eq. 4.4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.light.highlight import locate_light
from calibration.light.samples import linearised
from calibration.light.thresholds import thresholds
from calibration.source import Source
from surfclass.colour import as_fraction
from surfclass.errors import InputError, MissingCalibrationError
from surfclass.pipeline import lit_image
from surfclass.rig import Rig
from surfclass.training import fit_response
from surfclass.types import Float64
from surfclass.viewing import view_surface

_SQUARE = (1.0, 0.0, 0.0)  # the polynomial of a linear camera


@dataclass(frozen=True, slots=True, eq=False)
class ThesisLight:
    """What Eq. 4.5–4.10, corrected, make of each board.

    Attributes:
        positions: By board: (3,) m, in `rgb`.
        spreads: By board: the relative spread that Eq. 4.8 minimised.
        tau: By board: τ_s and τ_d that were found in the image.
        failed: By board: why it gave none.
        linear: Whether intensities were made linear first, for want of the polynomial.
    """

    positions: dict[str, Float64]
    spreads: dict[str, float]
    tau: dict[str, tuple[float, float]]
    failed: dict[str, str]
    linear: bool

    @property
    def mean(self) -> Float64 | None:
        """(3,) m, of the boards; None where none gave a position."""
        return np.mean(list(self.positions.values()), axis=0) if self.positions else None

    @property
    def scatter(self) -> Float64 | None:
        """(3,) m, standard deviation between the boards; None for fewer than two."""
        if len(self.positions) < 2:
            return None
        return np.asarray(np.std(list(self.positions.values()), axis=0, ddof=1))


def locate_by_each_board(source: Source, rig: Rig, inverse: Float64) -> ThesisLight:
    """Returns the light as the thesis' method has it, board by board.

    Args:
        source: Its `light` captures.
        rig: Cameras, `rgb_T_depth`; with `response.a2_a1_a0` intensities are used as they are.
        inverse: (3, s) g⁻¹, for rigs without that polynomial.
    """
    polynomial = None if rig.response is None else rig.response.a2_a1_a0
    found = ThesisLight({}, {}, {}, {}, polynomial is None)
    for capture in source.captures("light"):
        view = view_surface(capture.depth.depth_mm, rig)
        try:
            if polynomial is None and capture.colour is not None:
                grey = linearised(capture.colour.rgb, inverse).mean(axis=2)
                coefficients = _SQUARE
            else:
                grey = as_fraction(lit_image(capture, rig)).mean(axis=0)
                coefficients = _mean(polynomial)
            search = thresholds(grey, view.has_point)
            one = locate_light(grey, view, rig.rgb, coefficients, search)
        except (InputError, MissingCalibrationError) as error:
            found.failed[capture.name] = str(error)
            continue
        found.positions[capture.name] = one.position_rgb_m
        found.spreads[capture.name] = one.relative_spread
        found.tau[capture.name] = search.specular_above, search.diffuse_below
    return found


def polynomial_with(source: Source, rig: Rig) -> Float64 | None:
    """Returns Eq. 4.4's coefficients (3, 3) of the `response` captures, or None where they give none."""
    try:
        return fit_response(source.captures("response"), rig)
    except (InputError, MissingCalibrationError):
        return None


def _mean(polynomial: tuple[tuple[float, float, float], ...] | None) -> tuple[float, float, float]:
    rows = np.array(polynomial if polynomial is not None else [_SQUARE], np.float64).mean(axis=0)
    return float(rows[0]), float(rows[1]), float(rows[2])
