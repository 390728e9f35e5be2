"""Pictures of the limits: accuracy over distance and angle with the fitted curves, and blur against depth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.limits.cells import Cells
from calibration.limits.focus import Focus
from calibration.limits.likelihood import Fit
from calibration.plots import drawing
from surfclass.types import Float64

_DISTANCE_M, _ANGLE_DEG = 0.05, 5.0  # widths of the bins


def draw_limits(cells: Mapping[str, Cells], fits: Mapping[str, Fit], path: Path) -> None:
    """Draws a row for each class: what was right where, and against distance and angle with the fit."""
    with drawing(path, len(cells), 3, figsize=(12, 2.7 * len(cells) + 0.6)) as (figure, axes):
        figure.suptitle(
            "Share of windows given a class that are of it (dots) and the fitted probability (lines)"
        )
        for row, (name, counted) in zip(axes, cells.items(), strict=True):
            if not len(counted.total):
                for ax in row:
                    ax.set_axis_off()
                row[0].set_title(f"{name}: given to no window", fontsize=10)
                continue
            found = fits[name]
            _map(row[0], name, counted, found)
            angle = np.degrees(counted.angle_rad)
            _curve(row[1], counted, found, counted.distance_m, _DISTANCE_M, "distance, m")
            _curve(row[2], counted, found, angle, _ANGLE_DEG, "angle, °")
            for ax, limits in ((row[1], found.x[:2]), (row[2], [np.degrees(found.x[3])])):
                for limit in limits:
                    ax.axvline(limit, color="#888888", linewidth=0.8, linestyle="--")


def _map(ax: Any, name: str, cells: Cells, found: Fit) -> None:
    angle = np.degrees(cells.angle_rad)
    place = np.floor(cells.distance_m / _DISTANCE_M), np.floor(angle / _ANGLE_DEG)
    keys, group = np.unique(np.stack(place), axis=1, return_inverse=True)
    total = np.bincount(group.reshape(-1), cells.total)
    share = np.bincount(group.reshape(-1), cells.right) / total
    x, y = (keys[0] + 0.5) * _DISTANCE_M, (keys[1] + 0.5) * _ANGLE_DEG
    size = np.clip(120 * total / total.max(), 8, 120)
    dots = ax.scatter(
        x, y, s=size, c=share, cmap="RdYlGn", vmin=0, vmax=1, edgecolors="#555555", linewidths=0.3
    )
    ax.figure.colorbar(dots, ax=ax, label="share right")
    d = np.linspace(max(0.0, x.min() - 0.1), x.max() + 0.1, 120)
    a = np.linspace(0, min(90.0, y.max() + 10), 90)
    grid = np.meshgrid(d, np.radians(a))
    height = (found.probability(*grid) - found.chance) / max(1e-6, found.plateau - found.chance)
    ax.contour(d, a, height, levels=[0.5, 0.9], colors=["#1f5fa8", "#0b2e57"], linewidths=1.2)
    ax.set_title(f"{name}: lines at P = 0.5 and 0.9", fontsize=10)
    ax.set_xlabel("distance, m")
    ax.set_ylabel("angle, °")


def _curve(ax: Any, cells: Cells, found: Fit, value: Float64, width: float, label: str) -> None:
    """Dots and line are means over the same windows, whatever their other coordinate is."""
    keys, group = np.unique(np.floor(value / width), return_inverse=True)
    group = group.reshape(-1)
    total = np.bincount(group, cells.total)
    share = np.bincount(group, cells.right) / total
    said = np.bincount(group, cells.total * found.probability(cells.distance_m, cells.angle_rad)) / total
    x = (keys + 0.5) * width
    ax.plot(x, said, "-", color="#1f5fa8", label="fitted")
    ax.scatter(
        x, share, s=np.clip(80 * total / total.max(), 8, 80), color="#b7410e", zorder=3, label="measured"
    )
    ax.set_ylim(-0.03, 1.03)
    ax.set_xlabel(label)
    ax.grid(alpha=0.3)


def draw_focus(focus: Focus, path: Path) -> None:
    """Draws the blur of edges against their depth, and the lens that was fitted."""
    with drawing(path, figsize=(7, 4.5)) as (_, axes):
        ax, blur = axes[0, 0], focus.blur
        ax.scatter(
            blur.depth_m, np.sqrt(np.maximum(0, blur.squared_px2)), s=10, color="#b7410e", label="edges"
        )
        depth = np.linspace(blur.depth_m.min(), blur.depth_m.max(), 200)
        ax.plot(depth, focus.sigma_px(depth), color="#1f5fa8", label="thin lens")
        ax.axvline(focus.distance_m, color="#888888", linestyle="--", linewidth=0.8, label="plane of focus")
        ax.set_xlabel("depth, m")
        ax.set_ylabel("blur (standard deviation), px")
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.3)
        ax.legend()
