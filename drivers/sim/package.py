"""The true numbers of the simulated sensor package: cameras, mounting, light and response."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from surfclass.errors import ConfigurationError
from surfclass.rig import Camera
from surfclass.types import Float32, Float64, Transform, freeze

_CURVE_POINTS = 256
Vector = tuple[float, float, float]


def pose(dst: str, src: str, rotation_vector: Vector, translation: Vector) -> Transform:
    """Returns `dst_T_src` from a rotation vector (rad) and a translation (m)."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(rotation_vector, dtype=np.float64))[0]
    matrix[:3, 3] = translation
    return Transform(dst, src, matrix)


def scaled(camera: Camera, scale: float) -> Camera:
    """Returns the camera with an image `scale` times as large and the same field of view."""
    width, height = (round(side * scale) for side in camera.size)
    fx_scale, fy_scale = width / camera.size[0], height / camera.size[1]
    return camera.model_copy(
        update={
            "size": (width, height),
            "fx": camera.fx * fx_scale,
            "fy": camera.fy * fy_scale,
            "cx": (camera.cx + 0.5) * fx_scale - 0.5,
            "cy": (camera.cy + 0.5) * fy_scale - 0.5,
        }
    )


def camera_rays(camera: Camera) -> Float32:
    """Returns (2, h, w) x/z and y/z of every pixel, lens distortion undone by fixed-point iteration."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    distorted = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy])
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = distorted
    for _ in range(15):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        shift_x = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        shift_y = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (distorted[0] - shift_x) / radial, (distorted[1] - shift_y) / radial
    return np.stack([x, y]).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Led:
    """The LED: a small disc on the sensor package, in the `rgb` frame.

    Attributes:
        position_m: Its centre.
        axis: Unit direction of its strongest emission.
        falloff_exponent: Emission goes as the cosine off the axis to this power.
        radius_m: Of the emitting disc; it makes the shadows soft.
        gain_m2: Linear fraction of full scale that a white Lambertian surface (K_d = 1) at 1 m gives
            at full level in the nominal exposure.
    """

    position_m: tuple[float, float, float] = (-0.084, 0.037, -0.006)
    axis: tuple[float, float, float] = (0.0597, -0.0299, 0.99776846)
    falloff_exponent: float = 1.3
    radius_m: float = 0.004
    gain_m2: float = 0.45


@dataclass(frozen=True)
class Package:
    """Everything that a calibration can find out about the simulated sensor package.

    Attributes:
        rgb: The colour camera, vignetting included.
        depth: The depth camera.
        rgb_T_depth: The depth camera in the colour camera's frame.
        flange_T_depth: The hand-eye transform.
        led: The light.
        response_exponents: Per channel R, G, B: `g⁻¹(I) = s I + (1 − s) I^e` with s the
            `response_toe`.
        response_toe: As above.
        focal_length_m: Of the colour camera's lens; `f_number`, `focus_distance_m` likewise.
        nominal_exposure_s: What `Led.gain_m2` refers to.
        flange_offset_m: The last D-H length.
        projector_baseline_m: The depth camera's projector lies here along its x axis.
        depth_scale: What the depth camera reads, divided by the true depth: coefficients of 1, x, y, x²,
            xy, y² with x and y the place in its image from -1 at the first column and row to 1 at the last.
        disparity_offset_px: What it adds to its disparity.
    """

    rgb: Camera
    depth: Camera
    rgb_T_depth: Transform
    flange_T_depth: Transform
    led: Led = Led()
    response_exponents: tuple[float, float, float] = (2.20, 2.26, 2.14)
    response_toe: float = 0.06
    focal_length_m: float = 0.00609
    f_number: float = 2.0
    focus_distance_m: float = 0.65
    circle_of_confusion_m: float = 5.4e-6
    nominal_exposure_s: float = 0.010
    flange_offset_m: float = 0.084
    projector_baseline_m: float = 0.075
    depth_scale: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    disparity_offset_px: float = 0.0

    @cached_property
    def flange_T_rgb(self) -> Transform:
        """The colour camera on the flange."""
        return self.flange_T_depth @ self.rgb_T_depth.inverse

    @cached_property
    def response_inverse(self) -> Float64:
        """(3, 256) g⁻¹ at evenly spaced intensities from 0 to 1; linear in between, exactly."""
        level = np.linspace(0.0, 1.0, _CURVE_POINTS)
        toe = self.response_toe
        curves = [toe * level + (1 - toe) * level**exponent for exponent in self.response_exponents]
        return np.asarray(freeze(np.array(curves)))

    @cached_property
    def rgb_rays(self) -> Float32:
        """(2, h, w) of the colour camera."""
        return np.asarray(freeze(camera_rays(self.rgb)))

    @cached_property
    def depth_rays(self) -> Float32:
        """(2, h, w) of the depth camera."""
        return np.asarray(freeze(camera_rays(self.depth)))

    @cached_property
    def vignetting(self) -> Float32:
        """(h, w) relative illumination of the colour image."""
        r2 = (self.rgb_rays.astype(np.float64) ** 2).sum(axis=0)
        v2, v4, v6 = self.rgb.vignetting or (0.0, 0.0, 0.0)
        return np.asarray(freeze((1 + r2 * (v2 + r2 * (v4 + r2 * v6))).astype(np.float32)))

    def at_scale(self, scale: float) -> Package:
        """Returns the package with images `scale` times as large, for fast tests."""
        if not 0.05 <= scale <= 1:
            raise ConfigurationError(f"scale of the simulated images: {scale}, allowed is 0.05 to 1")
        return replace(self, rgb=scaled(self.rgb, scale), depth=scaled(self.depth, scale))


def standard_package(scale: float = 1.0) -> Package:
    """Returns the package that every simulated scene is seen with.

    The extrinsics between the cameras are those of the thesis' Table 6.2 (its translation is in
    millimetres); the rest is invented, of the size such parts have.

    Raises:
        ConfigurationError: If the scale is outside 0.05…1.
    """
    package = Package(
        rgb=Camera(
            size=(1280, 960),
            fx=1624.2,
            fy=1623.1,
            cx=644.7,
            cy=476.2,
            distortion=(-0.061, 0.083, 0.0004, -0.0003, 0.0),
            vignetting=(-2.0, 1.6, -0.5),
        ),
        depth=Camera(
            size=(640, 480),
            fx=585.0,
            fy=585.0,
            cx=321.3,
            cy=242.1,
            distortion=(-0.028, 0.041, 0.0, 0.0, 0.0),
        ),
        rgb_T_depth=pose("rgb", "depth", (-0.03674, -0.02362, 0.00861), (0.00349, 0.07742, 0.00142)),
        flange_T_depth=pose("flange", "depth", (0.020, 0.031, -1.560), (0.0475, -0.0215, 0.0785)),
    )
    return package if scale == 1.0 else package.at_scale(scale)
