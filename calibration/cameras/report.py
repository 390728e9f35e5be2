"""Tables and pictures of `calibrate cameras`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.cameras.depth import corrected_error
from calibration.outcome import Figures
from calibration.plots import drawing

if TYPE_CHECKING:
    from calibration.cameras.command import Found


def figures(result: Mapping[str, Any]) -> tuple[Figures, ...]:
    """Returns the parameters with their uncertainties, and the views."""
    names = list(result["cameras"])
    rows = []
    for name, camera in result["cameras"].items():
        values = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera["distortion"], strict=True))
        values |= {key: camera[key] for key in ("fx", "fy", "cx", "cy")}
        for key, sd in camera["sd"].items():
            digits = 2 if key in ("fx", "fy", "cx", "cy") else 5
            rows.append([f"{name} {key}", f"{values[key]:.{digits}f}", f"{sd:.{digits}f}"])
    views = [
        [
            view["name"],
            *(f"{view['rms_px'][name]:.3f}" if name in view["rms_px"] else "-" for name in names),
            f"{view['held_out_px']:.3f}",
            f"{view['tilt_deg']:.0f}",
            f"{view['distance_m']:.2f}",
        ]
        for view in result["views"]
    ]
    return (
        Figures("Cameras", ("", "value (px; distortion: -)", "sd"), rows),
        Figures(
            "Views",
            ("view", *(f"rms {name} (px)" for name in names), "held out (px)", "tilt (°)", "distance (m)"),
            views,
        ),
    )


def pictures(found: Found) -> dict[str, Callable[[Path], None]]:
    """Returns what draws each picture."""
    drawn: dict[str, Callable[[Path], None]] = {
        "cameras-residuals": partial(_draw_residuals, found),
        "cameras-projection": partial(_draw_uncertainty, found),
    }
    if found.depth is not None:
        drawn["cameras-depth"] = partial(_draw_depth, found)
    return drawn


def _draw_residuals(found: Found, path: Path) -> None:
    """Every corner's residual where it was seen; a pattern in the arrows is what the model lacks."""
    observations, fit = found.solution.observations, found.solution.adjustment
    count = len(found.cameras)
    with drawing(path, 1, count, figsize=(6.5 * count, 5.4)) as (_, axes):
        for index, (name, camera) in enumerate(found.cameras.items()):
            own = observations.camera == index
            pixel, left = observations.pixel[own], fit.residual[own]
            axis = axes[0][index]
            size = np.linalg.norm(left, axis=1)
            scale = 0.04 * camera.size[0] / max(float(np.quantile(size, 0.95)), 1e-9)
            arrows = axis.quiver(
                *pixel.T, *(scale * left).T, size, angles="xy", scale_units="xy", scale=1, width=0.0022
            )
            axis.figure.colorbar(arrows, ax=axis, label="residual (px)", shrink=0.8)
            axis.set(
                title=f"{name}: corners found minus computed, drawn {scale:.0f} times",
                xlim=(0, camera.size[0]),
                ylim=(camera.size[1], 0),
                xlabel="u (px)",
                ylabel="v (px)",
                aspect="equal",
            )


def _draw_uncertainty(found: Found, path: Path) -> None:
    """Standard deviation of the projection over the image; the dots are the corners that were seen."""
    observations = found.solution.observations
    count = len(found.cameras)
    with drawing(path, count, 2, figsize=(12, 4.8 * count)) as (_, axes):
        for index, (name, camera) in enumerate(found.cameras.items()):
            one = found.uncertainty[name]
            seen = observations.pixel[observations.camera == index]
            for axis, values, where in zip(
                axes[index], (one.infinity_px, one.metre_px), ("at infinity", "at 1 m"), strict=True
            ):
                drawn = axis.contourf(one.pixel[..., 0], one.pixel[..., 1], values, levels=12, cmap="viridis")
                axis.plot(*seen.T, ".", color="white", markersize=1.2, alpha=0.6)
                axis.figure.colorbar(drawn, ax=axis, label="sd (px)", shrink=0.85)
                axis.set(
                    title=f"{name}: where a point {where} projects",
                    xlim=(0, camera.size[0]),
                    ylim=(camera.size[1], 0),
                    xlabel="u (px)",
                    ylabel="v (px)",
                    aspect="equal",
                )


def _draw_depth(found: Found, path: Path) -> None:
    """Relative error of the depth readings on the boards, as read and corrected."""
    fit = found.depth
    assert fit is not None
    pixel = np.concatenate([one.pixel for one in found.readings])
    before = 100 * np.concatenate([one.read / one.plane - 1 for one in found.readings])
    after = 100 * np.concatenate([corrected_error(one, fit.correction) for one in found.readings])
    limit = float(np.quantile(np.abs(before), 0.98))
    width, height = found.cameras["depth"].size
    with drawing(path, 1, 2, figsize=(12, 4.8)) as (figure, axes):
        for axis, values, title in zip(axes[0], (before, after), ("as read", "corrected"), strict=True):
            drawn = axis.scatter(*pixel.T, c=values, s=10, cmap="RdBu", vmin=-limit, vmax=limit)
            axis.set(
                title=f"depth {title}: rms {np.sqrt(np.mean(values**2)):.2f} %",
                xlim=(0, width),
                ylim=(height, 0),
                xlabel="u (px)",
                ylabel="v (px)",
                aspect="equal",
            )
        figure.colorbar(drawn, ax=axes[0].tolist(), label="reading over plane − 1 (%)")
