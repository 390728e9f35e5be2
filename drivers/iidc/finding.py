"""Finds the IIDC camera that is meant, and says what keeps libdc1394 from one that the kernel sees."""

from __future__ import annotations

import contextlib
from pathlib import Path

from drivers.errors import DeviceFaultError, DeviceNotFoundError
from drivers.iidc.dc1394 import Camera, Library

USB_DEVICES = Path("/sys/bus/usb/devices")
_POINT_GREY_USB = "1e10"


def found(name: str, library: Library, wanted: str | None) -> Camera:
    """Opens the camera with the hexadecimal guid `wanted`, or the only one that there is.

    Raises:
        DeviceNotFoundError: If it is not there.
        DeviceFaultError: If there are several and none is named.
        Dc1394Error: If it went away or another program holds it.
    """
    guids = library.guids()
    there = ", ".join(f"{guid:016x}" for guid in guids)
    if not guids:
        raise DeviceNotFoundError(name, f"libdc1394 finds no camera{_hint()}")
    if wanted is not None and int(wanted, 16) not in guids:
        raise DeviceNotFoundError(name, f"no camera with guid {wanted}; there are: {there}")
    if wanted is None and len(guids) > 1:
        raise DeviceFaultError(name, f"there are several cameras; set guid to one of {there}")
    return library.camera(guids[0] if wanted is None else int(wanted, 16))


def _hint() -> str:
    for device in USB_DEVICES.glob("*/idVendor"):
        with contextlib.suppress(OSError):  # unplugged this moment
            if device.read_text().strip() == _POINT_GREY_USB:
                return (
                    ", though one of Point Grey's is on USB: it needs the udev rule "
                    f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{_POINT_GREY_USB}", GROUP="video", MODE="0660" '
                    "and this user in the group video; a USB 3 camera needs the aravis backend"
                )
    return ""
