"""Which disc is which: found centres against probed ones in no order, some of either missing or wrong."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.single_pose import align
from surfclass.errors import InputError
from surfclass.types import Float64, Transform

LEAST_DISCS = 4
"""Fewer matched centres than this prove nothing: three fit some three of nine too easily."""

_TOLERANCE_M = 0.010
_SPACING = 0.25  # of the least distance between two discs: a match must not be able to slip to the neighbour
_TRIPLES = 400
_ENOUGH = 60
_CHUNK = 1024
_SLACK_M = 0.0005  # by how much another arrangement must fit worse, beside twice as badly, to be told from it
_SLACK = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Arrangement:
    """One way to lay the found centres onto the probed ones.

    Attributes:
        found: (k,) index into the found centres.
        known: (k,) index into the probed positions.
        base_T_depth: The pose that lays them there.
        rms_m: Of the distances that are left.
    """

    found: NDArray[np.intp]
    known: NDArray[np.intp]
    base_T_depth: Transform
    rms_m: float


def arrangements(camera_m: NDArray[Any], positions_m: NDArray[Any]) -> list[Arrangement]:
    """Returns how the found centres can lie on the known ones, all that fit as well as the best; or none.

    Triples of found centres are laid on all triples of known ones with the same three distances;
    what brings most centres to a known place wins, and among as many the closest. More than one answer
    means that the layout looks the same after some turn: also over, for a flat plate turned over is its
    mirror image.

    Args:
        camera_m: (n, 3) m, found centres, any number of them false.
        positions_m: (m, 3) m in `base`, in any order.
    """
    found, known = np.asarray(camera_m, np.float64), np.asarray(positions_m, np.float64)
    if min(len(found), len(known)) < LEAST_DISCS:
        return []
    tolerance = min(_TOLERANCE_M, _SPACING * _least_distance(known))
    best: dict[tuple[tuple[int, int], ...], Arrangement] = {}
    most, looked = 0, 0
    for triple in _triples(found):
        looked += 1
        for pairs in _laid(found, known, triple, tolerance):
            if len(pairs) < max(LEAST_DISCS, most) or pairs in best:
                continue
            better = _settled(found, known, pairs, tolerance)
            if better is not None and len(better.found) >= most:
                most = len(better.found)
                best[pairs] = best[tuple(zip(better.found.tolist(), better.known.tolist(), strict=True))] = (
                    better
                )
        if most >= 0.7 * min(len(found), len(known)) and looked >= _ENOUGH:
            break
    distinct = {(tuple(one.found), tuple(one.known)): one for one in best.values() if len(one.found) == most}
    ranked = sorted(distinct.values(), key=lambda one: (one.rms_m, tuple(one.known)))
    return [one for one in ranked if one.rms_m <= _SLACK * ranked[0].rms_m + _SLACK_M]


def _least_distance(points: Float64) -> float:
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    return float(apart[~np.eye(len(points), dtype=bool)].min())


def _triples(points: Float64) -> list[tuple[int, int, int]]:
    """Returns triples of points, those that span most first; no more than a bounded number, evenly chosen."""
    every = list(combinations(range(len(points)), 3))
    corner = points[np.array(every)]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    ranked = [every[number] for number in np.lexsort((np.arange(len(every)), -area))]
    return ranked[:: max(1, len(ranked) // _TRIPLES)]


def _laid(
    found: Float64, known: Float64, triple: tuple[int, int, int], tolerance: float
) -> list[tuple[tuple[int, int], ...]]:
    """Returns what lies on what when a triple is laid on each known triple that is as large."""
    i, j, k = triple
    apart = np.linalg.norm(known[:, None] - known[None], axis=2)
    alike = [
        np.abs(apart - np.linalg.norm(found[first] - found[second])) < 2 * tolerance
        for first, second in ((i, j), (j, k), (i, k))
    ]
    places = np.argwhere(alike[0][:, :, None] & alike[1][None] & alike[2][:, None])
    places = places[
        (places[:, 0] != places[:, 1]) & (places[:, 1] != places[:, 2]) & (places[:, 0] != places[:, 2])
    ]
    results = []
    for start in range(0, len(places), _CHUNK):
        some = places[start : start + _CHUNK]
        turn, shift = _rigid(found[[i, j, k]], known[some])
        moved = np.einsum("hab,nb->hna", turn, found) + shift[:, None]
        distance = np.linalg.norm(moved[:, :, None] - known[None, None], axis=3)
        nearest = distance.argmin(axis=2)
        mutual = np.take_along_axis(distance.argmin(axis=1), nearest, axis=1) == np.arange(len(found))
        # A triple's own noise is levered at the far end of the plate.
        fits = mutual & (distance.min(axis=2) < 2 * tolerance)
        for row, near in zip(fits, nearest, strict=True):
            results.append(tuple((int(f), int(near[f])) for f in np.flatnonzero(row)))
    return results


def _rigid(source: Float64, targets: Float64) -> tuple[Float64, Float64]:
    """Returns rotations (h, 3, 3) and shifts (h, 3) that lay three points on each of (h, 3, 3)."""
    middle, middles = source.mean(axis=0), targets.mean(axis=1)
    u, _, vt = np.linalg.svd(np.einsum("na,hnb->hab", source - middle, targets - middles[:, None]))
    handed = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    vt[:, 2] *= handed[:, None]
    turn = np.einsum("hba,hcb->hac", vt, u)
    return turn, middles - np.einsum("hab,b->ha", turn, middle)


def _settled(
    found: Float64, known: Float64, pairs: tuple[tuple[int, int], ...], tolerance: float
) -> Arrangement | None:
    """Returns the arrangement once laying all its pairs on each other changes them no more."""
    for _ in range(10):
        first, second = np.array(pairs, np.intp).T
        try:
            pose = align(found[first], known[second], "base", "depth")
        except InputError:  # on a line
            return None
        moved = pose @ found
        distance = np.linalg.norm(moved[:, None] - known[None], axis=2)
        near = distance.argmin(axis=1)
        mutual = distance.argmin(axis=0)[near] == np.arange(len(found))
        fits = np.flatnonzero(mutual & (distance.min(axis=1) < tolerance))
        again = tuple((int(f), int(near[f])) for f in fits)
        if again == pairs:
            rms = float(np.sqrt(np.mean(distance[first, second] ** 2)))
            return Arrangement(first, second, pose, rms)
        if len(again) < LEAST_DISCS:
            return None
        pairs = again
    return None
