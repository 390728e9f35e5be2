"""Carries labels from one view to another through the 3D map: what one place is, it is from everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.frames import DepthFrame
from surfclass.geometry import register
from surfclass.rig import Rig
from surfclass.types import Bool, Float32, Transform
from surfclass.voxel_index import Keys, check_size, pack, voxel_of

_PLENTY_PX = 640  # of an image's width: depth cameras have no more, and looking closer tells nothing
_PIXELS_ACROSS = 3.0  # a voxel is no smaller than so many, or surfaces have holes
_LEAST_COVER = 0.1  # of a voxel's face that pixels have to speak for; a single one may be a bad reading
_LEAST_SHARE = 0.7  # of what is said, for one label
_CORNERS = tuple(product((0, 1), repeat=3))


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """Where in `base` the pixels of a colour image look, every few pixels.

    Attributes:
        point_base: (3, h, w) float32, m; meaningful where `has_point`.
        pitch_m: (h, w) float32, how far two neighbours are apart on a surface that faces the camera.
        has_point: (h, w) bool.
        stride_px: Colour pixels between two of these, from (0, 0) on.
    """

    point_base: Float32
    pitch_m: Float32
    has_point: Bool
    stride_px: int


def seen_points(depth: DepthFrame, base_T_depth: Transform, rig: Rig) -> SeenPoints:
    """Returns the surface points that a view's colour pixels see.

    A pixel whose surface the depth camera did not see, or that a nearer one hides, has none.

    Raises:
        InputError: If the depth image has not the rig's size.
    """
    registered = register(depth.depth_mm, rig)
    stride = max(1, rig.rgb.size[0] // _PLENTY_PX)
    grid = slice(None, None, stride)
    point = np.ascontiguousarray(registered.point[:, grid, grid])
    base_T_rgb = base_T_depth @ rig.rgb_T_depth.inverse
    pitch_m = point[2] * np.float32(stride / rig.rgb.fx)
    return SeenPoints(base_T_rgb.move_planes(point), pitch_m, registered.has_point[grid, grid], stride)


class LabelVoxels:
    """What one labelled view says about the voxels that it sees.

    Each pixel's vote is spread over the eight voxel centres around its point by their nearness, and read
    back in the same way, so that a border between labels lies where it was and not at the voxels' sides.
    A vote is the share of a voxel's face that the pixel covers, so that near and far views count alike.

    Args:
        seen: The view's points.
        label: (h, w) its label image, full size; 0 is a vote too, that a place is none of the classes.
        voxel_size_m: Side of a voxel; larger ones are taken where the view's pixels are too coarse for it.

    Raises:
        InputError: If the label image does not fit the points.
        ConfigurationError: If the size is not positive.
    """

    def __init__(self, seen: SeenPoints, label: NDArray[np.uint8], voxel_size_m: float) -> None:
        check_size(voxel_size_m)
        values = label[:: seen.stride_px, :: seen.stride_px]
        if values.shape != seen.has_point.shape:
            raise InputError(f"label image {label.shape} for {seen.has_point.shape} points")
        chosen, pitch_m = values[seen.has_point], seen.pitch_m[seen.has_point]
        coarse_m = _PIXELS_ACROSS * float(np.median(pitch_m)) if len(pitch_m) else 0.0
        self._size_m = max(voxel_size_m, coarse_m)
        self.labels = np.unique(chosen)
        kind = np.searchsorted(self.labels, chosen)
        key, weight = _around(seen.point_base[:, seen.has_point].T, self._size_m)
        weight *= (pitch_m / np.float32(self._size_m)) ** 2
        self._key, row = np.unique(key, return_inverse=True)
        flat = row.reshape(key.shape) * len(self.labels) + kind
        votes = np.bincount(flat.ravel(), weight.ravel(), len(self._key) * len(self.labels))
        self._votes = votes.reshape(len(self._key), len(self.labels)).astype(np.float32)

    def at(self, point_base: Float32) -> Float32:
        """Returns the votes at points (n, 3) for each of `labels`: (n, k) shares of a voxel's face."""
        total = np.zeros((len(point_base), len(self.labels)), np.float32)
        if not len(self._key):
            return total
        keys, weights = _around(point_base, self._size_m)
        for key, weight in zip(keys, weights, strict=True):
            row = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
            total += self._votes[row] * (weight * (self._key[row] == key))[:, None]
        return total


def suggested_labels(
    seen: SeenPoints, sources: Sequence[LabelVoxels], shape: tuple[int, int]
) -> NDArray[np.uint8]:
    """Returns what other views' labels say about a view: (h, w), 0 where they say nothing.

    A place is looked up by the view's own depth, so what stands in front of a labelled surface gets
    nothing of it. Each other view speaks for the one label that most of its votes are for; where several
    speak, most of their votes decide.

    Args:
        seen: The points of the view that is to be labelled.
        sources: What the labelled views say.
        shape: (h, w) of its colour image.
    """
    points = np.ascontiguousarray(seen.point_base[:, seen.has_point].T)
    count = 1 + max((int(source.labels.max(initial=0)) for source in sources), default=0)
    votes = np.zeros((len(points), count), np.float32)
    for source in sources:
        if not len(source.labels):
            continue
        said = source.at(points)
        most = said.argmax(axis=1)
        share = np.take_along_axis(said, most[:, None], 1)[:, 0]
        speaks = (share > 0.5 * said.sum(axis=1)) & (source.labels[most] > 0)
        votes[speaks, source.labels[most[speaks]]] += share[speaks]
    planes = np.zeros((*seen.has_point.shape, count), np.float32)
    planes[seen.has_point] = votes
    return _decided(planes, seen, shape)


def _decided(planes: Float32, seen: SeenPoints, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Interpolates the votes between the pixels that were looked at, and lets them decide."""
    h, w = shape
    label = np.zeros(shape, np.uint8)
    most, total = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    x, y = (np.arange(n, dtype=np.float32) / seen.stride_px for n in (w, h))
    place = (
        np.ascontiguousarray(np.broadcast_to(x, shape)),
        np.ascontiguousarray(np.broadcast_to(y[:, None], shape)),
    )
    for value in range(1, planes.shape[2]):
        if not planes[..., value].any():
            continue
        votes: NDArray[Any] = cv2.remap(
            np.ascontiguousarray(planes[..., value]),
            *place,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        np.copyto(label, np.uint8(value), where=votes > most)
        np.maximum(most, votes, out=most)
        total += votes
    label[(total < _LEAST_COVER) | (most < _LEAST_SHARE * total)] = 0
    return label


def _around(point: Float32, size_m: float) -> tuple[Keys, Float32]:
    """The eight voxels whose centres surround each point (n, 3), and how near it is to each: (8, n) both."""
    cell = point / np.float32(size_m) - np.float32(0.5)
    low = voxel_of(cell, 1.0)
    part = cell - low.astype(np.float32)
    keys = np.stack([pack(low + np.array(corner, np.int32)) for corner in _CORNERS])
    weights = np.stack(
        [np.prod(np.where(corner, part, 1 - part), axis=1, dtype=np.float32) for corner in _CORNERS]
    )
    return keys, weights
