"""How much light comes back from a surface: Torrance–Sparrow (Eq. 4.1), LED fall-off and shadows."""

from __future__ import annotations

import numpy as np

from drivers.sim.materials import MATERIALS
from drivers.sim.package import Led
from drivers.sim.raycast import Crop, Hits, length, lit_share
from drivers.sim.surfaces import Texture
from surfclass.types import Float32

_SPECULAR = np.array([material.specular for material in MATERIALS], np.float32)
_LOBE = np.array([material.lobe_rad for material in MATERIALS], np.float32)
_GRAZING = np.float32(0.10)  # 1 / cos of the viewing angle grows without bound; the surface's light does not


def points_of(hits: Hits, crop: Crop, rays: Float32) -> Float32:
    """Returns (h, w, 3) m, the points of a crop in the camera's frame."""
    box = crop.rows, crop.columns
    z = hits.z[box]
    return np.stack([rays[0][box] * z, rays[1][box] * z, z], axis=2)


def footprint(hits: Hits, number: int, point: Float32, focal_px: float) -> Float32:
    """Returns (h, w) m, the side of the patch of face `number` that a pixel sees."""
    distance = length(point)
    cosine = np.maximum(-(point @ hits.faces[number].normal) / np.maximum(distance, 1e-6), 0.05)
    return np.asarray(np.maximum(point[..., 2], 1e-3) / focal_px / np.sqrt(cosine), dtype=np.float32)


def led_emission(led: Led, point: Float32) -> Float32:
    """Returns (…,) relative emission of the LED towards the points (…, 3), cosⁿ off its axis."""
    away = point - np.array(led.position_m, np.float32)
    cosine = away @ np.array(led.axis, np.float32) / length(away)
    return np.asarray(np.maximum(cosine, 0) ** np.float32(led.falloff_exponent), dtype=np.float32)


def reflected(
    hits: Hits, number: int, crop: Crop, rays: Float32, texture: Texture, led: Led, focal_px: float
) -> tuple[Float32, Float32]:
    """Returns what one face sends to the colour camera, before lens and sensor.

    Args:
        hits: What the camera sees, in the `rgb` frame.
        number: The face.
        crop: Where it is seen.
        rays: (2, h, w) of the whole image.
        texture: The face's.
        led: The light.
        focal_px: Of the camera: decides how much of the surface a pixel averages.

    Returns:
        Linear fraction of full scale (h, w, 3) at full level and nominal exposure; and the albedo
        (h, w, 3), which is what ambient light would show.
    """
    face = hits.faces[number]
    box = crop.rows, crop.columns
    point = points_of(hits, crop, rays)
    albedo, slope = texture.sample(hits.s[box], hits.t[box], footprint(hits, number, point, focal_px))
    material = texture.material_at(hits.s[box], hits.t[box])
    source = np.array(led.position_m, np.float32)

    normal = face.normal - slope[..., :1] * face.along_s - slope[..., 1:] * face.along_t
    normal /= length(normal)[..., None]
    to_light = source - point
    distance = length(to_light)[..., None]
    to_light /= distance
    to_camera = -point / np.maximum(length(point)[..., None], np.float32(1e-6))
    half = to_light + to_camera
    half /= length(half)[..., None]

    light_cosine = np.maximum(np.einsum("ijk,ijk->ij", normal, to_light), 0)
    camera_cosine = np.maximum(np.einsum("ijk,ijk->ij", normal, to_camera), _GRAZING)
    facet = np.arccos(np.clip(np.einsum("ijk,ijk->ij", normal, half), -1, 1))
    lobe = np.exp(-0.5 * (facet / _LOBE[material]) ** 2)
    mirrored = _SPECULAR[material] / camera_cosine * lobe * (light_cosine > 0)

    arriving = np.float32(led.gain_m2) * led_emission(led, point) / distance[..., 0] ** 2
    arriving *= (to_light @ face.normal) > 0
    arriving *= lit_share(hits, number, crop, rays, source, led.radius_m)
    light = arriving[..., None] * (albedo * light_cosine[..., None] + mirrored[..., None])
    return light.astype(np.float32), albedo
