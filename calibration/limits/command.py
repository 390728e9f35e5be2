"""`calibrate limits`: from where texture can be trusted, by maximum likelihood from labelled captures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.gates import LimitsGates
from calibration.limits.cells import balance, cells_of
from calibration.limits.focus import Focus, find_focus, measure
from calibration.limits.lens import DepthOfField, LensData, depth_of_field
from calibration.limits.pictures import draw_focus, draw_limits
from calibration.limits.report import figures, focus_told, sentence, told_of
from calibration.limits.solution import Solution, solve
from calibration.limits.windows import Windows, windows_of
from calibration.outcome import SCHEMA, Note, Outcome, RefusedError, plain
from calibration.source import Source
from drivers.files import read_file
from surfclass import quality
from surfclass.errors import ConfigurationError
from surfclass.model import Model
from surfclass.pipeline import texture_limits
from surfclass.rig import Rig, SurfaceClasses


@dataclass(frozen=True, slots=True)
class Options:
    """How the limits are found.

    Attributes:
        model: File of the model whose texture route is judged; None: one is trained in place.
        window_px: Side of a texture window, where one is trained.
        place_px: Side of the square of pixels that is one place for hold-out.
        focal_length_m: Of the colour camera's lens. What is not told of the lens the rig's [lens] says, or
            else a focus series.
        f_number: Focal length over the entrance pupil's diameter.
        focus_distance_m: Distance of the plane of focus.
        circle_of_confusion_m: Greatest blur circle that is still sharp; None: by Eq. 5.4 from the limits.
        resamples: Of captures, for the uncertainties.
        seed: Of folds and resampling.
    """

    model: Path | None = None
    window_px: int = 20
    place_px: int = 80
    focal_length_m: float | None = None
    f_number: float | None = None
    focus_distance_m: float | None = None
    circle_of_confusion_m: float | None = None
    resamples: int = 100
    seed: int = 0


def calibrate(source: Source, options: Options, gates: LimitsGates, note: Note) -> Outcome:
    """Finds texture's limits for all classes and for each, and the depth of field.

    Args:
        source: Labelled captures of roles "train" and "test", from several distances and angles.
        options: See there.
        gates: The limits of the limits.
        note: Called with a sentence at each step.

    Raises:
        RefusedError: If the captures cannot determine the limits.
        InputError, ConfigurationError, MissingCalibrationError: If an input cannot be used.
    """
    model = None
    if options.model is not None:
        model = Model.from_bytes(read_file(options.model, "model"), str(options.model))
    windows = windows_of(source, model, options.window_px, options.place_px, options.seed, note)
    check_span(windows, gates)
    classes, rig = source.classes, source.rig.whole()
    if classes is None:  # windows_of has refused
        raise RefusedError(f"{source.path}: has no classes.toml")
    note(f"fitting {len(windows.right):,} windows of {len(windows.names)} captures")
    solution = solve(
        windows, len(classes.names), texture_limits(rig, classes), options.resamples, options.seed
    )
    focus = _focus(source, rig, note)
    depth, lens_reasons = _lens(_told(options, rig), rig, focus, solution, classes)
    without = [name for k, name in enumerate(classes.names) if k not in solution.classes]
    for name in without:
        note(f"{name}: too few windows were given this class; it keeps the limits of all classes together")
    reasons = (*_reasons(solution, classes, gates, without), *lens_reasons)
    verdict = "fail" if reasons else "pass"
    values = _values(solution, classes, rig, depth if not lens_reasons else None)
    found = {"all": solution.pooled} | {classes.names[k]: c for k, c in solution.classes.items()}
    result = {
        "schema": SCHEMA,
        "verdict": verdict,
        "reasons": list(reasons),
        "texture_limits": values["texture_limits"],
        "class_texture_limits": values["class_texture_limits"],
        "lens": values.get("lens"),
        "depth_of_field": None if depth is None else depth.to_json(),
        "focus": None if focus is None else focus_told(focus, rig),
        "classes": {name: told_of(one) for name, one in found.items()},
        "classes_without_data": without,
        "held_out": {
            name: getattr(solution.held_out, name)
            for name in ("found", "default", "gain", "gain_sd", "folds")
        },
        "captures": list(windows.names),
        "windows": len(windows.right),
        "model": None if options.model is None else str(options.model),
    }
    return Outcome(
        kind="limits",
        verdict="fail" if reasons else "pass",
        reasons=reasons,
        sentence=sentence(solution, windows),
        result=plain(result),
        rig=plain(values),
        figures=(figures(found),),
        pictures=_pictures(windows, solution, classes, focus),
    )


def check_span(windows: Windows, gates: LimitsGates) -> None:
    """Raises RefusedError where limits cannot be told from the captures, saying which are missing."""
    reasons = []
    captures = len(np.unique(windows.capture))
    if captures < gates.captures:
        reasons.append(
            f"{captures} labelled captures show windows of one class with a measured surface, needed are "
            f"{gates.captures:g} or more that the classifier was not trained on"
        )
    if len(windows.right):
        near, far = np.percentile(windows.distance_m, (1, 99))
        direct, oblique = np.percentile(windows.angle_rad, (1, 99))
        if far < gates.distance_ratio * near:
            reasons.append(
                f"the windows are {near:.2f} to {far:.2f} m away, a ratio of {far / near:.2f}; needed is "
                f"{gates.distance_ratio:g}: capture the boards from nearer and from farther away too"
            )
        if oblique - direct < gates.angle_span_rad:
            reasons.append(
                f"the windows are seen at {np.degrees(direct):.0f} to {np.degrees(oblique):.0f}°; "
                f"needed is a span of {np.degrees(gates.angle_span_rad):.0f}°: capture the boards turned too"
            )
    if reasons:
        raise RefusedError(*reasons)


def _focus(source: Source, rig: Rig, note: Note) -> Focus | None:
    roles = ("board",) if source.count("board") else ("train", "test")  # a board's edges are real steps
    try:
        return find_focus(measure(source.captures(roles), rig))
    except RefusedError as error:
        note(f"no focus series: {error}")
        return None


def _lens(
    told: LensData, rig: Rig, focus: Focus | None, solution: Solution, classes: SurfaceClasses
) -> tuple[DepthOfField | None, tuple[str, ...]]:
    """The depth of field, and why it cannot be used."""
    limits = {
        name: solution.classes.get(k, solution.pooled).fit.limits for k, name in enumerate(classes.names)
    }
    try:
        found = depth_of_field(told, focus, rig.rgb.fx, list(limits.values()))
        if found is not None:
            for name, one in limits.items():
                quality.range_of(found.near_m, found.far_m, one.near_m, one.far_m, name)
    except ConfigurationError as error:
        return None, (str(error),)
    return found, ()


def _told(options: Options, rig: Rig) -> LensData:
    """What the options say of the lens, or else the rig; never the rig's circle of confusion."""
    told = {}
    for name in ("focal_length_m", "f_number", "focus_distance_m"):
        given = getattr(options, name)
        told[name] = given if given is not None or rig.lens is None else getattr(rig.lens, name)
    return LensData(**told, circle_of_confusion_m=options.circle_of_confusion_m)


