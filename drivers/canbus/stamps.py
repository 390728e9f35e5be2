"""When a CAN frame arrived, in host monotonic time, though its stamp is of the wall clock or missing."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

_STAMP_NS = 1_000  # a float of seconds since 1970 has steps of 0.24 µs
_SLACK_NS = 1_000_000  # a frame is stamped a moment before a reader can find it
_OFFSETS = 16  # steps that frames still waiting can have seen


@dataclass(frozen=True, slots=True)
class Span:
    """The interval of host CLOCK_MONOTONIC in which something happened, ns."""

    begin_ns: int
    end_ns: int


class Arrivals:
    """Maps the stamps of a bus's frames, in their order, to host time.

    Linux keeps CLOCK_REALTIME at a constant distance from CLOCK_MONOTONIC but for steps: both follow
    the same disciplined oscillator. So the distance is sampled at every look at the bus; samples narrow
    it down, and one that contradicts is a step. A frame that was stamped before a step and read after
    it is told by where its time would have to lie: not before the frames ahead of it, not after now.
    Where both distances fit, the span covers both; a stamp that fits neither is not used.

    Args:
        now_ns: CLOCK_MONOTONIC, ns.
        wall_ns: CLOCK_REALTIME, ns.

    Attributes:
        steps: How often the wall clock was set.
        refused: Stamps that contradicted the order of the frames.
    """

    def __init__(
        self, now_ns: Callable[[], int] = time.monotonic_ns, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self.steps = self.refused = 0
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._earliest_ns = now_ns()
        self._offsets: list[Span] = []
        self._step_ns = 0
        self._sample()

    def idle(self, t_ns: int) -> None:
        """Notes that at `t_ns` no frame waited to be read: what comes next has arrived since."""
        self._earliest_ns = max(self._earliest_ns, t_ns)
        self._sample()

    def span(self, stamp_s: float | None) -> Span:
        """Returns when the frame arrived that has just been read.

        Args:
            stamp_s: Its reception in seconds of the wall clock; None where there is no such stamp.
        """
        arrived_ns = self._sample()
        begin_ns, end_ns = self._earliest_ns, arrived_ns
        if stamp_s is not None:
            spans = self._candidates(round(stamp_s * 1e9), arrived_ns)
            if spans:
                end_ns = min(arrived_ns, max(span.end_ns for span in spans))
                begin_ns = min(max(begin_ns - _SLACK_NS, min(span.begin_ns for span in spans)), end_ns)
            else:
                self.refused += 1
        self._earliest_ns = max(self._earliest_ns, begin_ns)
        return Span(begin_ns, end_ns)

    def _candidates(self, wall_ns: int, arrived_ns: int) -> list[Span]:
        """The stamp by each distance of the clocks that it can have been taken with."""
        if self._earliest_ns > self._step_ns:  # no frame from before the last step is left
            del self._offsets[:-1]
        spans = [
            Span(wall_ns + offset.begin_ns - _STAMP_NS, wall_ns + offset.end_ns + _STAMP_NS)
            for offset in self._offsets
        ]
        earliest_ns = self._earliest_ns - _SLACK_NS
        return [span for span in spans if span.end_ns >= earliest_ns and span.begin_ns <= arrived_ns]

    def _sample(self) -> int:
        """Measures the clocks' distance, and returns the monotonic time after that."""
        before_ns, wall_ns, after_ns = self._now_ns(), self._wall_ns(), self._now_ns()
        sample = Span(before_ns - wall_ns, after_ns - wall_ns)
        if not self._offsets:
            self._offsets.append(sample)
            return after_ns
        known = self._offsets[-1]
        begin_ns, end_ns = max(known.begin_ns, sample.begin_ns), min(known.end_ns, sample.end_ns)
        if begin_ns <= end_ns:
            self._offsets[-1] = Span(begin_ns, end_ns)
        elif begin_ns - end_ns > _STAMP_NS:
            self.steps += 1
            self._step_ns = after_ns
            self._offsets = [*self._offsets, sample][-_OFFSETS:]
        return after_ns
