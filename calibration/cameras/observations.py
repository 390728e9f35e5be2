"""The corners that were found, of all views and cameras, as the rows that an adjustment works on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import Board, Found
from surfclass.types import Bool, Float64


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One viewpoint.

    Attributes:
        name: Of the capture or the pair.
        found: The board in each camera's image that shows it, by the camera's name.
    """

    name: str
    found: Mapping[str, Found]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """n corners, sorted by view.

    Attributes:
        cameras: Names; the first one's frame is that of the poses.
        sizes: (width, height) of each camera's images, px.
        views: Names.
        camera: (n,) index in `cameras`.
        view: (n,) index in `views`, rising.
        corner: (n,) index in the board's corners.
        point: (n, 3) m, in the board's frame.
        pixel: (n, 2).
    """

    cameras: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    views: tuple[str, ...]
    camera: NDArray[np.int64]
    view: NDArray[np.int64]
    corner: NDArray[np.int64]
    point: Float64
    pixel: Float64

    def __len__(self) -> int:
        return len(self.view)

    def where(self, kept: Bool) -> Observations:
        """Returns some of the corners; the lists of cameras and views stay as they are."""
        return replace(
            self,
            camera=self.camera[kept],
            view=self.view[kept],
            corner=self.corner[kept],
            point=self.point[kept],
            pixel=self.pixel[kept],
        )

    def of_views(self, wanted: Sequence[int]) -> Observations:
        """Returns the corners of some views, which are numbered anew from 0."""
        kept = self.where(np.isin(self.view, wanted))
        order = np.unique(np.asarray(wanted))
        names = tuple(self.views[i] for i in order)
        return replace(kept, views=names, view=np.searchsorted(order, kept.view))

    def of_camera(self, index: int) -> Observations:
        """Returns one camera's corners, and only the views in which it saw the board."""
        own = self.where(self.camera == index)
        one = replace(
            own,
            cameras=(self.cameras[index],),
            sizes=(self.sizes[index],),
            camera=np.zeros(len(own), np.int64),
        )
        return one.of_views(np.unique(own.view).tolist())


def observations_of(
    views: Sequence[View], board: Board, sizes: Mapping[str, tuple[int, int]]
) -> Observations:
    """Returns the corners of the views in which any camera saw the board.

    Args:
        views: In any order.
        board: What was looked at.
        sizes: (width, height) of each camera's images; the first is the reference.
    """
    cameras = tuple(sizes)
    seen = [view for view in views if any(name in view.found for name in cameras)]
    rows = [
        (index, number, found)
        for index, view in enumerate(seen)
        for number, name in enumerate(cameras)
        if (found := view.found.get(name)) is not None
    ]
    counts = [len(found.ids) for *_, found in rows]
    corner = np.concatenate([found.ids for *_, found in rows] or [np.zeros(0, np.int64)])
    return Observations(
        cameras,
        tuple(sizes.values()),
        tuple(view.name for view in seen),
        np.repeat([number for _, number, _ in rows], counts).astype(np.int64),
        np.repeat([index for index, _, _ in rows], counts).astype(np.int64),
        corner,
        board.points_m[corner],
        np.concatenate([found.corners for *_, found in rows] or [np.zeros((0, 2))]),
    )
