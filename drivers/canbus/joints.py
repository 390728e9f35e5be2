"""Six joint angles out of several CAN frames: a set is used only when all of it is of one moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from drivers.canbus.stamps import Span

JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")
_ALL = frozenset(range(len(JOINTS)))
_MEMORY_PERIODS = 10
_OPEN_SETS = 8


@dataclass(frozen=True, slots=True)
class JointSet:
    """Six angles of one moment.

    Attributes:
        span: When they held: when the SYNC came that they answer, or from the first frame to the last.
        angles: j1 to j6, rad.
    """

    span: Span
    angles: tuple[float, ...]


@dataclass(slots=True)
class SetCounts:
    """What became of the frames; all but `complete` and `repeated` cost a set.

    Attributes:
        complete: Sets delivered.
        incomplete: Sets that a part of was missing of.
        late: Sets a part of which came after the window.
        conflicting: Sets in which a joint came twice with different angles.
        doubtful: Sets with a part that was missing in the set before: it may be that one, late.
        repeated: Frames that said again what was known, or carried the counter of a finished set.
        old: Frames with a counter that lies behind the last set's.
        unsynchronised: Frames before the first SYNC.
        malformed: Frames of a known id with the wrong length or an unknown selector.
        impossible: Sets, or frames, with angles that no joint can have.
    """

    complete: int = 0
    incomplete: int = 0
    late: int = 0
    conflicting: int = 0
    doubtful: int = 0
    repeated: int = 0
    old: int = 0
    unsynchronised: int = 0
    malformed: int = 0
    impossible: int = 0

    def since(self, before: SetCounts) -> SetCounts:
        """Returns what was counted since a copy `before` was made."""
        return SetCounts(*(getattr(self, each.name) - getattr(before, each.name) for each in fields(self)))

    def describe(self) -> str:
        """Returns those that are not zero, such as "120 complete, 2 late"."""
        counts = ((field.name, getattr(self, field.name)) for field in fields(self))
        return ", ".join(f"{count} {name}" for name, count in counts if count) or "none"


class _Gathering:
    """A set that is not whole yet."""

    def __init__(self, span: Span) -> None:
        self.span = span
        self.angles: dict[int, float] = {}
        self.spoiled = False

    def put(self, angles: Mapping[int, float], counts: SetCounts) -> None:
        """Takes what a frame says; twice the same is nothing new, twice different is no set."""
        for joint, angle in angles.items():
            if joint not in self.angles:
                self.angles[joint] = angle
            elif self.angles[joint] == angle:
                counts.repeated += 1
            elif not self.spoiled:
                self.spoiled = True
                counts.conflicting += 1

    @property
    def whole(self) -> bool:
        return self.angles.keys() == _ALL and not self.spoiled

    def finished(self, span: Span) -> JointSet:
        return JointSet(span, tuple(self.angles[joint] for joint in sorted(_ALL)))


class SyncedSets:
    """Sets whose frames follow the same SYNC.

    A frame does not say which SYNC it answers. So a joint that was missing after one SYNC is doubted
    after the next, and what is late beyond the window or comes twice with different angles spoils its
    set. One thing cannot be seen: a node that answers EVERY SYNC a period late; its synchronous window
    (CiA 301, object 0x1007) rules that out, or a counter in the frames.

    Args:
        window_ns: From the SYNC to the last frame, at most.
        counts: Where what becomes of the frames is counted.
    """

    def __init__(self, window_ns: int, counts: SetCounts) -> None:
        self.counts = counts
        self._window_ns = window_ns
        self._open: _Gathering | None = None
        self._done = False
        self._missed = _ALL  # what came before the first SYNC is not known
        self._sent = False

    def sync(self, span: Span, sent: bool = False) -> None:
        """Begins a set; what the last one lacks is dropped.

        Args:
            span: When the SYNC came.
            sent: It was sent from here at `span.begin_ns`, and reached the bus between then and the
                first answer.
        """
        if self._open is not None:
            self._missed = _ALL - self._open.angles.keys()
            self.counts.incomplete += bool(self._missed and not self._open.spoiled)
        self._open, self._done, self._sent = _Gathering(span), False, sent

    def add(self, angles: Mapping[int, float], span: Span) -> JointSet | None:
        """Takes a frame's joints (0…5 → rad), and returns the set that it completes."""
        gathering = self._open
        if gathering is None:
            self.counts.unsynchronised += 1
            return None
        if self._sent and not gathering.angles:
            gathering.span = Span(gathering.span.begin_ns, span.end_ns)
        gathering.put(angles, self.counts)
        if gathering.spoiled or self._done:
            return None
        if span.end_ns - gathering.span.begin_ns > self._window_ns:
            gathering.spoiled = True
            self.counts.late += 1
        elif not self._missed.isdisjoint(angles):
            gathering.spoiled = True
            self.counts.doubtful += 1
        elif gathering.whole:
            self._done = True
            self.counts.complete += 1
            return gathering.finished(gathering.span)
        return None


class CountedSets:
    """Sets whose frames carry the same counter.

    A counter has to be ahead of the last set's, by less than half its range: one that stands still
    gives no set, and a frame that comes again cannot begin one. What lies behind is believed only
    when no set came for ten periods: then the sender has started anew.

    Args:
        window_ns: From a set's first frame to its last, at most.
        period_ns: From set to set.
        modulus: How many values the counter has.
        counts: Where what becomes of the frames is counted.
    """

    def __init__(self, window_ns: int, period_ns: int, modulus: int, counts: SetCounts) -> None:
        self.counts = counts
        self._window_ns = window_ns
        self._memory_ns = _MEMORY_PERIODS * period_ns + window_ns
        self._modulus = modulus
        self._open: dict[int, _Gathering] = {}
        self._last: int | None = None
        self._last_ns = 0

    def add(self, angles: Mapping[int, float], span: Span, counter: int) -> JointSet | None:
        """Takes a frame's joints (0…5 → rad), and returns the set that it completes."""
        self._drop_what_is_over(span.end_ns, counter)
        if not self._is_ahead(counter):
            if counter == self._last or span.begin_ns - self._last_ns <= self._memory_ns:
                if counter == self._last:
                    self.counts.repeated += 1
                else:
                    self.counts.old += 1
                return None
            self._last = None
        gathering = self._open.setdefault(counter, _Gathering(span))
        if len(self._open) > _OPEN_SETS:
            self._open.pop(next(iter(self._open)))
            self.counts.incomplete += 1
        gathering.put(angles, self.counts)
        if not gathering.whole:
            return None
        del self._open[counter]
        self._close(counter, span.end_ns)
        for other in [other for other in self._open if not self._is_ahead(other)]:
            del self._open[other]
            self.counts.incomplete += 1
        self.counts.complete += 1
        return gathering.finished(Span(gathering.span.begin_ns, span.end_ns))

    def _is_ahead(self, counter: int) -> bool:
        if self._last is None:
            return True
        return 1 <= (counter - self._last) % self._modulus <= max(1, self._modulus // 2)

    def _close(self, counter: int, t_ns: int) -> None:
        if self._is_ahead(counter):
            self._last, self._last_ns = counter, t_ns

    def _drop_what_is_over(self, now_ns: int, counter: int) -> None:
        """Drops the sets whose window has passed: `late` if a part still comes, else `incomplete`."""
        over = [key for key, open_ in self._open.items() if now_ns - open_.span.begin_ns > self._window_ns]
        for key in over:
            gathering = self._open.pop(key)
            self._close(key, gathering.span.end_ns)
            if not gathering.spoiled:
                if key == counter:
                    self.counts.late += 1
                else:
                    self.counts.incomplete += 1
