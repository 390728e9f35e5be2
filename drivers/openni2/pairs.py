"""Which depth image and which IR image are of one exposure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.openni2.api import PixelFormat, Sensor
from drivers.openni2.device import Image
from drivers.openni2.errors import BrokenError

_MICROMETRES: dict[int, int] = {PixelFormat.DEPTH_1_MM: 1000, PixelFormat.DEPTH_100_UM: 100}


@dataclass(frozen=True)
class Pair:
    """One exposure.

    Attributes:
        timestamp_us: By the device's clock; the depth image's.
        index: The device's counter of depth frames.
        arrived_ns: When the first of the images was fetched, CLOCK_MONOTONIC.
        depth: (h, w) uint16 in the device's unit.
        ir: (h, w), None where there is no IR stream.
    """

    timestamp_us: int
    index: int
    arrived_ns: int
    depth: NDArray[np.uint16]
    ir: NDArray[Any] | None


class Pairing:
    """Puts images together as they come, in any order; what finds no partner is dropped and counted.

    Args:
        with_ir: Whether there is an IR stream; without, each depth image is a pair.
        tolerance_us: Stamps of one exposure differ by no more.
    """

    def __init__(self, with_ir: bool, tolerance_us: int) -> None:
        self._with_ir, self._tolerance_us = with_ir, tolerance_us
        self._waiting: dict[Sensor, Image] = {}
        self.dropped = 0

    def add(self, sensor: Sensor, image: Image) -> Pair | None:
        """Returns the pair that the image completes, if it does."""
        if not self._with_ir:
            return Pair(image.timestamp_us, image.index, image.arrived_ns, image.pixels, None)
        self.dropped += sensor in self._waiting
        self._waiting[sensor] = image
        if len(self._waiting) < 2:
            return None
        depth, ir = self._waiting[Sensor.DEPTH], self._waiting[Sensor.IR]
        ahead_us = depth.timestamp_us - ir.timestamp_us
        if abs(ahead_us) > self._tolerance_us:
            del self._waiting[Sensor.IR if ahead_us > 0 else Sensor.DEPTH]
            self.dropped += 1
            return None
        self._waiting.clear()
        arrived_ns = min(depth.arrived_ns, ir.arrived_ns)
        return Pair(depth.timestamp_us, depth.index, arrived_ns, depth.pixels, ir.pixels)


def unit_um(pixel_format: int) -> int:
    """Returns what one step of a depth format is, µm.

    Raises:
        BrokenError: If it is no format of depth.
    """
    if pixel_format not in _MICROMETRES:
        raise BrokenError(f"depth of format {pixel_format}, allowed are 1 mm and 100 µm")
    return _MICROMETRES[pixel_format]


def whole_millimetres(depth: NDArray[np.uint16], step_um: int) -> NDArray[np.uint16]:
    """Returns depth (h, w) in whole mm, to the nearest (halves up), 0 = no return.

    Args:
        depth: In steps of `step_um`.
        step_um: 1000 or 100.
    """
    if step_um == 1000:
        return depth
    steps = np.uint16(1000 // step_um)
    rest = depth % steps
    return depth // steps + (rest >= (steps + 1) // 2).astype(np.uint16)
