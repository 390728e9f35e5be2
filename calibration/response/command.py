"""`calibrate response`: how the colour camera turns light into intensities, from views of a grey card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from calibration.gates import ResponseGates
from calibration.light.unknown_response import DistanceResponse, response_from_distances
from calibration.outcome import SCHEMA, Figures, Note, Outcome, RefusedError
from calibration.response import pictures
from calibration.response.exposures import ExposureResponse, response_of
from calibration.source import Source
from surfclass.errors import InputError, MissingCalibrationError
from surfclass.training import fit_response
from surfclass.types import Float64


@dataclass(frozen=True, slots=True)
class ResponseOptions:
    """What the response is found from.

    Attributes:
        source: "exposure": the exposure series; "distance": the grey card at several distances, together
            with the light (weak); "auto": the first of the two that is there.
        thesis: Only the polynomial of Eq. 4.4 goes into the rig, not g⁻¹.
    """

    source: Literal["auto", "exposure", "distance"] = "auto"
    thesis: bool = False


Options = ResponseOptions


def calibrate(source: Source, options: ResponseOptions, gates: ResponseGates, note: Note) -> Outcome:
    """Returns the camera's response.

    Raises:
        RefusedError: If the captures cannot determine it.
    """
    exposures = source.count("exposure")
    used = options.source
    if used == "auto":
        used = "exposure" if exposures else "distance"
    if used == "exposure" and not exposures:
        raise RefusedError(
            "there is no capture of role 'exposure'; take one pose of the grey card at 5 or more "
            "exposures, each about twice the one before"
        )
    polynomial, why_not = _polynomial(source)
    if options.thesis:
        return _thesis(polynomial, why_not)
    if used == "exposure":
        note(f"fitting the response to {exposures} exposures")
        found = response_of(source.captures("exposure"))
        outcome = _from_exposures(found, gates)
    else:
        note("no exposure series: fitting response and light together to the grey card's distances")
        outcome = _from_distances(response_from_distances(source), gates)
    return _with_polynomial(outcome, polynomial, why_not)


def _polynomial(source: Source) -> tuple[Float64 | None, str]:
    """Eq. 4.4's coefficients where `response` captures and a known light give them, or why not."""
    if not source.count("response"):
        return None, "there is no capture of role 'response'"
    try:
        return fit_response(source.captures("response"), source.rig.whole()), ""
    except (MissingCalibrationError, InputError) as error:
        return None, str(error)


def _thesis(polynomial: Float64 | None, why_not: str) -> Outcome:
    if polynomial is None:
        raise RefusedError(f"the polynomial of Eq. 4.4 cannot be fitted: {why_not}")
    rows = polynomial.tolist()
    result = {"schema": SCHEMA, "verdict": "pass", "reasons": [], "source": "distance", "a2_a1_a0": rows}
    return Outcome(
        "response",
        "pass",
        (),
        f"polynomial of Eq. 4.4, green: {rows[1][0]:.3f} d² {rows[1][1]:+.3f} d {rows[1][2]:+.3f}; it "
        "holds straight on and at this exposure only",
        result,
        {"response": {"a2_a1_a0": rows}},
    )


def _with_polynomial(outcome: Outcome, polynomial: Float64 | None, why_not: str) -> Outcome:
    rows = None if polynomial is None else polynomial.tolist()
    result = {**outcome.result, "a2_a1_a0": rows}
    if rows is None:
        result["a2_a1_a0_missing"] = why_not
    response: dict[str, Any] = dict(outcome.rig.get("response", {}))
    if rows is not None and response:
        response["a2_a1_a0"] = rows
    return Outcome(
        outcome.kind,
        outcome.verdict,
        outcome.reasons,
        outcome.sentence,
        result,
        {"response": response} if response else {},
        outcome.figures,
        outcome.pictures,
    )


