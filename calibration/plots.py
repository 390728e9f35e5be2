"""The one door to matplotlib: figures that become PNG files, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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


def _pyplot() -> Any:
    import matplotlib  # late: it costs half a second

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot
