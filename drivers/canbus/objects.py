"""The one door to canopen: joint angles out of CiA 406 encoders and CiA 402 drives."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from drivers.canbus.bus import CanBus, CanFrame
from drivers.canbus.joints import JOINTS, JointSet, SetCounts, SyncedSets
from drivers.canbus.nodes import CanopenOptions, JointNode
from drivers.canbus.source import JointListener
from drivers.canbus.stamps import Span
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceNotFoundError, DriverUnavailableError

if TYPE_CHECKING:
    from canopen import Network, RemoteNode
    from canopen.emcy import EmcyError

_SERVICES = {0x80: 8, 0x580: 8, 0x700: 1}  # emergency, SDO reply, heartbeat: id without node, and bytes
_ERROR_REGISTER, _TPDO, _MAPPING = 0x1001, 0x1800, 0x1A00
_TPDOS = 8  # that a node is asked for
_NOT_VALID, _EXTENDED = 1 << 31, 1 << 29
_EVERY_SYNC = 1
_NO_SUCH_OBJECT = (0x06020000, 0x06090011)
_STARTED, _BOOTED = 1, 0
_JOIN_S = 2.0


class OnBus:
    """What canopen's network sends to, with an ordinary bus behind it.

    Args:
        send: Takes id, data and whether the id is extended.
    """

    def __init__(self, send: Callable[[int, bytes, bool], None]) -> None:
        self._send = send

    def send(self, message: Any) -> None:
        """Sends a python-can message."""
        self._send(message.arbitration_id, bytes(message.data), message.is_extended_id)


def _canopen(device: str) -> Any:
    try:
        return importlib.import_module("canopen")
    except ModuleNotFoundError as error:
        raise DriverUnavailableError(device, "CiA objects need the library canopen (PyPI)") from error


class _NoSuchObjectError(DeviceFaultError):
    """The node does not have it."""


@dataclass(frozen=True, slots=True)
class _Pdo:
    """A TPDO: how long it is, and which joints' four bytes begin where."""

    length: int
    parts: tuple[tuple[int, int], ...]


