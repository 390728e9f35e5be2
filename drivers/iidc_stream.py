"""Keeps libdc1394's ring of frames empty, so that what is in it is never old, and notices a loss at once."""

from __future__ import annotations

import select
import threading
from collections import deque
from dataclasses import dataclass

from drivers.dc1394 import Camera, Dc1394Error
from drivers.interfaces import Clock

_WAIT_MS = 50  # for a frame, before the thread looks whether it is to end
_STOP_S = 1.0  # a library call that has not returned then hangs
_KEPT = 2  # frames that nobody has asked for yet; the oldest is dropped


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame as it came over the bus.

    Attributes:
        after_ns: It was not here yet at this time; the bus gives no time of its own.
        at_ns: It was here at this time.
        sequence: Counts all frames that came, corrupt ones too.
        image: Its bytes, or None for a frame that is corrupt: short, damaged, or waiting in the camera
            while the ring was full.
    """

    after_ns: int
    at_ns: int
    sequence: int
    image: bytes | None


class StreamEndedError(Exception):
    """The camera went away, or the library's queue broke; the text says how that showed."""


class IidcStream:
    """A thread that takes each frame out of the ring as it comes and gives its buffer back.

    A USB camera has no memory for frames: where the ring is full the camera stalls, and its next frame
    is one of before. So once as many frames came in a row as the ring has buffers, the one after them
    is discarded.

    Args:
        camera: With its capture set up.
        buffers: Of the ring.
        clock: The host's.
    """

    def __init__(self, camera: Camera, buffers: int, clock: Clock) -> None:
        self._camera, self._buffers, self._clock = camera, buffers, clock
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
        empty_ns, in_a_row = self._clock.now_ns(), 0
        while not self._stop:
            before_ns = self._clock.now_ns()
            image = self._camera.take()
            if image is None:
                # A full ring is remembered: what the camera could not send then is still to come.
                empty_ns, in_a_row = before_ns, in_a_row if in_a_row >= self._buffers else 0
                wait.poll(_WAIT_MS)
                continue
            stalled = in_a_row >= self._buffers
            in_a_row = 0 if stalled else in_a_row + 1
            with self._changed:
                whole = None if stalled or not image else image
                self._arrived.append(Arrival(empty_ns, self._clock.now_ns(), self.frames, whole))
                self.frames += 1
                self.corrupt += whole is None
                self._changed.notify_all()
