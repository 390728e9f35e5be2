"""A made world for light and response: flat boards before one LED, by formulas of its own, in float64."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from raycast import make_rig, pixel_rays

from calibration.source import Source
from surfclass.frames import Capture, ColourFrame, DepthFrame

LIGHT = np.array([-0.084, 0.037, -0.006])
RIG = make_rig(rgb_size=(160, 120), rgb_f=203.0, depth_size=(160, 120), depth_f=146.0)
POSES = ((0.62, 0, 0), (0.70, 8, 4), (0.78, -7, 5), (0.88, 3, -6))  # distance, turned about y and about x
DISTANCES = (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3)


def linear(light):
    return light


def power(light):
    return light ** (1 / 2.2)


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-12) ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class World:
    """One LED, one lens, one sensor; `gain` is the irradiance of K_d = 1 at 1 m and 10 ms."""

    light: np.ndarray = field(default_factory=lambda: LIGHT)
    axis: tuple = (0.06, -0.03, 1.0)
    exponent: float = 1.3
    vignetting: tuple = (-2.1, 2.4, -1.2)
    response: object = srgb
    gain: float = 0.75
    coat: float = 0.0
    noise: float = 0.004
    depth_noise_m: float = 0.0015
    bits: int = 8
    rig: object = RIG

    def capture(
        self, name, role, pose, seed=0, exposure_s=0.010, albedo=(0.5, 0.48, 0.52), gloss=0.0, ambient=0.0
    ):
        """One view; gloss is K_s of a lobe of Gaussian facets, 0.09 rad wide."""
        rng = np.random.default_rng([seed, sum(map(ord, name))])
        distance, about_y, about_x = pose
        y, x = np.radians(about_y), np.radians(about_x)
        normal = np.array([np.sin(y), np.sin(x), 0.0])
        normal[2] = -np.sqrt(1 - normal @ normal)
        offset = distance * normal[2]  # the point on the optical axis stays where it is
        ray = pixel_rays(self.rig.rgb)
        point = ray * (offset / (ray @ normal))[..., None]
        light = self.irradiance(point, normal, np.array(albedo), gloss) * exposure_s / 0.010
        depth_mm = self.depth(normal, offset, rng)
        lit, dark = light + ambient * exposure_s / 0.010, np.full_like(light, ambient * exposure_s / 0.010)
        frame = ColourFrame(0, 0, exposure_s, self.image(lit, rng))
        return Capture(
            name,
            role,
            DepthFrame(0, 0, None, depth_mm),
            frame,
            dark=ColourFrame(0, 0, exposure_s, self.image(dark, rng)) if ambient else None,
        )

    def irradiance(self, point, normal, albedo, gloss):
        away = self.light - point
        d = np.linalg.norm(away, axis=-1)
        to_light, to_camera = away / d[..., None], -point / np.linalg.norm(point, axis=-1)[..., None]
        half = to_light + to_camera
        half /= np.linalg.norm(half, axis=-1)[..., None]
        axis = np.array(self.axis) / np.linalg.norm(self.axis)
        r2 = (point[..., 0] ** 2 + point[..., 1] ** 2) / point[..., 2] ** 2
        v2, v4, v6 = self.vignetting
        lens = (
            (1 + v2 * r2 + v4 * r2**2 + v6 * r2**3)
            * np.maximum(-(to_light @ axis), 0) ** self.exponent
            / d**2
        )
        alpha = np.arccos(np.clip(half @ normal, -1, 1))
        lobe = gloss * np.exp(-(alpha**2) / (2 * 0.09**2)) / (to_camera @ normal)
        matte = (to_light @ normal) * (fresnel(to_light @ normal) * fresnel(to_camera @ normal)) ** self.coat
        return self.gain * lens[..., None] * (albedo * matte[..., None] + lobe[..., None])

    def image(self, light, rng):
        noisy = light + np.sqrt(self.noise**2 * np.maximum(light, 0) + 1e-6) * rng.standard_normal(
            light.shape
        )
        level = self.response(np.clip(noisy, 0, 1))
        full = 2**self.bits - 1
        whole = np.round(np.clip(level, 0, 1) * full)
        return whole.astype(np.uint8 if self.bits == 8 else np.uint16)

    def depth(self, normal, offset, rng):
        rgb_T_depth = self.rig.rgb_T_depth
        turned = rgb_T_depth.rotation.T @ normal
        ray = pixel_rays(self.rig.depth)
        z = (offset - normal @ rgb_T_depth.translation) / (ray @ turned)
        noisy = z + self.depth_noise_m * z**2 * rng.standard_normal(z.shape)
        return np.round(1000 * noisy).astype(np.uint16)

    def boards(self, seed=0, poses=POSES, gloss=0.5, albedo=(0.34, 0.33, 0.35)):
        return [
            self.capture(f"board_{k}", "light", pose, seed, gloss=gloss, albedo=albedo)
            for k, pose in enumerate(poses)
        ]

    def cards(self, seed=0, distances=DISTANCES, **more):
        return [
            self.capture(f"card_{round(1e3 * d)}", "response", (d, 0, 0), seed, **more) for d in distances
        ]

    def exposures(self, seed=0, times=(0.0003, 0.0006, 0.00125, 0.0025, 0.005, 0.010, 0.020), **more):
        return [
            self.capture(f"exposure_{k}", "exposure", (0.7, 0, 0), seed, exposure_s=time, **more)
            for k, time in enumerate(times)
        ]


def fresnel(cosine, index=1.49):
    """Share of unpolarised light that enters a smooth dielectric."""
    sine = np.sqrt(1 - cosine**2) / index
    inside = np.sqrt(1 - sine**2)
    across = ((cosine - index * inside) / (cosine + index * inside)) ** 2
    along = ((inside - index * cosine) / (inside + index * cosine)) ** 2
    return 1 - (across + along) / 2


class Made:
    """A set of captures in memory, as a recording would give them."""

    def __init__(self, captures):
        self.all = list(captures)

    def captures(self, roles):
        wanted = {roles} if isinstance(roles, str) else set(roles)
        return iter([capture for capture in self.all if capture.role in wanted])


@dataclass(frozen=True)
class MadeSource(Source):
    """Source without a file."""

    def captures(self, roles):
        return self._set.captures(roles)

    def count(self, role):
        return sum(capture.role == role for capture in self._set.all)


def source_of(captures, rig=RIG):
    return MadeSource(Path("made"), rig, None, None, Made(captures))


def inverse_of(response):
    """(3, 256) g⁻¹ of a response, numerically."""
    light = np.linspace(0, 1, 200_001)
    level = np.linspace(0, 1, 256)
    return np.tile(np.interp(level, response(light), light), (3, 1))


def known(world, **light):
    """The world's rig with its response, and what else is given of the light."""
    curves = [[float(x) for x in curve] for curve in inverse_of(world.response)]
    for curve in curves:
        curve[0], curve[-1] = 0.0, 1.0
    values = {"response": {"inverse": curves}}
    if light:
        values["light"] = light
    return world.rig.with_values(values)


def moved(world, **changes):
    return replace(world, **changes)
