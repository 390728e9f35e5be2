"""Bright round blobs in an IR image: where reflector discs may be (A.2), whatever exposure and speckle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.types import Float64

_LEVELS = 12  # thresholds between the background and the brightest, evenly spaced in their logarithm
_KERNELS = (3, 5, 7, 9, 11, 13)
_LEAST_AREA_PX = 30
_SPECK = 0.3  # of the smallest disc's area, below which a piece is speckle
_KERNEL = 1.3  # of the smallest disc's radius: a median of 2.5 of it would take the disc away
_VERY_ROUND = 0.93  # of 1, which an ellipse has
ROUND = 0.80
"""Share of its ellipse's area below which a blob is certainly no disc."""
_SMALL = 0.6  # of the smallest disc
_CORES = (0.6, 0.75, 0.88)  # of the way to a blob's border: its neck may be nearly as wide as it is
_SAME_PLACE = 0.6  # of a semi-axis: centres closer than this belong to one blob
_MUCH_SMALLER = 0.75
_LONG = 1.5  # times as long as wide: it may be two discs
_LEAST_CONTRAST = 4.0  # of the distance between the background's median and 80 %


@dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """A bright region with its holes filled, as the ellipse that has its second moments.

    Attributes:
        pixel: (2,) centre, px.
        covariance: (2, 2) px², a quarter of the squared semi-axes along its own axes.
        roundness: Its area over the ellipse's; 1 for an ellipse.
        level: The threshold that shows it, in the image's counts.
        outline: (n, 2) px, its border.
        cut: Whether it reaches the image's border.
        within: Much smaller blobs of the same place at other thresholds, in case it is several discs in one.
    """

    pixel: Float64
    covariance: Float64
    roundness: float
    level: float
    outline: Float64
    cut: bool
    within: tuple[Blob, ...] = ()

    @property
    def semi_axes(self) -> tuple[float, float]:
        """The longer and the shorter, px."""
        (xx, xy), (_, yy) = self.covariance.tolist()
        middle, half = (xx + yy) / 2, float(np.hypot((xx - yy) / 2, xy))
        return 2 * (middle + half) ** 0.5, 2 * max(middle - half, 0.0) ** 0.5

    def reach(self, x: NDArray[Any] | float, y: NDArray[Any] | float) -> NDArray[Any]:
        """Returns how far pixels lie from the centre, as a multiple of the ellipse."""
        (xx, xy), (_, yy) = self.covariance.tolist()
        u, v = x - self.pixel[0], y - self.pixel[1]
        squared = (yy * u * u - 2 * xy * u * v + xx * v * v) / (4 * (xx * yy - xy * xy))
        far: NDArray[Any] = np.sqrt(squared)
        return far


def saturation_level(ir: NDArray[Any]) -> float:
    """Returns the count at which an IR image (h, w) is clipped; infinite where nothing piles up at its top.

    The range of a 16 bit image is not known: 10 bits are common.
    """
    top = int(ir.max())
    at_top = int(np.count_nonzero(ir == top))
    below = int(np.count_nonzero((ir >= 0.95 * top) & (ir < top)))
    levels = max(1, top - int(np.ceil(0.95 * top)))
    return float(top) if top >= 100 and at_top >= 20 and at_top > 3 * below / levels else np.inf


def find_blobs(ir: NDArray[Any], smallest_px: float, largest_px: float) -> list[Blob]:
    """Returns the bright blobs of an IR image, the roundest of each place.

    The median filter grows until no speckle is left that a threshold would show; it keeps edges
    where they are. Then every one of a series of thresholds is looked through: there is no single one
    where a brighter object stands beside the plate, or where discs shine into each other. What is not
    round is returned too if it is bright: it is to be told why it counts for nothing.

    Args:
        ir: (h, w) uint8 or uint16, any exposure.
        smallest_px: Radius of the farthest disc that there can be; what is much smaller is not returned.
        largest_px: Of the nearest; what is much larger is not returned either.
    """
    image, counts = _despeckled(ir, smallest_px)
    low, high = _range(image)
    found: list[Blob] = []
    if high <= low:
        return found
    for level in np.geomspace(max(low, 1.0), max(high, 1.0), _LEVELS + 1)[:-1]:
        found += _at(image, float(level), float(level) * counts, smallest_px, largest_px)
    middle = _middle(low, high) * counts
    return [blob for blob in best_of(found) if blob.roundness >= ROUND or blob.level >= middle]


def _despeckled(ir: NDArray[Any], smallest_px: float) -> tuple[NDArray[np.uint8], float]:
    """Returns the median-filtered image in 8 bits, and how many of the counts one of its levels is.

    Whether specks are left is asked halfway (in the logarithm) between the background and the brightest.
    """
    peak = float(np.partition(ir.ravel(), -_LEAST_AREA_PX)[-_LEAST_AREA_PX])
    counts = max(peak, 1.0) / 255.0
    eight = np.clip(np.round(ir / counts), 0, 255).astype(np.uint8)
    filtered = eight
    for size in _KERNELS:
        if size > max(3.0, _KERNEL * smallest_px):
            break
        filtered = np.asarray(cv2.medianBlur(eight, size), np.uint8)
        low, high = _range(filtered)
        binary = (filtered > _middle(low, high)).astype(np.uint8)
        count, _, stats, _ = cv2.connectedComponentsWithStats(binary, connectivity=4)
        if not (stats[1:count, cv2.CC_STAT_AREA] < _SPECK * np.pi * smallest_px**2).any():
            break
    return filtered, counts


