"""Sets of joint angles out of the frames that a DBC file describes; it only listens."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.canbus.bus import CanBus, CanFrame
from drivers.canbus.joints import CountedSets, JointSet, SetCounts, SyncedSets
from drivers.canbus.layout import DbcOptions, ImpossibleAngleError, Layout
from drivers.canbus.source import JointListener


class DbcJoints:
    """A `drivers.canbus.source.JointSource` that sends nothing.

    Args:
        layout: Which bits of which frame are a joint.
        options: How a set is closed.
    """

    def __init__(self, layout: Layout, options: DbcOptions) -> None:
        self.counts = SetCounts()
        self._layout = layout
        self._options = options
        self._sets: SyncedSets | CountedSets | None = None
        self._listener: JointListener | None = None

    @property
    def wanted(self) -> frozenset[tuple[int, bool]]:
        """The joints' messages and the SYNC."""
        return self._layout.wanted

    @property
    def may_send(self) -> bool:
        """False."""
        return False

    def begin(self, bus: CanBus, listener: JointListener) -> None:
        """Forgets the parts of sets from before, and tells `listener` from now on."""
        window_ns = round(self._options.window_ms * 1e6)
        period_ns = round(self._options.period_ms * 1e6)
        if self._layout.modulus:
            self._sets = CountedSets(window_ns, period_ns, self._layout.modulus, self.counts)
        else:
            self._sets = SyncedSets(window_ns, self.counts)
        self._listener = listener

    def add(self, frame: CanFrame) -> None:
        """Takes a frame; those of before `begin` are nobody's."""
        sets, listener = self._sets, self._listener
        if sets is None or listener is None:
            return
        if (frame.can_id, frame.extended) == self._layout.sync:
            if isinstance(sets, SyncedSets):
                sets.sync(frame.span)
            return
        try:
            read = self._layout.read(frame.can_id, frame.extended, frame.data)
        except ImpossibleAngleError as error:
            listener.impossible(str(error))
            return
        if read is None:
            self.counts.malformed += 1
            return
        joints: JointSet | None
        if isinstance(sets, CountedSets):
            joints = sets.add(read.angles, frame.span, read.counter)
        else:
            joints = sets.add(read.angles, frame.span)
        if joints is not None:
            listener.heard(joints)

    def end(self) -> None:
        """Hears no more."""
        self._sets = self._listener = None

    def about(self) -> Mapping[str, str]:
        """The library, and how sets are made."""
        layout, closed = self._layout, "the same counter"
        if layout.sync is not None:
            closed = f"after SYNC 0x{layout.sync[0]:X}"
        names = ", ".join(layout.messages)
        return {
            "library": layout.library,
            "format": f"{self._options.dbc_path.name}: {names}; a set is {closed} within "
            f"{self._options.window_ms:g} ms",
        }
