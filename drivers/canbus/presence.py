"""Whether a CAN adapter is there, and ours: the serial port or the network interface behind it."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
from pathlib import Path

from drivers.errors import DeviceNotFoundError, DriverUnavailableError

_IFF_UP = 1
_ARPHRD_CAN = 280
_WHY = {
    errno.EAGAIN: "another program has it open; end that program",
    errno.EACCES: "no permission: the user must be in the port's group (dialout on Debian)",
    errno.ENOENT: "there is no such port: is the adapter plugged in, and the path right?",
}


def lock_port(device: str, path: str) -> int | None:
    """Returns a file that holds a serial port for this process until it is closed; None for a URL.

    python-can does not ask for the port alone, and would write to one that another program uses.

    Raises:
        DeviceNotFoundError: If there is no such port, or another program has it.
    """
    if not path.startswith("/"):
        return None
    file = None
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if file is not None:
            os.close(file)
        raise DeviceNotFoundError(device, f"{path}: {_WHY.get(error.errno or 0, error)}") from error
    return file


def look_for_interface(device: str, channel: str) -> None:
    """Says why socketcan cannot open a channel; python-can, when it says so, leaves a socket open.

    Raises:
        DeviceNotFoundError: If there is no such network interface, or it is down.
        DriverUnavailableError: If the kernel has no CAN.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
            reason = "this kernel has no CAN; load can_raw, or boot one that has it (Debian's does)"
            raise DriverUnavailableError(device, f"socketcan {channel}: {reason} ({error})") from error
        raise DeviceNotFoundError(device, f"socketcan {channel}: {error}") from error
    if why := missing_interface(channel):
        raise DeviceNotFoundError(device, why)


def missing_interface(channel: str) -> str:
    """Says why a network interface is not usable; empty where it is."""
    folder = Path("/sys/class/net", channel)
    try:
        kind, flags = int((folder / "type").read_text()), int((folder / "flags").read_text(), 16)
    except (OSError, ValueError):
        return f"socketcan {channel}: there is no such network interface"
    if kind != _ARPHRD_CAN:
        return f"socketcan {channel}: the network interface is no CAN bus"
    if not flags & _IFF_UP:
        return f"socketcan {channel}: the interface is down (`ip link set {channel} up`)"
    return ""
