"""The one door to matplotlib: figures that become PNG files, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

_DPI = 110


@contextmanager
def drawing(path: Path, rows: int = 1, columns: int = 1, **options: Any) -> Iterator[tuple[Any, Any]]:
    """Yields a figure and its axes, (rows, columns) of them, and writes it to `path` at the end.

    Args:
        path: The PNG file.
        rows: Of axes.
        columns: Of axes.
        options: Of `matplotlib.pyplot.subplots`, such as `figsize` in inches.
    """
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(rows, columns, squeeze=False, layout="constrained", **options)
    part = path.with_name(f".{path.name}.part")
    try:
        yield figure, axes
        figure.savefig(part, format="png", dpi=_DPI)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
        pyplot.close(figure)


def draw_confusion(ax: Any, counts: Sequence[Sequence[int]], names: Sequence[str]) -> None:
    """Draws a confusion matrix: row by row the shares of each true class, by what it was taken for."""
    rows = np.array(counts, np.float64)
    share = rows / np.maximum(rows.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (row, col), value in np.ndenumerate(share):
        ink = "white" if value > 0.55 else "black"
        ax.text(col, row, f"{value:.2f}", ha="center", va="center", color=ink, fontsize=8)
    ax.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)


def _pyplot() -> Any:
    import matplotlib  # late: it costs half a second

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot
