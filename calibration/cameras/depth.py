"""The depth sensor's own scale and distortion, against the plane of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import Board
from calibration.resampling import jackknife_covariance
from surfclass.geometry import multiplier_terms, rays
from surfclass.rig import Camera, DepthCorrection
from surfclass.types import Float64

_BLOCK_PX = 8  # readings are medians over such squares: robust, and few
_LEAST_FILLED = 0.5  # of a block's pixels that have a reading
_INSET = 0.4  # of a square: how far inside of the outermost squares' outer edges readings count
_COUNTS = (1, 3, 6, 10)  # coefficients of orders 0 to 3
_GAIN = 0.02  # share of the held-out rms by which a larger model must be better
_NEEDED_GAIN = 0.05  # the same, against no correction …
_NEEDED = 1e-3  # … and what is corrected must be more than this, relative: a millimetre at 1 m
_ROUNDS = 5
_HUBER = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class DepthReadings:
    """Readings of one board's plane, one row a block of pixels.

    Attributes:
        view: Name.
        place: (n, 2) in the image, -1…1.
        pixel: (n, 2) px.
        read: (n,) m, as the sensor has it.
        plane: (n,) m, by the corners.
    """

    view: str
    place: Float64
    pixel: Float64
    read: Float64
    plane: Float64


@dataclass(frozen=True, slots=True, eq=False)
class DepthFit:
    """What was found of the depth sensor.

    Attributes:
        correction: The best of the models.
        needed: Whether it reads unseen views better than no correction does.
        sd: Of its coefficients, and last of its offset (None where it has none), by leaving out views.
        scale: Median of what is read over the plane's depth: 1 is right.
        before_rms: Relative, of the readings as they are; `after_rms` corrected, `held_out_rms` corrected by
            a fit without the view.
    """

    correction: DepthCorrection
    needed: bool
    sd: tuple[float, ...]
    scale: float
    before_rms: float
    after_rms: float
    held_out_rms: float


def read_plane(
    view: str, depth_mm: NDArray[Any], depth_T_board: Float64, board: Board, camera: Camera
) -> DepthReadings | None:
    """Returns what the sensor reads on the board, and how far its plane really is; None where too little.

    Args:
        view: Name.
        depth_mm: (h, w), 0 = no return.
        depth_T_board: (4, 4).
        board: Its outline is that of its squares.
        camera: The depth camera, as calibrated.
    """
    side = board.square_m
    low, high = -side * (1 - _INSET), side * (1 - _INSET)
    right, bottom = (board.columns - 1) * side + high, (board.rows - 1) * side + high
    x, y = rays(camera).astype(np.float64)
    normal = depth_T_board[:3, 2]
    toward = normal[0] * x + normal[1] * y + normal[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = float(normal @ depth_T_board[:3, 3]) / toward
    point = np.stack([x * z, y * z, z], axis=-1) - depth_T_board[:3, 3]
    s, t = point @ depth_T_board[:3, 0], point @ depth_T_board[:3, 1]
    inside = (z > 0) & (s > low) & (s < right) & (t > low) & (t < bottom)
    ratio = np.where(inside & (depth_mm > 0), depth_mm * 1e-3 / np.where(inside, z, 1), np.nan)
    height, width = (length // _BLOCK_PX * _BLOCK_PX for length in ratio.shape)
    tiles = ratio[:height, :width].reshape(height // _BLOCK_PX, _BLOCK_PX, width // _BLOCK_PX, _BLOCK_PX)
    blocks = tiles.swapaxes(1, 2).reshape(height // _BLOCK_PX, width // _BLOCK_PX, -1)
    rows, columns = np.nonzero(np.isfinite(blocks).mean(axis=-1) >= _LEAST_FILLED)
    if len(rows) < 3:
        return None
    middle = np.nanmedian(blocks[rows, columns], axis=-1)
    centre = np.asarray(np.stack([columns, rows], axis=1) * _BLOCK_PX + (_BLOCK_PX - 1) / 2, np.float64)
    plane = cv2.remap(
        np.where(np.isfinite(z), z, 0).astype(np.float32),
        centre[:, 0].astype(np.float32),
        centre[:, 1].astype(np.float32),
        cv2.INTER_LINEAR,
    ).reshape(-1)
    extent = np.array([camera.size[0] - 1, camera.size[1] - 1])
    place: Float64 = 2 * centre / extent - 1
    return DepthReadings(view, place, centre, middle * plane, plane.astype(np.float64))


def fit_depth(readings: Sequence[DepthReadings]) -> DepthFit:
    """Finds the multiplier and, if it helps, the offset, that bring the readings to the planes.

    The residual is that of the inverse depth, in which a structured-light sensor's noise is even. Every
    view counts alike. The model is the smallest one that predicts views it has not seen as well as
    any does, within 2 %.

    Args:
        readings: Of four or more views, in any order.
    """
    scale = float(np.median(np.concatenate([one.read / one.plane for one in readings])))
    models = [(count, offset) for count in _COUNTS for offset in (False, True)]
    plain = _rms([one.plane / one.read - 1 for one in readings])
    fits = [_solve(readings, count, offset) for count, offset in models]
    scores = [
        _rms([_relative(one, x, count) for one, x in zip(readings, left, strict=True)])
        for (count, _), (_, left) in zip(models, fits, strict=True)
    ]
    pick = next(i for i, score in enumerate(scores) if score <= (1 + _GAIN) * min(scores))
    (count, offset), (whole, left) = models[pick], fits[pick]
    sd = np.sqrt(np.diag(jackknife_covariance(left)))[: count + offset]
    return DepthFit(
        DepthCorrection(multiplier=tuple(whole[:count].tolist()), inverse_offset_per_m=float(whole[count])),
        scores[pick] < (1 - _NEEDED_GAIN) * plain and plain**2 - scores[pick] ** 2 > _NEEDED**2,
        tuple(sd.tolist()),
        scale,
        plain,
        _rms([_relative(one, whole, count) for one in readings]),
        scores[pick],
    )


def corrected_error(one: DepthReadings, correction: DepthCorrection) -> Float64:
    """Returns (n,) the corrected readings over the plane's depth, minus 1."""
    x = np.array([*correction.multiplier, correction.inverse_offset_per_m])
    return np.asarray(1 / (_relative(one, x, len(correction.multiplier)) + 1) - 1)


