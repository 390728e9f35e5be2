"""The emulated Firefly MV on Linux's own USB, by FunctionFS and dummy_hcd: for a virtual machine, as root.

python firefly_gadget.py SOCKET    plugs it in; SOCKET then takes one JSON object on each line and answers
                                   with one: {"do": "plug" | "unplug" | "shots"}, {"faults": {…}}
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import os
import signal
import socketserver
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from drivers.emulators.firefly import Faults, Firefly, Ramps

GADGET = Path("/sys/kernel/config/usb_gadget/firefly")
MOUNT = Path("/dev/ffs-firefly")
VENDOR_REQUEST = 0x7F  # libdc1394's for the registers of the IEEE 1394 address space's top
ENABLE, DISABLE, UNBIND, SETUP = 2, 3, 1, 4  # of usb_functionfs_event_type
_EVENT = struct.Struct("<BBHHHB3x")
_CHUNK = 65536  # a write of a whole frame would need as much contiguous memory in the kernel


def descriptors() -> bytes:
    """One interface with one bulk endpoint, at full and high speed; requests to the device come here too."""
    interface = struct.pack("<9B", 9, 4, 0, 0, 1, 0xFF, 0, 0, 1)
    full, high = (interface + struct.pack("<BBBBHB", 7, 5, 0x81, 2, packet, 0) for packet in (64, 512))
    flags = 1 | 2 | 64  # full speed, high speed, all control requests whoever they are addressed to
    body = struct.pack("<III", flags, 2, 2) + full + high
    return struct.pack("<II", 3, 8 + len(body)) + body


def strings() -> bytes:
    body = struct.pack("<H", 0x409) + b"IIDC\0"
    return struct.pack("<IIII", 2, 16 + len(body), 1, 1) + body


class FireflyGadget:
    """The camera and its plug, which is out at first."""

    def __init__(self) -> None:
        remove()
        subprocess.run(["modprobe", "-a", "libcomposite", "usb_f_fs", "dummy_hcd"], check=True)
        for folder in ("strings/0x409", "configs/c.1/strings/0x409", "functions/ffs.cam"):
            (GADGET / folder).mkdir(parents=True)
        for name, value in {
            "idVendor": "0x1e10",
            "idProduct": "0x2000",
            "bcdUSB": "0x0200",
            "strings/0x409/manufacturer": "Point Grey Research",
            "strings/0x409/product": "Firefly MV",
        }.items():
            (GADGET / name).write_text(value)
        (GADGET / "configs/c.1/ffs.cam").symlink_to(GADGET / "functions/ffs.cam")
        MOUNT.mkdir(exist_ok=True)
        subprocess.run(["mount", "-t", "functionfs", "cam", MOUNT], check=True)
        self._control = os.open(MOUNT / "ep0", os.O_RDWR)
        os.write(self._control, descriptors())
        os.write(self._control, strings())
        self._bulk = os.open(MOUNT / "ep1", os.O_RDWR)
        self._enabled = False
        self.camera = Firefly(self._send, Ramps())
        threading.Thread(target=self._serve, daemon=True).start()

    def plug(self) -> None:
        if (GADGET / "UDC").read_text().strip():
            return
        self.camera.reset()
        (GADGET / "UDC").write_text(next(Path("/sys/class/udc").iterdir()).name)

    def unplug(self) -> None:
        with contextlib.suppress(OSError):  # it is out already
            (GADGET / "UDC").write_text("\n")

    def _send(self, frame: bytes) -> None:
        for start in range(0, len(frame), _CHUNK):
            if not self._enabled:  # a write would wait for the next plug, and bring an old frame there
                raise ConnectionResetError(errno.ESHUTDOWN, "the plug is out")
            os.write(self._bulk, frame[start : start + _CHUNK])

    def _serve(self) -> None:
        while True:
            try:
                events = os.read(self._control, 4 * _EVENT.size)
            except OSError as error:
                if error.errno != errno.EIDRM:  # the host gave a request up before it was answered
                    raise
                continue
            for kind, request, value, index, length, event in _EVENT.iter_unpack(events):
                if event in (ENABLE, DISABLE, UNBIND):
                    self._enabled = event == ENABLE
                elif event == SETUP:
                    with contextlib.suppress(OSError):  # the host gave it up meanwhile
                        self._answer(kind, request, index << 16 | value, length)

    def _answer(self, kind: int, request: int, address: int, length: int) -> None:
        count = length // 4
        if not kind & 0x80:
            quadlets = struct.unpack(f"<{count}I", os.read(self._control, length)[: 4 * count])
            for n, quadlet in enumerate(quadlets):
                self.camera.write(address + 4 * n, quadlet)
            return
        read = [self.camera.read(address + 4 * n) for n in range(max(1, count))]
        if request != VENDOR_REQUEST or None in read:
            os.read(self._control, 0)  # the wrong direction stalls it: there is no such register
        else:
            os.write(self._control, struct.pack(f"<{len(read)}I", *read)[:length])


def remove() -> None:
    """Takes away what an earlier process left."""
    if not GADGET.exists():
        return
    with contextlib.suppress(OSError):
        (GADGET / "UDC").write_text("\n")
    subprocess.run(["umount", "-l", MOUNT], check=False, stderr=subprocess.DEVNULL)
    (GADGET / "configs/c.1/ffs.cam").unlink(missing_ok=True)
    for folder in ("configs/c.1/strings/0x409", "configs/c.1", "functions/ffs.cam", "strings/0x409", "."):
        with contextlib.suppress(FileNotFoundError):
            (GADGET / folder).resolve().rmdir()


def obey(gadget: FireflyGadget, command: dict[str, Any]) -> dict[str, Any]:
    if "faults" in command:
        gadget.camera.faults = dataclasses.replace(Faults(), **command["faults"])
        return {}
    match command["do"]:
        case "plug":
            gadget.plug()
        case "unplug":
            gadget.unplug()
        case "shots":
            return {"shots": [list(shot) for shot in gadget.camera.shots]}
    return {}


def main() -> None:
    path = Path(sys.argv[1])
    os.nice(-10)  # a camera's own processor answers whatever the computer does
    gadget = FireflyGadget()
    gadget.plug()

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                self.wfile.write(json.dumps(obey(gadget, json.loads(line))).encode() + b"\n")

    server = socketserver.ThreadingUnixStreamServer(str(path), Handler)
    server.daemon_threads = True
    signal.signal(signal.SIGTERM, lambda *_: threading.Thread(target=server.shutdown).start())
    server.serve_forever(poll_interval=0.2)
    gadget.unplug()
    time.sleep(0.2)  # the kernel ends what is under way
    os._exit(0)  # its threads wait in the kernel for a host; `remove` clears the rest next time


if __name__ == "__main__":
    main()
