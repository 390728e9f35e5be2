"""Pictures of a model: reliability diagrams, confusion matrices, its classes in the space of colours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calibration.plots import draw_confusion, drawing
from calibration.training.card import RouteCard
from surfclass.rig import SurfaceClasses
from surfclass.training import HeldOut
from surfclass.types import Float64

_MOST_POINTS = 600  # of a class


def draw_reliability(cards: Mapping[str, RouteCard], path: Path) -> None:
    """Draws accuracy against confidence on held-out places, a panel for each route."""
    with drawing(path, 1, len(cards), figsize=(3.6 * len(cards), 3.9)) as (figure, axes):
        figure.suptitle("Reliability on places that were held out")
        for ax, (route, card) in zip(axes[0], cards.items(), strict=True):
            shown = card.reliability
            full = shown.count > 0
            share = shown.count / max(1, shown.count.sum())
            bins = len(shown.count)
            ax.bar(
                (np.arange(bins) + 0.5) / bins, share, 0.9 / bins, color="#c9d3de", label="share of samples"
            )
            ax.plot([0, 1], [0, 1], color="#888888", linewidth=1)
            ax.plot(shown.confidence[full], shown.accuracy[full], "o-", color="#1f5fa8", label="share right")
            ax.set_title(f"{route}: ECE {card.ece:.3f}", fontsize=10)
            ax.set_xlim(0, 1)
            ax.set_ylim(0, 1)
            ax.set_xlabel("confidence")
            ax.set_aspect("equal")
        axes[0, 0].set_ylabel("share")
        axes[0, 0].legend(loc="upper left", fontsize=8)


def draw_confusions(cards: Mapping[str, RouteCard], classes: SurfaceClasses, path: Path) -> None:
    """Draws the confusion matrix of each route on held-out places."""
    with drawing(path, 1, len(cards), figsize=(3.9 * len(cards), 3.9)) as (figure, axes):
        figure.suptitle("Held-out places: rows are true, columns found")
        for ax, (route, card) in zip(axes[0], cards.items(), strict=True):
            draw_confusion(ax, card.told["confusion"], classes.names)
            ax.set_title(f"{route}: {card.balanced:.1%} balanced", fontsize=10)


def draw_features(feature: str, held_out: HeldOut, classes: SurfaceClasses, path: Path) -> None:
    """Draws the training samples of a colour feature, in chromaticity and lightness where it has three."""
    samples = held_out.samples
    random = np.random.default_rng(0)
    x, y, names = _plane(feature, samples.values)
    with drawing(path, figsize=(7, 6)) as (_, axes):
        ax = axes[0, 0]
        for k, (name, colour) in enumerate(zip(classes.names, classes.colours, strict=True)):
            rows = random.permutation(np.flatnonzero(samples.label == k))[:_MOST_POINTS]
            ax.scatter(x[rows], y[rows], s=6, color=colour, label=name, alpha=0.7, linewidths=0)
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
        ax.set_title(f"Training samples in {feature}")
        ax.legend(markerscale=3)
        ax.grid(alpha=0.3)


def _plane(feature: str, values: Float64) -> tuple[Float64, Float64, tuple[str, str]]:
    if values.shape[1] == 2:
        return values[:, 0], values[:, 1], ("a*", "b*")
    total = np.maximum(values.sum(axis=1), 1e-9)
    kind = "K_d" if feature == "K_d" else "intensity"
    share = (values[:, 0] - values[:, 2]) / total
    return share, total / 3, (f"(R − B) / (R + G + B) of {kind}", f"mean {kind}")
