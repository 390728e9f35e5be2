"""The process in which an isolated device lives; only `drivers.isolation.child_process` starts it.

It answers one question at a time: open, grab, exposure_range, set_exposure, check, about, close. Imports
come late, so that it is bound to its parent's life before anything that takes long.
"""

from __future__ import annotations

import faulthandler
import fcntl
import importlib
import os
import select
import signal
import socket
import sys
import traceback
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.isolation.frame_memory import FrameMemory


class TerminatedError(BaseException):
    """SIGTERM came: whatever is under way is given up, and the device closed."""


class DeviceServer:
    """Answers the parent's questions with a device of this process.

    Args:
        memory: Where frames are put.
        name: The device's.
    """

    def __init__(self, memory: FrameMemory, name: str) -> None:
        self._memory, self._name = memory, name
        self._device: Any = None

    def answer(self, question: dict[str, Any]) -> dict[str, Any]:
        """Returns the answer to one question; no error of the driver leaves this."""
        from drivers.isolation.wire import defect_message, error_message

        try:
            match question["call"]:
                case "open":
                    self._open(question["factory"], question["options"])
                case "grab":
                    return self._grab(question["not_before_ns"], question["timeout_s"], question["with_ir"])
                case "exposure_range":
                    return {"range_s": self._exposure_range_s()}
                case "set_exposure":
                    return {"exposure_s": self._device.set_exposure(question["exposure_s"])}
                case "check":
                    self._device.check()
                case "about":
                    return {"about": dict(self._device.about())}
                case "close":
                    self.close()
        except Exception as error:  # noqa: BLE001 - the border: all that a driver may do wrong ends here
            return error_message(error) or defect_message(error, traceback.format_exc())
        return {}

    def close(self) -> None:
        """Closes the device, if there is one."""
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _open(self, factory: str, options: dict[str, Any]) -> None:
        from drivers.clock import SystemClock
        from drivers.errors import DriverUnavailableError

        module, _, function = factory.partition(":")
        try:
            make = getattr(importlib.import_module(module), function)
            self._device = make(name=self._name, clock=SystemClock(), options=options, shared={})
            self._device.open()
        except ModuleNotFoundError as error:
            if error.name is None or error.name.split(".")[0] in ("drivers", "surfclass"):
                raise
            raise DriverUnavailableError(
                self._name, f"{module} needs the library {error.name!r}; install the package that has it"
            ) from error

    def _exposure_range_s(self) -> tuple[float, float]:
        from drivers.interfaces import ExposureControl

        device = self._device
        return device.exposure_range_s() if isinstance(device, ExposureControl) else (0.0, 0.0)

    def _grab(self, not_before_ns: int, timeout_s: float, with_ir: bool) -> dict[str, Any]:
        from drivers.errors import DeviceFaultError
        from surfclass.errors import InputError

        if with_ir:
            frame = self._device.grab(not_before_ns, timeout_s, with_ir=True)
        else:
            frame = self._device.grab(not_before_ns, timeout_s)
        try:
            return self._memory.write(frame)
        except InputError as error:
            raise DeviceFaultError(self._name, str(error)) from None


def main() -> None:
    """Serves until the parent says close, closes its end, or ends.

    The arguments are three inherited descriptors (the socket, the frame memory, the reading end of
    the lifeline) and the device's name.
    """
    channel, memory, lifeline = (int(argument) for argument in sys.argv[1:4])
    for descriptor in (channel, memory, lifeline):
        os.set_inheritable(descriptor, False)
    _end_with_the_parent(lifeline)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())  # the thread that started this may have blocked some
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _terminate)
    faulthandler.enable()
    sys.stdout = sys.stderr
    status = 0
    try:
        _serve(socket.socket(fileno=channel), memory, sys.argv[4])
    except TerminatedError:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.raise_signal(signal.SIGTERM)
    except BaseException:  # noqa: BLE001 - printed to where the parent reads; there is nobody else
        traceback.print_exc()
        status = 1
    # The device is closed. What vendors' libraries do at exit is what crashes most.
    os._exit(status)


def _serve(channel: socket.socket, memory: int, name: str) -> None:
    from drivers.isolation.frame_memory import FrameMemory
    from drivers.isolation.wire import WireError, defect_message, encode, receive

    server = DeviceServer(FrameMemory(memory, writable=True), name)
    os.close(memory)
    try:
        while (question := receive(channel)) is not None:
            answer = server.answer(question)
            number = {"id": question["id"]}
            try:
                packet = encode(answer | number)
            except WireError as error:  # such as a serial number that is no text
                packet = encode(defect_message(error, repr(answer)) | number)
            channel.send(packet)
            if question["call"] == "close":
                break
    finally:
        server.close()


def _end_with_the_parent(lifeline: int) -> None:
    """Has the kernel kill this process when the parent's end of the pipe closes.

    Nothing of this process need run for it: a library may hang in a call, with Python's lock held.
    """
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
    closed = select.poll()
    closed.register(lifeline, select.POLLIN)
    if closed.poll(0):  # the parent ended before this was set up
        os._exit(1)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise TerminatedError


if __name__ == "__main__":
    main()
