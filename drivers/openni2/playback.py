"""Plays a `.oni` recording back: every exposure, in the file's order, one for each question.

The player is run by hand (speed −1): it decodes one more image whenever one is waited for. It is never
asked to seek, which hangs.
"""

from __future__ import annotations

import threading
from ctypes import c_float, c_int

from drivers.openni2.api import DeviceProperty, Sensor, StreamProperty
from drivers.openni2.errors import BrokenError
from drivers.openni2.opening import Streams
from drivers.openni2.pairs import Pair, Pairing

_BY_HAND = -1.0


class Playback:
    """A recording that is open, from its beginning.

    Args:
        streams: The open recording's; still to be closed by the caller.
        pair_tolerance_us: Stamps of one exposure's images differ by no more.
    """

    def __init__(self, streams: Streams, pair_tolerance_us: int) -> None:
        self._streams = streams
        self._pairing = Pairing(streams.infrared is not None, pair_tolerance_us)
        self._left = {
            stream.sensor: stream.integer(StreamProperty.NUMBER_OF_FRAMES) for stream in streams.all
        }
        self._at: dict[Sensor, int] = {}
        self._ended = threading.Event()
        self.frames = min(left or 0 for left in self._left.values())
        self.pairs = 0

    def start(self) -> None:
        """Sets the player up and starts the streams.

        Raises:
            OpenNI2Error: If it cannot be.
        """
        device = self._streams.device
        device.write(DeviceProperty.PLAYBACK_REPEAT_ENABLED, c_int(0))
        device.write(DeviceProperty.PLAYBACK_SPEED, c_float(_BY_HAND))
        for stream in self._streams.all:
            stream.start()

    def ended(self) -> None:
        """Takes note that the player reached the end; from any thread."""
        self._ended.set()

    def next(self, timeout_s: float) -> Pair | None:
        """Returns the next exposure, None if the player gave no image within the timeout.

        Raises:
            BrokenError: At the end of the file, or if an image of it is missing or damaged.
            OpenNI2Error: If the runtime fails.
        """
        while True:
            # An image not waited for would be overwritten by the next: exactly one is asked for here.
            self._streams.device.forget_wakeup()
            if all(not left for left in self._left.values()):
                raise BrokenError(f"the recording ended after {self.pairs} exposures")
            stream = self._streams.device.wait(self._streams.all, timeout_s)
            if stream is None:
                if self._ended.is_set():
                    raise BrokenError(f"the recording ended after {self.pairs} exposures")
                return None
            image = stream.fetch()
            self._count(stream.sensor, image.index)
            pair = self._pairing.add(stream.sensor, image)
            if pair is not None:
                self.pairs += 1
                return pair

    def _count(self, sensor: Sensor, index: int) -> None:
        before = self._at.get(sensor)
        if before is not None and index != before + 1:
            raise BrokenError(f"the recording's {sensor.name} image {before + 1} is missing or damaged")
        self._at[sensor] = index
        left = self._left[sensor]
        self._left[sensor] = None if left is None else max(0, left - 1)
