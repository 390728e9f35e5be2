"""Reads the views: every image of the board, with its corners."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import Board, find_board, size_seen
from calibration.cameras.observations import View
from calibration.cameras.pairs import ImagePairs
from calibration.outcome import Note, RefusedError
from calibration.source import Source


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What was seen.

    Attributes:
        views: Each with the corners that were found.
        sizes: (width, height) of the cameras' images, px; the first camera is the reference.
        missed: For each camera the names of the views in which the board was not found.
        depth_mm: Depth images by view, of those that have one.
        other_board: Where most images do not show the board as told: which one they show, a sentence.
    """

    views: tuple[View, ...]
    sizes: Mapping[str, tuple[int, int]]
    missed: Mapping[str, tuple[str, ...]]
    depth_mm: Mapping[str, NDArray[np.uint16]]
    other_board: str | None


def read_views(source: Source | ImagePairs, board: Board, note: Note) -> Views:
    """Finds the board in every image.

    Raises:
        RefusedError: If it is in none, saying what is there instead.
        InputError: As the source does.
    """
    views, sizes, depth = [], dict[str, tuple[int, int]](), {}
    missed: dict[str, list[str]] = {}
    last: NDArray[Any] | None = None
    for name, images, reading in _images(source):
        found = {}
        for camera, image in images.items():
            sizes.setdefault(camera, (image.shape[1], image.shape[0]))
            corners = find_board(image, board)
            if corners is None:
                missed.setdefault(camera, []).append(name)
                last = image
            else:
                found[camera] = corners
        views.append(View(name, found))
        if reading is not None:
            depth[name] = reading
        note(f"{name}: board in {' and '.join(found) or 'no image'}")
    order = source.cameras if isinstance(source, ImagePairs) else ("depth", "rgb")
    seen = {camera: sizes[camera] for camera in order if any(camera in view.found for view in views)}
    other = None
    if last is not None and sum(map(len, missed.values())) > sum(len(view.found) for view in views):
        other = _other_board(board, last)
    if not seen:
        if last is None:
            raise RefusedError(
                "there are no images of a board (captures of the role board with IR or colour): capture a "
                "board from 12 or more directions"
            )
        whole = "it has to be whole in the image, lit evenly and sharp"
        raise RefusedError(f"the {board} is in none of {len(views)} views; {other or whole}")
    return Views(tuple(views), seen, {camera: tuple(names) for camera, names in missed.items()}, depth, other)


def _images(
    source: Source | ImagePairs,
) -> Iterator[tuple[str, dict[str, NDArray[Any]], NDArray[np.uint16] | None]]:
    if isinstance(source, ImagePairs):
        for name, images in source.images():
            yield name, images, None
        return
    for capture in source.captures("board"):
        both = {"depth": capture.depth.ir, "rgb": None if capture.colour is None else capture.colour.rgb}
        yield (
            capture.name,
            {key: image for key, image in both.items() if image is not None},
            capture.depth.depth_mm,
        )


def _other_board(board: Board, image: NDArray[Any]) -> str | None:
    size = size_seen(image) if board.kind == "checkerboard" else None
    if size is None or set(size) == {board.columns, board.rows}:
        return None
    return (
        f"there is a checkerboard of {size[0]} × {size[1]} inner corners instead: count the corners where "
        f"four squares meet, and say --board {size[0]}x{size[1]}"
    )
