"""What the surfaces are made of: albedo and relief of each material, and how glossy it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.sim.randomness import stream
from drivers.sim.relief import Patch, mix, step
from surfclass.types import Float32

CLASS_NAMES = ("rusted", "blasted", "painted", "timber", "cardboard")
CLASS_COLOURS = ("#b7410e", "#9aa5ad", "#3f8f6f", "#c8a165", "#d9c19a")

# Albedo (h, w, 3) and height (h, w) in metres.
Look = tuple[Float32, Float32]


@dataclass(frozen=True, slots=True)
class Material:
    """One material.

    Attributes:
        name: How scenes call it.
        look: Makes albedo and relief of a patch.
        specular: K_s of Eq. 4.3 relative to a white K_d of 1.
        lobe_rad: Sigma of the specular lobe.
        label: 1 + the class's index, or 0.
        infrared: Reflectance in the depth camera's IR relative to the albedo.
        retro: Share of the IR sent straight back to the depth camera's projector.
    """

    name: str
    look: Callable[[Patch], Look]
    specular: float
    lobe_rad: float
    label: int = 0
    infrared: float = 1.0
    retro: float = 0.0


def _flat(patch: Patch, albedo: tuple[float, float, float]) -> Float32:
    return np.broadcast_to(np.array(albedo, np.float32), (*patch.shape, 3)).copy()


def _tint(patch: Patch, spread: float) -> Float32:
    """(3,) Two pieces of one material never have quite the same colour."""
    draw = stream(patch.seed, patch.key, "tint").standard_normal(4)
    return np.asarray(1 + spread * (draw[0] + 0.5 * draw[1:]), dtype=np.float32)


def _stained(patch: Patch, albedo: Float32, wide: float, fine: float) -> Float32:
    """Warmer here, cooler there: no real surface keeps one hue, neither over a hand's width nor a grain."""
    drift = wide * patch.fractal("hue", 0.060, 6, 0.65)
    for channel, share in enumerate((0.7, 0.1, -1.0)):
        speck = fine * patch.noise(f"pigment.{channel}", 0.0012)
        albedo[..., channel] *= np.exp(np.float32(share) * drift + speck)
    return albedo


def _rusted(patch: Patch) -> Look:
    blotch = patch.fractal("blotch", 0.070, 7, 0.62)
    fine = patch.fractal("fine", 0.006, 5, 0.75)
    scale = patch.fractal("scale", 0.110, 7, 0.60)
    fresh = patch.fractal("fresh", 0.035, 6, 0.65)
    albedo = _flat(patch, (0.225, 0.098, 0.046))
    albedo = mix(albedo, (0.105, 0.054, 0.036), step(blotch + 0.35 * fine, -0.2, 1.2))
    albedo = mix(albedo, (0.330, 0.148, 0.055), 0.85 * step(fresh + 0.3 * fine, 0.4, 1.5))
    pale = step(scale + 0.25 * fine, 1.0, 1.45)
    albedo = mix(albedo, (0.415, 0.295, 0.205), 0.9 * pale)
    bare = step(patch.fractal("bare", 0.050, 6, 0.6) + 0.2 * fine, 1.95, 2.25)
    albedo = mix(albedo, (0.315, 0.270, 0.240), 0.8 * bare)
    albedo = _stained(patch, albedo, 0.06, 0.035)
    albedo *= np.exp(np.float32(0.11) * fine + np.float32(0.10) * patch.noise("speck", 0.0007))[..., None]
    height = 1.6e-4 * blotch - 3.0e-4 * pale + 7.5e-5 * fine + 2.6e-5 * patch.noise("pit", 0.0009)
    return albedo * _tint(patch, 0.012), height.astype(np.float32)


def _blasted(patch: Patch) -> Look:
    grain = patch.noise("grain", 0.0008)
    peaks = patch.noise("peaks", 0.0016)
    cloud = patch.fractal("cloud", 0.120, 5)
    flash = step(patch.fractal("flash", 0.060, 6, 0.6), 0.9, 2.4)
    albedo = _flat(patch, (0.470, 0.458, 0.462))
    albedo = mix(albedo, (0.395, 0.292, 0.205), 0.75 * flash)
    albedo = _stained(patch, albedo, 0.022, 0.030)
    shadow = step(patch.noise("shadow", 0.0011), 0.6, 2.2)
    albedo *= np.exp(0.07 * grain + 0.05 * peaks + 0.045 * cloud - 0.28 * shadow)[..., None]
    height = 3.6e-5 * grain + 4.5e-5 * peaks
    return albedo * _tint(patch, 0.012), height.astype(np.float32)


def _painted(patch: Patch) -> Look:
    chalk = patch.fractal("chalk", 0.150, 6, 0.55)
    brush = patch.noise("brush", 0.060, 0.0022)
    dirt = step(patch.fractal("dirt", 0.045, 6, 0.6) + 0.4 * chalk, 1.2, 2.6)
    blister = patch.noise("spot", 0.011) + 0.28 * patch.fractal("ragged", 0.0045, 4, 0.7)
    spot = step(blister, 2.40, 2.65)
    halo = step(blister, 1.80, 2.65)
    albedo = _flat(patch, (0.245, 0.385, 0.335))
    albedo = mix(albedo, (0.390, 0.440, 0.405), 0.65 * step(chalk, -0.4, 2.0))
    albedo = mix(albedo, (0.235, 0.255, 0.205), 0.55 * dirt)
    albedo = mix(albedo, (0.310, 0.250, 0.160), 0.6 * halo)
    albedo = mix(albedo, (0.210, 0.105, 0.052), spot)
    albedo = _stained(patch, albedo, 0.030, 0.020)
    albedo *= np.exp(np.float32(0.018) * brush + np.float32(0.012) * patch.noise("pigment", 0.0009))[
        ..., None
    ]
    height = 1.1e-5 * patch.noise("peel", 0.0028) + 1.2e-5 * brush + 6.0e-5 * spot
    return albedo * _tint(patch, 0.012), height.astype(np.float32)


