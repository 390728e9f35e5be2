"""What views must be like to determine a camera: enough, tilted, all over the image; of this camera."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from calibration.cameras.initial import poses_of
from calibration.cameras.observations import Observations
from surfclass.types import Float64

PARTS = (4, 5)  # rows and columns of an image in which corners are counted
LEAST_VIEWS = 4
_LEAST_SPREAD = 0.12  # of the image's area: of the corners' convex hull
_LEAST_TILT_DEG = 8.0
SQUARE_TOLERANCE = 0.03  # a depth sensor's own scale may be off by two thirds of this


def coverage(observations: Observations, camera: int) -> Float64:
    """Returns (4, 5) how many corners the camera saw in each part of its image."""
    width, height = observations.sizes[camera]
    pixel = observations.pixel[observations.camera == camera]
    limits = [(-0.5, height - 0.5), (-0.5, width - 0.5)]
    counts, *_ = np.histogram2d(pixel[:, 1], pixel[:, 0], bins=PARTS, range=limits)
    return np.asarray(counts, np.float64)


def faults(observations: Observations) -> list[str]:
    """Returns why the views cannot determine the cameras, a sentence each: what is missing, what to do."""
    found = []
    for index, name in enumerate(observations.cameras):
        own = observations.of_camera(index)
        if len(own.views) < LEAST_VIEWS:
            found.append(
                f"{name}: the board was found in {len(own.views)} views, at least {LEAST_VIEWS} are needed "
                "and 12 are good: capture more, from other directions"
            )
            continue
        area = _hull_share(own)
        if area < _LEAST_SPREAD:
            found.append(
                f"{name}: the board was only ever in {100 * area:.0f} % of the image; {_empty_parts(own)} "
                "saw no corner: hold the board there, too"
            )
        tilt = _tilt_deg(own)
        if tilt < _LEAST_TILT_DEG:
            found.append(
                f"{name}: all boards are parallel within {tilt:.0f}°, so the focal length is not determined: "
                "tilt the board (or the camera) by 20 to 40° to the left, right, up and down"
            )
    if len(observations.cameras) > 1:
        both = sum(
            len(np.unique(observations.camera[observations.view == i])) > 1
            for i in range(len(observations.views))
        )
        if both < 2:
            found.append(
                f"only {both} views show the board to both cameras: where they are to each other takes "
                "3 or more"
            )
    return found


def square_fault(scale: float, square_m: float) -> str | None:
    """Returns what is wrong with the told size of the squares by the depth readings, or None.

    Args:
        scale: Depth readings over the plane's depth by the corners.
        square_m: As told.
    """
    if abs(scale - 1) <= SQUARE_TOLERANCE:
        return None
    return (
        f"the squares look like {1e3 * square_m * scale:.1f} mm, not {1e3 * square_m:g} mm: the depth camera "
        f"reads {abs(scale - 1):.1%} {'more' if scale > 1 else 'less'} than the board's plane is away. "
        "Measure over ten squares and give --square-mm"
    )


def serial_faults(expected: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Returns a sentence for each device whose serial number is another one than expected.

    Args:
        expected: Serial numbers by device ("colour", "depth"), as far as they are known.
        found: Likewise.
    """
    return [
        f"the {device} camera has serial number {found[device]}, expected is {serial}: this is another camera"
        for device, serial in expected.items()
        if device in found and found[device] != serial
    ]


def tilts_deg(poses: Float64) -> Float64:
    """Returns (views,) degrees between the board's normal and the optical axis."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0, 1))))


def _tilt_deg(own: Observations) -> float:
    """The largest angle between any two boards; a nominal camera is good enough for that."""
    width, height = own.sizes[0]
    nominal = np.array([width, width, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0], np.float64)
    normals = poses_of(own, nominal)[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max())


def _hull_share(own: Observations) -> float:

    hull = cv2.convexHull(own.pixel.astype(np.float32))
    width, height = own.sizes[0]
    return float(cv2.contourArea(hull)) / (width * height)


def _empty_parts(own: Observations) -> str:
    counts = coverage(own, 0)
    sides = {
        "the left": counts[:, :2],
        "the right": counts[:, 3:],
        "the top": counts[:2],
        "the bottom": counts[2:],
    }
    empty = [side for side, part in sides.items() if not part.any()]
    return " and ".join(empty) if empty else "most of it"
