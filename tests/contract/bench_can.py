"""The CAN readers on an emulated PLC and emulated CiA nodes: virtual bus, slcan on a pty, SocketCAN."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench import Backend, Bench, Trouble

from drivers.arm_can import canopen, dbc
from drivers.canbus.options import BusOptions
from drivers.clock import SystemClock
from drivers.emulators.can_bridge import BridgeFault, BusEnd, CanBridge
from drivers.emulators.can_nodes import COUNTS_PER_TURN, NODE_IDS, ZERO_COUNTS, CiaNodes, NodeFault
from drivers.emulators.slcan_adapter import SlcanAdapter
from surfclass.types import Float64

DBC = Path(__file__).resolve().parents[2] / "systemd/can_joints.dbc"
MESSAGES = ("Joints12", "Joints34", "Joints56")
PERIOD_S = 0.02
OPEN_S = 1.5
SLACK_S = 0.3
VM_SLACK_S = 1.0  # emulated processors
VCAN = "vcan0"

_BRIDGE_FAULTS: dict[Trouble, BridgeFault] = {
    "missing": "mute",
    "mute": "mute",
    "garbage": "garbage",
    "half": "short",
    "frozen": "frozen",
    "faulty": "impossible",
}
_NODE_FAULTS: dict[Trouble, NodeFault] = {
    "missing": "mute",
    "mute": "mute",
    "half": "short",
    "faulty": "impossible",
}


class Standing:
    """An arm that stands still."""

    def joints(self, t_ns: int) -> Float64:
        return np.radians([10.0, -20.5, 90.0, -170.25, 45.0, 359.0])


def bridge_options(**more: Any) -> dict[str, Any]:
    """The options of a reader of the emulated PLC."""
    joints = {
        f"j{joint}": {"message": MESSAGES[(joint - 1) // 2], "signal": f"J{joint}"} for joint in range(1, 7)
    }
    return {
        "period_ms": PERIOD_S * 1e3,
        "window_ms": 200.0,
        "open_timeout_s": OPEN_S,
        "max_gap_s": 1.0,
        "dbc_path": str(DBC),
        "counter": "Counter",
        "joints": joints,
        **more,
    }


def node_options(**more: Any) -> dict[str, Any]:
    """The options of a reader of the emulated nodes."""
    nodes = {
        f"j{node_id}": {
            "node_id": node_id,
            "object": 0x6004,
            "counts_per_turn": COUNTS_PER_TURN,
            "zero_counts": ZERO_COUNTS,
        }
        for node_id in NODE_IDS
    }
    return {
        "period_ms": PERIOD_S * 1e3,
        "window_ms": PERIOD_S * 1e3,
        "read": "pdo",
        "open_timeout_s": OPEN_S,
        "max_gap_s": 1.0,
        "nodes": nodes,
        **more,
    }


def bridge_bench(
    options: dict[str, Any], bridge: CanBridge, unplug: Callable[[], None], replug: Callable[[], None]
) -> Bench:
    def fail(_: str, trouble: Trouble) -> None:
        if trouble == "unplugged":
            unplug()
        else:
            bridge.faults = {_BRIDGE_FAULTS[trouble]}

    def mend(_: str) -> None:
        bridge.faults = set()
        replug()

    arm = dbc(name="arm", clock=SystemClock(), options=options, shared={})
    slack_s = VM_SLACK_S if options["interface"] == "socketcan" else SLACK_S
    return Bench(SystemClock(), arm=arm, fail=fail, mend=mend, slack_s=slack_s)


@contextmanager
def on_a_bus(folder: Path, interface: str, channel: str = "", **more: Any) -> Iterator[Bench]:
    channel = channel or str(folder)

    def link(state: str) -> None:
        if interface == "socketcan":
            subprocess.run(["ip", "link", "set", channel, state], check=True, timeout=10)

    end = BusEnd(BusOptions(interface=interface, channel=channel))
    options = bridge_options(interface=interface, channel=channel, **more)
    with ExitStack() as stack:
        stack.enter_context(end)
        bridge = stack.enter_context(CanBridge(Standing(), end.send, period_s=PERIOD_S))
        stack.callback(link, "up")
        bench = bridge_bench(options, bridge, partial(link, "down"), partial(link, "up"))
        assert bench.arm is not None
        stack.callback(bench.arm.close)
        yield bench


@contextmanager
def by_slcan(folder: Path) -> Iterator[Bench]:
    adapter = SlcanAdapter(folder / "can")
    options = bridge_options(interface="slcan", channel=str(adapter.link_path), bitrate=500_000)

    def replug() -> None:
        adapter.stop()
        adapter.start()

    with adapter, CanBridge(Standing(), adapter.send, period_s=PERIOD_S) as bridge:
        bench = bridge_bench(options, bridge, adapter.stop, replug)
        yield bench
        assert bench.arm is not None
        bench.arm.close()


@contextmanager
def by_canopen(folder: Path) -> Iterator[Bench]:
    bus = {"interface": "virtual", "channel": str(folder)}
    end = BusEnd(BusOptions(interface="virtual", channel=str(folder)))
    nodes = CiaNodes(Standing(), end.send, sync_period_s=PERIOD_S)
    end.received = nodes.receive

    def fail(_: str, trouble: Trouble) -> None:
        nodes.faults = {_NODE_FAULTS[trouble]}

    def mend(_: str) -> None:
        nodes.faults = set()

    with end, nodes:
        arm = canopen(name="arm", clock=SystemClock(), options=node_options(**bus), shared={})
        yield Bench(SystemClock(), arm=arm, fail=fail, mend=mend, slack_s=SLACK_S)
        arm.close()


_BRIDGE = frozenset(_BRIDGE_FAULTS)
_NO_VCAN = "" if Path("/sys/class/net", VCAN).exists() else "needs vcan0: ./run test --vm"

BACKENDS = [
    Backend("CAN (virtual bus, DBC)", lambda folder: on_a_bus(folder, "virtual"), {"arm": _BRIDGE}),
    Backend("CAN (virtual bus, CANopen)", by_canopen, {"arm": frozenset(_NODE_FAULTS)}),
    Backend("CAN (slcan on a pty)", by_slcan, {"arm": _BRIDGE | {"unplugged"}}),
    Backend(
        f"CAN (socketcan, {VCAN})",
        lambda folder: on_a_bus(folder, "socketcan", VCAN),
        {"arm": _BRIDGE | {"unplugged"}},
        missing=_NO_VCAN,
    ),
]
