"""Colour of an image: fractions of full scale, and a*, b* of CIELab."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float32, Float64, freeze

# sRGB primaries, D65, 2° observer (Eq. 4.15–4.17), with Y = 1 for white.
RGB_TO_XYZ: Float64 = freeze(
    np.array(
        [
            [0.4124564, 0.3575761, 0.1804375],
            [0.2126729, 0.7151522, 0.0721750],
            [0.0193339, 0.1191920, 0.9503041],
        ]
    )
)
WHITE: Float64 = freeze(RGB_TO_XYZ.sum(axis=1))
"""(3,) X, Y, Z of white: the rows' sums, so that every grey has a* = b* = 0."""

_SRGB_KNEE = 0.04045
_LAB_KNEE = 0.008856
_TINY = 1e-30  # keeps the logarithm finite where a linear branch is taken anyway


def as_fraction(rgb: NDArray[np.uint8] | NDArray[np.uint16]) -> Float32:
    """Returns an image's intensities as fractions of full scale.

    Args:
        rgb: (h, w, 3) uint8 or uint16.

    Returns:
        (3, h, w) float32 in [0, 1].

    Raises:
        InputError: If it is no such image.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"colour image: {rgb.dtype} of shape {rgb.shape}, allowed is h × w × 3, uint8 or uint16"
        )
    planes = np.empty((3, *rgb.shape[:2]), np.float32)
    scale = np.float32(1 / np.iinfo(rgb.dtype).max)
    for channel, plane in enumerate(planes):
        np.multiply(rgb[:, :, channel], scale, out=plane)
    return planes


def rgb_to_xyz(rgb_fraction: NDArray[Any]) -> NDArray[Any]:
    """Returns the tristimulus values, (3, …) for (3, …), of sRGB fractions (Eq. 4.15–4.18), Y of white 1.

    The dtype is kept. Linear values come from the sRGB transfer curve, whatever the camera's own is.
    """
    linear = _power(rgb_fraction, 2.4, scale=1 / 1.055, shift=0.055 / 1.055)
    np.multiply(
        rgb_fraction, rgb_fraction.dtype.type(1 / 12.92), out=linear, where=rgb_fraction <= _SRGB_KNEE
    )
    flat: NDArray[Any] = RGB_TO_XYZ.astype(linear.dtype) @ linear.reshape(3, -1)
    return flat.reshape(linear.shape)


def xyz_to_ab(xyz: NDArray[Any]) -> NDArray[Any]:
    """Returns a*, b* (2, …) of tristimulus values (3, …) with Y of white 1 (Eq. 4.20–4.22).

    Both terms of each difference pass through `f`; the second one is printed without.
    """
    relative = xyz / WHITE.astype(xyz.dtype).reshape(3, *[1] * (xyz.ndim - 1))
    f = _power(relative, 1 / 3)
    np.copyto(f, 7.787 * relative + 16 / 116, where=relative <= _LAB_KNEE, casting="same_kind")
    ab = np.empty((2, *xyz.shape[1:]), xyz.dtype)
    np.subtract(f[0], f[1], out=ab[0])
    np.subtract(f[1], f[2], out=ab[1])
    ab[0] *= 500
    ab[1] *= 200
    return ab


def a_b(rgb_fraction: Float32) -> Float32:
    """Returns a*, b* of every pixel: (2, h, w) float32 for (3, h, w) fractions of full scale.

    Raises:
        InputError: If it has not three planes.
    """
    if rgb_fraction.ndim != 3 or rgb_fraction.shape[0] != 3:
        raise InputError(f"colour planes: shape {rgb_fraction.shape}, allowed is 3 × h × w")
    ab = np.empty((2, *rgb_fraction.shape[1:]), np.float32)
    rows = max(1, 65536 // max(1, rgb_fraction.shape[2]))  # strips that stay in the cache
    for top in range(0, rgb_fraction.shape[1], rows):
        strip = np.s_[:, top : top + rows]
        ab[strip] = xyz_to_ab(rgb_to_xyz(rgb_fraction[strip]))
    return ab


def _power(x: NDArray[Any], exponent: float, scale: float = 1.0, shift: float = 0.0) -> NDArray[Any]:
    """`(scale x + shift) ** exponent` of numbers not below 0; exp and log are vectorised, pow is not."""
    kind = x.dtype.type
    result: NDArray[Any] = x * kind(scale)
    result += kind(shift)
    np.maximum(result, kind(_TINY), out=result)
    np.log(result, out=result)
    result *= kind(exponent)
    np.exp(result, out=result)
    return result
