"""Diffuse reflectance K_d: the colour of a surface without the light's distance and angle."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError, MissingCalibrationError
from surfclass.geometry import rays
from surfclass.rig import Camera, Light, Response, Rig
from surfclass.types import Bool, Float32, Float64, SurfaceView, freeze

UNDER_EXPOSED = 0.02
"""Fraction of full scale at and below which a channel of 8 bits says nothing but noise."""
LEAST_IRRADIANCE = 0.0015
"""The same as g⁻¹(I), for images of more bits: what `UNDER_EXPOSED` is in the response of sRGB."""
OVER_EXPOSED = 0.98
"""Fraction of full scale at and above which a channel is saturated."""
LEAST_LIGHT_COSINE = 0.5
"""The model holds for incidence angles up to 60° (thesis 6.4)."""

_SAME_EXPOSURE = 0.01
_LEVELS = 65536


def fit_distance_polynomial(
    distance_m: NDArray[Any], intensity: NDArray[Any], reference_m: float
) -> tuple[float, float, float]:
    """Fits Eq. 4.4's `1 / I ∝ a2 d² + a1 d + a0` to a Lambertian target lit straight on.

    Least squares of 1/I, weighted by I: a relative error counts alike at every distance; unweighted,
    the darkest samples rule.

    Args:
        distance_m: (n,) from the light, at least three different ones.
        intensity: (n,) fractions of full scale, positive.
        reference_m: Where the polynomial is scaled to 1.

    Returns:
        a2, a1, a0 for metres.

    Raises:
        InputError: If the samples do not determine a polynomial that is positive between them.
    """
    d, i = np.asarray(distance_m, np.float64), np.asarray(intensity, np.float64)
    if d.shape != i.shape or d.ndim != 1 or not (np.isfinite(d).all() and np.isfinite(i).all()):
        raise InputError(f"distance polynomial: shapes {d.shape} and {i.shape}, allowed are n finite pairs")
    if np.unique(d).size < 3 or i.min() <= 0 or d.min() <= 0:
        raise InputError("distance polynomial: needs positive intensities at 3 or more different distances")
    powers = np.stack([d * d, d, np.ones_like(d)], axis=1)
    coefficients = np.linalg.lstsq(powers * i[:, None], np.ones_like(d), rcond=None)[0]
    between = np.linspace(min(d.min(), reference_m), max(d.max(), reference_m), 101)
    if np.polyval(coefficients, between).min() <= 0:
        raise InputError(
            f"distance polynomial: the fit to {d.size} samples is not positive from {between[0]:.3f} to "
            f"{between[-1]:.3f} m; the samples are too noisy, or too far from the reference {reference_m} m"
        )
    a2, a1, a0 = coefficients / np.polyval(coefficients, reference_m)
    return float(a2), float(a1), float(a0)


def well_exposed(fraction: Float32, least: float = UNDER_EXPOSED) -> Bool:
    """Returns (h, w): no channel of the (3, h, w) fractions is at or below `least`, or over-exposed."""
    low = np.minimum(np.minimum(fraction[0], fraction[1]), fraction[2])
    high = np.maximum(np.maximum(fraction[0], fraction[1]), fraction[2])
    good: Bool = (low > np.float32(least)) & (high < OVER_EXPOSED)
    return good


def least_fraction(response: Response | None, bits: int) -> float:
    """Returns the fraction of full scale at and below which a channel says nothing but noise.

    Where a deep image has a known response, the limit is one of light: in a linear image a fraction of
    0.02 is a surface that any camera sees well.

    Args:
        response: The camera's.
        bits: Of the image, 8 or 16.
    """
    if bits <= 8 or response is None or response.inverse is None:
        return UNDER_EXPOSED
    levels = (np.interp(LEAST_IRRADIANCE, curve, np.linspace(0, 1, len(curve))) for curve in response.inverse)
    return min(UNDER_EXPOSED, float(max(levels)))


def diffuse_reflectance(
    fraction: Float32,
    view: SurfaceView,
    rig: Rig,
    mode: Literal["thesis", "full"],
    exposure_ratio: float = 1.0,
    bits: int = 8,
) -> tuple[Float32, Bool]:
    """Returns K_d of every pixel and channel.

    "thesis" is Eq. 4.12, `K_d = I (a2 d² + a1 d + a0) / cos θ_l`. Its polynomial stands for the camera's
    response too, which acts on the whole irradiance and not on the distance alone, so that it is wrong
    off the normal. "full" is `K_d = g⁻¹(I) d² / (cos θ_l · led · vignetting)`.

    Args:
        fraction: (3, h, w) intensities, fractions of full scale.
        view: The geometry of the same pixels.
        rig: Its light, response and vignetting.
        mode: Which of the two.
        exposure_ratio: Reference exposure time over this image's.
        bits: Of the image that the fractions are of, 8 or 16.

    Returns:
        (3, h, w) float32, 0 where not valid; and (h, w) bool: False where there is no normal, where
        θ_l exceeds 60°, where the light does not shine, or where any channel is badly exposed.

    Raises:
        MissingCalibrationError: Naming what of the rig is missing.
        InputError: If the shapes differ, the mode is unknown, or "thesis" is to mix exposures.
    """
    if fraction.shape != (3, *view.has_point.shape):
        raise InputError(f"K_d: planes {fraction.shape} for a view of {view.has_point.shape} pixels")
    if rig.light is None or view.light_distance_m is None or view.light_cosine is None:
        raise _missing(rig, "light.position_rgb_m")
    d, cosine = view.light_distance_m, view.light_cosine
    valid: Bool = view.has_normal & (cosine >= LEAST_LIGHT_COSINE)
    valid &= well_exposed(fraction, least_fraction(rig.response, bits))
    if mode == "thesis":
        if abs(exposure_ratio - 1) > _SAME_EXPOSURE:
            raise InputError(
                f"K_d: exposure ratio {exposure_ratio:g}; Eq. 4.12's polynomial holds at one exposure only, "
                "the full model scales"
            )
        return _by_polynomial(fraction, d, cosine, valid, rig), valid
    if mode == "full":
        return _by_full_model(fraction, view, d, cosine, valid, rig, exposure_ratio), valid
    raise InputError(f"K_d: mode {mode!r}, allowed are 'thesis' and 'full'")


def lacking_for_full_model(rig: Rig) -> list[str]:
    """Returns the rig's keys that the full model needs and that are missing."""
    response, light = rig.response, rig.light
    needed = {
        "response.inverse": None if response is None else response.inverse,
        "rgb.vignetting": rig.rgb.vignetting,
        "light.axis_rgb": None if light is None else light.axis_rgb,
        "light.falloff_exponent": None if light is None else light.falloff_exponent,
    }
    return [key for key, value in needed.items() if value is None]


