"""`calibrate light`: where the LED is, which way and how widely it shines, and the lens' vignetting."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from calibration.gates import LightGates
from calibration.light import pictures
from calibration.light.estimate import (
    LightEstimate,
    Use,
    board_views,
    correlations,
    estimate_light,
)
from calibration.light.near_light import AXIS, COAT, EXPONENT, NAMES, POSITION, VIGNETTING
from calibration.light.photometry import known_response, rig_values
from calibration.light.thesis import ThesisLight, locate_by_each_board, polynomial_with
from calibration.light.variation import k_d_variation
from calibration.outcome import SCHEMA, Figures, Note, Outcome, RefusedError
from calibration.source import Source
from surfclass.rig import Rig
from surfclass.types import Float64


@dataclass(frozen=True, slots=True)
class LightOptions:
    """What the light is found from.

    Attributes:
        use: "boards": `light` captures alone; "lambertian": `response` captures alone; "all".
        thesis: Only the position, by Eq. 4.5–4.10 (corrected) from each board, and their mean.
        between_sd: (6,) standard deviations of `rgb_T_depth`, rotation (rad) and translation (m), where they
            are known: what they do to the result is part of its own.
    """

    use: Use = "all"
    thesis: bool = False
    between_sd: tuple[float, ...] | None = None


Options = LightOptions


@dataclass(frozen=True, slots=True)
class Variation:
    """Of K_d over the grey card's pixels, standard deviation over mean.

    Attributes:
        full: Of the channels' mean, by the full model; None without a grey card.
        channels: Of R, G, B: what noise adds to them is larger.
        smooth: Of the means of places of some hundred pixels, which have next to no noise.
        thesis: Of the channels' mean by the polynomial of Eq. 4.4; None where it cannot be fitted.
        views: As `full`, of each capture by itself.
    """

    full: float | None = None
    channels: tuple[float, ...] | None = None
    smooth: float | None = None
    thesis: float | None = None
    views: dict[str, float] = field(default_factory=dict)


def calibrate(source: Source, options: LightOptions, gates: LightGates, note: Note) -> Outcome:
    """Returns light and lens.

    Raises:
        RefusedError: If the captures cannot determine them.
        MissingCalibrationError: If the rig has no colour camera or no `rgb_T_depth`.
    """
    rig = source.rig.whole()
    inverse, response = known_response(source, rig, note)
    if options.thesis:
        return _thesis(locate_by_each_board(source, rig, inverse), source)
    views = board_views(source, rig, inverse, options.use, note)
    estimate = estimate_light(views, between_sd=options.between_sd)
    note(f"fitted light and lens to {len(estimate.views)} views; now the comparison with the thesis' method")
    values: dict[str, Any] = rig_values(estimate)
    if response:
        values["response"] = response
    variation, polynomial = _variation(source, rig, values, estimate)
    if polynomial is not None:
        values["response"] = {**values.get("response", {}), "a2_a1_a0": polynomial.tolist()}
    compared = None
    if source.count("light"):
        compared = locate_by_each_board(source, rig.with_values(values).whole(), inverse)
    reasons = _reasons(estimate, variation, gates)
    result = _result(estimate, variation, compared, reasons, rig, bool(response))
    return Outcome(
        "light",
        result["verdict"],
        reasons,
        _sentence(estimate, variation),
        result,
        values,
        _figures(estimate, compared),
        {
            "light": partial(pictures.draw_light, estimate, compared),
            "k_d": partial(pictures.draw_k_d, estimate, polynomial),
            "light_residuals": partial(pictures.draw_residuals, estimate),
        },
    )


def _variation(
    source: Source, rig: Rig, values: dict[str, Any], estimate: LightEstimate
) -> tuple[Variation, Float64 | None]:
    cards = tuple(view.name for view in estimate.views if view.kind == "lambertian")
    if not cards:
        return Variation(), None
    lit = rig.with_values(values).whole()
    full = k_d_variation(source, lit, cards, "full")
    polynomial = polynomial_with(source, lit)
    thesis = None
    if polynomial is not None:
        with_polynomial = lit.with_values({"response": {"a2_a1_a0": polynomial.tolist()}}).whole()
        thesis = k_d_variation(source, with_polynomial, cards, "thesis")
    places = estimate.fit.observed.lobe < 0
    return (
        Variation(
            None if full is None else float(full[0][3]),
            None if full is None else tuple(full[0][:3].tolist()),
            float(np.std(estimate.fit.residual[places])),
            None if thesis is None else float(thesis[0][3]),
            {} if full is None else full[1],
        ),
        polynomial,
    )


def _result(
    estimate: LightEstimate,
    variation: Variation,
    compared: ThesisLight | None,
    reasons: tuple[str, ...],
    rig: Rig,
    found_response: bool,
) -> dict[str, Any]:
    found, sd = estimate.fit, np.sqrt(np.diag(estimate.covariance))
    known = None if rig.light is None else np.array(rig.light.position_rgb_m)
    return {
        "schema": SCHEMA,
        "verdict": "fail" if reasons else "pass",
        "reasons": list(reasons),
        "position_rgb_m": found.position.tolist(),
        "axis_rgb": found.axis.tolist(),
        "falloff_exponent": found.exponent,
        "vignetting": found.vignetting.tolist(),
        "sd": {
            "position_m": sd[POSITION].tolist(),
            "position_worst_m": estimate.position_sd,
            "axis_rad": sd[AXIS].tolist(),
            "falloff_exponent": float(sd[EXPONENT]),
            "vignetting": sd[VIGNETTING].tolist(),
            "from": "jackknife over views, and what may be uneven in every view",
        },
        "correlations": {"names": list(NAMES), "matrix": correlations(estimate.covariance).tolist()},
        "k_d_variation": variation.full if variation.full is not None else _boards_variation(estimate),
        "k_d_variation_of": "places of the boards" if variation.full is None else "pixels, mean of R, G, B",
        "k_d_variation_channels": variation.channels,
        "k_d_variation_smooth": variation.smooth,
        "k_d_variation_by_view": variation.views,
        "k_d_variation_thesis": variation.thesis,
        "held_out": {"rms": estimate.held_out_rms, "views": estimate.held_out},
        "coat": float(found.parameters[COAT]),
        "boards": _boards(estimate),
        "left_out": list(estimate.left_out),
        "response_calibrated_here": found_response,
        "rig_position_rgb_m": None if known is None else known.tolist(),
        "from_rig_position_m": None if known is None else float(np.linalg.norm(found.position - known)),
        "thesis": None if compared is None else _thesis_result(compared, found.position),
    }


def _boards(estimate: LightEstimate) -> list[dict[str, Any]]:
    observed = estimate.fit.observed
    entries = []
    for index, view in enumerate(estimate.views):
        tilt = np.degrees(np.arccos(np.clip(-view.plane.normal[2], -1, 1)))
        residual = estimate.fit.residual[observed.view == index]
        entries.append(
            {
                "name": view.name,
                "kind": view.kind,
                "distance_m": abs(view.plane.offset),
                "tilt_deg": float(tilt),
                "depth_rms_m": view.plane.thickness_m,
                "places": len(view.ray),
                "saturated": view.saturated_share,
                "residual_rms": float(np.sqrt(np.mean(np.clip(residual, -0.05, 0.05) ** 2))),
                "held_out": estimate.held_out[view.name],
                "position_without_rgb_m": estimate.alone[view.name].tolist(),
            }
        )
    return entries


def _boards_variation(estimate: LightEstimate) -> float:
    """Of K_d over the places of each board, where no grey card was seen."""
    return float(np.sqrt(np.mean(np.clip(estimate.fit.residual, -0.05, 0.05) ** 2)))


def _thesis_result(found: ThesisLight, position: Float64 | None) -> dict[str, Any]:
    mean, scatter = found.mean, found.scatter
    away = None if mean is None or position is None else float(np.linalg.norm(mean - position))
    return {
        "boards": {
            name: {
                "position_rgb_m": place.tolist(),
                "relative_spread": found.spreads[name],
                "tau_s": found.tau[name][0],
                "tau_d": found.tau[name][1],
            }
            for name, place in found.positions.items()
        },
        "failed": found.failed,
        "mean_rgb_m": None if mean is None else mean.tolist(),
        "scatter_m": None if scatter is None else scatter.tolist(),
        "from_full_model_m": away,
        "intensities": "made linear" if found.linear else "with the polynomial of Eq. 4.4",
    }


def _thesis(found: ThesisLight, source: Source) -> Outcome:
    mean, scatter = found.mean, found.scatter
    if mean is None:
        told = "; ".join(f"{name}: {why}" for name, why in found.failed.items())
        raise RefusedError(
            f"no board of {source.count('light')} gives a position by Eq. "
            f"4.5–4.10{': ' if told else ''}{told}"
        )
    result = {
        "schema": SCHEMA,
        "verdict": "pass",
        "reasons": [],
        "position_rgb_m": mean.tolist(),
        "axis_rgb": None,
        "falloff_exponent": None,
        "vignetting": None,
        "sd": None if scatter is None else {"position_m": scatter.tolist(), "from": "between boards"},
        "k_d_variation": None,
        "thesis": _thesis_result(found, None),
    }
    wide = "one board only" if scatter is None else f"boards differ by {_mm(scatter)} mm (sd)"
    return Outcome(
        "light",
        "pass",
        (),
        f"thesis' method, mean of {len(found.positions)} boards: light at {_mm(mean)} mm; {wide}",
        result,
        {"light": {"position_rgb_m": mean.tolist()}},
    )


def _sentence(estimate: LightEstimate, variation: Variation) -> str:
    found = estimate.fit
    sd = np.sqrt(np.diag(estimate.covariance))
    constant = ""
    if variation.full is not None:
        constant = f"; K_d of the grey card varies by {100 * variation.full:.2f} % over all pixels"
        if variation.thesis is not None:
            constant += f" (thesis' polynomial: {100 * variation.thesis:.2f} %)"
    return (
        f"light at {_mm(found.position)} mm ± {_mm(sd[POSITION], 1)} mm, fall-off cos^{found.exponent:.2f} ± "
        f"{sd[EXPONENT]:.2f}, from {len(estimate.views)} views; a left-out view's light is predicted to "
        f"{100 * estimate.held_out_rms:.2f} %{constant}"
    )


def _reasons(estimate: LightEstimate, variation: Variation, gates: LightGates) -> tuple[str, ...]:
    reasons = []
    if estimate.position_sd > gates.position_sd_m:
        reasons.append(
            f"the light's position is uncertain by {1e3 * estimate.position_sd:.1f} mm, allowed are "
            f"{1e3 * gates.position_sd_m:g} mm; add boards that are turned differently, or a grey card at "
            "more distances"
        )
    if variation.full is not None and variation.full > gates.k_d_variation:
        worst = max(variation.views, key=lambda name: variation.views[name])
        reasons.append(
            f"K_d of the grey card varies by {100 * variation.full:.2f} %, allowed are "
            f"{100 * gates.k_d_variation:g} %; most within {worst} ({100 * variation.views[worst]:.2f} %)"
        )
    if estimate.held_out_rms > gates.held_out:
        worst = max(estimate.held_out, key=lambda name: estimate.held_out[name])
        reasons.append(
            f"the light of a view is predicted from the others to {100 * estimate.held_out_rms:.2f} % only, "
            f"allowed are {100 * gates.held_out:g} %; worst is {worst} "
            f"({100 * estimate.held_out[worst]:.2f} %)"
        )
    return tuple(reasons)


def _figures(estimate: LightEstimate, compared: ThesisLight | None) -> tuple[Figures, ...]:
    rows = []
    for entry in _boards(estimate):
        moved = estimate.alone[entry["name"]] - estimate.fit.position
        rows.append(
            [
                entry["name"],
                f"{entry['distance_m']:.3f}",
                f"{entry['tilt_deg']:.1f}",
                f"{100 * entry['saturated']:.0f}",
                f"{100 * entry['residual_rms']:.2f}",
                f"{100 * entry['held_out']:.2f}",
                _mm(moved, 1),
            ]
        )
    columns = (
        "view", "distance, m", "tilt, °", "saturated, %", "residual, %", "held out, %",
        "light without it moves by, mm",
    )  # fmt: skip
    tables = [Figures("Views of boards", columns, rows)]
    if compared is not None:
        thesis = [
            [name, _mm(place), _mm(place - estimate.fit.position), f"{100 * compared.spreads[name]:.1f}"]
            for name, place in compared.positions.items()
        ]
        thesis += [[name, "none", why, ""] for name, why in compared.failed.items()]
        heading = ("board", "light, mm", "less the full model's, mm", "spread of Eq. 4.8, %")
        tables.append(
            Figures("The thesis' method (Eq. 4.5–4.10, corrected), board by board", heading, thesis)
        )
    return tuple(tables)


def _mm(vector: Float64, digits: int = 0) -> str:
    return "(" + ", ".join(f"{1e3 * value:.{digits}f}" for value in vector) + ")"
