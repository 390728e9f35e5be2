"""Times a joint read over b-CAP beside a bare socket echo of as many bytes, and the reader's share of a core.

Run it from the project's folder: `python -m benchmarks.arm_bcap`. The controller and the echo run in
processes of their own; milliseconds are medians, CPU is that of this process alone.
"""

from __future__ import annotations

import multiprocessing
import socket
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from drivers.arm_bcap import arm
from drivers.bcap.options import ArmBcapOptions
from drivers.bcap.packet import Function, Packet, encode
from drivers.bcap.session import ArmSession
from drivers.bcap.transport import SerialLink, TcpLink, UdpLink
from drivers.bcap.variant import EMPTY, bstr, i4, r8_array
from drivers.clock import SystemClock
from drivers.emulators.bcap_controller import BcapController

READS = 2000
READER_S = 10.0
RATE_HZ = 125.0
REQUEST = encode(Packet(1, 0, Function.ROBOT_EXECUTE, (i4(3), bstr("HighCurJntEx"), EMPTY)))
REPLY = encode(Packet(1, 0, 0, (r8_array((0.0,) * 9),)))


class RestingArm:
    def joints(self, t_ns: int) -> np.ndarray:
        return np.zeros(6) + 0.5


def serve_arm(ready: Connection, link: str) -> None:
    with BcapController(RestingArm(), serial_link=Path(link)) as controller:
        ready.send(controller.port)
        ready.recv()


def serve_echo(ready: Connection) -> None:
    """Answers each request's worth of bytes with a reply's."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ready.send(server.getsockname()[1])
        peer, _ = server.accept()
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while peer.recv(1000):
            peer.sendall(REPLY)
        peer.close()


def measured(call: Callable[[], object]) -> tuple[float, float, float]:
    """Median and 95th percentile of a call, ms, and its CPU, ms."""
    for _ in range(100):
        call()
    times, cpu_s = [], time.process_time()
    for _ in range(READS):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    cpu_ms = 1e3 * (time.process_time() - cpu_s) / READS
    return statistics.median(times), float(np.percentile(times, 95)), cpu_ms


def echo(port: int) -> tuple[tuple[float, float, float], float]:
    """What `measured` says of the bare echo, and its share of a core at RATE_HZ."""
    with socket.create_connection(("127.0.0.1", port)) as made:
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def ask() -> None:
            made.sendall(REQUEST)
            made.recv(1000)

        def ask_in_step() -> None:
            next_s = time.monotonic()
            while time.monotonic() < until_s:
                ask()
                next_s += 1 / RATE_HZ
                time.sleep(max(0.0, next_s - time.monotonic()))

        at_once = measured(ask)
        until_s = time.monotonic() + READER_S
        return at_once, share(ask_in_step)


def share(call: Callable[[], object]) -> float:
    """The CPU of this process during a call, in percent of a core."""
    cpu_s, start_s = time.process_time(), time.monotonic()
    call()
    return 100 * (time.process_time() - cpu_s) / (time.monotonic() - start_s)


def reads(link: TcpLink | UdpLink | SerialLink) -> tuple[float, float, float]:
    link.open(2.0)
    session = ArmSession("arm", link, ArmBcapOptions(host="127.0.0.1"))
    session.begin()
    try:
        return measured(session.read)
    finally:
        session.end()


def main() -> None:
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        tty = f"{folder}/tty"
        here, there = context.Pipe()
        controller = context.Process(target=serve_arm, args=(there, tty), daemon=True)
        echo_here, echo_there = context.Pipe()
        echoing = context.Process(target=serve_echo, args=(echo_there,), daemon=True)
        controller.start()
        echoing.start()
        port = here.recv()

        print(f"{READS} joint reads ({len(REQUEST)} bytes there, {len(REPLY)} back), ms:")
        bare, bare_share = echo(echo_here.recv())
        print(f"  {'bare echo, TCP':<18} median {bare[0]:6.3f}   95 % {bare[1]:6.3f}   CPU {bare[2]:6.3f}")
        links = {
            "b-CAP, TCP": TcpLink("arm", "127.0.0.1", port),
            "b-CAP, UDP": UdpLink("arm", "127.0.0.1", port),
            "b-CAP, pty": SerialLink("arm", tty, 38400),
        }
        for name, link in links.items():
            ours = reads(link)
            print(
                f"  {name:<18} median {ours[0]:6.3f}   95 % {ours[1]:6.3f}   CPU {ours[2]:6.3f}   "
                f"{ours[0] / bare[0]:.1f} and {ours[2] / bare[2]:.1f} times the echo's"
            )

        where = {"host": "127.0.0.1", "port": port}
        with closing(arm(name="arm", clock=SystemClock(), options=where, shared={})) as device:
            device.open()
            taken = share(lambda: time.sleep(READER_S))
            print(
                f"at {RATE_HZ:g} Hz the reader takes {taken:.1f} % of a core, a bare echo as often "
                f"{bare_share:.1f} %: {taken / bare_share:.1f} times"
            )
            asked = measured(lambda: device.read_joints(2.0))
            print(f"read_joints(): median {asked[0]:.3f} ms, 95 % {asked[1]:.3f} ms")
        here.send("end")
        controller.join()
        echoing.join()


if __name__ == "__main__":
    main()
