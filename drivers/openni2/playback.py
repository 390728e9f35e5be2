"""Plays a `.oni` recording back: every exposure, in the file's order, one for each question.

The player is run by hand (speed −1): it decodes one more image whenever one is waited for. It is never
asked to seek, which hangs, and never let come to the file's end: there its thread spins over its list of
streams, and crashes when one is closed. It repeats instead, and what comes after the last image is left.
"""

from __future__ import annotations

import time
from ctypes import c_float, c_int

from drivers.openni2.api import DeviceProperty, Sensor, StreamProperty
from drivers.openni2.errors import BrokenError
from drivers.openni2.opening import Streams
from drivers.openni2.pairs import Pair

_BY_HAND = -1.0
_UNKNOWN = 0xFFFFFFFF  # of frames, in a recording that was cut off
_SETTLE_S = 0.1


class Playback:
    """A recording that is open, from its beginning.

    Args:
        streams: The open recording's; still to be closed by the caller, after close() here.
        pair_tolerance_us: Stamps of one exposure's images differ by no more.

    Attributes:
        frames: How many exposures the file says that it has, None where it does not.
        pairs: How many were played.
    """

    def __init__(self, streams: Streams, pair_tolerance_us: int) -> None:
        self._streams = streams
        self._pairing = streams.pairing(pair_tolerance_us)
        number = StreamProperty.NUMBER_OF_FRAMES
        counts = [(stream.integer(number) or 0) % 2**32 for stream in streams.all]
        self.frames = None if _UNKNOWN in counts else min(counts)
        self._at: dict[Sensor, int] = {}
        self.pairs = 0

    @property
    def ended(self) -> bool:
        """Whether all that the file says it has was played."""
        return self.frames is not None and self.pairs >= self.frames

    def start(self) -> None:
        """Sets the player up and starts the streams.

        Raises:
            OpenNI2Error: If it cannot be.
        """
        device = self._streams.device
        device.write(DeviceProperty.PLAYBACK_REPEAT_ENABLED, c_int(1))
        device.write(DeviceProperty.PLAYBACK_SPEED, c_float(_BY_HAND))
        for stream in self._streams.all:
            stream.start()

    def close(self) -> None:
        """Lets the player's thread come to where it waits; the only place where streams may be taken away."""
        time.sleep(_SETTLE_S)

    def next(self, timeout_s: float) -> Pair | None:
        """Returns the next exposure, None if the player gave no image within the timeout.

        Raises:
            BrokenError: At the end of the file, or if an image of it is missing or damaged.
            OpenNI2Error: If the runtime fails.
        """
        while True:
            if self.ended:
                raise BrokenError(f"the recording ended after {self.pairs} exposures")
            # An image not waited for would be overwritten by the next: exactly one is asked for here.
            self._streams.device.forget_wakeup()
            stream = self._streams.device.wait(self._streams.all, timeout_s)
            if stream is None:
                return None
            image = stream.fetch()
            self._must_follow(stream.sensor, image.index)
            pair = self._pairing.add(stream.sensor, image)
            if pair is not None:
                self.pairs += 1
                return pair

    def _must_follow(self, sensor: Sensor, index: int) -> None:
        before = self._at.get(sensor)
        if before is not None and index <= before:  # it plays from the beginning again
            raise BrokenError(f"the recording ended after {self.pairs} exposures, with no sign of its end")
        if before is not None and index > before + 1:
            raise BrokenError(f"the recording's {sensor.name} image {before + 1} is missing or damaged")
        self._at[sensor] = index
