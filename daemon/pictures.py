"""Pictures for people: the map, images beside their labels, confusion matrices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.types import Float32, Float64, Int32

RGB = NDArray[np.uint8]
_BACKGROUND = (250, 250, 250)
_UNKNOWN = np.array([40, 40, 40], np.uint8)
# Corners of a unit cube's faces around its centre, and each face's outward normal.
_FACES = [
    (axis, sign, [[(sign if a == axis else (u if a == (axis + 1) % 3 else v)) for a in range(3)]
                  for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    for axis in range(3) for sign in (-1, 1)
]  # fmt: skip


def draw_voxels(
    index: Int32,
    size_m: float,
    colour: NDArray[np.uint8],
    eye_direction: Float64,
    width: int = 1100,
) -> RGB:
    """Draws voxels as shaded cubes, seen from afar (orthographic), z up.

    Args:
        index: (n, 3) voxels in `base`.
        size_m: Their side.
        colour: (n, 3) RGB.
        eye_direction: (3,) from the voxels to the eye; not vertical.
        width: Of the picture, px; its height follows from what there is to see, up to the width.
    """
    if not len(index):
        return np.full((width // 2, width, 3), _BACKGROUND, np.uint8)
    towards = np.asarray(eye_direction, np.float64) / np.linalg.norm(eye_direction)
    right = np.cross([0, 0, 1], towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(towards, right)])  # the picture's x and y in base
    centre = (index + 0.5) * size_m
    flat = centre @ axes.T
    low, high = flat.min(axis=0) - size_m, flat.max(axis=0) + size_m
    extent = high - low
    scale = (width - 20) / float(extent.max())
    picture = np.full((int(extent[1] * scale) + 20, width, 3), _BACKGROUND, np.uint8)
    offset = np.array([width, picture.shape[0]]) / 2 - (low + high) / 2 * scale
    occupied = {tuple(voxel) for voxel in index.tolist()}
    visible = []
    for axis, sign, corners in _FACES:
        facing = sign * towards[axis]
        if facing > 1e-9:
            step = [sign if a == axis else 0 for a in range(3)]
            place = (np.array(corners) * size_m / 2) @ axes.T * scale
            visible.append((step, 0.45 + 0.55 * facing, place))
    order = np.argsort(centre @ towards, kind="stable")
    for row in order:
        i, j, k = index[row].tolist()
        at = flat[row] * scale + offset
        for step, light, place in visible:
            if (i + step[0], j + step[1], k + step[2]) not in occupied:
                polygon = np.round((place + at) * 16).astype(np.int32)
                shade = (colour[row] * light).tolist()
                cv2.fillConvexPoly(picture, polygon, shade, cv2.LINE_8, shift=4)
    return picture


def draw_map(path: Path, layers: Any, size_m: float, names: tuple[str, ...], class_rgb: RGB) -> None:
    """Writes a picture of a map: its classes, their probability, and a legend.

    Args:
        path: The PNG to write.
        layers: A fused map (index, p, weight, count).
        size_m: Voxel size.
        names: The classes.
        class_rgb: (k, 3) their colours.
    """
    plt = _pyplot()
    label = layers.label()
    confidence = layers.p.max(axis=1)
    class_colour = coloured(label, class_rgb)
    shades = plt.get_cmap("viridis")(confidence)[:, :3]
    eye = _eye_direction(layers.index, size_m)
    drawn = draw_voxels(layers.index, size_m, class_colour, eye)
    sure = draw_voxels(layers.index, size_m, (shades * 255).astype(np.uint8), eye)
    height = 8.5 * drawn.shape[0] / drawn.shape[1] + 1.2
    figure, axes = plt.subplots(1, 2, figsize=(17, height), layout="constrained")
    for ax, title, picture in zip(axes, ("surface type", "its probability"), (drawn, sure), strict=True):
        ax.imshow(picture, interpolation="antialiased")
        ax.set_title(title)
        ax.axis("off")
    counts = np.bincount(label, minlength=len(names) + 1)
    patches = [
        plt.matplotlib.patches.Patch(color=rgb / 255, label=f"{name}  {count:,}")
        for name, rgb, count in zip(names, class_rgb, counts[1:], strict=True)
    ]
    if counts[0]:
        patches.append(plt.matplotlib.patches.Patch(color=_UNKNOWN / 255, label=f"unknown  {counts[0]:,}"))
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), frameon=False)
    bar = plt.cm.ScalarMappable(cmap="viridis", norm=plt.Normalize(0, 1))
    figure.colorbar(bar, ax=axes[1], fraction=0.025)
    figure.suptitle(f"{len(label):,} voxels of {size_m * 1000:g} mm, seen from the robot's side")
    _save(figure, path)


def _eye_direction(index: Int32, size_m: float) -> Float64:
    """From the map's middle towards the robot's base, and from above."""
    middle = (index.mean(axis=0) + 0.5) * size_m if len(index) else np.ones(3)
    flat = -middle[:2] / max(float(np.linalg.norm(middle[:2])), 1e-6)
    return np.array([flat[0], flat[1], 0.6])


def coloured(label: NDArray[np.uint8], class_rgb: RGB) -> RGB:
    """Returns a label image in the classes' colours; 0 is drawn dark."""
    return np.vstack([_UNKNOWN[None], class_rgb])[label]


def draw_views(path: Path, rows: list[tuple[str, list[tuple[str, RGB]]]]) -> None:
    """Writes rows of titled pictures: one row a view, the same columns in each."""
    plt = _pyplot()
    columns = len(rows[0][1])
    figure, axes = plt.subplots(
        len(rows), columns, figsize=(3.6 * columns, 2.75 * len(rows)), layout="constrained", squeeze=False
    )
    for line, (name, pictures) in zip(axes, rows, strict=True):
        for ax, (title, picture) in zip(line, pictures, strict=True):
            ax.imshow(picture)
            ax.set_title(f"{name}: {title}" if picture is pictures[0][1] else title, fontsize=9)
            ax.axis("off")
    _save(figure, path)


def draw_confusions(path: Path, result: dict[str, Any]) -> None:
    """Writes the confusion matrix of every route's fused map, rows normalised to the truth."""
    plt = _pyplot()
    routes = result["routes"]
    figure, axes = plt.subplots(
        1, len(routes), figsize=(3.4 * len(routes) + 0.6, 3.9), layout="constrained", squeeze=False
    )
    names = result["classes"]
    for ax, (route, figures) in zip(axes[0], routes.items(), strict=True):
        counts = np.array(figures["fused"]["confusion"], np.float64)
        share: Float32 | Float64 = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        ax.imshow(share, cmap="Blues", vmin=0, vmax=1)
        for row in range(len(names)):
            for col in range(len(names)):
                ink = "white" if share[row, col] > 0.55 else "black"
                ax.text(col, row, f"{share[row, col]:.2f}", ha="center", va="center", color=ink, fontsize=8)
        ax.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
        ax.set_yticks(range(len(names)), names, fontsize=8)
        overall = figures["fused"]["overall"]
        ax.set_title(f"{route}: {overall:.1%} of {figures['fused']['voxels']:,} voxels", fontsize=9)
    axes[0][0].set_ylabel("truth")
    _save(figure, path)


def _pyplot() -> Any:
    import matplotlib  # late: it costs half a second

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _save(figure: Any, path: Path) -> None:
    part = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(part, format="png", dpi=110)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
        _pyplot().close(figure)
