"""Raw Bayer images to RGB in linear light: unpacking of packed formats, demosaicing, and its inverse."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError

Pattern = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)
BITS = (8, 10, 12, 14, 16)

_REACH = 2  # of the kernels
_STRIP_ROWS = 64  # even, and so few that what is between raw and RGB stays in the cache

# PFNC's "p" formats are one little-endian stream of bits; GigE Vision's older "Packed" ones and MIPI's
# (V4L2's SRGGB10P, SRGGB12P) keep the high 8 bits of each pixel in a byte of its own.
Packing = Literal["10p", "12p", "10Packed", "12Packed", "mipi10", "mipi12"]
PACKINGS: tuple[Packing, ...] = get_args(Packing)

# By packing: pixels in a group, bytes in it, and the parts of which each pixel's value is put together:
# (byte, right shift, mask, left shift).
_Part = tuple[int, int, int, int]
_GROUPS: dict[str, tuple[int, int, tuple[tuple[_Part, ...], ...]]] = {
    "10p": (
        4,
        5,
        tuple(((n, 2 * n, 0xFF >> 2 * n, 0), (n + 1, 0, 0x3FF >> 8 - 2 * n, 8 - 2 * n)) for n in range(4)),
    ),
    "12p": (2, 3, (((0, 0, 0xFF, 0), (1, 0, 0x0F, 8)), ((1, 4, 0x0F, 0), (2, 0, 0xFF, 4)))),
    "10Packed": (2, 3, (((0, 0, 0xFF, 2), (1, 0, 0x03, 0)), ((2, 0, 0xFF, 2), (1, 4, 0x03, 0)))),
    "12Packed": (2, 3, (((0, 0, 0xFF, 4), (1, 0, 0x0F, 0)), ((2, 0, 0xFF, 4), (1, 4, 0x0F, 0)))),
    "mipi10": (4, 5, tuple(((n, 0, 0xFF, 2), (4, 2 * n, 0x03, 0)) for n in range(4))),
    "mipi12": (2, 3, (((0, 0, 0xFF, 4), (2, 0, 0x0F, 0)), ((1, 0, 0xFF, 4), (2, 4, 0x0F, 0)))),
}


def demosaic(
    raw: NDArray[np.uint8] | NDArray[np.uint16], pattern: Pattern, bits: int
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Returns the (h, w, 3) RGB image of a (h, w) Bayer mosaic, pixel for pixel and linear in it.

    The method is Malvar, He and Cutler's gradient-corrected linear interpolation (ICASSP 2004): each
    missing value is a fixed weighted sum of 5 × 5 mosaic values. A linear method is wanted: the image
    of a lit view minus that of the dark view is the image of the difference, which no method that picks
    an edge's direction for each image keeps. Beyond the border the mosaic is mirrored about its outermost
    pixels, which keeps its pattern. Only what would leave 0…full scale is clipped.

    Args:
        raw: (h, w), each side at least 2: uint8 for 8 bits, else uint16 with the value in the low bits.
        pattern: Colours of pixels (0, 0), (0, 1), (1, 0) and (1, 1), each as (row, column).
        bits: Of a raw value: 8, 10, 12, 14 or 16; 2^bits − 1 is full scale.

    Returns:
        uint8 for 8 bits; else uint16 whose full scale is 65535.

    Raises:
        InputError: If the array, the pattern or the bits are none of these, or a value has more bits.
    """
    _check(raw, pattern, bits)
    full_in, dtype, _ = _scale(bits)
    height, width = raw.shape
    padded = cv2.copyMakeBorder(raw, _REACH, _REACH, _REACH, _REACH, cv2.BORDER_REFLECT_101)
    rgb: NDArray[Any] = np.empty((height, width, 3), dtype)
    scale = np.float32(np.iinfo(dtype).max / full_in)
    for row in range(0, height, _STRIP_ROWS):
        rows = min(_STRIP_ROWS, height - row)
        strip = np.multiply(padded[row : row + rows + 2 * _REACH], scale, dtype=np.float32)
        cv2.merge(_planes(strip, pattern, bits), dst=rgb[row : row + rows])
    return rgb


def mosaic(rgb: NDArray[Any], pattern: Pattern) -> NDArray[Any]:
    """Returns the (h, w) mosaic that a sensor with this pattern sees of a (h, w, 3) image; same type.

    Raises:
        InputError: If the image is not (h, w, 3) or the pattern is unknown.
    """
    _check_pattern(pattern)
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise InputError(f"image: shape {rgb.shape}, must be (h, w, 3)")
    raw = np.empty(rgb.shape[:2], rgb.dtype)
    for place, colour in enumerate(pattern):
        row, col = divmod(place, 2)
        raw[row::2, col::2] = rgb[row::2, col::2, "RGB".index(colour)]
    return raw


def packed_row_bytes(width: int, packing: Packing) -> int:
    """Returns the bytes of a row of `width` pixels.

    Raises:
        InputError: If the packing is unknown or a row would end inside a group of pixels.
    """
    pixels, size, _ = _group(packing)
    if width < 1 or width % pixels:
        raise InputError(f"width {width} in packing {packing}, allowed is a multiple of {pixels}")
    return width // pixels * size


