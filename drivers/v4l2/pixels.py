"""Pixel formats of V4L2 from which radiance can be had, decoded; and why others are refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.bayer import PATTERNS, Packing, Pattern, demosaic, packed_row_bytes, unpack
from surfclass.errors import ConfigurationError, InputError


@dataclass(frozen=True, slots=True)
class Layout:
    """How the pixels of a format lie in memory.

    Attributes:
        bits: Of one value.
        pattern: Of a raw Bayer format; None: three bytes a pixel.
        packing: Of a packed Bayer format; None: a value has bytes of its own, the low one first.
        order: Of three bytes a pixel.
    """

    bits: int
    pattern: Pattern | None = None
    packing: Packing | None = None
    order: Literal["RGB", "BGR"] = "RGB"

    def row_bytes(self, width: int) -> int:
        """Returns the bytes of a row without padding.

        Raises:
            InputError: If a row of a packed format would end inside a group of pixels.
        """
        if self.packing is not None:
            return packed_row_bytes(width, self.packing)
        return width * (3 if self.pattern is None else (self.bits + 7) // 8)


# Kernel documentation, "Image Formats": the codes have no rule, so here they are, in PATTERNS' order.
_BAYER: tuple[tuple[str, int, Packing | None], ...] = (
    ("RGGB GRBG GBRG BA81", 8, None),
    ("RG10 BA10 GB10 BG10", 10, None),
    ("RG12 BA12 GB12 BG12", 12, None),
    ("RG14 GR14 GB14 BG14", 14, None),
    ("RG16 GR16 GB16 BYR2", 16, None),
    ("pRAA pgAA pGAA pBAA", 10, "mipi10"),
    ("pRCC pgCC pGCC pBCC", 12, "mipi12"),
)
LAYOUTS: dict[str, Layout] = {
    code: Layout(bits, pattern, packing)
    for codes, bits, packing in _BAYER
    for code, pattern in zip(codes.split(), PATTERNS, strict=True)
} | {"RGB3": Layout(8), "BGR3": Layout(8, order="BGR")}

_REFUSED = {
    "two pixels share their colour": "YUYV UYVY YVYU VYUY NV12 NV21 NV16 NV61 YU12 YV12 422P Y210",
    "it is compressed with loss": "MJPG JPEG H264 HEVC VP80 VP90 MPG4",
    "it has no colour": "GREY Y04 Y06 Y10 Y12 Y14 Y16",
}


def layout(pixel_format: str) -> Layout:
    """Returns how a format's pixels lie in memory.

    Raises:
        ConfigurationError: If the format is none that is supported, with the reason where there is one.
    """
    if pixel_format in LAYOUTS:
        return LAYOUTS[pixel_format]
    reason = next((why for why, codes in _REFUSED.items() if pixel_format.strip() in codes.split()), None)
    raise ConfigurationError(
        f"pixel_format {pixel_format!r}{f': {reason}, so its values are no radiance' if reason else ''}; "
        f"supported: {', '.join(LAYOUTS)}"
    )


def needed_bytes(of: Layout, width: int, height: int, row_bytes: int) -> int:
    """Returns what a whole image needs; the last row may lack its padding."""
    return (height - 1) * row_bytes + of.row_bytes(width)


def decode(
    data: bytes, of: Layout, width: int, height: int, row_bytes: int
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Returns the (h, w, 3) RGB image in a buffer: uint8 of 8-bit formats, else uint16 of full scale 65535.

    Args:
        data: At least `needed_bytes()`.
        of: The format's layout.
        width: Pixels.
        height: Rows.
        row_bytes: From one row to the next.

    Raises:
        InputError: If there is too little data, or a value has more bits than the format.
    """
    used = of.row_bytes(width)
    if row_bytes < used or len(data) < needed_bytes(of, width, height, row_bytes):
        raise InputError(f"{len(data)} bytes in rows of {row_bytes}, needed are {height} rows of {used}")
    if of.packing is not None and of.pattern is not None:
        return demosaic(unpack(data, width, height, of.packing, row_bytes), of.pattern, of.bits)
    flat = np.frombuffer(data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(flat, (height, used), (row_bytes, 1), writeable=False)
    if of.pattern is not None:
        raw = np.ascontiguousarray(rows)
        return demosaic(raw if of.bits == 8 else raw.view("<u2"), of.pattern, of.bits)
    rgb = rows.reshape(height, width, 3)
    return np.ascontiguousarray(rgb[..., ::-1] if of.order == "BGR" else rgb)
