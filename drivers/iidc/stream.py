"""Keeps libdc1394's ring of frames empty, so that what is in it is never old, and notices a loss at once."""

from __future__ import annotations

import select
import threading
from collections import deque
from dataclasses import dataclass

from drivers.iidc.dc1394 import Camera, Dc1394Error
from drivers.interfaces import Clock

_WAIT_S = 0.01  # for a frame; how late its time may be noticed at most
_SETTLE_S = 0.02  # what the library takes at most from the kernel's frame to the ring, while it runs
_STOP_S = 1.0  # a library call that has not returned then hangs
_KEPT = 2  # frames that nobody has asked for yet; the oldest is dropped


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame as it came over the bus.

    Attributes:
        after_ns: Its transfer ended after this time; the bus gives no time of its own.
        at_ns: It was here at this time.
        sequence: Counts all frames that came, corrupt ones too.
        image: Its bytes, or None for a frame that came short or damaged.
    """

    after_ns: int
    at_ns: int
    sequence: int
    image: bytes | None


class StreamEndedError(Exception):
    """The camera went away, or the library's queue broke; the text says how that showed."""


class IidcStream:
    """A thread that takes each frame out of the ring as it comes and gives its buffer back.

    Where this process did not run for a while, frames wait in the kernel, and once the ring is full one
    more in the camera, and come later as if they were new. None of them is then said to be newer than
    the last time at which the ring was surely empty.

    Args:
        camera: With its capture set up.
        readout_s: From an exposure's end until its frame is here, at most, while the ring has room.
        clock: The host's.
    """

    def __init__(self, camera: Camera, readout_s: float, clock: Clock) -> None:
        self._camera, self._readout_s, self._clock = camera, readout_s, clock
        self._changed = threading.Condition()
        self._arrived: deque[Arrival] = deque(maxlen=_KEPT)
        self._ended = ""
        self._stop = False
        self.frames = 0
        self.corrupt = 0
        self._thread = threading.Thread(target=self._run, name="iidc frames", daemon=True)
        self._thread.start()

    @property
    def ended(self) -> str:
        """How the camera's going away showed; empty while it is there."""
        return self._ended

    def next(self, deadline_ns: int) -> Arrival | None:
        """Returns the oldest frame that has not been asked for, or None if none comes by the deadline.

        Raises:
            StreamEndedError: If the camera is gone; frames from before are not given any more.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: self._arrived or self._ended, max(0.0, (deadline_ns - self._clock.now_ns()) / 1e9)
            )
            if self._ended:
                raise StreamEndedError(self._ended)
            return self._arrived.popleft() if self._arrived else None

    def rest_until(self, t_ns: int) -> None:
        """Returns at `t_ns`.

        Raises:
            StreamEndedError: At once, if the camera is gone.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ended, max(0.0, (t_ns - self._clock.now_ns()) / 1e9))
            if self._ended:
                raise StreamEndedError(self._ended)

    def clear(self) -> int:
        """Drops what nobody asked for, and returns how many frames those were."""
        with self._changed:
            dropped = len(self._arrived)
            self._arrived.clear()
            return dropped

    def stop(self) -> bool:
        """Ends the thread, and returns whether it did end: then the capture may be stopped."""
        self._stop = True
        self._thread.join(_STOP_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        how = ""
        try:
            self._drain()
        except Dc1394Error as error:
            how = str(error)
        except Exception as error:  # noqa: BLE001 - a thread's end must reach whoever waits for its frames
            how = f"a defect in its stream: {error!r}"
        with self._changed:
            self._ended = how
            self._changed.notify_all()

    def _drain(self) -> None:
        wait = select.poll()
        wait.register(self._camera.fileno(), select.POLLIN)
        settle_ns, readout_ns = round(_SETTLE_S * 1e9), round(self._readout_s * 1e9)
        begun_ns = empty_ns = trusted_ns = self._clock.now_ns()
        while not self._stop:
            before_ns = self._clock.now_ns()
            if before_ns - begun_ns > round(_WAIT_S * 1e9) + settle_ns:  # it did not run meanwhile
                trusted_ns = before_ns + settle_ns + readout_ns
            begun_ns = before_ns
            image = self._camera.take()
            if image is None:
                if before_ns >= trusted_ns:
                    empty_ns = before_ns - settle_ns
                wait.poll(_WAIT_S * 1e3)
                continue
            with self._changed:
                self._arrived.append(Arrival(empty_ns, self._clock.now_ns(), self.frames, image or None))
                self.frames += 1
                self.corrupt += not image
                self._changed.notify_all()