def unpack(
    data: bytes | NDArray[np.uint8], width: int, height: int, packing: Packing, row_bytes: int | None = None
) -> NDArray[np.uint16]:
    """Returns the (height, width) values of a packed image, in the low bits of uint16.

    Args:
        data: At least `height` rows; what follows them is ignored.
        width: Pixels; a whole number of groups of 2 or 4, as the packing has.
        height: Rows.
        packing: How pixels are packed, as its standard calls it.
        row_bytes: From one row to the next; None where rows follow without a gap.

    Raises:
        InputError: If the packing is unknown, sizes do not fit it, or there is too little data.
    """
    pixels, size, parts_of = _group(packing)
    used = packed_row_bytes(width, packing)
    step = used if row_bytes is None else row_bytes
    if height < 1 or step < used:
        raise InputError(f"{height} rows of {step} bytes, allowed is at least 1 row of {used} bytes")
    flat = np.frombuffer(data, np.uint8)
    if flat.size < (height - 1) * step + used:
        raise InputError(f"{flat.size} bytes of {packing}, {height} rows of {step} bytes are needed")
    rows = np.lib.stride_tricks.as_strided(flat, (height, used), (step, 1), writeable=False)
    groups = rows.reshape(height, width // pixels, size)
    values = np.empty((height, width), np.uint16)
    for n, parts in enumerate(parts_of):
        value = np.zeros(groups.shape[:2], np.uint16)
        for byte, right, mask, left in parts:
            value |= (groups[..., byte] >> right & mask).astype(np.uint16) << left
        values[:, n::pixels] = value
    return values


@lru_cache(maxsize=1)
def _kernels() -> tuple[NDArray[np.float32], ...]:
    """For green at red and blue; red or blue at the green of its own row, of its own column, at the other."""
    green = [[0, 0, -2, 0, 0], [0, 0, 4, 0, 0], [-2, 4, 8, 4, -2], [0, 0, 4, 0, 0], [0, 0, -2, 0, 0]]
    along = [[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]]
    opposite = [[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]]
    kernels = (green, along, np.transpose(along).tolist(), opposite)
    return tuple(np.array(kernel, np.float32) / np.float32(16) for kernel in kernels)


def _planes(mosaic_rows: NDArray[np.float32], pattern: Pattern, bits: int) -> list[NDArray[Any]]:
    """Red, green and blue of some rows, which begin like the pattern and have a border of `_REACH`."""
    depth = _scale(bits)[2]
    inside = (slice(_REACH, -_REACH),) * 2
    own = _rounded(mosaic_rows, depth)[inside]
    green, along, across, opposite = (
        _rounded(cv2.filter2D(mosaic_rows, -1, kernel), depth)[inside] for kernel in _kernels()
    )
    planes = {colour: own.copy() for colour in "RGB"}
    red_row, red_col = divmod(pattern.index("R"), 2)
    for colour, row, col in (("R", red_row, red_col), ("B", 1 - red_row, 1 - red_col)):
        plane = planes[colour]
        for target, y, x in ((along, row, 1 - col), (across, 1 - row, col), (opposite, 1 - row, 1 - col)):
            plane[y::2, x::2] = target[y::2, x::2]
        planes["G"][row::2, col::2] = green[row::2, col::2]
    return list(planes.values())


def _rounded(values: NDArray[Any], depth: int) -> NDArray[Any]:
    """To OpenCV's type `depth`, rounded and clipped to its range, in one pass."""
    nothing: Any = 0.0  # a constant for every pixel, which OpenCV's type stubs leave out
    return cv2.add(values, nothing, dtype=depth)


def _scale(bits: int) -> tuple[int, type[np.uint8] | type[np.uint16], int]:
    """Full scale of the raw values, and the result's type for numpy and for OpenCV."""
    return (2**bits - 1, np.uint8, cv2.CV_8U) if bits == 8 else (2**bits - 1, np.uint16, cv2.CV_16U)


def _check(raw: NDArray[Any], pattern: str, bits: int) -> None:
    _check_pattern(pattern)
    if bits not in BITS:
        raise InputError(f"{bits} bits, allowed: {', '.join(map(str, BITS))}")
    full, dtype, _ = _scale(bits)
    if raw.ndim != 2 or raw.dtype != dtype or min(raw.shape) < 2:
        raise InputError(
            f"raw image: {raw.dtype} of shape {raw.shape}, {bits} bits need (h, w) of "
            f"{np.dtype(dtype).name}, each side at least 2"
        )
    if full != np.iinfo(dtype).max and raw.max() > full:
        raise InputError(f"raw image: value {raw.max()}, {bits} bits allow up to {full}")


def _check_pattern(pattern: str) -> None:
    if pattern not in PATTERNS:
        raise InputError(f"Bayer pattern {pattern!r}, allowed: {', '.join(PATTERNS)}")


def _group(packing: str) -> tuple[int, int, tuple[tuple[_Part, ...], ...]]:
    if packing not in _GROUPS:
        raise InputError(f"packing {packing!r}, allowed: {', '.join(PACKINGS)}")
    return _GROUPS[packing]
