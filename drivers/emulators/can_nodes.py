"""Emulated CANopen nodes of an arm: CiA 406 encoders or CiA 402 drives, which fail when they are told to."""

from __future__ import annotations

import contextlib
import importlib
import math
import threading
import time
from collections.abc import Callable, Collection
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

from drivers.canbus.bus import CanFrame
from drivers.canbus.objects import OnBus
from drivers.emulators.can_bridge import SYNC_ID, Jointed
from drivers.errors import DriverError

if TYPE_CHECKING:
    from canopen import LocalNode, ObjectDictionary

NODE_IDS = (1, 2, 3, 4, 5, 6)
COUNTS_PER_TURN = 1 << 20
ZERO_COUNTS = 1 << 16
_TPDO_ID = 0x180
_STATUS_WORD = 0x6041
_OPERATIONAL = 5
_JOIN_S = 2.0

# missing: node 6 sends no TPDO. late: node 6 sends it `late_s` after the SYNC. short: TPDOs lack their last
# bytes. mute: neither TPDO nor SDO nor SYNC. refused: the positions cannot be read by SDO. impossible:
# joint 2 is at 400°.
NodeFault = Literal["missing", "late", "short", "mute", "refused", "impossible"]


class CiaNodes:
    """Six nodes (1 to 6) on one bus; node n is joint n, 2²⁰ counts in a turn, zero at 2¹⁶.

    They latch their positions when a SYNC comes, and send them in TPDO 1 while they are operational:
    an encoder the position alone, a drive after its status word. SDO serves all of it.

    Args:
        cell: Whose joints.
        send: Puts a frame on the bus: id, data, whether the id is extended.
        profile: 406, encoders (object 0x6004), or 402, drives (0x6064).
        sync_period_s: How often they send SYNC themselves; None: another does it.
        operational: Whether they start sending by themselves, or wait to be set operational.
        late_s: How late the fault "late" is.
    """

    def __init__(
        self,
        cell: Jointed,
        send: Callable[[int, bytes, bool], None],
        *,
        profile: Literal[402, 406] = 406,
        sync_period_s: float | None = None,
        operational: bool = True,
        late_s: float = 0.05,
    ) -> None:
        canopen = importlib.import_module("canopen")
        self._cell, self._send = cell, send
        self._drive = profile == 402
        self._object = 0x6064 if self._drive else 0x6004
        self._sync_period_s, self._late_s = sync_period_s, late_s
        self._network: Any = canopen.Network(OnBus(self._answer))
        self._nodes: list[LocalNode] = []
        self._faults: frozenset[NodeFault] = frozenset()
        self._answering = threading.RLock()  # several threads may make them send
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        for node_id in NODE_IDS:
            node = canopen.LocalNode(node_id, self._dictionary(canopen, node_id))
            node.add_read_callback(lambda index, subindex, od, node_id=node_id: self._value(node_id, index))
            self._network.add_node(node)
            self._nodes.append(node)
        if operational:
            self.receive_command(bytes([1, 0]))

    @property
    def faults(self) -> frozenset[NodeFault]:
        """What fails; may be set at any time, and holds for all that is sent after that."""
        return self._faults

    @faults.setter
    def faults(self, faults: Collection[NodeFault]) -> None:
        with self._answering:
            self._faults = frozenset(faults)

    def receive(self, frame: CanFrame) -> None:
        """Takes a frame of the bus."""
        if frame.extended:
            return
        with self._answering:
            self._take(frame)

    def receive_command(self, data: bytes) -> None:
        """Takes an NMT command: its code, and a node or 0 for all."""
        self._network.notify(0, bytearray(data), 0.0)

    def emergency(self, node_id: int, code: int) -> None:
        """A node reports an emergency; code 0: it is over."""
        self._nodes[NODE_IDS.index(node_id)].emcy.send(code)

    def boot(self, node_id: int) -> None:
        """A node starts anew: it says so, and is no longer operational."""
        self.receive_command(bytes([0x80, node_id]))
        self._answer(0x700 + node_id, bytes([0]), False)

    def start(self) -> None:
        """Begins to send SYNC, if they do."""
        if self._sync_period_s is not None:
            self._stop.clear()
            self._thread = threading.Thread(target=self._run, args=(self._sync_period_s,), name="SYNC")
            self._thread.start()

    def stop(self) -> None:
        """Sends no more SYNC; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _take(self, frame: CanFrame) -> None:
        if "mute" in self._faults:
            return
        if frame.can_id == SYNC_ID:
            self._answer_sync(time.monotonic_ns())
        elif len(frame.data) == 8 or frame.can_id == 0:
            self._network.notify(frame.can_id, bytearray(frame.data), frame.span.end_ns / 1e9)

    def _run(self, period_s: float) -> None:
        while not self._stop.wait(period_s):
            with self._answering:
                if "mute" not in self._faults:
                    t_ns = time.monotonic_ns()
                    self._answer(SYNC_ID, b"", False)
                    self._answer_sync(t_ns)

    def _answer_sync(self, t_ns: int) -> None:
        for node in self._nodes:
            if node.nmt.state != "OPERATIONAL" or (node.id == 6 and "missing" in self._faults):
                continue
            if node.id == 6 and "late" in self._faults:
                self._stop.wait(self._late_s)
            data = self._counts(node.id or 0, t_ns).to_bytes(4, "little")
            data = bytes([0x37, 0x06]) + data if self._drive else data
            self._answer(_TPDO_ID + (node.id or 0), data[:3] if "short" in self._faults else data, False)

    def _answer(self, can_id: int, data: bytes, extended: bool) -> None:
        with self._answering, contextlib.suppress(DriverError):  # unplugged: a node goes on all the same
            self._send(can_id, data, extended)

    def _counts(self, node_id: int, t_ns: int) -> int:
        angle = float(self._cell.joints(t_ns)[node_id - 1])
        if node_id == 2 and "impossible" in self._faults:
            angle = math.radians(400)
        return (round(angle / math.tau * COUNTS_PER_TURN) + ZERO_COUNTS) % (1 << 32)

    def _value(self, node_id: int, index: int) -> int | None:
        if index != self._object:
            return None
        counts = self._counts(node_id, time.monotonic_ns())
        return counts - (1 << 32) if self._drive and counts >= 1 << 31 else counts

    def _dictionary(self, canopen: Any, node_id: int) -> ObjectDictionary:
        """Returns the objects of a node (CiA 301, and 406 or 402)."""
        od = canopen.objectdictionary
        entries = [(_STATUS_WORD, 16)] if self._drive else []
        entries.append((self._object, 32))
        dictionary: ObjectDictionary = canopen.ObjectDictionary()
        dictionary.add_object(_variable(od, "Error register", 0x1001, 0, od.UNSIGNED8, 0))
        position = od.INTEGER32 if self._drive else od.UNSIGNED32
        if self._drive:
            dictionary.add_object(_variable(od, "Status word", _STATUS_WORD, 0, od.UNSIGNED16, 0x0637))
        dictionary.add_object(_variable(od, "Position", self._object, 0, position, None))
        record = od.ODRecord("TPDO 1", 0x1800)
        for subindex, kind, value in (
            (0, od.UNSIGNED8, 2),
            (1, od.UNSIGNED32, _TPDO_ID + node_id),
            (2, od.UNSIGNED8, 1),
        ):
            record.add_member(_variable(od, f"TPDO 1, {subindex}", 0x1800, subindex, kind, value))
        dictionary.add_object(record)
        mapping = od.ODRecord("TPDO 1 mapping", 0x1A00)
        mapping.add_member(_variable(od, "Entries", 0x1A00, 0, od.UNSIGNED8, len(entries)))
        for subindex, (index, bits) in enumerate(entries, start=1):
            mapping.add_member(
                _variable(od, f"Entry {subindex}", 0x1A00, subindex, od.UNSIGNED32, index << 16 | bits)
            )
        dictionary.add_object(mapping)
        return dictionary


def _variable(od: Any, name: str, index: int, subindex: int, kind: int, value: int | None) -> Any:
    variable = od.ODVariable(name, index, subindex)
    variable.data_type, variable.access_type, variable.value = kind, "ro", value
    return variable