def _from_exposures(found: ExposureResponse, gates: ResponseGates) -> Outcome:
    low, high = found.seen
    reasons = _reasons(found.held_out_rms, found.curve_sd, high - low, gates)
    noise = [None if one is None else (one.read, one.gain, one.full_well_e) for one in found.noise]
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "verdict": "fail" if reasons else "pass",
        "reasons": list(reasons),
        "source": "exposure",
        "inverse": found.inverse.tolist(),
        "inverse_relative_sd": found.relative_sd.tolist(),
        "curve_sd": found.curve_sd,
        "linear": [curve.bend is None for curve in found.curves],
        "dark_level": [curve.dark for curve in found.curves],
        "dark_from": found.dark_from,
        "noise": {
            "unit": "fraction of the irradiance at full scale",
            "read": [None if one is None else one[0] for one in noise],
            "gain": [None if one is None else one[1] for one in noise],
            "full_well_e": [None if one is None else one[2] for one in noise],
        },
        "rms": found.rms,
        "held_out": {"rms": found.held_out_rms, "exposures": found.held_out},
        "seen": [low, high],
        "exposures": _exposures(found),
        "left_out": list(found.series.left_out),
    }
    linear = all(curve.bend is None for curve in found.curves)
    sentence = (
        f"{'linear camera' if linear else 'response'} from "
        f"{sum(e is not None for e in found.held_out.values())} exposures: a left-out one is predicted to "
        f"{100 * found.held_out_rms:.3f} % of full scale, g⁻¹ known to {100 * found.curve_sd:.2f} % "
        f"between intensities {low:.2f} and {high:.2f}"
    )
    rows = [
        [
            one["name"],
            f"{1e3 * one['exposure_s']:.3g}",
            f"{one['usable']:.0%}",
            *(f"{level:.3f}" for level in one["level"]),
            "–" if one["held_out"] is None else f"{100 * one['held_out']:.3f}",
        ]
        for one in result["exposures"]
    ]
    columns = ("exposure", "ms", "usable", "red", "green", "blue", "held out, % of full scale")
    return Outcome(
        "response",
        "fail" if reasons else "pass",
        reasons,
        sentence,
        result,
        {"response": {"inverse": result["inverse"]}},
        (Figures("Exposures, mean intensity and error when left out", columns, rows),),
        {"response": partial(pictures.draw_response, found)},
    )


def _exposures(found: ExposureResponse) -> list[dict[str, Any]]:
    series = found.series
    return [
        {
            "name": name,
            "exposure_s": float(series.exposure_s[index]),
            "usable": float(series.use[index].all(axis=1).mean()),
            "level": series.images[index].mean.mean(axis=0).tolist(),
            "held_out": found.held_out[name],
        }
        for index, name in enumerate(series.names)
    ]


def _from_distances(found: DistanceResponse, gates: ResponseGates) -> Outcome:
    low, high = found.seen
    reasons = _reasons(found.held_out_rms, found.curve_sd, high - low, gates)
    result = {
        "schema": SCHEMA,
        "verdict": "fail" if reasons else "pass",
        "reasons": list(reasons),
        "source": "distance",
        "inverse": found.inverse.tolist(),
        "inverse_relative_sd": found.relative_sd.tolist(),
        "curve_sd": found.curve_sd,
        "dark_level": [0.0, 0.0, 0.0],
        "dark_from": "assumed",
        "noise": None,
        "rms": found.rms,
        "held_out": {"rms": found.held_out_rms, "views": found.held_out},
        "seen": [low, high],
        "position_rgb_m": found.position.tolist(),
    }
    sentence = (
        f"response from {len(found.held_out)} views of the grey card, together with the light: g⁻¹ known "
        f"to {100 * found.curve_sd:.1f} % between intensities {low:.2f} and {high:.2f}, a left-out view "
        f"predicted to {100 * found.held_out_rms:.2f} % of full scale; an exposure series is several times "
        "better"
    )
    rig: Mapping[str, Any] = {"response": {"inverse": result["inverse"]}}
    return Outcome(
        "response",
        "fail" if reasons else "pass",
        reasons,
        sentence,
        result,
        rig,
        (),
        {"response": partial(pictures.draw_curves, found.inverse, found.relative_sd, found.seen)},
    )


def _reasons(held_out: float, curve_sd: float, reach: float, gates: ResponseGates) -> tuple[str, ...]:
    reasons = []
    if not held_out <= gates.held_out:
        reasons.append(
            f"what was left out is predicted to {100 * held_out:.2f} % of full scale only, allowed are "
            f"{100 * gates.held_out:g} %"
        )
    if not curve_sd <= gates.curve_sd:
        reasons.append(
            f"g⁻¹ is uncertain by {100 * curve_sd:.2f} % (jackknife), allowed are {100 * gates.curve_sd:g} "
            "%; take more exposures"
        )
    if reach < gates.least_range:
        reasons.append(
            f"only {reach:.0%} of the intensities were seen, needed are {gates.least_range:.0%}; take "
            "longer and shorter exposures"
        )
    return tuple(reasons)