def _relative(one: DepthReadings, x: Float64, count: int) -> Float64:
    """(n,) the plane's depth over the corrected reading, minus 1."""
    multiplier = np.tensordot(x[:count], multiplier_terms(one.place[:, 0], one.place[:, 1], count), axes=1)
    return np.asarray(one.plane * (1 / (multiplier * one.read) + x[count]) - 1)


def _rms(residuals: Sequence[Float64]) -> float:
    """Every view counts alike; robust within each."""
    return float(np.sqrt(np.mean([(1.4826 * np.median(np.abs(part))) ** 2 for part in residuals])))


def _solve(readings: Sequence[DepthReadings], count: int, offset: bool) -> tuple[Float64, Float64]:
    """Fits the inverse depths by reweighted least squares.

    Returns:
        (count + 1,) the coefficients and the offset, 0 where there is none; and (views, count + 1) the same
        without one view each.
    """
    place = np.concatenate([one.place for one in readings])
    read = np.concatenate([one.read for one in readings])
    plane = np.concatenate([one.plane for one in readings])
    share = np.concatenate([np.full(len(one.read), 1 / len(one.read)) for one in readings])
    starts = np.cumsum([0, *(len(one.read) for one in readings[:-1])])
    terms = multiplier_terms(place[:, 0], place[:, 1], count)
    x = np.zeros(count + 1)
    x[0] = float(np.median(plane / read))
    used = slice(0, count + offset)
    matrix, right = np.zeros((1, 0, 0)), np.zeros((1, 0))
    for _ in range(_ROUNDS):
        multiplier = x[:count] @ terms
        left = 1 / plane - 1 / (multiplier * read) - x[count]
        spread = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
        weight = share * np.minimum(1, _HUBER * spread / np.maximum(np.abs(left), 1e-12))
        design = np.concatenate([-terms / (multiplier**2 * read), np.ones((int(offset), len(read)))]).T
        heavy = design * weight[:, None]
        matrix = np.array(
            [a.T @ b for a, b in zip(_split(heavy, starts), _split(design, starts), strict=True)]
        )
        right = np.add.reduceat(heavy * left[:, None], starts)
        x[used] += np.linalg.lstsq(matrix.sum(axis=0), right.sum(axis=0), rcond=None)[0]
    rest, pull = matrix.sum(axis=0) - matrix, right.sum(axis=0) - right
    without = np.tile(x, (len(readings), 1))
    without[:, used] += [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(rest, pull, strict=True)]
    return x, without


def _split(rows: Float64, starts: NDArray[Any]) -> list[Float64]:
    return np.split(rows, starts[1:])