def _range(image: NDArray[np.uint8]) -> tuple[float, float]:
    """Returns the least and the greatest threshold that can part discs from the rest.

    Discs are a small part of the image, so its 80 % tell how the rest spreads; unless something bright is
    large, which must not hide them.
    """
    middle, upper = (float(value) for value in np.quantile(image, (0.5, 0.8)))
    high = float(image.max())
    return middle + max(2.0, min(_LEAST_CONTRAST * (upper - middle), 0.2 * (high - middle))), high


def _middle(low: float, high: float) -> float:
    return float(np.sqrt(max(low, 1.0) * max(high, 1.0)))


def _at(
    image: NDArray[np.uint8], level: float, counts: float, smallest_px: float, largest_px: float
) -> list[Blob]:
    binary = (image > level).astype(np.uint8)
    contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    blobs = []
    for contour in contours:
        sides = cv2.boundingRect(contour)[2:]
        if max(sides) < _SMALL * 2 * smallest_px or len(contour) > 16 * largest_px:
            continue
        blob = _blob(contour, image.shape, counts)
        if blob is None or blob.semi_axes[0] > 2.2 * largest_px:
            continue
        blobs.append(blob)
        if blob.roundness < _VERY_ROUND or blob.semi_axes[0] > _LONG * blob.semi_axes[1]:
            blobs += _parted(contour, blob, image.shape)
    return blobs


def _blob(
    contour: NDArray[Any], shape: tuple[int, ...], level: float, least_px: float = _LEAST_AREA_PX
) -> Blob | None:
    x, y, w, h = cv2.boundingRect(contour)
    filled = np.zeros((h, w), np.uint8)
    cv2.drawContours(filled, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    moments = cv2.moments(filled, binaryImage=True)
    area = moments["m00"]
    if area < least_px:
        return None
    # A pixel is a square, whose own second moment of 1/12 the sum over its centres leaves out.
    covariance = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / area
    covariance += np.eye(2) / 12
    centre = np.array([x + moments["m10"] / area, y + moments["m01"] / area])
    ellipse = 4 * np.pi * float(np.sqrt(np.linalg.det(covariance)))
    cut = x <= 1 or y <= 1 or x + w >= shape[1] - 1 or y + h >= shape[0] - 1
    outline = contour[:, 0].astype(np.float64)
    return Blob(centre, covariance, float(area / ellipse), level, outline, cut)


def _parted(contour: NDArray[Any], blob: Blob, shape: tuple[int, ...]) -> list[Blob]:
    """Returns the cores of a blob that is several discs run into one: where its border is far away."""
    x, y, w, h = cv2.boundingRect(contour)
    filled = np.zeros((h + 2, w + 2), np.uint8)
    cv2.drawContours(filled, [contour], -1, 1, cv2.FILLED, offset=(1 - x, 1 - y))
    inside = np.asarray(cv2.distanceTransform(filled, cv2.DIST_L2, 5), np.float32)
    deepest = float(inside.max())
    for depth in (share * deepest for share in _CORES):
        binary = (inside > depth).astype(np.uint8)
        cores, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        parts = [_blob(core + np.array([x - 1, y - 1], core.dtype), shape, blob.level, 4) for core in cores]
        whole = [part for part in parts if part is not None]
        if len(whole) > 1:
            return [_grown(part, blob, depth) for part in whole]
    return []


def _grown(core: Blob, whole: Blob, by_px: float) -> Blob:
    """A core with what lies around it everywhere; anything round by itself goes before it."""
    values, axes = np.linalg.eigh(core.covariance)
    covariance = axes @ np.diag((np.sqrt(values) + by_px / 2) ** 2) @ axes.T
    return Blob(core.pixel, covariance, ROUND, core.level, whole.outline, whole.cut)


def best_of(blobs: Sequence[Blob]) -> list[Blob]:
    """Returns the roundest blob of each place; of those alike, that of the lowest threshold."""
    ranked = sorted(blobs, key=lambda b: (-min(b.roundness, _VERY_ROUND), b.level, tuple(b.pixel)))
    if not ranked:
        return []
    centre = np.array([blob.pixel for blob in ranked])
    spread = np.array([blob.covariance for blob in ranked])
    away = centre[None] - centre[:, None]  # of j from i
    squared = (
        spread[:, None, 1, 1] * away[..., 0] ** 2
        - 2 * spread[:, None, 0, 1] * away[..., 0] * away[..., 1]
        + spread[:, None, 0, 0] * away[..., 1] ** 2
    ) / (4 * np.linalg.det(spread)[:, None])
    within = squared <= _SAME_PLACE**2  # the centre of j within the core of i
    same = within | within.T
    longest = np.array([blob.semi_axes[0] for blob in ranked])
    kept: list[int] = []
    for number in range(len(ranked)):
        if not same[number, kept].any():
            kept.append(number)
    return [
        replace(
            ranked[number],
            within=tuple(
                ranked[i] for i in np.flatnonzero(same[number] & (longest < _MUCH_SMALLER * longest[number]))
            ),
        )
        for number in kept
    ]
