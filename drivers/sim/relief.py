"""Noise over a patch of surface: a function of the place on the surface, whatever the texel size."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from drivers.sim.randomness import stream
from surfclass.types import Float32


@dataclass(frozen=True)
class Patch:
    """The texels of a rectangle of surface.

    Attributes:
        size_m: Width (along s) and height (along t).
        texel_m: Side of a texel; texel (0, 0) has its centre at half of it.
        seed: Of the world.
        key: The patch's own name: another name is another place of the same material.
    """

    size_m: tuple[float, float]
    texel_m: float
    seed: int
    key: str

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of texels that cover the rectangle."""
        width, height = (max(2, int(np.ceil(side / self.texel_m))) for side in self.size_m)
        return height, width

    @cached_property
    def s(self) -> Float32:
        """(1, w) m along the width."""
        return ((np.arange(self.shape[1], dtype=np.float32) + 0.5) * np.float32(self.texel_m))[None]

    @cached_property
    def t(self) -> Float32:
        """(h, 1) m along the height."""
        return ((np.arange(self.shape[0], dtype=np.float32) + 0.5) * np.float32(self.texel_m))[:, None]

    def noise(self, name: str, wave_s: float, wave_t: float | None = None) -> Float32:
        """Returns (h, w) smooth noise of about unit variance with features of `wave` metres.

        Waves finer than the texel are averaged over it, as a camera would: their amplitude falls.
        """
        wave_t = wave_s if wave_t is None else wave_t
        damping = 1.0
        waves = []
        for wave in (wave_s, wave_t):
            damping *= min(1.0, wave / (1.3 * self.texel_m))
            waves.append(max(wave, 1.3 * self.texel_m))
        width, height = self.size_m
        columns, rows = int(width / waves[0]) + 6, int(height / waves[1]) + 6
        lattice = stream(self.seed, self.key, name).standard_normal((rows, columns), dtype=np.float32)
        step_s, step_t = self.texel_m / waves[0], self.texel_m / waves[1]
        places = np.array([[step_s, 0, 2 + step_s / 2], [0, step_t, 2 + step_t / 2]])
        how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        smooth = cv2.warpAffine(lattice, places, self.shape[::-1], flags=how)
        # 1.35: what the interpolation takes off the deviation.
        return np.asarray(smooth * np.float32(1.35 * damping), dtype=np.float32)

    def fractal(self, name: str, wave_m: float, octaves: int, gain: float = 0.5) -> Float32:
        """Returns (h, w) noise of about unit variance summed over `octaves` of halving waves."""
        total = np.zeros(self.shape, np.float32)
        power = 0.0
        for octave in range(octaves):
            amplitude = gain**octave
            total += np.float32(amplitude) * self.noise(f"{name}.{octave}", wave_m / 2**octave)
            power += amplitude**2
        total /= np.float32(np.sqrt(power))
        return total


def step(value: Float32, low: float, high: float) -> Float32:
    """Returns 0 below `low`, 1 above `high`, and a smooth rise between."""
    part = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    return np.asarray(part * part * (3 - 2 * part), dtype=np.float32)


def mix(first: Float32, second: tuple[float, float, float], part: Float32) -> Float32:
    """Returns (h, w, 3) `first` where `part` is 0, the colour `second` where it is 1."""
    return first + (np.array(second, np.float32) - first) * part[..., None]
