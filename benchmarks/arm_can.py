"""Compares a set of joint angles from a CAN bus with the bare frames through python-can's recv().

First the cost in processor time: the same frames, waiting in a virtual bus, are read by both as fast as
they can. Then readers in a thread at 100 sets a second: their thread's processor time, and how long after
a set's last frame was sent its joint state (or that frame) is in the hands of who waits for it.
"""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np

from drivers.arm_can import dbc
from drivers.canbus.bus import CanBus
from drivers.canbus.dbc import DbcJoints
from drivers.canbus.layout import DbcOptions, Layout
from drivers.canbus.options import BusOptions
from drivers.clock import SystemClock
from drivers.emulators.can_bridge import BusEnd, CanBridge, joint_frames
from drivers.emulators.slcan_adapter import SlcanAdapter
from surfclass.schema import validate

DBC = Path(__file__).resolve().parents[1] / "systemd/can_joints.dbc"
MESSAGES = ("Joints12", "Joints34", "Joints56")
SETS = 2000
PERIOD_S = 0.01
WATCHED_S = 4.0


class Standing:
    def joints(self, t_ns: int) -> np.ndarray:
        return np.full(6, 0.5)


def options(interface: str, channel: str) -> dict[str, Any]:
    return {
        "interface": interface,
        "channel": channel,
        "period_ms": PERIOD_S * 1e3,
        "window_ms": 100.0,
        "dbc_path": str(DBC),
        "counter": "Counter",
        "joints": {
            f"j{joint}": {"message": MESSAGES[(joint - 1) // 2], "signal": f"J{joint}"}
            for joint in range(1, 7)
        },
    }


def fill(channel: str) -> None:
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as sender:
        for counter in range(SETS):
            for can_id, data in joint_frames(np.full(6, 1e-4 * counter), counter):
                sender.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def bare_us() -> float:
    """One set's three frames through recv()."""
    with can.Bus(interface="virtual", channel="bare", ignore_config=True) as bus:
        fill("bare")
        start = time.thread_time()
        frames = sum(bus.recv(0.0) is not None for _ in range(3 * SETS))
        took = time.thread_time() - start
    assert frames == 3 * SETS
    return 1e6 * took / SETS


def driver_us() -> float:
    """One set's three frames to a joint state in the history."""
    table = validate(DbcOptions, options("virtual", "ours"), "arm")
    source = DbcJoints(Layout("arm", table), table)
    arm = dbc(name="arm", clock=SystemClock(), options=options("virtual", "ours"), shared={})
    bus = CanBus("arm", table, wanted=source.wanted)
    bus.open()
    source.begin(bus, arm)
    fill("ours")
    start = time.thread_time()
    for _ in range(3 * SETS):
        frame = bus.receive()
        assert frame is not None
        source.add(frame)
    took = time.thread_time() - start
    bus.close()
    assert source.counts.complete > 0.9 * SETS, "a busy computer may make a few late"
    return 1e6 * took / SETS


@contextmanager
def bridge(interface: str, folder: Path) -> Iterator[str]:
    """The emulated PLC on a bus; gives the bus's channel."""
    with ExitStack() as stack:
        if interface == "slcan":
            channel = str(folder / "can")
            send = stack.enter_context(SlcanAdapter(channel)).send
        else:
            channel = f"watched {interface}"
            send = stack.enter_context(BusEnd(BusOptions(interface=interface, channel=channel))).send
        stack.enter_context(CanBridge(Standing(), send, period_s=PERIOD_S))
        yield channel


def watched(thread: threading.Thread, seconds: float) -> float:
    """Returns the share of a processor that a thread takes, per cent."""
    clock = time.pthread_getcpuclockid(thread.ident or 0)
    start, began = time.clock_gettime(clock), time.monotonic()
    time.sleep(seconds)
    return 100 * (time.clock_gettime(clock) - start) / (time.monotonic() - began)


def bare_reader(interface: str, folder: Path) -> tuple[float, float]:
    """Processor share of a thread around recv(), and the median age of a set's last frame, µs."""
    stop = threading.Event()
    ages: list[float] = []
    more = {"sleep_after_open": 0, "listen_only": True} if interface == "slcan" else {}
    with bridge(interface, folder) as channel:
        bus = can.Bus(interface=interface, channel=channel, ignore_config=True, **more)

        def read() -> None:
            while not stop.is_set():
                message = bus.recv(0.02)
                if message is not None and message.arbitration_id == 0x183:
                    ages.append(1e6 * (time.time() - message.timestamp))

        thread = threading.Thread(target=read)
        thread.start()
        share = watched(thread, WATCHED_S)
        stop.set()
        thread.join()
        bus.shutdown()
    return share, statistics.median(ages)


def driver_reader(interface: str, folder: Path) -> tuple[float, float]:
    """The same of the driver: its thread, and the age of a set when read_joints() returns it."""
    ages = []
    with bridge(interface, folder) as channel:
        arm = dbc(name="arm", clock=SystemClock(), options=options(interface, channel), shared={})
        with arm:
            thread = next(thread for thread in threading.enumerate() if thread.name == "arm: CAN")
            share = watched(thread, WATCHED_S)
            for _ in range(200):
                reading = arm.read_joints(1.0)
                ages.append((time.monotonic_ns() - reading.t_ns - reading.t_sd_ns) / 1e3)
    return share, statistics.median(ages)


def best(call: Callable[[], float], rounds: int = 5) -> float:
    return min(call() for _ in range(rounds))


def main() -> None:
    bare, ours = best(bare_us), best(driver_us)
    print(f"a set of three frames, python-can {can.__version__}")
    print(f"  recv() alone                    {bare:7.1f} µs")
    print(f"  to a joint state in the history {ours:7.1f} µs   {ours / bare:.1f} ×")
    for interface in ("virtual", "slcan"):
        with tempfile.TemporaryDirectory() as folder:
            share, age = bare_reader(interface, Path(folder))
            our_share, our_age = driver_reader(interface, Path(folder))
        print(f"{interface}, {1 / PERIOD_S:.0f} sets a second")
        print(f"  recv() alone                    {share:7.2f} % of a processor, {age:6.0f} µs")
        print(
            f"  joint states                    {our_share:7.2f} % of a processor, {our_age:6.0f} µs   "
            f"{our_share / share:.1f} ×"
        )


if __name__ == "__main__":
    main()
