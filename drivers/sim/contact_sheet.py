"""A picture of every simulated scene: colour, depth, IR and truth side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim import truth
from drivers.sim.materials import CLASS_COLOURS, CLASS_NAMES
from drivers.sim.scenes import SCENES
from drivers.sim.views import Viewpoint
from drivers.sim.world import SimWorld
from surfclass.errors import InputError

CELL_VIEWS = ("front_065", "left_065", "upper_075", "plate_070", "corner_090", "steep_105", "whole_130")
_SHOWN_ALREADY = ("limits:", "exposure_card")  # boards and a card as in other scenes, from elsewhere
_TILE = (240, 180)
_CAPTION_PX = 18
_NEAR_MM, _FAR_MM = 500, 1700

Image = NDArray[np.uint8]


def contact_sheet(seed: int = 0, scale: float = 1.0) -> Image:
    """Returns (h, w, 3) uint8 RGB: two views a row, each with colour, depth, IR and labels.

    Args:
        seed: Of the worlds.
        scale: Of the rendered images; the tiles have one size in any case.
    """
    strips = []
    for scene in (one for one in SCENES if not one.startswith(_SHOWN_ALREADY)):
        world = SimWorld(scene, seed, scale=scale)
        names = CELL_VIEWS if scene == "cell" else (world.viewpoints[0].name,)
        strips += [_strip(world, one) for one in world.viewpoints if one.name in names]
    if len(strips) % 2:
        strips.append(np.full_like(strips[0], 255))
    rows = [np.hstack(strips[index : index + 2]) for index in range(0, len(strips), 2)]
    return np.vstack([*rows, _legend(rows[0].shape[1])])


def write(path: Path, image: Image) -> None:
    """Writes the picture as PNG or JPEG, as the name says.

    Raises:
        InputError: If the name ends in neither, or the file cannot be written.
    """
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{path}: allowed endings are .png, .jpg and .jpeg")
    options = [cv2.IMWRITE_JPEG_QUALITY, 86] if path.suffix.lower() != ".png" else []
    _, data = cv2.imencode(path.suffix, image[..., ::-1], options)
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _strip(world: SimWorld, view: Viewpoint) -> Image:
    colour = world.render_colour(view.q, 1.0, 1)
    depth, ir = world.render_depth(view.q, 1)
    label = truth.label_image(world, view.q)
    near = (depth.astype(np.float32) - _NEAR_MM) / (_FAR_MM - _NEAR_MM)
    turbo = cv2.applyColorMap((255 * np.clip(near, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)
    shown = np.where((depth > 0)[..., None], turbo[..., ::-1], 0).astype(np.uint8)
    bright = np.repeat((ir // 4).astype(np.uint8)[..., None], 3, axis=2)
    tiles = [_tile(np.asarray(image)) for image in (colour, shown, bright, _palette()[label])]
    text = f"{world.scene.name}  {view.name}  {view.distance_m:.2f} m  {np.degrees(view.angle_rad):.0f} deg"
    return np.vstack([_caption(text, 4 * _TILE[0]), np.hstack(tiles)])


def _tile(image: Image) -> Image:
    small = cv2.resize(image, _TILE, interpolation=cv2.INTER_AREA)
    small[-1:], small[:, -1:] = 255, 255
    return np.asarray(small, dtype=np.uint8)


def _palette() -> Image:
    colours = [[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in CLASS_COLOURS]
    return np.array([[40, 40, 40], *colours], np.uint8)


def _caption(text: str, width: int) -> Image:
    band = np.full((_CAPTION_PX, width, 3), 255, np.uint8)
    return np.asarray(
        cv2.putText(band, text, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    )


def _legend(width: int) -> Image:
    text = f"colour (raw), depth {_NEAR_MM} to {_FAR_MM} mm (black: no return), IR, labels:"
    band = _caption(text, width)
    x = 640
    for name, colour in zip(("none", *CLASS_NAMES), _palette(), strict=True):
        band[3:15, x : x + 24] = colour
        cv2.putText(band, name, (x + 30, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
        x += 130
    return band


def main(arguments: list[str] | None = None) -> int:
    """Draws the sheet; returns 0, or 2 where the file cannot be written."""
    parser = argparse.ArgumentParser(prog="python -m drivers.sim.contact_sheet", description=__doc__)
    parser.add_argument("out", type=Path, help="OUT.png or OUT.jpg")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0, help="of the rendered images, 0.05 to 1")
    given = parser.parse_args(arguments)
    try:
        write(given.out, contact_sheet(given.seed, given.scale))
    except InputError as error:
        parser.exit(2, f"{error}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
