"""Polygons and the label images that they stand for, both ways."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surfclass.schema import Number, Table

_FRACTION_BITS = 4  # of a pixel, in cv2's fixed-point coordinates
_REACH_PX = 20_000  # a polygon may be dragged beyond the image, and no further than this
Coordinate = Annotated[Number, Field(ge=-_REACH_PX, le=_REACH_PX)]


class Shape(Table):
    """A filled polygon; where lines cross, the even-odd rule says what is inside.

    Attributes:
        label: What its pixels are: 1 + the class index, or 0 to erase.
        points: Corners (x, y), px; (0, 0) is the centre of the top-left pixel.
    """

    label: Annotated[int, Field(ge=0, le=254, strict=True)]
    points: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(min_length=3, max_length=20_000)]


def rasterise(shapes: Sequence[Shape], below: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns (h, w): the label image `below` with the shapes painted over it, the last on top.

    A polygon covers the pixels whose centres it contains, and those that its outline passes through.
    """
    label = below.copy()
    for shape in shapes:
        corners = np.rint(np.array(shape.points) * (1 << _FRACTION_BITS)).astype(np.int32)
        cv2.fillPoly(label, [corners], int(shape.label), shift=_FRACTION_BITS)
    return label


def outlines(
    label: NDArray[np.uint8], tolerance_px: float = 0.0, least_px: int = 1, least_hole_px: int = 1
) -> tuple[Shape, ...]:
    """Returns polygons that `rasterise` turns into this label image again.

    Every region of one label is its filled outline; regions inside it, holes too, are smaller and painted
    after it.

    Args:
        label: (h, w).
        tolerance_px: How far an outline may be from the region's, to have fewer corners; 0 is exact.
        least_px: Regions of fewer pixels are left out.
        least_hole_px: Holes of fewer pixels are filled.
    """
    found: list[Shape] = []
    covered = np.zeros_like(label)  # by an outline: what is unlabelled elsewhere needs none
    least = {int(value): least_px if value else least_hole_px for value in np.unique(label)}
    regions = [one for value, size in least.items() for one in _regions(label == value, value, size)]
    for _, value, contour in sorted(regions, key=lambda region: -region[0]):
        column, row = contour[0, 0]
        if value == 0 and not covered[row, column]:
            continue
        cv2.fillPoly(covered, [contour], 1)
        smooth = cv2.approxPolyDP(contour, tolerance_px, closed=True) if tolerance_px else contour
        corners = smooth[:, 0].tolist()
        while len(corners) < 3:  # a region one pixel wide is a line or a point
            corners.append(corners[-1])
        found.append(Shape(label=value, points=tuple((float(x), float(y)) for x, y in corners)))
    return tuple(found)


_Region = tuple[int, int, NDArray[np.int32]]


def _regions(mask: NDArray[np.bool_], value: int, least_px: int) -> list[_Region]:
    """The 4-connected regions of a mask: filled area, value and outline (n, 1, 2)."""
    count, number, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    regions: list[_Region] = []
    for index in range(1, count):
        x, y, w, h, count_px = statistics[index]
        if count_px < least_px:
            continue
        own = (number[y : y + h, x : x + w] == index).astype(np.uint8)
        contours, _ = cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        filled_px = int(cv2.fillPoly(np.zeros_like(own), contours, 1).sum())
        regions.append((filled_px, value, np.asarray(contours[0], np.int32) + np.array([x, y], np.int32)))
    return regions