def _values(
    solution: Solution, classes: SurfaceClasses, rig: Rig, depth: DepthOfField | None
) -> dict[str, Any]:
    """The keys of `rig.toml`; a class without data gets the common limits where the rig had its own."""
    own = {}
    for k, name in enumerate(classes.names):
        if k in solution.classes:
            own[name] = solution.classes[k].fit.limits.model_dump()
        elif name in rig.class_texture_limits:
            own[name] = solution.pooled.fit.limits.model_dump()
    values = {
        "texture_limits": solution.pooled.fit.limits.model_dump(),
        "class_texture_limits": own,
    }
    return values if depth is None else values | {"lens": depth.lens}


def _reasons(
    solution: Solution, classes: SurfaceClasses, gates: LimitsGates, without: list[str]
) -> tuple[str, ...]:
    reasons = []
    held_out = solution.held_out
    if held_out.gain + held_out.gain_sd < gates.gain:
        reasons.append(
            f"windows of other captures are less likely under the new limits than under those in use, by "
            f"{-held_out.gain:.3f} ± {held_out.gain_sd:.3f} nats a window; allowed is {gates.gain:g}"
        )
    share = len(solution.classes) / len(classes.names)
    if share < gates.classes:
        reasons.append(
            f"only {len(solution.classes)} of {len(classes.names)} classes have limits of their own, needed "
            f"are {gates.classes:.0%}: capture boards of {', '.join(without)}"
        )
    return tuple(reasons)


def _pictures(
    windows: Windows, solution: Solution, classes: SurfaceClasses, focus: Focus | None
) -> dict[str, Any]:
    weight = balance(windows, len(classes.names))
    cells = {"all": cells_of(windows, weight, None)}
    fits = {"all": solution.pooled.fit}
    for k, name in enumerate(classes.names):
        cells[name] = cells_of(windows, weight, k)
        fits[name] = solution.classes.get(k, solution.pooled).fit
    pictures = {"limits": partial(draw_limits, cells, fits)}
    return pictures if focus is None else pictures | {"focus": partial(draw_focus, focus)}
