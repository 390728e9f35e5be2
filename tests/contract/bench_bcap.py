"""A Denso controller over TCP, UDP and RS-232: the real driver, and a controller that speaks its bytes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench import Backend, Bench, Trouble

from drivers import backends
from drivers.bcap.result import Result
from drivers.clock import SystemClock
from drivers.emulators.bcap_controller import BcapController
from drivers.emulators.bcap_machine import BcapFaults


class RestingArm:
    def joints(self, t_ns: int) -> np.ndarray:
        return np.array([0.4, -0.3, 1.7, 0.9, -0.8, 2.1])


@contextmanager
def emulated(folder: Path, transport: str) -> Iterator[Bench]:
    link = folder / "ttyArm"
    with BcapController(RestingArm(), serial_link=link) as controller:
        where: dict[str, Any] = {"host": controller.host, "port": controller.port}
        if transport == "serial":
            where = {"port_path": str(link)}
        # On a busy computer a reader may not run for a while; the readings around are then far apart.
        options = {"transport": transport, "max_gap_s": 2.0} | where
        arm = backends.create("arm", "bcap", clock=SystemClock(), options=options)

        def fail(_: str, trouble: Trouble) -> None:
            if trouble in ("missing", "unplugged"):
                controller.stop()
            elif trouble == "mute":
                controller.faults.mute = True
            elif trouble == "faulty":
                controller.faults.result = Result.E_FAIL
            elif trouble == "frozen":
                controller.faults.frozen = True
            else:
                controller.faults.wire = trouble

        def mend(_: str) -> None:
            controller.machine.faults = BcapFaults()
            controller.start()

        yield Bench(SystemClock(), arm=arm, fail=fail, mend=mend, slack_s=0.4)
        arm.close()


_TROUBLES: frozenset[Trouble] = frozenset(
    ("missing", "unplugged", "mute", "faulty", "garbage", "half", "frozen")
)

BACKENDS = [
    Backend(f"b-CAP ({name})", partial(emulated, transport=transport), {"arm": _TROUBLES})
    for name, transport in (("TCP", "tcp"), ("UDP", "udp"), ("RS-232", "serial"))
]
