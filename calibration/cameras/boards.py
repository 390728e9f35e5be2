"""Calibration boards in images: which corners are seen, and where to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.detection import find_checkerboard, grey_image, rough_size, stretched
from calibration.cameras.refinement import refine
from drivers.recordings.board import Board
from surfclass.errors import ConfigurationError
from surfclass.types import Float32, Float64

__all__ = ["Board", "Found", "find_board", "size_seen", "symmetries"]

_LEAST_CORNERS = 6
_LEAST_PLACED = 0.93  # of a checkerboard's corners; a whole row that is none is another board


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The corners of a board that an image shows.

    Attributes:
        corners: (n, 2) float64 px, sub-pixel, in the image's grid.
        ids: (n,) which rows of `Board.points_m` they are.
    """

    corners: Float64
    ids: NDArray[np.int64]


def find_board(image: NDArray[Any], board: Board, *, quick: bool = False) -> Found | None:
    """Returns where the board's corners are, or None where it is not found.

    A plain checkerboard is found whole or not at all. Its corners are in one order in any image where
    the colours of its squares allow that (columns + rows odd); else the two ends may be swapped.

    Args:
        image: (h, w) or (h, w, 3) RGB, of any type; IR with speckle, too.
        board: What to look for.
        quick: For a live view: fewer attempts.

    Raises:
        InputError: For an image of another shape.
        ConfigurationError: For a dictionary that the library does not know.
    """
    grey = grey_image(image)
    if board.dictionary is not None and board.marker_m is not None:
        return _find_charuco(grey, board, board.dictionary, board.marker_m)
    size = board.columns, board.rows
    rough = find_checkerboard(grey, size, quick=quick)
    if rough is None:
        return None
    corners = refine(grey, rough, size, quick=quick)
    placed = np.isfinite(corners[:, 0])
    if placed.mean() < _LEAST_PLACED:
        return None
    return Found(corners[placed], np.flatnonzero(placed))


def size_seen(image: NDArray[Any]) -> tuple[int, int] | None:
    """Returns columns and rows of inner corners of whatever checkerboard an image shows, or None."""
    rough = rough_size(grey_image(image))
    if rough is None:
        return None
    columns, rows = rough
    for size in ((columns, rows), (columns - 1, rows), (columns, rows - 1), (columns - 1, rows - 1)):
        if min(size) >= 3 and find_board(image, Board(columns=size[0], rows=size[1], square_m=1.0)):
            return max(size), min(size)
    return None


def symmetries(board: Board) -> list[NDArray[np.int64]]:
    """Returns the orders in which a board's corners may be found, (n,) indices each; the first as they are.

    A checkerboard looks the same from its other end where columns + rows is even, and from all four
    sides where both are the same even number; a ChArUco board says which corner is which.
    """
    grid = np.arange(board.columns * board.rows).reshape(board.rows, board.columns)
    quarters = [0]
    if board.kind == "checkerboard" and (board.columns + board.rows) % 2 == 0:
        quarters = [0, 1, 2, 3] if board.columns == board.rows and board.columns % 2 == 0 else [0, 2]
    return [np.rot90(grid, quarter).reshape(-1).astype(np.int64) for quarter in quarters]


def _find_charuco(grey: Float32, board: Board, dictionary: str, marker_m: float) -> Found | None:
    number = getattr(cv2.aruco, dictionary, None)
    if number is None:
        known = ", ".join(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
        raise ConfigurationError(f"board: dictionary {dictionary!r}, allowed: {known}")
    markers = cv2.aruco.getPredefinedDictionary(number)
    squares = (board.columns + 1, board.rows + 1)
    image = stretched(grey)
    best: Found | None = None
    for legacy in (False, True):
        pattern = cv2.aruco.CharucoBoard(squares, board.square_m, marker_m, markers)
        pattern.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(image)
        if ids is None or len(ids) < _LEAST_CORNERS:
            continue
        if best is None or len(ids) > len(best.ids):
            places = np.asarray(corners, np.float64).reshape(-1, 2)
            best = Found(places, np.asarray(ids, np.int64).reshape(-1))
    return best
