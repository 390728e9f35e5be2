"""What is really so in a simulated world: rig, labels, geometry and reflectance without noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.sim.materials import CLASS_COLOURS, CLASS_NAMES, MATERIALS
from drivers.sim.raycast import crop_of
from drivers.sim.reflection import footprint, points_of
from drivers.sim.scenes import CHECKERBOARD_SIDE_M, CHECKERBOARD_SQUARES, DISC_PLACES_M, DISC_RADIUS_M
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError
from surfclass.rig import Camera
from surfclass.types import Bool, Float32, Float64, Transform

_LABEL = np.array([material.label for material in MATERIALS], np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The surface that each pixel of a camera sees, in that camera's frame.

    Attributes:
        point: (3, h, w) float32 m, zeros where nothing is.
        normal: (3, h, w) float32, unit, of the flat surface (its relief left out).
        hit: (h, w) bool.
    """

    point: Float32
    normal: Float32
    hit: Bool


def surface(world: SimWorld, q: Float64, camera: Literal["rgb", "depth"] = "rgb") -> Surface:
    """Returns the geometry that a camera sees from the joint angles `q` (6,) rad."""
    hits = world.hits(q, camera)
    rays = world.package.rgb_rays if camera == "rgb" else world.package.depth_rays
    normals = np.array([face.normal for face in hits.faces] + [np.zeros(3)], np.float32)
    point = np.stack([rays[0] * hits.z, rays[1] * hits.z, hits.z])
    return Surface(point, np.ascontiguousarray(normals[hits.face].transpose(2, 0, 1)), hits.face >= 0)


def depth(world: SimWorld, q: Float64) -> Float32:
    """Returns (h, w) m along the depth camera's axis, 0 where nothing is."""
    return world.hits(q, "depth").z


def normal(world: SimWorld, q: Float64) -> Float32:
    """Returns (3, h, w) unit normals in the depth camera's frame, turned to the camera."""
    return surface(world, q, "depth").normal


def label_image(world: SimWorld, q: Float64) -> NDArray[np.uint8]:
    """Returns (h, w) in the colour image's grid: 1 + the class index, 0 for what is no class."""
    hits = world.hits(q, "rgb")
    label = np.zeros(hits.z.shape, np.uint8)
    for number in range(len(hits.faces)):
        crop = crop_of(hits, number)
        if crop is not None:
            box = crop.rows, crop.columns
            material = world.texture(number).material_at(hits.s[box], hits.t[box])
            label[box][crop.seen] = _LABEL[material][crop.seen]
    return label


def reflectance(world: SimWorld, q: Float64) -> Float32:
    """Returns (3, h, w) K_d of every colour pixel, on the scale of the full reflectance model.

    That scale includes the LED's strength: on a matte flat surface `g⁻¹(I) d² / (cos θ_l · led ·
    vignetting)` of a nominal exposure at full level is this, up to noise and blur.
    """
    hits = world.hits(q, "rgb")
    result = np.zeros((3, *hits.z.shape), np.float32)
    for number in range(len(hits.faces)):
        crop = crop_of(hits, number)
        if crop is None:
            continue
        box = crop.rows, crop.columns
        point = points_of(hits, crop, world.package.rgb_rays)
        size = footprint(hits, number, point, world.package.rgb.fx)
        albedo, _ = world.texture(number).sample(hits.s[box], hits.t[box], size)
        for channel in range(3):
            result[channel][box][crop.seen] = albedo[..., channel][crop.seen]
    return result * np.float32(world.package.led.gain_m2)


def base_T_depth(world: SimWorld, q: Float64) -> Transform:
    """Returns the depth camera's pose."""
    return world.base_T_depth(q)


def base_T_rgb(world: SimWorld, q: Float64) -> Transform:
    """Returns the colour camera's pose."""
    return world.base_T_rgb(q)


def classes_toml() -> str:
    """Returns the text of `classes.toml`."""
    names = ", ".join(f'"{name}"' for name in CLASS_NAMES)
    colours = ", ".join(f'"{colour}"' for colour in CLASS_COLOURS)
    return f"names = [{names}]\ncolours = [{colours}]\n"


def plate_toml(world: SimWorld) -> str:
    """Returns the text of `plate.toml`: the reflector discs' radius and centres in `base`.

    Raises:
        ConfigurationError: If the scene has no reflector discs.
    """
    plates = [one for one in world.scene.surfaces if "reflector" in one.materials and one.layout]
    if not plates:
        raise ConfigurationError(f"scene {world.scene.name!r} has no reflector discs")
    plate = plates[0]
    centres = [plate.corner + s * plate.along_s + t * plate.along_t for s, t in DISC_PLACES_M]
    rows = ",\n".join(f"  {_numbers(centre)}" for centre in centres)
    return f"disc_radius_m = {DISC_RADIUS_M}\npositions_base_m = [\n{rows},\n]\n"


def board_toml() -> str:
    """Returns the text of `board.toml`: the checkerboard of the scene of that name."""
    columns, rows = CHECKERBOARD_SQUARES
    return f"columns = {columns - 1}\nrows = {rows - 1}\nsquare_m = {CHECKERBOARD_SIDE_M}\n"


def rig(world: SimWorld, raw: bool = False) -> str:
    """Returns the text of `rig.toml` as a perfect calibration would give it.

    Complete but for the thesis' polynomial of Eq. 4.4, which is no truth of this camera.

    Args:
        world: What is calibrated.
        raw: Whether images are the sensor's own, which are linear, or went through the response.
    """
    package = world.package
    led = package.led
    curves = [[0.0, 1.0]] * 3 if raw else package.response_inverse
    lines = [
        "schema = 1",
        f'name = "simulated {world.scene.name}"',
        "voxel_size_m = 0.010",
        *_camera("rgb", package.rgb),
        *_camera("depth", package.depth),
        "[transforms]",
        f"rgb_T_depth = {_rows(package.rgb_T_depth)}",
        f"flange_T_depth = {_rows(package.flange_T_depth)}",
        "[light]",
        f"position_rgb_m = {_numbers(led.position_m)}",
        f"axis_rgb = {_numbers(led.axis)}",
        f"falloff_exponent = {led.falloff_exponent}",
        "[response]",
        f"inverse = [{', '.join(_numbers(curve) for curve in curves)}]",
        "[features]",
        'colour = "K_d"',
        'texture = "LBP"',
        "[lens]",
        f"focal_length_m = {package.focal_length_m}",
        f"f_number = {package.f_number}",
        f"focus_distance_m = {package.focus_distance_m}",
        f"circle_of_confusion_m = {package.circle_of_confusion_m}",
        "[arm]",
        f"flange_offset_m = {package.flange_offset_m}",
    ]
    return "\n".join(lines) + "\n"


def _camera(table: str, camera: Camera) -> list[str]:
    lines = [f"[{table}]", f"size = [{camera.size[0]}, {camera.size[1]}]"]
    lines += [f"{key} = {float(getattr(camera, key))!r}" for key in ("fx", "fy", "cx", "cy")]
    lines.append(f"distortion = {_numbers(camera.distortion)}")
    if camera.vignetting is not None:
        lines.append(f"vignetting = {_numbers(camera.vignetting)}")
    return lines


def _numbers(values: Iterable[float]) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def _rows(transform: Transform) -> str:
    return "[" + ", ".join(_numbers(row) for row in transform.matrix) + "]"
