"""What is told of the limits: rows of the result, the table, the verdict's sentence."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.limits.focus import Focus
from calibration.limits.likelihood import NAMES
from calibration.limits.solution import ClassLimits, Solution
from calibration.limits.windows import Windows
from calibration.outcome import Figures
from surfclass.rig import Rig


def told_of(one: ClassLimits) -> dict[str, Any]:
    """Returns one row of the result."""
    limits = one.fit.limits
    sd = dict(zip(NAMES, one.sd, strict=True))
    return {
        **limits.model_dump(),
        "plateau": one.fit.plateau,
        "chance": one.fit.chance,
        "sd": {name: None if name in one.ends or not np.isfinite(sd[name]) else sd[name] for name in NAMES},
        "ends_with_the_data": list(one.ends),
        "dispersion": one.fit.dispersion,
        "windows": one.windows,
        "captures": one.captures,
        "seen_m": list(one.span.distance_m),
        "seen_rad": list(one.span.angle_rad),
    }


def focus_told(focus: Focus, rig: Rig) -> dict[str, Any]:
    """Returns what a focus series gave."""
    return {
        "distance_m": focus.distance_m,
        "aperture_m": focus.aperture_m(rig.rgb.fx),
        "sharpest_px": float(np.sqrt(max(0.0, focus.sharpest_px2))),
        "sd": {"distance_m": focus.sd[0], "aperture_m": 4 * focus.sd[1] / rig.rgb.fx},
        "depth_m": [float(focus.blur.depth_m.min()), float(focus.blur.depth_m.max())],
    }


def sentence(solution: Solution, windows: Windows) -> str:
    """Returns the figures that decide."""
    limits, held_out = solution.pooled.fit.limits, solution.held_out
    return (
        f"all classes {limits.near_m:.2f} to {limits.far_m:.2f} m and {np.degrees(limits.angle_rad):.0f}°, "
        f"{len(solution.classes)} classes by themselves; windows of left-out captures are more likely by "
        f"{held_out.gain:+.3f} ± {held_out.gain_sd:.3f} nats than under the limits before "
        f"({len(windows.right):,} windows, {len(windows.names)} captures)"
    )


def figures(found: dict[str, ClassLimits]) -> Figures:
    """Returns the table of limits."""
    columns = (
        "surface", "near, m", "far, m", "angle, °", "slope, 1/m", "slope, 1/rad", "at best right, %",
        "windows", "captures",
    )  # fmt: skip
    rows = []
    for name, one in found.items():
        limits, sd = one.fit.limits, one.sd
        cells = []
        for key, value, scatter in (
            ("near_m", limits.near_m, sd[0]),
            ("far_m", limits.far_m, sd[1]),
            ("angle_rad", limits.angle_rad, sd[3]),
        ):
            factor, digits = (180 / np.pi, 1) if key == "angle_rad" else (1.0, 3)
            certain = " (the captures end here)" if key in one.ends else f" ± {factor * scatter:.{digits}f}"
            cells.append(f"{factor * value:.{digits}f}{certain}")
        rows.append(
            (
                name,
                *cells,
                f"{limits.slope_per_m:.0f}",
                f"{limits.slope_per_rad:.0f}",
                f"{100 * one.fit.plateau:.1f}",
                f"{one.windows:,}",
                str(one.captures),
            )
        )
    return Figures("limits of texture", columns, rows)
