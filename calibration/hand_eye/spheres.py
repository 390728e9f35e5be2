"""A pair of bright spheres of known radii in an IR image and its organised cloud: centres by robust fits."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.discs_plane import tukey
from calibration.hand_eye.observations import Intrinsics
from surfclass.errors import InputError
from surfclass.types import Float64

_MEDIAN_PX = 5
_LEAST_READINGS = 100
_MOST_BLOBS = 8
_CAP = 0.8  # of the radius across the line of sight; beyond it readings are grazing, and mixed at the rim
_DEPTH_OF_CAP = 0.6  # of the radius: how far behind its readings' median a sphere's centre lies, about
_TUKEY = 4.685
_LEAST_SCALE_M = 2e-5
_SETTLED_M = 1e-8
_STEPS = 100
_ON_SPHERE = 0.10  # of the radius
_DISTANCE_OFF = 0.03
_PINHOLE_OFF_PX = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Sphere:
    """A sphere of known radius as fitted.

    Attributes:
        centre_m: (3,) in the camera's frame.
        radius_m: The known one.
        rms_m: Of the readings that count, from its surface.
        readings: How many count.
    """

    centre_m: Float64
    radius_m: float
    rms_m: float
    readings: int


@dataclass(frozen=True, slots=True, eq=False)
class SpherePair:
    """Two spheres on one rod.

    Attributes:
        first: The one of the first radius.
        second: Of the second.
    """

    first: Sphere
    second: Sphere

    @property
    def axis(self) -> Float64:
        """(3,) unit, from the first centre to the second."""
        away: Float64 = self.second.centre_m - self.first.centre_m
        return away / np.linalg.norm(away)

    @property
    def middle_m(self) -> Float64:
        """(3,) halfway between the centres."""
        middle: Float64 = (self.first.centre_m + self.second.centre_m) / 2
        return middle

    @property
    def distance_m(self) -> float:
        """Between the centres."""
        return float(np.linalg.norm(self.second.centre_m - self.first.centre_m))


def pinhole_of_cloud(pixels: NDArray[Any], points_m: NDArray[Any]) -> Intrinsics:
    """Returns the pinhole camera that an organised cloud was made with.

    Args:
        pixels: (n, 2) column and row of each point in the organised image.
        points_m: (n, 3).

    Raises:
        InputError: If the points are too few or do not come from one pinhole without distortion.
    """
    u, p = np.asarray(pixels, np.float64), np.asarray(points_m, np.float64)
    if len(p) < _LEAST_READINGS or u.shape != (len(p), 2) or not (p[:, 2] > 0).all():
        raise InputError(f"cloud: {len(p)} points, needed are {_LEAST_READINGS} in front of the camera")
    values = []
    for axis in (0, 1):
        tangent = p[:, axis] / p[:, 2]
        if np.ptp(tangent) < 1e-3:
            raise InputError("cloud: its points lie on one line of the image")
        slope, start = np.polyfit(tangent, u[:, axis], 1)
        worst = float(np.abs(slope * tangent + start - u[:, axis]).max())
        if worst > _PINHOLE_OFF_PX:
            raise InputError(f"cloud: no pinhole gives its points, {worst:.2f} px off; it is not organised")
        values.append((float(slope), float(start)))
    (fx, cx), (fy, cy) = values
    return Intrinsics(fx, fy, cx, cy)


def fit_sphere(points_m: NDArray[Any], radius_m: float) -> Sphere | None:
    """Returns the sphere of known radius through the readings of its visible side, or None.

    Robust least squares of the distance to the surface; readings near the rim are left out, wherever
    the centre comes to lie: there the sensor mixes the sphere with what is behind it.
    """
    p = np.asarray(points_m, np.float64)
    if len(p) < _LEAST_READINGS:
        return None
    middle = np.median(p, axis=0)
    centre = middle * (1 + _DEPTH_OF_CAP * radius_m / np.linalg.norm(middle))
    for _ in range(_STEPS):
        away = p - centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        across = np.linalg.norm(np.cross(away, centre / np.linalg.norm(centre)), axis=1)
        cap = across < _CAP * radius_m
        off = distance - radius_m
        if cap.sum() < _LEAST_READINGS // 2:
            return None
        scale = max(1.4826 * float(np.median(np.abs(off[cap]))), _LEAST_SCALE_M)
        influence, _ = tukey(off / (_TUKEY * scale))
        weight = np.where(
            cap, np.divide(influence * _TUKEY * scale, off, where=off != 0, out=np.ones_like(off)), 0
        )
        rows = -away / distance[:, None]
        hessian = (rows * weight[:, None]).T @ rows
        if np.linalg.cond(hessian) > 1e8:
            return None
        step = -np.linalg.solve(hessian, (rows * weight[:, None]).T @ off)
        centre = centre + step
        if np.abs(step).max() < _SETTLED_M:
            break
    counts = weight > 0.1
    rms = float(np.sqrt(np.mean(off[counts] ** 2)))
    near = np.abs(off) < _ON_SPHERE * radius_m
    if rms > _ON_SPHERE * radius_m or near.mean() < 0.5:
        return None
    return Sphere(centre, radius_m, rms, int(counts.sum()))


def find_pair(
    ir: NDArray[Any],
    pixels: NDArray[Any],
    points_m: NDArray[Any],
    radii_m: tuple[float, float],
    distance_m: float,
) -> SpherePair | str:
    """Returns the two spheres, or why they were not found.

    Which bright region is which sphere, and which are none, follows from the radii and the distance.

    Args:
        ir: (h, w) uint8 or uint16.
        pixels: (n, 2) column and row of each reading in `ir`.
        points_m: (n, 3) the readings in the camera's frame.
        radii_m: Of the first and the second sphere.
        distance_m: Between their centres.
    """
    regions = _regions(ir, pixels)
    if len(regions) < 2:
        return f"{len(regions)} bright regions with depth, needed are two"
    fits = [[fit_sphere(points_m[region], radius) for radius in radii_m] for region in regions]
    best: SpherePair | None = None
    for i, j in permutations(range(len(regions)), 2):
        first, second = fits[i][0], fits[j][1]
        if first is None or second is None:
            continue
        pair = SpherePair(first, second)
        if best is None or abs(pair.distance_m - distance_m) < abs(best.distance_m - distance_m):
            best = pair
    if best is None:
        return "no two bright regions are spheres of these radii"
    if abs(best.distance_m - distance_m) > _DISTANCE_OFF * distance_m:
        return f"spheres {1e3 * best.distance_m:.1f} mm apart, they are {1e3 * distance_m:.1f} mm"
    return best


def _regions(ir: NDArray[Any], pixels: NDArray[Any]) -> list[NDArray[np.intp]]:
    """Returns which readings lie in each bright region of the image, the largest regions first."""
    scaled = np.clip(np.round(ir * (255.0 / max(1.0, float(ir.max())))), 0, 255).astype(np.uint8)
    smooth = cv2.medianBlur(scaled, _MEDIAN_PX)
    _, binary = cv2.threshold(smooth, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    count, labels = cv2.connectedComponents(binary, connectivity=4)
    at = labels[pixels[:, 1], pixels[:, 0]]
    regions = [np.flatnonzero(at == number) for number in range(1, count)]
    regions = [region for region in regions if len(region) >= _LEAST_READINGS]
    return sorted(regions, key=lambda region: (-len(region), int(region[0])))[:_MOST_BLOBS]
