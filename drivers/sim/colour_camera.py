"""The colour camera's optics and sensor: defocus, vignetting, noise, response and 8 bits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.package import Package
from surfclass.types import Float32

FULL_WELL_E = 12000.0
READ_NOISE_E = 9.0
RAW_FULL_SCALE = 65535
_SHARP_SIGMA_PX = 0.45
_CURVE_STEPS = 16384


def blur_sigma_px(package: Package, z: Float32) -> Float32:
    """Returns the Gaussian that stands for the thin lens' blur circle at depth `z` (m; 0: nothing there), px.

    A disc of diameter D has the standard deviation D/4 along each axis; the lens' own sharpness
    adds in quadrature.
    """
    focal, distance = package.focal_length_m, package.focus_distance_m
    diameter_m = (
        focal**2 / package.f_number * np.abs(z - distance) / (np.maximum(z, 0.05) * (distance - focal))
    )
    diameter_px = diameter_m / focal * package.rgb.fx
    sigma = np.hypot(np.where(z > 0, diameter_px / 4, 0), _SHARP_SIGMA_PX)
    return np.asarray(sigma, dtype=np.float32)


def defocus(package: Package, light: Float32, z: Float32) -> Float32:
    """Returns the image (h, w, 3) as the lens renders it, each pixel blurred for its own depth."""
    sigma = blur_sigma_px(package, z)
    levels = [_SHARP_SIGMA_PX]
    while levels[-1] < float(sigma.max()):
        levels.append(levels[-1] * 1.5)
    # Where on the ladder of blurred copies each pixel lies.
    rung = np.log(sigma / np.float32(levels[0])) / np.float32(np.log(1.5))
    image = np.zeros_like(light)
    for index, level in enumerate(levels):
        share = np.maximum(0, 1 - np.abs(rung - np.float32(index)))
        if not share.any():
            continue
        image += share[..., None] * cv2.GaussianBlur(light, (0, 0), level)
    return image


def expose(
    package: Package, irradiance: Float32, noise: np.random.Generator, gain: float = 1.0
) -> NDArray[np.uint8]:
    """Returns the image (h, w, 3) of linear irradiance (fraction of full scale, after vignetting).

    Photon noise, read noise, gain, saturation, the camera's response, 8 bits.
    """
    electrons = _electrons(irradiance, noise)
    steps = np.clip(electrons * np.float32(gain * (_CURVE_STEPS - 1) / FULL_WELL_E), 0, _CURVE_STEPS - 1)
    index = (steps + np.float32(0.5)).astype(np.uint16)
    image = np.empty(irradiance.shape, np.uint8)
    for channel, curve in enumerate(_curves(package)):
        image[..., channel] = curve[index[..., channel]]
    return image


def expose_raw(irradiance: Float32, noise: np.random.Generator, gain: float = 1.0) -> NDArray[np.uint16]:
    """Returns what the sensor's converter gives before the camera's own processing: linear, 65535 is full.

    Args:
        irradiance: (h, w, 3) fraction of full scale, after vignetting; every pixel in all colours,
            of which a mosaic keeps one.
        noise: All that is random in this exposure.
        gain: Of the converter, as a factor; it raises the noise with the signal.
    """
    counts = _electrons(irradiance, noise) * np.float32(gain * RAW_FULL_SCALE / FULL_WELL_E)
    return np.asarray(np.clip(np.round(counts), 0, RAW_FULL_SCALE).astype(np.uint16))


def _electrons(irradiance: Float32, noise: np.random.Generator) -> Float32:
    """Electrons with photon and read noise; they may exceed the well, or lie below zero."""
    electrons = np.maximum(irradiance, 0) * np.float32(FULL_WELL_E)
    spread = np.sqrt(electrons + np.float32(READ_NOISE_E**2))
    electrons += spread * noise.standard_normal(irradiance.shape, dtype=np.float32)
    return np.asarray(electrons, dtype=np.float32)


def _curves(package: Package) -> list[NDArray[np.uint8]]:
    """Linear light in even steps to 8-bit intensity, per channel: the inverse of g⁻¹."""
    linear = np.linspace(0.0, 1.0, _CURVE_STEPS)
    inverse = package.response_inverse
    level = np.linspace(0.0, 1.0, inverse.shape[1])
    return [np.round(255 * np.interp(linear, curve, level)).astype(np.uint8) for curve in inverse]
