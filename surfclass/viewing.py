"""What each colour pixel looks at, from how far and at which angle, for the camera and for the light."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.geometry import RegisteredDepth, corrected_depth, register
from surfclass.normals import DEFAULT_SETTINGS, Normals, NormalSettings, estimate_normals
from surfclass.rig import Rig
from surfclass.types import Bool, Float32, Float64, SurfaceView

_LEAST_LENGTH = 0.9  # of the mean of the normals around a pixel: the sides of a crease are not averaged


def view_surface(
    depth_mm: NDArray[Any], rig: Rig, settings: NormalSettings = DEFAULT_SETTINGS
) -> SurfaceView:
    """Registers a depth image with the colour camera and measures distances and angles.

    Viewing angle and distance are those of Eq. 3.7 and 3.8, incidence angle and distance to the light
    those of Eq. 4.13 and 4.14; the light's are None where the rig has no light.

    Args:
        depth_mm: (h, w) as the sensor reads it, along its optical axis, 0 = no return.
        rig: Cameras, `rgb_T_depth`, `depth_correction` and light.
        settings: How normals are fitted.

    Raises:
        InputError: If the image has not the depth camera's size.
    """
    registered = register(depth_mm, rig)
    normals = estimate_normals(corrected_depth(depth_mm, rig), rig.depth, settings)
    normal, has_normal = _normals_at(registered, normals, rig.rgb_T_depth.rotation)
    origin = np.zeros(3)
    distance, cosine = _seen_from(origin, registered.point, normal, registered.has_point)
    light_distance = light_cosine = None
    if rig.light is not None:
        position = np.array(rig.light.position_rgb_m)
        light_distance, light_cosine = _seen_from(position, registered.point, normal, registered.has_point)
    return SurfaceView(
        registered.point,
        normal,
        distance,
        cosine,
        light_distance,
        light_cosine,
        registered.has_point,
        has_normal,
    )


def _normals_at(registered: RegisteredDepth, normals: Normals, rotation: Float64) -> tuple[Float32, Bool]:
    """Reads the normals where the colour pixels' points were measured, and turns them into `rgb`."""
    turned = np.tensordot(rotation.astype(np.float32), normals.normal, axes=1)
    place = registered.u, registered.v
    normal: NDArray[Any] = np.stack([cv2.remap(plane, *place, cv2.INTER_LINEAR) for plane in turned])
    valid = cv2.remap(normals.valid.view(np.uint8), *place, cv2.INTER_NEAREST)
    length = np.sqrt(np.einsum("ihw,ihw->hw", normal, normal))
    has_normal: Bool = registered.has_point & (valid > 0) & (length > _LEAST_LENGTH)
    scale = np.divide(1, length, out=np.zeros_like(length), where=has_normal)
    np.multiply(normal, scale, out=normal)
    return normal, has_normal


def _seen_from(origin: Float64, point: Float32, normal: Float32, has_point: Bool) -> tuple[Float32, Float32]:
    """Distance from `origin` (m) and the cosine between the normal and the direction to it."""
    away = origin.astype(np.float32)[:, None, None] - point
    distance = np.sqrt(np.einsum("ihw,ihw->hw", away, away))
    distance *= has_point
    cosine = np.einsum("ihw,ihw->hw", away, normal)
    np.divide(cosine, distance, out=cosine, where=distance > 0)
    return distance, cosine
