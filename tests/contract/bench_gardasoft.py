"""The Gardasoft driver on the emulated controller: by RS-232 (a pty), TCP and UDP, and strobed."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from bench import Backend, Bench, Trouble

from drivers.clock import SystemClock
from drivers.emulators.led_controller import LedController, WireFaults
from drivers.light_gardasoft import light

_EXPOSURE_NS = 10_000_000


@contextmanager
def gardasoft(folder: Path, wire: str, **more: Any) -> Iterator[Bench]:
    clock = SystemClock()
    controller = LedController(None, folder / "led", tcp_port=0, udp_port=0)
    with controller:
        where = {
            "pty": {"port_path": str(controller.link_path)},
            "tcp": {"host": "127.0.0.1", "host_port": controller.tcp_port},
            "udp": {"host": "127.0.0.1", "host_port": controller.udp_port, "local_port": free_udp_port()},
        }[wire]
        options = {**where, "rating_a": 0.7, "reply_timeout_s": 0.4, **more}
        device = light(name="light", clock=clock, options=options, shared={})

        def fail(_: str, trouble: Trouble) -> None:
            if trouble in ("missing", "unplugged"):
                controller.unplug()
            elif trouble == "faulty":
                controller.outputs.overheat()
            else:
                controller.faults = {
                    "mute": WireFaults(mute="deaf"),
                    "garbage": WireFaults(garbage=True),
                    "half": WireFaults(half=True),
                }[trouble]

        def mend(_: str) -> None:
            controller.faults = WireFaults()
            controller.outputs.cool_down()
            controller.replug()

        def brightness(not_before_ns: int) -> float:
            end_ns = not_before_ns + _EXPOSURE_NS
            if more.get("mode") == "strobe":
                controller.outputs.strobe(1, not_before_ns, end_ns)
            time.sleep(max(0.0, (end_ns - clock.now_ns()) / 1e9))
            return 255 * controller.outputs.mean_level(not_before_ns, end_ns)

        yield Bench(clock, light=device, fail=fail, mend=mend, brightness=brightness, slack_s=0.4)
        device.close()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


_EVERY: frozenset[Trouble] = frozenset({"missing", "unplugged", "mute", "faulty", "garbage", "half"})
_GONE: frozenset[Trouble] = frozenset({"missing", "unplugged"})

BACKENDS = [
    Backend("gardasoft (pty)", partial(gardasoft, wire="pty"), {"light": _EVERY}),
    Backend("gardasoft (TCP)", partial(gardasoft, wire="tcp"), {"light": _EVERY}),
    Backend("gardasoft (UDP)", partial(gardasoft, wire="udp"), {"light": _GONE}),
    Backend(
        "gardasoft (strobe)",
        partial(gardasoft, wire="pty", mode="strobe", pulse_width_ms=10.0),
        {"light": frozenset()},
    ),
]
