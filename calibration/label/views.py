"""The captures that can be labelled, as the page shows them and as their labels travel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import MissingCalibrationError
from surfclass.frames import Capture, DepthFrame
from surfclass.kinematics import depth_pose
from surfclass.rig import DepthRig, SurfaceClasses
from surfclass.types import Transform

ROLES = ("train", "test", "map")
"""Of the captures that are shown; calibration targets have no classes."""
_QUALITY = 92
_BRIGHT = 99.5  # per cent of a deep image's values that are shown below white
_THUMBNAIL_PX = 160


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A capture that can be labelled.

    Attributes:
        name: Of the capture.
        role: Of the capture.
        jpeg: Its colour image, to be looked at.
        thumbnail: The same, small.
        depth: Its depth frame, without IR.
        base_T_depth: Its pose, or None where it is not known.
        below: (h, w) its own label image, zeros where it has none.
    """

    name: str
    role: str
    jpeg: bytes
    thumbnail: bytes
    depth: DepthFrame
    base_T_depth: Transform | None
    below: NDArray[np.uint8]


def view_of(capture: Capture, rig: DepthRig) -> View | None:
    """Returns a capture as a view, or None where it has no colour image.

    Raises:
        InputError: If it has a pose and joint angles that contradict each other.
    """
    if capture.colour is None:
        return None
    rgb = capture.colour.rgb
    label = np.zeros(rgb.shape[:2], np.uint8) if capture.label is None else capture.label
    shown = _eight_bits(rgb)
    scale = _THUMBNAIL_PX / max(rgb.shape[:2])
    small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    depth = replace(capture.depth, ir=None)
    return View(capture.name, capture.role, _jpeg(shown), _jpeg(small), depth, _pose(capture, rig), label)


def overlay_png(label: NDArray[np.uint8], classes: SurfaceClasses) -> bytes:
    """Returns a label image in the classes' colours, what is unlabelled transparent, as a PNG."""
    colours = np.zeros((256, 4), np.uint8)
    colours[1 : 1 + len(classes.names)] = np.column_stack([classes.rgb, np.full(len(classes.names), 255)])
    return _encoded(".png", cv2.cvtColor(colours[label], cv2.COLOR_RGBA2BGRA), [])


def _pose(capture: Capture, rig: DepthRig) -> Transform | None:
    if capture.joints is None and capture.base_T_depth is None:
        return None
    try:
        return depth_pose(capture, rig)
    except MissingCalibrationError:
        return None


def _eight_bits(rgb: NDArray[Any]) -> NDArray[np.uint8]:
    """A deep image is stretched and its shadows lifted, so that one can see what is there."""
    if rgb.dtype == np.uint8:
        return np.ascontiguousarray(rgb, np.uint8)
    bright = max(float(np.percentile(rgb, _BRIGHT)), 1.0)
    levels = np.rint(np.sqrt(np.clip(np.arange(1 << 16) / bright, 0, 1)) * 255).astype(np.uint8)
    shown: NDArray[np.uint8] = levels[rgb]
    return shown


def _jpeg(rgb: NDArray[Any]) -> bytes:
    return _encoded(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


def _encoded(kind: str, bgr: NDArray[Any], options: list[int]) -> bytes:
    done, data = cv2.imencode(kind, bgr, options)
    if not done:
        raise RuntimeError(f"an image of {bgr.shape} cannot be encoded as {kind}")
    return bytes(data)
