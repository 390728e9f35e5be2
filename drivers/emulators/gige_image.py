"""What an emulated GenICam camera makes of the light on its sensor: its processing and its pixel formats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.bayer import mosaic
from surfclass.errors import InputError

SENSOR_PATTERN: Literal["RGGB"] = "RGGB"
_GREY_WORLD = 0.45  # of full scale: where the automatic exposure and gain of the emulated camera aim


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A pixel format of the Pixel Format Naming Convention.

    Attributes:
        name: Such as "BayerRG12p".
        bits: Of one value.
        packing: As `drivers.bayer.Packing`; "" where each value has bytes of its own.
    """

    name: str
    bits: int
    packing: str = ""


# By PFNC code; as in gige_camera.xml.
FORMATS = {
    0x01080001: PixelFormat("Mono8", 8),
    0x01080009: PixelFormat("BayerRG8", 8),
    0x0110000D: PixelFormat("BayerRG10", 10),
    0x010A0058: PixelFormat("BayerRG10p", 10, "10p"),
    0x01100011: PixelFormat("BayerRG12", 12),
    0x010C0059: PixelFormat("BayerRG12p", 12, "12p"),
    0x010C002B: PixelFormat("BayerRG12Packed", 12, "12Packed"),
    0x0110002F: PixelFormat("BayerRG16", 16),
    0x02180014: PixelFormat("RGB8", 8),
}


@dataclass(frozen=True, slots=True)
class Processing:
    """What the camera does to an image, as its client left it.

    Attributes:
        region: x, y, width, height on the sensor.
        reverse: Whether columns and whether rows are mirrored.
        automatic_level: Exposure or gain is automatic.
        automatic_white: White balance is automatic.
        balance: Factors of red and blue.
        gamma: Exponent; 1 leaves light linear.
        sharpen: Whether edges are exaggerated.
    """

    region: tuple[int, int, int, int]
    reverse: tuple[bool, bool] = (False, False)
    automatic_level: bool = False
    automatic_white: bool = False
    balance: tuple[float, float] = (1.0, 1.0)
    gamma: float = 1.0
    sharpen: bool = False

    def cropped(
        self, image: NDArray[np.uint16] | NDArray[np.uint8]
    ) -> NDArray[np.uint16] | NDArray[np.uint8]:
        """Returns the region of a whole sensor's image, mirrored as it is set."""
        x, y, width, height = self.region
        mirror_x, mirror_y = (slice(None, None, -1 if flip else 1) for flip in self.reverse)
        return image[y : y + height, x : x + width][mirror_y, mirror_x]

    def processed(self, linear: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Returns the region of a sensor's (h, w, 3) image, full scale 65535, after what is switched on."""
        image = np.asarray(self.cropped(linear), np.uint16)
        neutral = self.balance == (1.0, 1.0) and self.gamma == 1
        if neutral and not (self.automatic_level or self.automatic_white or self.sharpen):
            return image
        light = image.astype(np.float32) / 65535
        light *= np.array([self.balance[0], 1.0, self.balance[1]], np.float32)
        means = np.maximum(light.mean(axis=(0, 1)), 1e-4)
        if self.automatic_white:
            light *= means[1] / means
        if self.automatic_level:
            light *= _GREY_WORLD / means[1]
        if self.sharpen:
            light += light - cv2.blur(light, (3, 3))
        return np.asarray((np.clip(light, 0, 1) ** self.gamma * 65535).round(), np.uint16)


def encoded(image: NDArray[np.uint16], pixel_format: PixelFormat) -> NDArray[np.uint8]:
    """Returns the bytes, one-dimensional, of a (h, w, 3) linear image in a format that has one value a pixel.

    Raises:
        InputError: If it is none of those.
    """
    if pixel_format.name == "Mono8":
        grey = image.astype(np.uint32) @ np.array([1, 2, 1], np.uint32) >> 2
        return (grey >> 8).astype(np.uint8).ravel()
    if not pixel_format.name.startswith("BayerRG"):
        raise InputError(f"pixel format {pixel_format.name}, allowed here: Mono8 and BayerRG…")
    values = mosaic(image, SENSOR_PATTERN).ravel() >> (16 - pixel_format.bits)
    match pixel_format.packing:
        case "":
            return values.astype(np.uint8) if pixel_format.bits == 8 else values.astype("<u2").view(np.uint8)
        case "10p":
            a, b, c, d = (values[n::4] for n in range(4))
            parts = [a, a >> 8 | b << 2, b >> 6 | c << 4, c >> 4 | d << 6, d >> 2]
        case "12p":
            a, b = values[0::2], values[1::2]
            parts = [a, a >> 8 | b << 4, b >> 4]
        case _:
            a, b = values[0::2], values[1::2]
            parts = [a >> 4, (a & 15) | (b & 15) << 4, b >> 4]
    return (np.stack(parts, axis=1) & 0xFF).astype(np.uint8).ravel()