def _missing(rig: Rig, *keys: str) -> MissingCalibrationError:
    are_missing, them = ("is missing", "it") if len(keys) == 1 else ("are missing", "them")
    return MissingCalibrationError(
        f"rig {rig.name}: {' and '.join(keys)} {are_missing}, K_d needs {them}; add {them} to rig.toml"
    )


def _by_polynomial(fraction: Float32, d: Float32, cosine: Float32, valid: Bool, rig: Rig) -> Float32:
    if rig.response is None or rig.response.a2_a1_a0 is None:
        raise _missing(rig, "response.a2_a1_a0")
    inverse = np.divide(1, cosine, out=np.zeros_like(cosine), where=valid)
    k_d = np.empty_like(fraction)
    for channel, polynomial in enumerate(rig.response.a2_a1_a0):
        a2, a1, a0 = (np.float32(a) for a in polynomial)
        factor = d * a2
        factor += a1
        factor *= d
        factor += a0
        factor *= inverse
        np.multiply(fraction[channel], factor, out=k_d[channel])
    return k_d


def _by_full_model(
    fraction: Float32,
    view: SurfaceView,
    d: Float32,
    cosine: Float32,
    valid: Bool,
    rig: Rig,
    exposure_ratio: float,
) -> Float32:
    if rig.response is None or rig.response.inverse is None:
        raise _missing(rig, "response.inverse")
    if rig.rgb.vignetting is None:
        raise _missing(rig, "rgb.vignetting")
    light = rig.light
    if light is None or light.axis_rgb is None or light.falloff_exponent is None:
        raise _missing(rig, "light.axis_rgb", "light.falloff_exponent")
    emission, shines = _emission(view.point, d, light)
    valid &= shines
    emission *= cosine
    factor = np.divide(np.float32(exposure_ratio), emission, out=np.zeros_like(d), where=valid)
    factor *= d
    factor *= d
    factor *= _inverse_vignetting(rig.rgb)
    k_d = np.empty_like(fraction)
    for channel, table in enumerate(_linear_tables(rig.response.inverse)):
        level = (fraction[channel] * np.float32(_LEVELS - 1) + np.float32(0.5)).astype(np.uint16)
        np.multiply(table[level], factor, out=k_d[channel])
    return k_d


