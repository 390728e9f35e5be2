"""What of the photometric calibration a recording lacks and its own captures can give."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.light.estimate import LightEstimate, board_views, estimate_light
from calibration.light.fit import PositionPrior
from calibration.light.unknown_response import response_from_distances
from calibration.outcome import Note, RefusedError
from calibration.response.exposures import response_of
from calibration.source import Source
from surfclass.reflectance import lacking_for_full_model
from surfclass.rig import Rig
from surfclass.types import Float64

_KEPT_SD_M = 0.001  # of a position that the rig already has
_AGREES_M = 0.005
"""A position of the rig is kept if the captures contradict it by no more than this and three sd."""


def photometry_from(source: Source, note: Note) -> dict[str, Any]:
    """Returns the keys of `rig.toml` that the full reflectance model lacks, nested as there.

    The response comes from `exposure` captures, or else from the distances of `response` captures; light and
    lens from `light` and `response` captures. A position that the rig has is kept if they agree with it.

    Args:
        source: A recording or a data folder.
        note: Called with a sentence at each step.

    Returns:
        `{}` if nothing is lacking.

    Raises:
        RefusedError: If the captures cannot determine what is lacking.
        MissingCalibrationError: If the rig has no colour camera or no `rgb_T_depth`.
    """
    rig = source.rig.whole()
    if rig.light is not None and not lacking_for_full_model(rig):
        return {}
    values: dict[str, Any] = {}
    inverse, found = known_response(source, rig, note)
    if found:
        values["response"] = found
    if rig.light is None or {"light.axis_rgb", "rgb.vignetting"} & set(lacking_for_full_model(rig)):
        views = board_views(source, rig, inverse, "all", note)
        estimate = estimate_light(views)
        light = rig_values(estimate)
        if rig.light is not None:
            kept = _kept(estimate, np.array(rig.light.position_rgb_m), note)
            if kept is not None:
                light = rig_values(estimate_light(views, kept))
                light["light"]["position_rgb_m"] = list(rig.light.position_rgb_m)
        values |= light
    return values


def known_response(source: Source, rig: Rig, note: Note) -> tuple[Float64, dict[str, Any]]:
    """Returns g⁻¹ (3, s), and the keys of `[response]` that had to be found for it (empty: the rig has it).

    Raises:
        RefusedError: If the rig has none and the captures cannot give it.
    """
    if rig.response is not None and rig.response.inverse is not None:
        level = np.linspace(0, 1, 256)
        curves = [np.interp(level, np.linspace(0, 1, len(one)), one) for one in rig.response.inverse]
        return np.stack(curves), {}
    if source.count("exposure"):
        found = response_of(source.captures("exposure"))
        note(
            f"the rig has no response: found it from the exposure series, to {100 * found.curve_sd:.2f} %, "
            f"a left-out exposure predicted to {100 * found.held_out_rms:.3f} % of full scale"
        )
        return found.inverse, {"inverse": found.inverse.tolist()}
    if source.count("response"):
        weak = response_from_distances(source)
        note(
            "the rig has no response and there is no exposure series: found it from the grey card's "
            f"distances, to {100 * weak.curve_sd:.1f} % only"
        )
        return weak.inverse, {"inverse": weak.inverse.tolist()}
    raise RefusedError(
        "response.inverse is missing in the rig, and there are captures neither of role 'exposure' nor of "
        "role 'response' to find it from; run `surfclass calibrate response` first"
    )


def rig_values(estimate: LightEstimate) -> dict[str, Any]:
    """Returns light and lens as keys of `rig.toml`."""
    found = estimate.fit
    return {
        "light": {
            "position_rgb_m": found.position.tolist(),
            "axis_rgb": found.axis.tolist(),
            "falloff_exponent": found.exponent,
        },
        "rgb": {"vignetting": found.vignetting.tolist()},
    }


def _kept(estimate: LightEstimate, position: Float64, note: Note) -> PositionPrior | None:
    away = float(np.linalg.norm(estimate.fit.position - position))
    allowed = _AGREES_M + 3 * estimate.position_sd
    if away <= allowed:
        note(f"kept the rig's position of the light: the captures have it {1e3 * away:.1f} mm from there")
        return PositionPrior(position, _KEPT_SD_M)
    note(
        f"the captures have the light {1e3 * away:.0f} mm from where the rig has it, and know it to "
        f"{1e3 * estimate.position_sd:.0f} mm: theirs is used"
    )
    return None
