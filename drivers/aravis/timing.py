"""When the exposures of an Aravis camera began, on the host's clock, and in which order its frames came."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from drivers.aravis.library import Buffer
from drivers.device_clock import DeviceClock
from drivers.errors import DeviceFaultError

_WALL_STEP_NS = 1_000_000  # more than this between two looks, and the wall clock was set
_FRAME_IDS = 65_535  # GigE Vision 1 counts 1…65535 and starts again


@dataclass(frozen=True, slots=True)
class Trigger:
    """A software trigger.

    Attributes:
        sent_ns: Just before it was sent.
        accepted_ns: When the camera had accepted it.
        prompt: Whether the exposure begins at once; the first after a start need not.
    """

    sent_ns: int
    accepted_ns: int
    prompt: bool


class Arrivals:
    """Turns Aravis's arrival times, which are of the wall clock, into the host clock's."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self.begin()

    def begin(self) -> None:
        """To be called when frames begin to be waited for: from here on the wall clock is watched."""
        self._offset_ns = time.time_ns() - self._now_ns()

    def of(self, buffer: Buffer) -> tuple[int, int]:
        """Returns when the first packet of a frame just taken came, and when all of it was there."""
        whole_ns = self._now_ns()
        offset_ns = time.time_ns() - whole_ns
        stepped = abs(offset_ns - self._offset_ns) > _WALL_STEP_NS
        self._offset_ns = offset_ns
        return whole_ns if stepped else min(whole_ns, buffer.host_wall_ns - offset_ns), whole_ns


class Exposures:
    """Tells when exposures began, from the device's stamps and what is certain on the host.

    Args:
        device: Its name.
        exposure_s: Exposure time.
        stamped_at_end: Whether stamps mean the end of an exposure, not its beginning.
        trigger_latency_s: Within how long a trigger that was accepted begins an exposure.
    """

    def __init__(
        self, device: str, exposure_s: float, stamped_at_end: bool, trigger_latency_s: float
    ) -> None:
        self._device, self._stamped_at_end = device, stamped_at_end
        self._latency_ns = round(trigger_latency_s * 1e9)
        self.clock = DeviceClock(1e-9)
        self.last(exposure_s)

    def last(self, exposure_s: float) -> None:
        """From the next frame on exposures last so long."""
        self._exposure_ns = round(exposure_s * 1e9)
        self._stamp_after_ns = self._exposure_ns if self._stamped_at_end else 0

    def is_from_before(self, buffer: Buffer, t_ns: int) -> bool:
        """Whether a frame certainly began before `t_ns`, as far as the device's clock is known yet."""
        if not buffer.device_ns or self.clock.offset_ns is None:
            return False
        began_ns, half_ns = self.clock.to_host(buffer.device_ns - self._stamp_after_ns)
        return began_ns + half_ns < t_ns

    def began(self, buffer: Buffer, first_ns: int, whole_ns: int, trigger: Trigger | None) -> tuple[int, int]:
        """Returns when a frame's exposure began, and half the interval in which that can have been.

        Args:
            buffer: The frame; each to be given once.
            first_ns: When its first packet came.
            whole_ns: When all of it was there.
            trigger: What it answers, or None.

        Raises:
            DeviceFaultError: If the device's clock stands still, or tells nothing where nothing else does.
        """
        latest_ns = min(first_ns, whole_ns - self._exposure_ns)
        if trigger is not None and trigger.prompt:
            latest_ns = min(latest_ns, trigger.accepted_ns + self._latency_ns)
        if not buffer.device_ns:
            if trigger is None:
                raise DeviceFaultError(
                    self._device, "its frames bear no time stamps; only trigger = 'software' can do without"
                )
            low_ns, high_ns = trigger.sent_ns, latest_ns
        else:
            ticks, repeated = buffer.device_ns - self._stamp_after_ns, self.clock.frozen
            self.clock.observe(ticks, latest_ns, None if trigger is None else trigger.sent_ns)
            if self.clock.frozen > repeated:
                raise DeviceFaultError(
                    self._device, f"its clock stands still: frame {buffer.frame_id} has the last one's time"
                )
            began_ns, half_ns = self.clock.to_host(ticks)
            low_ns, high_ns = began_ns - half_ns, began_ns + half_ns
            if trigger is not None:
                low_ns, high_ns = max(low_ns, trigger.sent_ns), min(high_ns, latest_ns)
        if trigger is not None and low_ns > high_ns:  # the device's clock is wrong; the host's is not
            low_ns, high_ns = trigger.sent_ns, max(trigger.sent_ns, latest_ns)
        middle_ns = (low_ns + high_ns) // 2
        return middle_ns, max(high_ns - middle_ns, middle_ns - low_ns)


class FrameCount:
    """Numbers frames upwards, whatever the device's own counter does.

    Attributes:
        missing: Frames that the device counted and that were not numbered, while each was waited for.
    """

    def __init__(self) -> None:
        self._number, self._last_id = 0, 0
        self.missing = 0

    def restart(self) -> None:
        """The next id may be any, and none is missing before it."""
        self._last_id = 0

    def number(self, frame_id: int) -> int:
        """Returns the number of the frame with this id."""
        ahead = frame_id - self._last_id if self._last_id else 1
        if ahead < 0 and self._last_id <= _FRAME_IDS:
            ahead += _FRAME_IDS
        ahead = max(1, ahead)
        self.missing += ahead - 1
        self._number += ahead
        self._last_id = frame_id
        return self._number