def _emission(point: Float32, d: Float32, light: Light) -> tuple[Float32, Bool]:
    """The LED's fall-off cos(ψ)^n towards each point, and where it shines at all."""
    axis = np.array(light.axis_rgb, np.float32)
    towards = np.einsum("i,ihw->hw", axis, point)
    towards -= np.float32(axis @ np.array(light.position_rgb_m, np.float32))
    shines = towards > 0
    cosine = np.divide(towards, d, out=np.zeros_like(d), where=shines & (d > 0))
    exponent = light.falloff_exponent
    if exponent != 1:
        np.power(cosine, np.float32(exponent), out=cosine)
    return cosine, shines


@lru_cache(maxsize=4)
def _inverse_vignetting(camera: Camera) -> Float32:
    x, y = rays(camera).astype(np.float64)
    r2 = x * x + y * y
    v2, v4, v6 = camera.vignetting or (0.0, 0.0, 0.0)
    relative = 1 + r2 * (v2 + r2 * (v4 + r2 * v6))
    if relative.min() <= 0:
        raise InputError(
            f"rgb.vignetting {camera.vignetting}: the relative illumination falls to {relative.min():.3f} "
            "in the image, allowed is above 0"
        )
    return freeze((1 / relative).astype(np.float32))


@lru_cache(maxsize=4)
def _linear_tables(inverse: tuple[tuple[float, ...], ...]) -> Float32:
    """(3, 65536): g⁻¹ at every 16-bit intensity, which 8- and 16-bit images hit exactly."""
    return freeze(
        np.stack([_linear(np.linspace(0, 1, _LEVELS), curve) for curve in inverse]).astype(np.float32)
    )


def _linear(intensity: Float64, curve: tuple[float, ...]) -> Float64:
    """g⁻¹: irradiance of an intensity, both fractions of full scale."""
    return np.interp(intensity, np.linspace(0, 1, len(curve)), curve)


def subtract_dark(
    lit: NDArray[Any], dark: NDArray[Any], response: Response | None
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Takes ambient light off an image: `g(g⁻¹(lit) − g⁻¹(dark))`, for light adds up before the response.

    What is over-exposed in `lit` keeps its value, so that it is still known to be.

    Args:
        lit: (h, w, 3) uint8 or uint16, the LED on.
        dark: The same view and exposure, the LED off; uint8 or uint16, whichever `lit` is.
        response: The camera's; its `inverse` is needed.

    Returns:
        (h, w, 3) of `lit`'s type.

    Raises:
        MissingCalibrationError: If `response.inverse` is missing.
        InputError: If the images differ in shape, or have another type.
    """
    if response is None or response.inverse is None:
        raise MissingCalibrationError(
            "response.inverse is missing: the dark frame cannot be subtracted without it, for light adds up "
            "before the camera's response; add it to rig.toml, or leave the dark frames out"
        )
    if lit.shape != dark.shape or not {lit.dtype, dark.dtype} <= {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise InputError(
            f"dark image: {dark.dtype} {dark.shape}, the lit one is {lit.dtype} {lit.shape}; "
            "allowed is the same shape, each uint8 or uint16"
        )
    levels = np.arange(np.iinfo(lit.dtype).max + 1, dtype=lit.dtype)
    dark_levels = np.arange(np.iinfo(dark.dtype).max + 1, dtype=dark.dtype)
    result = np.empty_like(lit)
    for channel, curve in enumerate(response.inverse):
        image, unlit = lit[..., channel], dark[..., channel]
        if levels.size == dark_levels.size == 256:  # few enough pairs to have each ready
            table = _without_dark(levels[:, None], dark_levels[None, :], curve)
            result[..., channel] = table[image, unlit]
        else:
            result[..., channel] = _without_dark(image, unlit, curve)
    return result


def _without_dark(lit: NDArray[Any], dark: NDArray[Any], curve: tuple[float, ...]) -> NDArray[Any]:
    """One channel of `subtract_dark`, in the type of `lit`; the shapes broadcast."""
    full = np.iinfo(lit.dtype).max
    left = np.maximum(_irradiance(lit, curve) - _irradiance(dark, curve), 0)
    taken_off = np.rint(np.interp(left, curve, np.linspace(0, 1, len(curve))) * full).astype(lit.dtype)
    return np.where(lit >= OVER_EXPOSED * full, lit, taken_off)


def _irradiance(image: NDArray[Any], curve: tuple[float, ...]) -> Float64:
    """g⁻¹ of an image of integers, whatever their full scale."""
    full = np.iinfo(image.dtype).max
    linear: Float64 = _linear(np.linspace(0, 1, full + 1), curve)[image]
    return linear
