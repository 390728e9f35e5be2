"""The depth camera: a Kinect-like structured-light sensor with its steps, holes, shadows and speckle.

Disparity d = f b / z carries the noise: it is homoscedastic there, so the axial noise grows with z².
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.materials import MATERIALS
from drivers.sim.package import Package
from drivers.sim.randomness import stream
from drivers.sim.raycast import Hits, crop_of, length, lit_share
from drivers.sim.reflection import footprint, points_of
from drivers.sim.surfaces import Texture
from surfclass.types import Float32, Float64

DISPARITY_SD_PX = 0.10
DISPARITY_STEP_PX = 1 / 8
NEAR_M = 0.50
FAR_M = 4.0
IR_FULL_SCALE = 1023
_IR_GAIN_M2 = 260.0
_CORRELATION_PX = 1.2  # neighbours share most of a correlation window
_SPECKLE_PX = 2.2
_INFRARED = np.array([material.infrared for material in MATERIALS], np.float32)
_RETRO = np.array([material.retro for material in MATERIALS], np.float32)
_SPECULAR = np.array([material.specular for material in MATERIALS], np.float32)
_LOBE = np.array([material.lobe_rad for material in MATERIALS], np.float32)


def disparity_per_metre(package: Package) -> float:
    """Returns f b (px m): disparity in px of the depth camera is this over z."""
    return package.depth.fx * package.projector_baseline_m


def infrared(
    package: Package, hits: Hits, textures: Sequence[Texture | None], seed: int
) -> tuple[Float32, Float32]:
    """Returns what the projector's light does.

    Returns:
        (h, w) IR irradiance without noise, in counts; and (h, w) the cosine of its incidence angle,
        0 where it does not reach.
    """
    shape = hits.z.shape
    light, cosine = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    projector = np.array([package.projector_baseline_m, 0, 0], np.float32)
    for number, texture in enumerate(textures):
        crop = crop_of(hits, number) if texture is not None else None
        if crop is None or texture is None:
            continue
        box = crop.rows, crop.columns
        face = hits.faces[number]
        point = points_of(hits, crop, package.depth_rays)
        size = footprint(hits, number, point, package.depth.fx)
        albedo, _ = texture.sample(hits.s[box], hits.t[box], size)
        material = texture.material_at(hits.s[box], hits.t[box])
        to_projector = projector - point
        distance = length(to_projector)
        to_camera = -point / np.maximum(length(point)[..., None], np.float32(1e-6))
        half = to_projector / distance[..., None] + to_camera
        half /= length(half)[..., None]
        angle = np.clip(to_projector @ face.normal / distance, 0, 1)
        facet = np.arccos(np.clip(half @ face.normal, -1, 1))
        lobe = _SPECULAR[material] * np.exp(-0.5 * (facet / _LOBE[material]) ** 2)
        back = _INFRARED[material] * albedo.mean(axis=2) * angle + lobe + 2.6 * _RETRO[material]
        share = lit_share(hits, number, crop, package.depth_rays, projector, 0.001)
        angle, back = angle * (share > 0.5), back * share
        bright = np.float32(_IR_GAIN_M2) * back / distance**2 * _speckle(package, point, seed)
        light[box][crop.seen] = bright[crop.seen]
        cosine[box][crop.seen] = angle[crop.seen]
    return light, cosine


def _speckle(package: Package, point: Float32, seed: int) -> Float32:
    """The projector's dots: a pattern fixed to the projector, so it moves over the surfaces."""
    width, height = package.depth.size
    draw = stream(seed, "projector").standard_normal((height + 64, width + 192), dtype=np.float32)
    pattern = cv2.GaussianBlur(draw, (0, 0), max(0.5, _SPECKLE_PX / 2.6 * width / 640))
    pattern = np.clip(pattern / pattern.std(), -0.7, None) + np.float32(0.7)
    z = np.maximum(point[..., 2], np.float32(0.05))
    u = package.depth.fx * (point[..., 0] - np.float32(package.projector_baseline_m)) / z
    v = package.depth.fy * point[..., 1] / z
    u += np.float32(package.depth.cx + 128)
    v += np.float32(package.depth.cy + 32)
    dots = cv2.remap(pattern, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(0.35 + 0.9 * dots, dtype=np.float32)


def measure(
    package: Package, hits: Hits, light: Float32, cosine: Float32, noise: np.random.Generator
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Returns one exposure: depth (h, w) in mm, 0 = no return, and IR (h, w) 0…1023.

    Args:
        package: The sensors.
        hits: The scene in the depth camera's frame.
        light: The first that `infrared` returned.
        cosine: The second.
        noise: All that is random in this exposure.
    """
    shape = hits.z.shape
    per_metre = np.float32(disparity_per_metre(package))
    z = _jitter(hits.z, noise)
    true = per_metre / np.where(z > 0, z, np.float32(np.inf))
    draw = noise.standard_normal(shape, dtype=np.float32)
    smooth = cv2.GaussianBlur(draw, (0, 0), _CORRELATION_PX)
    # A Gaussian of this sigma leaves 1 / (2 sigma √π) of the standard deviation.
    error = smooth * np.float32(DISPARITY_SD_PX * 2 * _CORRELATION_PX * np.sqrt(np.pi))
    true = _misread(package, true)
    disparity = np.round((true + error) / DISPARITY_STEP_PX) * np.float32(DISPARITY_STEP_PX)
    with np.errstate(divide="ignore"):
        depth = np.where(disparity > 0, per_metre / disparity, np.float32(0))
    lost = _lost(hits, light, cosine, noise)
    kept = (z > 0) & ~lost & (depth >= NEAR_M) & (depth <= FAR_M)
    depth_mm = np.where(kept, np.round(depth * 1000), 0).astype(np.uint16)

    counts = cv2.GaussianBlur(light, (0, 0), 0.6) + np.float32(6)
    counts += np.sqrt(counts + 9) * noise.standard_normal(shape, dtype=np.float32)
    return depth_mm, np.clip(np.round(counts), 0, IR_FULL_SCALE).astype(np.uint16)


def _misread(package: Package, disparity: Float64) -> Float64:
    """The disparity that a sensor finds whose own calibration is off; an ideal one finds the true one."""
    scale = package.depth_scale
    if scale == (1.0, 0.0, 0.0, 0.0, 0.0, 0.0) and package.disparity_offset_px == 0:
        return disparity
    height, width = disparity.shape
    x = np.linspace(-1, 1, width)[None, :]
    y = np.linspace(-1, 1, height)[:, None]
    read = scale[0] + scale[1] * x + scale[2] * y + scale[3] * x * x + scale[4] * x * y + scale[5] * y * y
    return np.asarray(disparity / read + package.disparity_offset_px)


def _jitter(z: Float32, noise: np.random.Generator) -> Float32:
    """Depth edges are ragged: each pixel reads up to a pixel beside its place."""
    height, width = z.shape
    rows, columns = np.indices((height, width), dtype=np.int32)
    shift = np.clip(np.round(0.55 * noise.standard_normal((2, height, width), dtype=np.float32)), -1, 1)
    rows = np.clip(rows + shift[0].astype(np.int32), 0, height - 1)
    columns = np.clip(columns + shift[1].astype(np.int32), 0, width - 1)
    beside = z[rows, columns]
    edge = np.abs(beside - z) > np.float32(0.02) * z
    return np.where(edge, beside, z)


def _lost(hits: Hits, light: Float32, cosine: Float32, noise: np.random.Generator) -> NDArray[np.bool_]:
    """Where no disparity is found: grazing, shadowed, saturated or dark, at edges, and at random."""
    draw = noise.random(hits.z.shape, dtype=np.float32)
    grazing = draw < np.clip((np.float32(0.42) - cosine) / np.float32(0.25), 0, 1)
    near, far = cv2.erode(hits.z, np.ones((3, 3))), cv2.dilate(hits.z, np.ones((3, 3)))
    edge = (far - near > np.float32(0.03) * far) & (noise.random(hits.z.shape, dtype=np.float32) < 0.55)
    window = cv2.blur(np.minimum(light, IR_FULL_SCALE), (5, 5))
    washed = window > np.float32(0.97 * IR_FULL_SCALE)
    weak = window < np.float32(6)
    blotch = cv2.GaussianBlur(noise.standard_normal(hits.z.shape, dtype=np.float32), (0, 0), 1.5)
    hole = blotch > np.float32(2.6 / (2 * 1.5 * np.sqrt(np.pi)))
    return np.asarray(grazing | (cosine <= 0) | edge | washed | weak | hole)
