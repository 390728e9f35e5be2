"""When the exposure of a V4L2 buffer was: what its time stamp says, and what it leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

# Where in a frame the stamp was taken. "arrival": as its first bytes came, after the exposure; so does
# uvcvideo (unless its parameter hwtimestamps is set), though it flags its stamps "start of exposure".
StampedAt = Literal["start of exposure", "end of frame", "arrival"]
_RESOLUTION_NS = 1_000  # buffers are stamped in whole microseconds


@dataclass(frozen=True, slots=True)
class Exposure:
    """What is certain about one exposure, CLOCK_MONOTONIC.

    Attributes:
        began_ns: It began at this time or later.
        mid_ns: The middle of the times at which mid-exposure can have been.
        sd_ns: Half the interval of those times.
    """

    began_ns: int
    mid_ns: int
    sd_ns: int


def exposure(
    stamp_ns: int, stamped_at: StampedAt, exposure_ns: int | None, period_ns: int, seen_ns: int
) -> Exposure:
    """Returns when a frame was exposed.

    How long the read-out took is not told; it took no longer than a frame's period, and neither did an
    exposure of unknown duration.

    Args:
        stamp_ns: The buffer's time stamp.
        stamped_at: Where in the frame it was taken.
        exposure_ns: How long the exposure was; None where it is not known.
        period_ns: From one frame to the next.
        seen_ns: When the buffer was there: it cannot have been exposed after that.
    """
    longest_ns = period_ns if exposure_ns is None else exposure_ns
    shortest_ns = 0 if exposure_ns is None else exposure_ns
    if stamped_at == "start of exposure":
        first_ns = last_ns = stamp_ns  # when it can have begun
    else:
        last_ns = stamp_ns - shortest_ns
        first_ns = stamp_ns - max(period_ns, longest_ns) - longest_ns
    first_ns = min(first_ns, seen_ns - shortest_ns)
    last_ns = min(last_ns + _RESOLUTION_NS, seen_ns - shortest_ns)
    if exposure_ns is not None:
        low_ns, high_ns = first_ns + exposure_ns // 2, last_ns + exposure_ns // 2
    elif stamped_at == "start of exposure":
        low_ns, high_ns = first_ns, min(last_ns + period_ns // 2, (last_ns + seen_ns) // 2)
    else:
        low_ns, high_ns = first_ns + longest_ns // 2, last_ns
    high_ns = max(low_ns, high_ns)
    return Exposure(first_ns, (low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2)