def _timber(patch: Patch) -> Look:
    drift = 0.010 * patch.noise("drift", 0.300, 0.060) + 0.0022 * patch.noise("sway", 0.070, 0.020)
    across = patch.t + drift
    knot = np.zeros(patch.shape, np.float32)
    for s, t, radius in _knots(patch):
        ds, dt = (patch.s - s) / (3.0 * radius), (patch.t - t) / radius
        knot = np.maximum(knot, np.exp(-(ds * ds + dt * dt)))
    across = across + 0.020 * knot
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * across / 0.0105 + 1.3 * patch.noise("rings", 0.400, 0.030))
    late = np.float32(1) - np.abs(2 * rings.astype(np.float32) - 1) ** np.float32(0.8)
    late = late * step(patch.noise("ringwidth", 0.500, 0.016), -1.6, 0.8)
    fibre = patch.noise("fibre", 0.030, 0.0008) + 0.6 * patch.noise("fibre2", 0.012, 0.0005)
    pores = step(patch.noise("pores", 0.009, 0.0006), 1.7, 2.4)
    albedo = _flat(patch, (0.565, 0.388, 0.236))
    albedo = mix(albedo, (0.425, 0.262, 0.142), 0.85 * late)
    albedo = mix(albedo, (0.475, 0.352, 0.250), 0.6 * step(patch.fractal("grey", 0.160, 5), 0.9, 2.4))
    albedo = mix(albedo, (0.235, 0.132, 0.075), 0.85 * step(knot, 0.45, 0.95))
    stain = step(patch.fractal("stain", 0.080, 6, 0.6), 1.1, 2.4)
    albedo = mix(albedo, (0.275, 0.172, 0.100), 0.75 * stain)
    albedo = _stained(patch, albedo, 0.034, 0.020)
    albedo *= np.exp(np.float32(0.055) * fibre - np.float32(0.18) * pores)[..., None]
    height = 2.2e-5 * fibre - 5.0e-5 * pores + 3.5e-5 * late
    return albedo * _tint(patch, 0.012), height.astype(np.float32)


def _knots(patch: Patch) -> list[tuple[float, float, float]]:
    """Centre and radius of the knots: one for each 0.06 square metres."""
    width, height = patch.size_m
    draw = stream(patch.seed, patch.key, "knots").random((round(width * height / 0.06), 3))
    return [(float(a) * width, float(b) * height, 0.004 + 0.008 * float(c)) for a, b, c in draw]


def _cardboard(patch: Patch) -> Look:
    fleck = patch.noise("fleck", 0.0030, 0.0012)
    fibres = patch.fractal("fibres", 0.0045, 4, 0.8)
    flute = np.sin(2 * np.pi * (patch.s + 0.0005 * patch.noise("wander", 0.060, 0.200)) / 0.0072)
    scuff = step(patch.fractal("scuff", 0.055, 6, 0.6), 1.1, 2.5)
    albedo = _flat(patch, (0.515, 0.381, 0.264))
    albedo = mix(albedo, (0.600, 0.470, 0.340), 0.55 * scuff)
    albedo = mix(albedo, (0.400, 0.270, 0.165), 0.5 * step(fleck, 1.5, 2.6))
    damp = patch.fractal("damp", 0.120, 4)
    wet = step(patch.fractal("wet", 0.100, 6, 0.55), 1.2, 1.7)
    albedo = mix(albedo, (0.335, 0.222, 0.135), 0.55 * wet)
    albedo = _stained(patch, albedo, 0.032, 0.018)
    shade = 0.030 * fibres + 0.016 * flute.astype(np.float32) + 0.045 * damp
    albedo *= np.exp(shade.astype(np.float32))[..., None]
    height = 4.0e-5 * flute + 1.0e-5 * fibres
    return albedo * _tint(patch, 0.012), height.astype(np.float32)


def _concrete(patch: Patch) -> Look:
    cloud = patch.fractal("cloud", 0.300, 8, 0.6)
    albedo = _flat(patch, (0.155, 0.150, 0.145)) * np.exp(0.16 * cloud)[..., None]
    return albedo, (1.0e-4 * cloud).astype(np.float32)


def _plain(albedo: tuple[float, float, float]) -> Callable[[Patch], Look]:
    return lambda patch: (_flat(patch, albedo), np.zeros(patch.shape, np.float32))


MATERIALS: tuple[Material, ...] = (
    Material("rusted", _rusted, 0.012, 0.40, label=1, infrared=1.6),
    Material("blasted", _blasted, 0.110, 0.30, label=2),
    Material("painted", _painted, 0.075, 0.15, label=3),
    Material("timber", _timber, 0.015, 0.40, label=4, infrared=1.2),
    Material("cardboard", _cardboard, 0.008, 0.45, label=5, infrared=1.2),
    Material("concrete", _concrete, 0.0, 0.40),
    Material("grey", _plain((0.50, 0.50, 0.50)), 0.0, 0.40),
    Material("semi-gloss", _plain((0.36, 0.36, 0.36)), 0.60, 0.090),
    Material("white", _plain((0.70, 0.70, 0.70)), 0.0, 0.40),
    Material("black", _plain((0.03, 0.03, 0.03)), 0.0, 0.40),
    Material("plate", _plain((0.10, 0.10, 0.11)), 0.0, 0.40),
    Material("reflector", _plain((0.55, 0.55, 0.57)), 0.0, 0.40, retro=1.0),
)
INDEX = {material.name: index for index, material in enumerate(MATERIALS)}
