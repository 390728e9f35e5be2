"""Pictures for people: the map, images beside their labels, confusion matrices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.plots import draw_confusion, drawing
from surfclass.types import Float64, Int32

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
    label = layers.label()
    confidence = layers.p.max(axis=1)
    class_colour = coloured(label, class_rgb)
    eye = _eye_direction(layers.index, size_m)
    drawn = draw_voxels(layers.index, size_m, class_colour, eye)
    with drawing(path, 1, 2, figsize=(17, 8.5 * drawn.shape[0] / drawn.shape[1] + 1.2)) as (figure, axes):
        from matplotlib import cm, colormaps, colors, patches  # after `drawing` has chosen how it draws

        shades = colormaps["viridis"](confidence)[:, :3]
        sure = draw_voxels(layers.index, size_m, (shades * 255).astype(np.uint8), eye)
        titles = ("surface type", "its probability")
        for ax, title, picture in zip(axes[0], titles, (drawn, sure), strict=True):
            ax.imshow(picture, interpolation="antialiased")
            ax.set_title(title)
            ax.axis("off")
        counts = np.bincount(label, minlength=len(names) + 1)
        legend = [
            patches.Patch(color=tuple(rgb / 255), label=f"{name}  {count:,}")
            for name, rgb, count in zip(names, class_rgb, counts[1:], strict=True)
        ]
        if counts[0]:
            legend.append(patches.Patch(color=tuple(_UNKNOWN / 255), label=f"unknown  {counts[0]:,}"))
        figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
        bar = cm.ScalarMappable(cmap="viridis", norm=colors.Normalize(0, 1))
        figure.colorbar(bar, ax=axes[0][1], fraction=0.025)
        figure.suptitle(f"{len(label):,} voxels of {size_m * 1000:g} mm, seen from the robot's side")


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
    columns = len(rows[0][1])
    size = (3.6 * columns, 2.75 * len(rows))
    with drawing(path, len(rows), columns, figsize=size) as (_, axes):
        for line, (name, pictures) in zip(axes, rows, strict=True):
            for ax, (title, picture) in zip(line, pictures, strict=True):
                ax.imshow(picture)
                ax.set_title(f"{name}: {title}" if picture is pictures[0][1] else title, fontsize=9)
                ax.axis("off")


def draw_confusions(path: Path, result: dict[str, Any]) -> None:
    """Writes the confusion matrix of every route's fused map, rows normalised to the truth."""
    routes, names = result["routes"], result["classes"]
    with drawing(path, 1, len(routes), figsize=(3.4 * len(routes) + 0.6, 3.9)) as (_, axes):
        for ax, (route, figures) in zip(axes[0], routes.items(), strict=True):
            draw_confusion(ax, figures["fused"]["confusion"], names)
            overall = figures["fused"]["overall"]
            ax.set_title(f"{route}: {overall:.1%} of {figures['fused']['voxels']:,} voxels", fontsize=9)
        axes[0][0].set_ylabel("truth")
