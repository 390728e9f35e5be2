"""Pictures of the light: where it is, how it falls off, the lens' vignetting, K_d before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.light import near_light
from calibration.light.estimate import LightEstimate
from calibration.light.near_light import POSITION, Observed
from calibration.light.thesis import ThesisLight
from calibration.plots import drawing
from surfclass.types import Float64

_SIDES = ((0, 1, "x, mm", "y, mm"), (0, 2, "x, mm", "z, mm"))
_SCALE = 0.05  # of K_d about its mean, in the maps
_COLUMNS = 6
_NAMED = 4  # views without which the light moves most


def draw_light(estimate: LightEstimate, compared: ThesisLight | None, path: Path) -> None:
    """Draws the position with its ellipse, the fall-off with what it was fitted to, and the vignetting."""
    with drawing(path, 2, 2, figsize=(11, 9)) as (figure, axes):
        figure.suptitle("Light and lens")
        for ax, side in zip(axes[0], _SIDES, strict=True):
            _position(ax, estimate, side)
        if compared is not None and compared.mean is not None:
            away = 1e3 * np.linalg.norm(compared.mean - estimate.fit.position)
            axes[0, 0].set_title(f"Position (1 and 3 sd); thesis' mean is {away:.0f} mm away", fontsize=10)
        _fall_off(axes[1, 0], estimate)
        _vignetting(axes[1, 1], estimate)


def draw_k_d(estimate: LightEstimate, polynomial: Float64 | None, path: Path) -> None:
    """Draws K_d of every view over its mean: by the thesis' polynomial above, by the full model below."""
    observed = estimate.fit.observed
    full = _diffuse_only(estimate) / near_light.geometry_factor(estimate.fit.parameters, observed)
    thesis = None if polynomial is None else _thesis_k_d(estimate, polynomial)
    ways = [(full, "full")] if thesis is None else [(thesis, "thesis"), (full, "full")]
    count = len(estimate.views)
    columns = min(count, _COLUMNS)
    blocks = -(-count // columns)
    rows = blocks * len(ways)
    with drawing(path, rows, columns, figsize=(2.2 * columns + 1, 2.1 * rows + 0.5)) as (figure, axes):
        for ax in axes.ravel():
            ax.set_axis_off()
        cards = observed.lobe < 0
        for way, (values, name) in enumerate(ways):
            card_mean = values[cards].mean() if cards.any() else 1.0
            for index, view in enumerate(estimate.views):
                places = observed.view == index
                matte = view.kind == "board"
                mean = np.median(values[places]) if matte else card_mean
                shown = values[places] / mean - 1
                ax = axes[len(ways) * (index // columns) + way, index % columns]
                x, y = observed.ray[places].T
                drawn = ax.scatter(
                    x,
                    -y,
                    c=100 * shown,
                    s=7,
                    marker="s",
                    cmap="RdBu_r",
                    vmin=-100 * _SCALE,
                    vmax=100 * _SCALE,
                )
                ax.set_title(f"{view.name}\n{name} sd {100 * np.std(shown):.2f} %", fontsize=7)
                ax.set(aspect="equal")
        figure.colorbar(drawn, ax=axes, label="K_d over its mean less 1, %", shrink=0.8)


def draw_residuals(estimate: LightEstimate, path: Path) -> None:
    """Draws the distribution of what is left, and where in the image it is left."""
    fitted = estimate.fit
    with drawing(path, 1, 2, figsize=(11, 4.2)) as (figure, axes):
        figure.suptitle("Measured over modelled light, less 1")
        for kind, colour, boards in (("boards", "#c0392b", True), ("grey card", "#2c5fb3", False)):
            chosen = (fitted.observed.lobe >= 0) == boards
            if chosen.any():
                axes[0, 0].hist(
                    np.clip(100 * fitted.residual[chosen], -1, 1),
                    bins=80,
                    color=colour,
                    alpha=0.6,
                    label=kind,
                )
        axes[0, 0].set(xlabel="%", ylabel="places", title="All views")
        axes[0, 0].legend()
        x, y = fitted.observed.ray.T
        shown = np.clip(100 * fitted.residual, -0.5, 0.5)
        drawn = axes[0, 1].hexbin(x, -y, C=shown, gridsize=(18, 8), cmap="RdBu_r", vmin=-0.2, vmax=0.2)
        axes[0, 1].set(aspect="equal", xlabel="x/z", ylabel="−y/z", title="Mean over the views")
        figure.colorbar(drawn, ax=axes[0, 1], label="%")


def _position(ax: Any, estimate: LightEstimate, side: tuple[int, int, str, str]) -> None:
    first, second, across, up = side
    place = 1e3 * estimate.fit.position[[first, second]]
    part = 1e6 * estimate.covariance[POSITION, POSITION][np.ix_([first, second], [first, second])]
    root = np.linalg.cholesky(part + 1e-9 * np.eye(2))
    turn = np.linspace(0, 2 * np.pi, 100)
    circle = root @ np.stack([np.cos(turn), np.sin(turn)])
    for times, style in ((1, "-"), (3, "--")):
        ax.plot(place[0] + times * circle[0], place[1] + times * circle[1], style, color="#2c5fb3")
    ax.plot(*place, "+", color="#2c5fb3", markersize=12, label="all views")
    spots = {name: 1e3 * alone[[first, second]] for name, alone in estimate.alone.items()}
    far = sorted(spots, key=lambda name: -float(np.linalg.norm(spots[name] - place)))
    for name, spot in spots.items():
        ax.plot(*spot, ".", color="#c0392b", markersize=5)
        if name in far[:_NAMED]:
            ax.annotate(name, spot, fontsize=6, xytext=(3, 3), textcoords="offset points")
    ax.plot([], [], ".", color="#c0392b", label="without one view")
    ax.set(xlabel=across, ylabel=up)
    ax.invert_yaxis()
    ax.axis("equal")
    ax.locator_params(nbins=6)
    ax.legend(fontsize=8)


def _fall_off(ax: Any, estimate: LightEstimate) -> None:
    """Each place's light, all else divided out, against the angle off the LED's axis."""
    fitted = estimate.fit
    observed, parameters = fitted.observed, fitted.parameters
    towards = observed.point - fitted.position
    psi = np.arccos(np.clip(towards @ fitted.axis / np.linalg.norm(towards, axis=1), -1, 1))
    led = np.cos(psi) ** fitted.exponent
    measured = led * (1 + fitted.residual)
    order = np.argsort(psi)
    ax.plot(np.degrees(psi), measured, ".", markersize=1, color="grey", alpha=0.4, rasterized=True)
    ax.plot(np.degrees(psi[order]), led[order], color="#c0392b", label=f"cos^{fitted.exponent:.2f}")
    ax.set(xlabel="angle off the LED's axis, °", ylabel="relative emission", title="Fall-off of the LED")
    x, y = parameters[near_light.AXIS]
    ax.plot([], [], " ", label=f"axis ({x:.3f}, {y:.3f}, 1)")
    ax.legend(fontsize=8)


def _vignetting(ax: Any, estimate: LightEstimate) -> None:
    observed = estimate.fit.observed
    x, y = observed.ray.T
    v2, v4, v6 = estimate.fit.vignetting
    r2 = x * x + y * y
    relative = 1 + r2 * (v2 + r2 * (v4 + r2 * v6))
    drawn = ax.tripcolor(*_thin(x, -y, relative), cmap="viridis", shading="gouraud")
    ax.figure.colorbar(drawn, ax=ax, label="relative illumination")
    title = f"Vignetting {v2:.2f} r² {v4:+.2f} r⁴ {v6:+.2f} r⁶"
    ax.set(aspect="equal", xlabel="x/z", ylabel="−y/z", title=title)


def _thin(x: Float64, y: Float64, value: Float64) -> tuple[Float64, Float64, Float64]:
    """One of the places that lie at the same place of the image."""
    _, first = np.unique(np.round(np.stack([x, y]), 4), axis=1, return_index=True)
    return x[first], y[first], value[first]


def _diffuse_only(estimate: LightEstimate) -> Float64:
    _, specular = near_light.emitted(estimate.fit.parameters, estimate.fit.observed)
    return np.asarray(estimate.fit.observed.light - specular)


def _thesis_k_d(estimate: LightEstimate, polynomial: Float64) -> Float64:
    """Eq. 4.12 with the position of the full model, the mean of the channels."""
    observed: Observed = estimate.fit.observed
    towards = estimate.fit.position - observed.point
    distance = np.linalg.norm(towards, axis=1)
    cosine = np.einsum("ni,ni->n", towards, observed.normal) / distance
    channels = [
        observed.level[:, channel] * np.polyval(polynomial[channel], distance) / cosine
        for channel in range(3)
    ]
    return np.asarray(np.mean(channels, axis=0))
