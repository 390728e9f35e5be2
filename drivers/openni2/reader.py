"""Reads a live device in a thread of its own, keeps the newest exposures, and knows when they were taken."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from drivers.device_clock import DeviceClock
from drivers.openni2.errors import BrokenError, GoneError, HangingError, OpenNI2Error
from drivers.openni2.opening import Streams
from drivers.openni2.pairs import Pair

KEPT = 4  # exposures that nobody has asked for yet; the oldest goes first
_WAIT_S = 0.05  # other calls have to wait for so long
_JOIN_S = 1.0


@dataclass(frozen=True)
class Timed:
    """An exposure and when it was.

    Attributes:
        t_ns: Mid-exposure, CLOCK_MONOTONIC.
        t_sd_ns: Half the interval in which that can have been.
    """

    pair: Pair
    t_ns: int
    t_sd_ns: int


class Reader:
    """Reads the streams from start() to close().

    Args:
        streams: The open device's; still to be closed by the caller, after close() here.
        clock: For the device's clock; nobody else may use it meanwhile.
        pair_tolerance_us: Stamps of one exposure's images differ by no more.
    """

    def __init__(self, streams: Streams, clock: DeviceClock, pair_tolerance_us: int) -> None:
        self._streams, self._clock = streams, clock
        self._pairing = streams.pairing(pair_tolerance_us)
        self._changed = threading.Condition()  # guards all below, and the clock
        self._kept = deque[Pair](maxlen=KEPT)
        self._failure: Exception | None = None
        self._gone = self._ending = False
        self._arrived_ns = time.monotonic_ns()
        self._count = 0
        self._thread = threading.Thread(target=self._run, name="OpenNI2 reader", daemon=True)

    def start(self) -> None:
        """Starts the streams and the reading.

        Raises:
            OpenNI2Error: If a stream does not start.
        """
        for stream in self._streams.all:
            stream.start()
        self._thread.start()

    def close(self) -> None:
        """Ends the reading; never raises."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)  # longer only where the library hangs; then nobody gets through

    def disconnected(self) -> None:
        """Takes note that the device was unplugged; from any thread."""
        with self._changed:
            self._gone = True
            self._kept.clear()
            self._changed.notify_all()

    def silent_s(self) -> float:
        """Returns how long ago the last exposure came, or the streams were started.

        Raises:
            GoneError, BrokenError, HangingError: As the class says.
        """
        with self._changed:
            self._must_live()
            return (time.monotonic_ns() - self._arrived_ns) / 1e9

    def first_from(self, not_before_ns: int, before_ns: int, deadline_ns: int) -> Timed | None:
        """Returns the first exposure that certainly began at or after a time, None after the deadline.

        Args:
            not_before_ns: CLOCK_MONOTONIC.
            before_ns: What an exposure begins before its middle.
            deadline_ns: CLOCK_MONOTONIC.

        Raises:
            GoneError, BrokenError, HangingError: As the class says.
        """
        with self._changed:
            while True:
                self._must_live()
                while self._kept:
                    pair = self._kept.popleft()
                    t_ns, t_sd_ns = self._clock.to_host(pair.timestamp_us)
                    if t_ns - before_ns - t_sd_ns >= not_before_ns:
                        return Timed(pair, t_ns, t_sd_ns)
                left_ns = deadline_ns - time.monotonic_ns()
                if left_ns <= 0:
                    return None
                self._changed.wait(left_ns / 1e9)

    def describe_clock(self) -> str:
        """Returns what is known of the device's clock, in words."""
        with self._changed:
            return self._clock.describe()

    def describe(self) -> str:
        """Returns how the reading went, in words."""
        with self._changed:
            words = [f"{self._count} exposures read"]
            if self._pairing.dropped:
                words.append(f"{self._pairing.dropped} images without their partner")
            if self._clock.frozen:
                words.append(f"{self._clock.frozen} stamps repeated")
            return ", ".join(words)

    def _must_live(self) -> None:
        if self._gone:
            raise GoneError
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        streams, device = self._streams.all, self._streams.device
        try:
            while not self._ending:
                stream = device.wait(streams, _WAIT_S)
                if stream is None:
                    continue
                pair = self._pairing.add(stream.sensor, stream.fetch())
                if pair is not None:
                    self._take(pair)
        except OpenNI2Error as error:
            with self._changed:
                self._failure = error if isinstance(error, HangingError) else BrokenError(str(error))
                self._changed.notify_all()

    def _take(self, pair: Pair) -> None:
        with self._changed:
            clock = self._clock
            jumps, frozen = clock.jumps, clock.frozen
            clock.observe(pair.timestamp_us, pair.arrived_ns)
            if clock.jumps != jumps:
                self._kept.clear()  # stamped by a clock that is no more
            if clock.frozen != frozen or self._gone:
                return  # nobody knows when this was
            self._arrived_ns = pair.arrived_ns
            self._count += 1
            self._kept.append(pair)
            self._changed.notify_all()
