"""Pictures of the response: the curve with what it was fitted to, its uncertainty, and the noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.plots import drawing
from calibration.response import curve as curves
from calibration.response.exposures import ExposureResponse
from surfclass.types import Float64

CHANNELS = (("red", "#c0392b"), ("green", "#2e8b57"), ("blue", "#2c5fb3"))
_POINTS = 60  # of each exposure


def draw_response(found: ExposureResponse, path: Path) -> None:
    """Draws curve, what is left of each exposure about it, its uncertainty, and noise against intensity."""
    with drawing(path, 2, 2, figsize=(11, 8)) as (figure, axes):
        figure.suptitle("Response of the colour camera, from its exposure series")
        for channel in range(3):
            _points(axes[0, 0], axes[0, 1], found, channel)
            _noise(axes[1, 1], found, channel)
        _curve(axes[0, 0], found.inverse, found.seen)
        axes[0, 1].axhline(0, color="black", linewidth=0.8)
        axes[0, 1].set(
            xlabel="intensity",
            ylabel="measured − predicted, % of full scale",
            title="What is left",
            xlim=(0, 1),
        )
        _uncertainty(axes[1, 0], found.relative_sd, found.seen)
        axes[1, 1].set(
            xlabel="intensity",
            ylabel="noise of a pixel, % of full scale",
            title="Noise",
            xlim=(0, 1),
            ylim=(0, None),
        )
        axes[1, 1].legend(fontsize=8)


def draw_curves(inverse: Float64, relative_sd: Float64, seen: tuple[float, float], path: Path) -> None:
    """Draws a curve that was found without an exposure series, and its uncertainty."""
    with drawing(path, 1, 2, figsize=(11, 4.5)) as (figure, axes):
        figure.suptitle("Response of the colour camera, from distances")
        _curve(axes[0, 0], inverse, seen)
        _uncertainty(axes[0, 1], relative_sd, seen)


def _curve(ax: Any, inverse: Float64, seen: tuple[float, float]) -> None:
    level = np.linspace(0, 1, inverse.shape[1])
    for curve, (name, colour) in zip(inverse, CHANNELS, strict=True):
        ax.plot(level, curve, color=colour, label=name, linewidth=1.2)
    for edge in seen:
        ax.axvline(edge, color="grey", linewidth=0.8, linestyle=":")
    ax.plot([0, 1], [0, 1], color="grey", linewidth=0.6)
    ax.set(
        xlabel="intensity",
        ylabel="irradiance g⁻¹",
        title="g⁻¹ (dotted: what was seen)",
        xlim=(0, 1),
        ylim=(0, 1),
    )
    ax.legend(fontsize=8)


def _uncertainty(ax: Any, relative_sd: Float64, seen: tuple[float, float]) -> None:
    level = np.linspace(0, 1, relative_sd.shape[1])
    for sd, (_, colour) in zip(relative_sd, CHANNELS, strict=True):
        ax.semilogy(level[1:], 100 * np.maximum(sd[1:], 1e-6), color=colour)
    ax.axvspan(*seen, color="grey", alpha=0.15)
    ax.set(xlabel="intensity", ylabel="sd of g⁻¹, %", title="Uncertainty (grey: what was seen)", xlim=(0, 1))


def _points(curve_ax: Any, rest_ax: Any, found: ExposureResponse, channel: int) -> None:
    """The places' intensities against their irradiance as the other exposures have it."""
    readings, curve = found.series.readings(channel), found.curves[channel]
    weight = curves.weights(readings, curve)
    for index in readings.used:
        expected, both = curves.predicted(readings, curve, weight, index)
        shown = np.flatnonzero(both)
        shown = shown[:: max(1, len(shown) // _POINTS)]
        level, expected = readings.level[index, shown], expected[shown]
        curve_ax.plot(level, curve.irradiance(expected), ".", color=CHANNELS[channel][1], markersize=2)
        rest_ax.plot(level, 100 * (level - expected), ".", color=CHANNELS[channel][1], markersize=2)


def _noise(ax: Any, found: ExposureResponse, channel: int) -> None:
    series, noise, curve = found.series, found.noise[channel], found.curves[channel]
    name, colour = CHANNELS[channel]
    for index in range(len(series.names)):
        use = series.use[index, :, channel]
        if use.any():
            order = np.array_split(np.argsort(series.level[index, use, channel]), 5)
            level, sd = series.level[index, use, channel], series.pixel_sd[index, use, channel]
            for part in order:
                if part.size:
                    rms = np.sqrt(np.mean(sd[part] ** 2))
                    ax.plot(level[part].mean(), 100 * rms, "o", color=colour, markersize=3)
    if noise is not None:
        level = np.linspace(max(curve.dark + 0.02, curve.low / 2), 1, 100)
        label = f"{name}: " + (
            f"{noise.full_well_e:,.0f} e⁻ at full scale" if noise.full_well_e else "read noise"
        )
        ax.plot(level, 100 * noise.intensity_sd(level, curve, series.step), color=colour, label=label)
