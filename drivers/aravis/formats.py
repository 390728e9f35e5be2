"""Which pixel formats of GenICam cameras are read, which is best, and how their bytes become RGB."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from drivers.bayer import PACKINGS, Packing, Pattern, demosaic, packed_row_bytes, unpack
from surfclass.errors import InputError

# Twelve bits say all that these sensors' converters give, and where they lie in a value. What "16" holds
# differs: some cameras leave the high bits empty, which would be taken for a dark image.
_BITS_BY_WORTH = (12, 10, 14, 16, 8)
_RGB = ("RGB8", "RGB8Packed", "BGR8", "BGR8Packed")
_BAYER = re.compile(r"Bayer(RG|GR|GB|BG)(8|10|12|14|16)(p|Packed)?")


@dataclass(frozen=True, slots=True)
class Format:
    """A pixel format, by the GenICam Pixel Format Naming Convention.

    Attributes:
        name: Such as "BayerRG12p".
        pattern: Of the mosaic; None for RGB.
        bits: Of one value.
        packing: None where each value has bytes of its own.
    """

    name: str
    pattern: Pattern | None
    bits: int
    packing: Packing | None = None

    def frame_bytes(self, width: int, height: int) -> int:
        """Returns the size of an image.

        Raises:
            InputError: If the width is none that this format can have.
        """
        if self.packing is not None:
            return height * packed_row_bytes(width, self.packing)
        values = 3 if self.pattern is None else 1
        return height * width * values * (1 if self.bits == 8 else 2)

    def rgb(self, content: bytes, width: int, height: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Returns the (height, width, 3) image: uint8 for 8 bits, else uint16 of full scale 65535.

        Raises:
            InputError: If the content is not of this format and size.
        """
        wanted = self.frame_bytes(width, height)
        if len(content) != wanted:
            raise InputError(f"{len(content)} bytes, {self.name} of {width} × {height} pixels has {wanted}")
        if self.packing is not None:
            raw: NDArray[np.uint8] | NDArray[np.uint16] = unpack(content, width, height, self.packing)
        elif self.bits == 8:
            raw = np.frombuffer(content, np.uint8)
        else:
            raw = np.frombuffer(content, "<u2").astype(np.uint16, copy=False)
        if self.pattern is not None:
            return demosaic(raw.reshape(height, width), self.pattern, self.bits)
        image = raw.reshape(height, width, 3)
        return np.asarray(image[..., ::-1] if self.name.startswith("BGR") else image, np.uint8)


def parse(name: str) -> Format | None:
    """Returns the format of that name, or None if it is not read here (Mono, YUV and so on)."""
    if name in _RGB:
        return Format(name, None, 8)
    match = _BAYER.fullmatch(name)
    if match is None:
        return None
    first, bits, packed = match.groups()
    # The name gives the first row; the second has the other two.
    pattern = first + {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[first]
    packing = f"{bits}{packed}" if packed else None
    if packing is not None and packing not in PACKINGS:
        return None
    return Format(name, cast(Pattern, pattern), int(bits), packing)


def best(names: Sequence[str]) -> Format | None:
    """Returns the best of a camera's formats: raw before RGB, twelve bits before others, not packed first."""
    formats = [found for name in names if (found := parse(name)) is not None]
    return min(
        formats,
        key=lambda one: (one.pattern is None, _BITS_BY_WORTH.index(one.bits), one.packing is not None),
        default=None,
    )
