"""What the cameras would see from a pose: functions of what they are given, whatever was drawn before."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.sim import colour_camera, depth_camera, reflection
from drivers.sim.package import Package
from drivers.sim.randomness import stream
from drivers.sim.raycast import Hits, cast, crop_of, faces_from
from drivers.sim.surfaces import TEXEL_M, Surface, Texture, bake
from surfclass.types import Float32, Transform


class Renderer:
    """Draws one scene; may be called from several threads, and then draws one image of each camera at a time.

    Args:
        surfaces: Of the scene, in `base`.
        package: The sensors.
        seed: Decides textures and noise.
        scale: Of the images: textures are as much coarser.
    """

    def __init__(self, surfaces: Sequence[Surface], package: Package, seed: int, scale: float) -> None:
        self.surfaces = tuple(surfaces)
        self.package = package
        self.seed = seed
        self._texel_m = TEXEL_M / scale
        self._textures: dict[int, Texture] = {}
        # Apart, so that neither camera waits for the other's image.
        self._texture_lock, self._colour_lock, self._depth_lock = (threading.Lock() for _ in range(3))
        self._last: tuple[bytes, Float32, Float32, Float32] | None = None
        self._last_depth: tuple[bytes, Hits, Float32, Float32] | None = None

    def hits(self, base_T_camera: Transform) -> Hits:
        """Returns what the pixels see of the camera whose frame, "rgb" or "depth", the pose is of."""
        rays = self.package.rgb_rays if base_T_camera.src == "rgb" else self.package.depth_rays
        return cast(faces_from(self.surfaces, base_T_camera.inverse), rays)

    def texture(self, number: int) -> Texture:
        """Returns the baked look of surface `number`; made when it is first seen."""
        with self._texture_lock:
            if number not in self._textures:
                self._textures[number] = bake(self.surfaces[number], self.seed, self._texel_m)
            return self._textures[number]

    def irradiance(self, base_T_rgb: Transform, level: float, ambient: float, exposure_s: float) -> Float32:
        """Returns (h, w, 3) linear light on the sensor as a fraction of full scale, without noise."""
        with self._colour_lock:
            lit, albedo, z = self._radiance(base_T_rgb)
            light = np.float32(level) * lit + np.float32(ambient) * albedo
            image = colour_camera.defocus(self.package, light, z)
        image *= self.package.vignetting[..., None]
        return image * np.float32(exposure_s / self.package.nominal_exposure_s)

    def prepare(self, base_T_rgb: Transform) -> None:
        """Does now what the next colour image from there would have to wait for."""
        with self._colour_lock:
            self._radiance(base_T_rgb)

    def colour(
        self,
        base_T_rgb: Transform,
        level: float,
        ambient: float,
        exposure_s: float,
        key: int,
        gain: float = 1.0,
    ) -> NDArray[np.uint8]:
        """Returns the image (h, w, 3) of frame `key`, which only its noise depends on."""
        light = self.irradiance(base_T_rgb, level, ambient, exposure_s)
        return colour_camera.expose(self.package, light, stream(self.seed, "colour", key), gain)

    def raw(
        self,
        base_T_rgb: Transform,
        level: float,
        ambient: float,
        exposure_s: float,
        key: int,
        gain: float = 1.0,
    ) -> NDArray[np.uint16]:
        """Returns the linear image (h, w, 3) before the camera's own processing, of frame `key`."""
        light = self.irradiance(base_T_rgb, level, ambient, exposure_s)
        return colour_camera.expose_raw(light, stream(self.seed, "colour", key), gain)

    def depth(self, base_T_depth: Transform, key: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Returns depth (h, w) in mm and IR (h, w) in 0…1023 of frame `key`."""
        hits, light, cosine = self._infrared(base_T_depth)
        return depth_camera.measure(self.package, hits, light, cosine, stream(self.seed, "depth", key))

    def _infrared(self, base_T_depth: Transform) -> tuple[Hits, Float32, Float32]:
        """What the depth camera sees and how its projector lights it; kept for the next frame at rest."""
        key = base_T_depth.matrix.tobytes()
        with self._depth_lock:
            if self._last_depth is not None and self._last_depth[0] == key:
                return self._last_depth[1:]
        hits = self.hits(base_T_depth)
        present = set(np.unique(hits.face).tolist())
        textures = [self.texture(n) if n in present else None for n in range(len(hits.faces))]
        light, cosine = depth_camera.infrared(self.package, hits, textures, self.seed)
        with self._depth_lock:
            self._last_depth = (key, hits, light, cosine)
        return hits, light, cosine

    def _radiance(self, base_T_rgb: Transform) -> tuple[Float32, Float32, Float32]:
        """Lit image at full level, albedo image and depth, before the lens; kept for a dark frame."""
        key = base_T_rgb.matrix.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1:]
        hits = self.hits(base_T_rgb)
        lit = np.zeros((*hits.z.shape, 3), np.float32)
        albedo = np.zeros_like(lit)
        rays, focal_px = self.package.rgb_rays, self.package.rgb.fx
        for number in range(len(hits.faces)):
            crop = crop_of(hits, number)
            if crop is None:
                continue
            light, colour = reflection.reflected(
                hits, number, crop, rays, self.texture(number), self.package.led, focal_px
            )
            box = crop.rows, crop.columns
            lit[box][crop.seen] = light[crop.seen]
            albedo[box][crop.seen] = colour[crop.seen]
        self._last = (key, lit, albedo, hits.z)
        return lit, albedo, hits.z
