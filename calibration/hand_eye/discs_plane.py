"""The plane of a reflector disc, from the depth readings on it and in the ring around it (A.4, A.5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.types import Bool, Float64

_TRIPLES = 80
_LEAST_READINGS = 30
_ROUNDS = 6
_TUKEY = 4.685
_BLOCKS = 6  # along each side of the readings; those of one block count as one: they share noise and steps
LEAST_SLOPE = 0.2
"""Of the biweight's mean derivative, 0.76 where errors are normal: a few readings can make it anything."""
_ROUNDING_M = 1e-3 / np.sqrt(12)  # depth images carry whole millimetres
SATURATED_SHARE = 0.2  # of a disc's pixels, from which on its own readings are not relied on
_LEAST_SHARE = 0.4  # of a region's pixels that must have a reading
_AGREE_SD = 4.0
_AGREE = 0.004  # of the depth


@dataclass(frozen=True, slots=True, eq=False)
class InversePlane:
    """A plane as `inverse · (x, y, 1) = 1 / z`, x and y being tangents: in it a depth camera's noise is even.

    Attributes:
        inverse: (3,) 1/m; the plane's normal over its offset.
        covariance: (3, 3) 1/m².
        readings: How many it rests on.
        ring_only: Whether those on the disc itself were left out.
    """

    inverse: Float64
    covariance: Float64
    readings: int
    ring_only: bool

    @property
    def normal(self) -> Float64:
        """(3,) unit, turned to the camera."""
        unit: Float64 = -self.inverse / np.linalg.norm(self.inverse)
        return unit

    def meet(self, tangents: NDArray[Any]) -> Float64:
        """Returns (n, 3) m: where rays of x/z and y/z (n, 2) meet it, if only behind the camera."""
        rays = np.column_stack([tangents, np.ones(len(tangents))])
        points: Float64 = rays / (rays @ self.inverse)[:, None]
        return points


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """The depth readings of a part of an image, flat.

    Attributes:
        tangents: (n, 2) x/z and y/z of each pixel's ray.
        inverse: (n,) 1/m, 1/z; 0 where there is no return.
        column, row: (n,) px.
    """

    tangents: Float64
    inverse: Float64
    column: NDArray[np.int64]
    row: NDArray[np.int64]

    def of(self, chosen: Bool) -> Readings:
        """Returns those that are `chosen` (n,) and have a return."""
        keep = chosen & (self.inverse > 0)
        return Readings(self.tangents[keep], self.inverse[keep], self.column[keep], self.row[keep])

    def __len__(self) -> int:
        return len(self.inverse)


def plane_of_disc(window: Readings, on: Bool, around: Bool, saturated_share: float) -> InversePlane | str:
    """Returns the plane of a disc, or why there is none.

    Where the IR image is saturated the sensor has no depth or a wrong one (the thesis' A.5): then
    the ring around the disc alone counts, as long as there is one. Otherwise both count where they
    agree, and the disc's own readings where the ring lies in another plane.

    Args:
        window: The readings of a window around the disc, n pixels.
        on: (n,) pixels on the disc, its edge left out.
        around: (n,) pixels of the ring, its edge and other bright places left out.
        saturated_share: Of the pixels on the disc.
    """
    disc, ring = window.of(on), window.of(around)
    ring_fit = _fit(ring, True) if len(ring) >= _LEAST_SHARE * around.sum() else None
    if saturated_share > SATURATED_SHARE and ring_fit is not None:
        return ring_fit
    disc_fit = _fit(disc, False) if len(disc) >= _LEAST_SHARE * on.sum() else None
    if disc_fit is None or ring_fit is None:
        if saturated_share > SATURATED_SHARE:
            return "saturated, so its own depth counts for nothing, and there is too little depth around it"
        return disc_fit or ring_fit or "no depth, neither on it nor around it"
    middle = np.append(disc.tangents.mean(axis=0), 1.0)
    gap = abs(middle @ (disc_fit.inverse - ring_fit.inverse))
    allowed = _AGREE_SD * np.sqrt(middle @ (disc_fit.covariance + ring_fit.covariance) @ middle)
    if gap > max(allowed, _AGREE * middle @ disc_fit.inverse):
        return disc_fit
    return _fit(window.of(on | around), False) or disc_fit


