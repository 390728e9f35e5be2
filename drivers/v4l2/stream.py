"""The stream of a V4L2 camera between open() and close(): which of the kernel's buffers are frames."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from drivers.v4l2 import pixels, times
from drivers.v4l2.controls import Settings
from drivers.v4l2.node import Facts, Filled, Format, VideoNode


@dataclass
class Tally:
    """Buffers that were not delivered, since open(), by why."""

    stale: int = 0
    flagged: int = 0
    short: int = 0
    misdated: int = 0
    lost: int = 0

    def __str__(self) -> str:
        why = {
            "stale": "exposed too early",
            "flagged": "with the kernel's error flag",
            "short": "not whole",
            "misdated": "with impossible times",
            "lost": "missing in the count",
        }
        counts = {each.name: getattr(self, each.name) for each in fields(self)}
        return ", ".join(f"{count} {why[name]}" for name, count in counts.items() if count)


@dataclass
class Stream:
    """What was negotiated, and what came since.

    Attributes:
        node: The open node, streaming.
        facts: Who it is.
        format: Of the images.
        layout: Of their pixels.
        period_ns: From one frame to the next.
        settings: The controls in force.
        tally: What was not delivered.
        delivered: Frames that were.
        stamped_at: Where in a frame the stamps are taken; None before the first.
        sequence: Of the last buffer: rises by what the driver's counter does, and by 1 where that stands
            still or starts again.
    """

    node: VideoNode
    facts: Facts
    format: Format
    layout: pixels.Layout
    period_ns: int
    settings: Settings
    tally: Tally = field(default_factory=Tally)
    delivered: int = 0
    stamped_at: times.StampedAt | None = None
    sequence: int = 0
    _stamp_ns: int = 0
    _counter: int | None = None
    _fresh: bool = False

    def change_exposure(self, exposure_s: float) -> None:
        """Sets the exposure while the stream stands, so that no frame of before is left or under way.

        Raises:
            DeviceFaultError: If it does not take it; the stream stands still then.
            OSError: As the node does.
        """
        self.node.stop()
        self.settings.set_exposure(exposure_s)
        self._fresh = False  # the driver's count may start again
        self.node.resume()

    def judge(self, filled: Filled, fresh: bool, seen_ns: int, not_before_ns: int) -> times.Exposure | None:
        """Returns when a buffer was exposed, or counts why it is no frame to deliver and returns None.

        Args:
            filled: The buffer; its stamp is of CLOCK_MONOTONIC.
            fresh: Whether the kernel had buffers to fill all the while before.
            seen_ns: When it was taken.
            not_before_ns: The exposure must certainly have begun by then or later.
        """
        self._count(filled, fresh)
        form = self.format
        if filled.error:
            self.tally.flagged += 1
            return None
        if filled.size < pixels.needed_bytes(self.layout, form.width, form.height, form.row_bytes):
            self.tally.short += 1
            return None
        # A stamp of the frame's end may be a forecast; one of its start cannot, nor can one repeat the last.
        ahead_ns = filled.stamp_ns - seen_ns
        if filled.stamp_ns <= self._stamp_ns or ahead_ns > (0 if filled.at_start else self.period_ns):
            self.tally.misdated += 1
            return None
        self._stamp_ns = filled.stamp_ns
        if not filled.at_start:
            self.stamped_at = "end of frame"
        else:
            self.stamped_at = "arrival" if self.facts.stamps_arrival else "start of exposure"
        exposed = times.exposure(
            filled.stamp_ns, self.stamped_at, self.settings.exposure_ns, self.period_ns, seen_ns
        )
        if exposed.began_ns < not_before_ns:
            self.tally.stale += 1
            return None
        return exposed

    def _count(self, filled: Filled, fresh: bool) -> None:
        step = 1 if self._counter is None else (filled.sequence - self._counter) & 0xFFFF_FFFF
        if not 0 < step < 0x8000_0000:
            step = 1
        if fresh and self._fresh:
            self.tally.lost += step - 1
        self.sequence += step
        self._counter, self._fresh = filled.sequence, fresh
