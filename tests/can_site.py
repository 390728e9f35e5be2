"""An arm that turns, on emulated CAN buses, and the options of its readers."""

from __future__ import annotations

import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from drivers.arm_can import canopen, dbc
from drivers.canbus.options import BusOptions
from drivers.clock import SystemClock
from drivers.emulators.can_bridge import BusEnd, CanBridge
from drivers.emulators.can_nodes import COUNTS_PER_TURN, NODE_IDS, ZERO_COUNTS, CiaNodes
from drivers.emulators.slcan_adapter import SlcanAdapter
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceTimeoutError

DBC = Path(__file__).resolve().parents[1] / "systemd/can_joints.dbc"
MESSAGES = ("Joints12", "Joints34", "Joints56")
PERIOD_S = 0.01
PATIENT_S = 3.0
OPEN_S = 0.8
RATE = 0.05  # rad/s, all joints: slow enough to stay in their range, fast enough to tell times apart
WORD_RAD = np.radians(1e-4)


class Turning:
    """Each joint's angle tells the time."""

    def __init__(self):
        self.start_ns = time.monotonic_ns()

    def joints(self, t_ns):
        return np.array([-0.9, -0.5, -0.1, 0.3, 0.7, 1.1]) + RATE * (t_ns - self.start_ns) / 1e9

    def times_ns(self, q):
        """When each joint had its angle."""
        return self.start_ns + (q - np.array([-0.9, -0.5, -0.1, 0.3, 0.7, 1.1])) / RATE * 1e9


def joints():
    return {
        f"j{joint}": {"message": MESSAGES[(joint - 1) // 2], "signal": f"J{joint}"} for joint in range(1, 7)
    }


def bridge_options(interface="virtual", channel="nowhere", **more):
    closed = {} if "sync" in more else {"counter": "Counter"}
    return {
        "interface": interface,
        "channel": channel if isinstance(channel, int) else str(channel),
        "period_ms": PERIOD_S * 1e3,
        "window_ms": PERIOD_S * 1e3 if "sync" in more else 100.0,
        "open_timeout_s": OPEN_S,
        "max_gap_s": 1.0,
        "dbc_path": str(DBC),
        "joints": joints(),
        **closed,
        **more,
    }


def node_options(channel, thing=0x6004, **more):
    nodes = {
        f"j{node_id}": {
            "node_id": node_id,
            "object": thing,
            "counts_per_turn": COUNTS_PER_TURN,
            "zero_counts": ZERO_COUNTS,
        }
        for node_id in NODE_IDS
    }
    return {
        "interface": "virtual",
        "channel": str(channel),
        "period_ms": PERIOD_S * 1e3,
        "window_ms": PERIOD_S * 1e3,
        "open_timeout_s": OPEN_S,
        "max_gap_s": 1.0,
        "read": "pdo",
        "nodes": nodes,
        **more,
    }


def reader(options):
    return dbc(name="arm", clock=SystemClock(), options=options, shared={})


def node_reader(options):
    return canopen(name="arm", clock=SystemClock(), options=options, shared={})


@contextmanager
def bridge_on_a_bus(channel, cell=None, **more):
    """The emulated PLC on a virtual bus, and its end of it."""
    end = BusEnd(BusOptions(interface="virtual", channel=str(channel)))
    with end, CanBridge(cell or Turning(), end.send, period_s=PERIOD_S, **more) as bridge:
        yield bridge, end


@contextmanager
def bridge_by_slcan(path, cell=None):
    """The emulated PLC behind an emulated adapter."""
    with (
        SlcanAdapter(path) as adapter,
        CanBridge(cell or Turning(), adapter.send, period_s=PERIOD_S) as bridge,
    ):
        yield bridge, adapter


@contextmanager
def nodes_on_a_bus(channel, cell=None, **more):
    """The emulated nodes on a virtual bus, and their end of it."""
    end = BusEnd(BusOptions(interface="virtual", channel=str(channel)))
    nodes = CiaNodes(cell or Turning(), end.send, **more)
    end.received = nodes.receive
    with end, nodes:
        yield nodes, end


def assert_of_one_time(cell, reading, word_rad=WORD_RAD, late_s=0.5):
    """All six angles are of one time, and that is what the reading says, but for the way to the bus."""
    times_ns = cell.times_ns(reading.q)
    step_ns = word_rad / RATE * 1e9
    assert np.ptp(times_ns) <= step_ns + 1000
    assert -late_s * 1e9 <= times_ns.mean() - reading.t_ns <= reading.t_sd_ns + step_ns


def waits_for(condition, within_s=PATIENT_S):
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s, "it did not come about"
        time.sleep(0.01)


def outcome(arm):
    """A reading, or the error instead."""
    try:
        return arm.read_joints(0.2)
    except (DeviceFaultError, DeviceLostError, DeviceTimeoutError) as error:
        return error


def fails(arm, within_s=PATIENT_S):
    """Reads until it fails, and returns the error."""
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        if isinstance(result := outcome(arm), Exception):
            return result
    raise AssertionError("it did not fail")