def _fit(readings: Readings, ring_only: bool) -> InversePlane | None:
    """Fits inverse depth over the rays by Tukey's biweight, from the best of some planes through three."""
    n = len(readings)
    if n < _LEAST_READINGS:
        return None
    origin = readings.tangents.mean(axis=0)
    rows = np.column_stack([readings.tangents - origin, np.ones(n)])
    start = _start(rows, readings.inverse)
    if start is None:
        return None
    floor = _ROUNDING_M * float(np.median(readings.inverse)) ** 2
    solution, weights = start, np.ones(n)
    for _ in range(_ROUNDS):
        residual = readings.inverse - rows @ solution
        scale = max(1.4826 * float(np.median(np.abs(residual))), floor)
        weights = np.clip(1 - (residual / (_TUKEY * scale)) ** 2, 0, None) ** 2
        if np.count_nonzero(weights) < _LEAST_READINGS:
            return None
        solution = np.linalg.lstsq(
            rows * np.sqrt(weights)[:, None], readings.inverse * np.sqrt(weights), rcond=None
        )[0]
    covariance = _covariance(rows, readings, readings.inverse - rows @ solution, _TUKEY * scale, floor)
    back = np.array([[1, 0, 0], [0, 1, 0], [-origin[0], -origin[1], 1]])  # to rays from the axis
    inverse = back @ solution
    return InversePlane(inverse, back @ covariance @ back.T, int(np.count_nonzero(weights)), ring_only)


def _start(rows: Float64, inverse: Float64) -> Float64 | None:
    """Least median of squares over planes through three readings each (Rousseeuw 1984)."""
    rng = np.random.default_rng(0)
    triples = rng.integers(0, len(rows), (_TRIPLES, 3))
    matrices = rows[triples]
    flat = np.abs(np.linalg.det(matrices))
    usable = flat > 0.05 * np.max(flat, initial=0.0)
    if not usable.any():
        return None
    planes = np.linalg.solve(matrices[usable], inverse[triples[usable]][..., None])[..., 0]
    some = slice(None, None, max(1, len(rows) // 300))
    misfit = np.median(np.abs(rows[some] @ planes.T - inverse[some, None]), axis=0)
    best: Float64 = planes[misfit.argmin()]
    return best


def _covariance(rows: Float64, readings: Readings, residual: Float64, limit: float, floor: float) -> Float64:
    """Returns (3, 3) the covariance that holds although neighbours share noise and the sensor's steps.

    A sandwich over blocks (Liang and Zeger 1986) of the M-estimator's derivative (Huber 1981), but never
    below what independent readings would give, nor below `floor` (1/m) for each.
    """
    influence, slope = tukey(residual / limit)
    inverse_hessian = np.linalg.inv(max(float(slope.mean()), LEAST_SLOPE) * rows.T @ rows)
    variance = limit**2 * float((influence**2).sum()) / max(1, int(np.count_nonzero(influence)) - 3)
    variance = max(variance, floor**2)
    formal: Float64 = variance * inverse_hessian @ (rows.T @ rows) @ inverse_hessian
    side = 1 + max(np.ptp(readings.column), np.ptp(readings.row)) // _BLOCKS
    _, member = np.unique((readings.row // side) * 10_000 + readings.column // side, return_inverse=True)
    scores = np.zeros((int(member.max()) + 1, 3))
    np.add.at(scores, member, rows * (limit * influence)[:, None])
    few = len(scores) / max(1, len(scores) - 3)
    clustered = few * inverse_hessian @ (scores.T @ scores) @ inverse_hessian
    # One factor for all three: the ratio of each alone is known too poorly from so few blocks.
    return formal * max(1.0, float(np.trace(np.linalg.solve(formal, clustered))) / 3)


def tukey(share: NDArray[Any]) -> tuple[Float64, Float64]:
    """Returns the influence of the biweight and its derivative, of residuals as shares of its limit."""
    squared = np.minimum(np.asarray(share, np.float64) ** 2, 1.0)
    return share * (1 - squared) ** 2, (1 - squared) * (1 - 5 * squared)
