"""Finds the corners of a checkerboard in an image, also where speckle or low contrast hide them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float32, Float64

Grey = NDArray[np.uint8]

_LEAST_SQUARE_PX = 3.0
_SMOOTHINGS = (0.0, 1.0, 2.0, 3.0)  # px; speckle of a structured-light projector is about 2 px wide
_QUICK_SMOOTHINGS = (0.0, 1.5)


def grey_image(image: NDArray[Any]) -> Float32:
    """Returns (h, w) float32 from a grey or an RGB image of any type.

    Raises:
        InputError: For an image of another shape.
    """
    if image.ndim == 3 and image.shape[2] == 3:
        return np.asarray(cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY), np.float32)
    if image.ndim != 2:
        raise InputError(f"board: image of shape {image.shape}, allowed are height × width and × 3")
    return image.astype(np.float32)


def find_checkerboard(grey: Float32, size: tuple[int, int], *, quick: bool = False) -> Float64 | None:
    """Returns the inner corners (rows · columns, 2) in px to about half a pixel, or None.

    They go row by row, x to the right of y as on the board's front; where the colours of the squares
    tell the two ends of the board apart, the first square (beside the first corner, inside) is dark.

    Args:
        grey: (h, w).
        size: Columns and rows of inner corners.
        quick: For a live view: the likely attempts only.
    """
    for attempt, scale in _attempts(grey, quick):
        found, corners = cv2.findChessboardCornersSB(attempt, size, flags=0)
        if found:
            places = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
            if _is_grid(places, size):
                return in_order(places, size, grey)
    return None


def rough_size(grey: Float32) -> tuple[int, int] | None:
    """Returns columns and rows of inner corners of whatever checkerboard is in sight, or None.

    It may be one too many: something beside the board may look like one more row.
    """
    for attempt, _ in _attempts(grey, quick=False):
        found, _, cells = cv2.findChessboardCornersSBWithMeta(attempt, (3, 3), cv2.CALIB_CB_LARGER)
        if found and cells is not None and min(cells.shape[:2]) >= 3:
            return int(cells.shape[1]), int(cells.shape[0])
    return None


def _attempts(grey: Float32, quick: bool) -> Iterator[tuple[Grey, float]]:
    """Yields 8-bit images and how much larger each is, the likeliest to succeed first.

    The square root evens out noise that grows with the light, such as speckle's: the edges of a dark
    square then are as sharp from both sides.
    """
    root = np.sqrt(np.maximum(grey - grey.min(), 0))
    small = max(grey.shape) < 1000
    scales: tuple[float, ...] = (2.0, 1.0) if small else (1.0, 0.5)
    if quick:
        scales = scales[:1] if small else scales[1:]
    for scale in scales:
        for smoothing in _QUICK_SMOOTHINGS if quick else _SMOOTHINGS:
            smooth = cv2.GaussianBlur(root, (0, 0), smoothing) if smoothing else root
            way = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
            sized = smooth if scale == 1 else cv2.resize(smooth, None, fx=scale, fy=scale, interpolation=way)
            yield stretched(sized), scale
    if not quick:
        even = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(6, 6))
        for smoothing in _SMOOTHINGS[1:]:
            flat = even.apply(stretched(cv2.GaussianBlur(root, (0, 0), smoothing)))
            yield np.asarray(flat, np.uint8), 1.0


def stretched(image: NDArray[Any]) -> Grey:
    """Returns the image in 8 bits, black at its 1st and white at its 98th percentile."""
    low, high = np.percentile(image, [1, 98])
    scaled = (image - low) * (255 / max(float(high - low), 1e-6))
    result: Grey = np.clip(scaled, 0, 255).astype(np.uint8)
    return result


def in_order(places: Float64, size: tuple[int, int], grey: Float32) -> Float64:
    """Returns the corners right-handed and, where the colours tell, with the first square dark."""
    columns, rows = size
    grid = places.reshape(rows, columns, 2)
    across, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    right, below = across.mean(axis=0), down.mean(axis=0)
    if right[0] * below[1] - right[1] * below[0] < 0:
        grid = grid[:, ::-1]
    if (columns + rows) % 2 and _first_is_light(grid, grey):
        grid = grid[::-1, ::-1]
    elif columns == rows and columns % 2 and _first_is_light(grid, grey):
        grid = np.rot90(grid)
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _first_is_light(grid: Float64, grey: Float32) -> bool:
    """Compares the squares inside the grid of corners, the two colours by each one's middle."""
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    spot = middle.astype(np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.5)
    value = cv2.remap(smooth, spot[..., 0], spot[..., 1], cv2.INTER_LINEAR)
    even = np.add.outer(np.arange(value.shape[0]), np.arange(value.shape[1])) % 2 == 0
    return bool(np.median(value[even]) > np.median(value[~even]))


def _is_grid(places: Float64, size: tuple[int, int]) -> bool:
    """Whether the corners lie as a plane's would: close to a homography of the grid."""
    columns, rows = size
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    flat = np.stack([x, y], axis=-1).reshape(-1, 2)
    matrix, _ = cv2.findHomography(flat, places)
    if matrix is None:
        return False
    away = np.linalg.norm(cv2.perspectiveTransform(flat[None], matrix)[0] - places, axis=1)
    side = square_px(places, size)
    return bool(side >= _LEAST_SQUARE_PX and np.sqrt(np.mean(away**2)) < 0.25 * side)


def square_px(places: Float64, size: tuple[int, int]) -> float:
    """Returns the shortest median side of the squares, px: along rows or along columns."""
    grid = places.reshape(size[1], size[0], 2)
    sides = [np.median(np.linalg.norm(np.diff(grid, axis=axis), axis=-1)) for axis in (0, 1)]
    return float(min(sides))