class CanopenJoints:
    """A `drivers.canbus.source.JointSource` that reads nodes' objects; it changes none of their settings.

    Args:
        device: What errors name.
        options: Which nodes, and how they are read.
    """

    def __init__(self, device: str, options: CanopenOptions) -> None:
        self.counts = SetCounts()
        self._device, self._options = device, options
        self._canopen = _canopen(device)
        self._joints: list[JointNode] = [getattr(options.nodes, joint) for joint in JOINTS]
        ids = {joint.node_id for joint in self._joints}
        self._services = {base + node: size for base, size in _SERVICES.items() for node in ids}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._asker: threading.Thread | None = None
        self._network: Network | None = None
        self._nodes: dict[int, RemoteNode] = {}
        self._pdos: dict[tuple[int, bool], _Pdo] = {}
        self._emergencies: dict[int, str] = {}
        self._sets: SyncedSets
        self._bus: CanBus
        self._listener: JointListener

    @property
    def wanted(self) -> None:
        """All frames: which ones are the nodes' PDOs is asked on the bus itself."""

    @property
    def may_send(self) -> bool:
        """True: SDO requests, and SYNC and NMT commands where they are configured."""
        return True

    def begin(self, bus: CanBus, listener: JointListener) -> None:
        """Finds the nodes and their PDOs, and starts what has to be asked for.

        Raises:
            DeviceNotFoundError: If a node does not answer.
            DeviceFaultError: If a node is in error, or does not have the object or the PDO.
            DeviceLostError: If the bus takes nothing.
        """
        self._forget()
        self._bus, self._listener = bus, listener
        self._network = network = self._canopen.Network(OnBus(bus.send))
        for node_id in sorted({joint.node_id for joint in self._joints}):
            node = self._canopen.RemoteNode(node_id, self._canopen.ObjectDictionary())
            node.sdo.RESPONSE_TIMEOUT = self._options.sdo_timeout_s
            node.emcy.add_callback(partial(self._on_emergency, node_id))
            node.nmt.add_heartbeat_callback(partial(self._on_heartbeat, node_id))
            self._nodes[node_id] = node
            network.add_node(node)
            self._look_at(node_id)
        if self._options.start_nodes:
            for node in self._nodes.values():
                node.nmt.send_command(_STARTED)
        if self._options.read == "sdo" or self._options.send_sync:
            self._stop = threading.Event()
            ask = self._read_all if self._options.read == "sdo" else self._send_sync
            self._asker = threading.Thread(
                target=self._asks, args=(ask, self._stop), name=f"{self._device}: CANopen", daemon=True
            )
            self._asker.start()

    def add(self, frame: CanFrame) -> None:
        """Takes a frame: a SYNC, a PDO, or an answer; those of before `begin` are nobody's."""
        network = self._network
        if network is None:
            return
        if (pdo := self._pdos.get((frame.can_id, frame.extended))) is not None:
            self._add_pdo(pdo, frame)
        elif frame.can_id == self._options.sync_id and not frame.extended:
            if self._options.read == "pdo":
                with self._lock:
                    self._sets.sync(frame.span)
        elif frame.can_id in self._services and not frame.extended:
            if len(frame.data) == self._services[frame.can_id]:
                network.notify(frame.can_id, bytearray(frame.data), frame.span.end_ns / 1e9)
            else:
                self.counts.malformed += 1

    def end(self) -> None:
        """Stops asking, and hears no more."""
        self._network = None
        self._stop.set()
        if self._asker is not None:
            self._asker.join(_JOIN_S)
            self._asker = None

    def about(self) -> Mapping[str, str]:
        """The library, and which objects are read how."""
        options = self._options
        how = f"asked for every {options.period_ms:g} ms"
        if options.read == "pdo":
            sender = "sent from here" if options.send_sync else "of another node"
            how = f"by PDO within {options.window_ms:g} ms after SYNC 0x{options.sync_id:X}, {sender}"
        objects = ", ".join(f"0x{joint.object:X} of node {joint.node_id}" for joint in self._joints)
        return {"library": f"canopen {self._canopen.__version__}", "format": f"{objects}, {how}"}

    def _forget(self) -> None:
        self._network = None
        self._nodes = {}
        self._sets = SyncedSets(round(self._options.window_ms * 1e6), self.counts)
        self._pdos = {}
        self._emergencies = {}

    def _look_at(self, node: int) -> None:
        """Finds out whether a node is well and how it gives its positions."""
        register = self._upload(node, _ERROR_REGISTER, 0)
        if any(register):
            raise DeviceFaultError(
                self._device, f"node {node} reports an error: register 0x1001 is 0x{register[0]:02X}"
            )
        objects = {joint.object: index for index, joint in enumerate(self._joints) if joint.node_id == node}
        if self._options.read == "pdo":
            self._find_pdos(node, objects)
            return
        for index in objects:
            self._read(node, index)

    def _find_pdos(self, node: int, objects: dict[int, int]) -> None:
        """Reads a node's TPDOs (CiA 301, 0x1800 and 0x1A00) until each object is found in one."""
        missing = dict(objects)
        for number in range(_TPDOS):
            try:
                cob_id = int.from_bytes(self._upload(node, _TPDO + number, 1), "little")
            except _NoSuchObjectError:
                break
            if not cob_id & _NOT_VALID:
                self._map(node, number, cob_id, missing)
        if missing:
            names = ", ".join(f"0x{index:X}" for index in sorted(missing))
            raise DeviceFaultError(
                self._device,
                f"node {node} sends {names} in none of its TPDOs that are on: map it (0x1A00), "
                'or read = "sdo"',
            )

    def _map(self, node: int, number: int, cob_id: int, missing: dict[int, int]) -> None:
        """Notes where in a TPDO the objects that are still `missing` lie."""
        bit = 0
        parts = []
        for entry in range(1, self._upload(node, _MAPPING + number, 0)[0] + 1):
            mapped = int.from_bytes(self._upload(node, _MAPPING + number, entry), "little")
            index, subindex, bits = mapped >> 16, mapped >> 8 & 0xFF, mapped & 0xFF
            if subindex == 0 and index in missing:
                if bits != 32 or bit % 8:
                    raise DeviceFaultError(
                        self._device,
                        f"node {node}, TPDO {number + 1}: 0x{index:X} is not four whole bytes",
                    )
                parts.append((missing.pop(index), bit // 8))
            bit += bits
        if not parts:
            return
        kind = self._upload(node, _TPDO + number, 2)[0]
        if kind != _EVERY_SYNC:
            raise DeviceFaultError(
                self._device,
                f"node {node}, TPDO {number + 1}: transmission type {kind}, allowed is 1, after each "
                'SYNC: others are not of one moment; set it, or read = "sdo"',
            )
        key = (cob_id & 0x1FFFFFFF, bool(cob_id & _EXTENDED))
        if key in self._pdos or key == (self._options.sync_id, False):
            raise DeviceFaultError(
                self._device, f"node {node}, TPDO {number + 1}: its id 0x{key[0]:X} is in use already"
            )
        self._pdos[key] = _Pdo(bit // 8, tuple(parts))

    def _add_pdo(self, pdo: _Pdo, frame: CanFrame) -> None:
        if len(frame.data) != pdo.length:
            self.counts.malformed += 1
            return
        angles = {joint: self._joints[joint].angle(frame.data[at : at + 4]) for joint, at in pdo.parts}
        with self._lock:
            joints = self._sets.add(angles, frame.span)
        if joints is not None:
            self._heard(joints)

    def _heard(self, joints: JointSet) -> None:
        """Passes a set on, unless a node has said that something is wrong and not yet that it is over."""
        if not self._emergencies:
            self._listener.heard(joints)

    def _asks(self, ask: Callable[[], None], stop: threading.Event) -> None:
        """Calls `ask` every period, in a thread of its own, until the bus takes nothing any more."""
        period_s = self._options.period_ms / 1e3
        due_s = time.monotonic()
        try:
            while not stop.wait(max(0.0, due_s - time.monotonic())):
                ask()
                due_s = max(due_s + period_s, time.monotonic())
        except DeviceLostError as error:
            if stop.is_set():
                return
            self._listener.lost(str(error).removeprefix(f"{self._device}: "))

    def _send_sync(self) -> None:
        now_ns = time.monotonic_ns()
        with self._lock:  # before it is sent: the answers come in another thread
            self._sets.sync(Span(now_ns, now_ns), sent=True)
        self._bus.send(self._options.sync_id, b"")

    def _read_all(self) -> None:
        """Asks for all positions; they are of the time between the first question and the last answer."""
        begin_ns = time.monotonic_ns()
        angles = []
        try:
            for node in self._joints:
                if self._stop.is_set():
                    return
                angles.append(node.angle(self._read(node.node_id, node.object)))
        except DeviceNotFoundError:
            self.counts.incomplete += 1
            self._stop.wait(
                self._options.sdo_timeout_s
            )  # an answer that comes late must not be the next one's
        except DeviceFaultError as error:
            self._listener.failed(str(error).removeprefix(f"{self._device}: "))
        else:
            span = Span(begin_ns, time.monotonic_ns())
            if span.end_ns - span.begin_ns > self._options.window_ms * 1e6:
                self.counts.late += 1
            else:
                self.counts.complete += 1
                self._heard(JointSet(span, tuple(angles)))

    def _read(self, node: int, index: int) -> bytes:
        data = self._upload(node, index, 0)
        if len(data) != 4:
            raise DeviceFaultError(
                self._device, f"node {node}: 0x{index:X} has {len(data)} bytes, allowed are 4"
            )
        return data

    def _upload(self, node: int, index: int, subindex: int) -> bytes:
        where = f"node {node}, object 0x{index:X}.{subindex}"
        try:
            data: bytes = self._nodes[node].sdo.upload(index, subindex)
        except self._canopen.SdoAbortedError as error:
            kind = _NoSuchObjectError if error.code in _NO_SUCH_OBJECT else DeviceFaultError
            raise kind(self._device, f"{where}: {error}") from error
        except self._canopen.SdoCommunicationError as error:
            raise DeviceNotFoundError(self._device, f"{where}: {error}") from error
        if not data:
            raise DeviceFaultError(self._device, f"{where} is empty")
        return data

    def _on_emergency(self, node: int, error: EmcyError) -> None:
        for kept in (self._nodes[node].emcy.log, self._nodes[node].emcy.active):
            kept.clear()
        if error.code & 0xFF00 == 0:
            self._emergencies.pop(node, None)
        else:
            self._emergencies[node] = f"node {node} reports an emergency: {error}"
            self._listener.failed(self._emergencies[node])

    def _on_heartbeat(self, node: int, state: int) -> None:
        if state == _BOOTED and self._options.start_nodes:
            self._nodes[node].nmt.send_command(_STARTED)
