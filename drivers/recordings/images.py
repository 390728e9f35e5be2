"""Encoded images (PNG, JPEG) to arrays, with the channels in the order red, green, blue."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError

_MAGIC = {"png": b"\x89PNG\r\n\x1a\n", "jpeg": b"\xff\xd8\xff"}


def image_format(data: bytes, source: str) -> str:
    """Returns "png" or "jpeg", by the first bytes and not by a name.

    Raises:
        InputError: Naming `source`, where it is neither.
    """
    for name, magic in _MAGIC.items():
        if data.startswith(magic):
            return name
    raise InputError(f"{source}: not an image that is understood; allowed are PNG and JPEG")


def decode_image(data: bytes, source: str) -> NDArray[Any]:
    """Returns the image as it was stored: (h, w) or (h, w, 3), uint8 or uint16, channels R, G, B.

    Raises:
        InputError: Naming `source`, where the image is broken, or has alpha or another pixel type.
    """
    image_format(data, source)
    try:
        image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"{source}: the image cannot be decoded: {error}") from None
    if image is None:
        raise InputError(f"{source}: the image is damaged or cut off ({len(data)} bytes)")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{source}: {image.dtype} pixels, allowed are 8 and 16 bit unsigned")
    if image.ndim == 3 and image.shape[2] == 1:
        return image[:, :, 0]
    if image.ndim == 3 and image.shape[2] != 3:
        raise InputError(f"{source}: {image.shape[2]} channels (alpha?), allowed are 1 and 3")
    return image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])


def check_pixels(image: NDArray[Any], channels: int, bits: tuple[int, ...], source: str) -> None:
    """Raises InputError naming `source` where channels or bits are others than allowed."""
    found = (1 if image.ndim == 2 else image.shape[2], image.dtype.itemsize * 8)
    if found[0] != channels or found[1] not in bits:
        allowed = " or ".join(str(count) for count in bits)
        raise InputError(
            f"{source}: {found[0]} channel{'s' * (found[0] > 1)} of {found[1]} bit, "
            f"allowed: {channels} channel{'s' * (channels > 1)} of {allowed} bit"
        )
