"""Tells systemd how the service is: a datagram to $NOTIFY_SOCKET, and nothing where there is none."""

from __future__ import annotations

import os
import socket
import time


def notify(*lines: str) -> bool:
    """Sends `lines`, such as "READY=1" or "STATUS=waiting for depth", in one datagram.

    Returns:
        Whether a supervisor took it. A supervisor that went away is no reason to stop working, so
        nothing is raised.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    if address.startswith("@"):  # Linux' abstract name space
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.settimeout(1.0)
            channel.sendto("\n".join(lines).encode(), address)
    except OSError:
        return False
    return True


def reloading() -> bool:
    """Announces a reload; systemd 253 and newer wants the time with it, 252 ignores that line."""
    return notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")


class Watchdog:
    """Sends WATCHDOG=1 at half of systemd's interval; silent where the unit asks for none.

    `beat()` belongs into the loop that does the work and nowhere else: a timer thread would go on
    beating through a hang.
    """

    def __init__(self) -> None:
        mine = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        interval = os.environ.get("WATCHDOG_USEC", "")
        self.interval_s: float | None = int(interval) / 2e6 if mine and interval.isdigit() else None
        self._next = 0.0

    def beat(self) -> None:
        """Call every time the loop goes round and every worker is alive."""
        if self.interval_s is not None and (now := time.monotonic()) >= self._next:
            self._next = now + self.interval_s
            notify("WATCHDOG=1")
