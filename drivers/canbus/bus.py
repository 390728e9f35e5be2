"""The one door to python-can: a bus of any make, its frames in host time, and what goes wrong with it."""

from __future__ import annotations

import contextlib
import importlib
import os
import select
import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.canbus.presence import lock_port, look_for_interface, missing_interface
from drivers.canbus.stamps import Arrivals, Span
from drivers.errors import DeviceLostError, DeviceNotFoundError, DriverUnavailableError
from surfclass.errors import ConfigurationError

if TYPE_CHECKING:
    import can

    from drivers.canbus.options import BusOptions

# Their stamps are receptions on the wall clock; others' count from the adapter's start, or are taken
# when python-can reads the frame, which the host knows better.
_STAMPED = ("socketcan", "virtual")
_LINUX_ERROR_FRAMES = ("socketcan", "gs_usb", "virtual")  # as in linux/can/error.h
_ON_A_PORT = ("slcan", "serial", "robotell", "seeedstudio")
_BUS_OFF, _RESTARTED, _CONTROLLER, _PASSIVE = 0x40, 0x100, 0x04, 0x30
_WAIT_S = 0.02
_POLL_S = 0.002  # between two looks at a bus without stamps: how well a frame's arrival is known
_PRESENCE_NS = 100_000_000
_SEND_S = 0.1


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data frame.

    Attributes:
        can_id: 11 bits, or 29 where `extended`.
        extended: Which of the two.
        data: Up to 8 bytes, of CAN FD 64.
        span: When it arrived, host time.
    """

    can_id: int
    extended: bool
    data: bytes
    span: Span


def _python_can(device: str) -> Any:
    """Returns the module `can`.

    Raises:
        DriverUnavailableError: If it is not installed.
    """
    try:
        return importlib.import_module("can")
    except ModuleNotFoundError as error:
        raise DriverUnavailableError(
            device, "a CAN bus needs the library python-can (PyPI, Debian: python3-can)"
        ) from error


def interfaces() -> frozenset[str]:
    """Returns the names of python-can's interfaces.

    Raises:
        DriverUnavailableError: If python-can is not installed.
    """
    return frozenset(_python_can("arm").VALID_INTERFACES)


class CanBus:
    """A bus; one thread receives, and another may send.

    Args:
        device: What its errors name.
        options: Which bus.
        wanted: The frames to receive, as (id, extended); None: all.
        may_send: False: `send` refuses, and an adapter that can be told only listens.

    Attributes:
        frames: Wanted frames received.
        error_frames: Error frames received.
        garbage: What an adapter sent that is no frame.
        state: "error-active", "error-passive" or "bus-off", as far as the controller said.
        stamped: Whether the kernel's time of reception comes with each frame.
        arrivals: How stamps became host time.
    """

    def __init__(
        self,
        device: str,
        options: BusOptions,
        *,
        wanted: Collection[tuple[int, bool]] | None = None,
        may_send: bool = False,
    ) -> None:
        self.device, self.options = device, options
        self.frames = self.error_frames = self.garbage = 0
        self.state = "error-active"
        self.arrivals = Arrivals()
        self._wanted = None if wanted is None else frozenset(wanted)
        self._may_send = may_send
        self.stamped = options.interface in _STAMPED
        self._can = _python_can(device)
        self._bus: can.BusABC | None = None
        self._lock_file: int | None = None
        self._poll = select.poll()
        self._present_ns = 0

    @property
    def address(self) -> str:
        """Such as "slcan /dev/ttyACM0, 500 kbit/s"."""
        rate = self.options.bitrate
        return f"{self.options.interface} {self.options.channel}" + (
            "" if rate is None else f", {rate / 1000:g} kbit/s"
        )

    @property
    def library(self) -> str:
        """Name and version."""
        return f"python-can {self._can.__version__}"

    def open(self) -> None:
        """Opens the bus.

        Raises:
            ConfigurationError: If the interface knows no such channel, bitrate or argument.
            DeviceNotFoundError: If there is no such bus, or another program has it.
            DriverUnavailableError: If the interface needs a library or a kernel that is not here.
        """
        try:
            if self.options.interface == "socketcan":
                look_for_interface(self.device, str(self.options.channel))
            if self.options.interface in _ON_A_PORT:
                self._lock_file = lock_port(self.device, str(self.options.channel).partition("@")[0])
            self._bus = self._opened()
            self._poll = select.poll()
            with contextlib.suppress(NotImplementedError, self._can.CanError):  # a bus that has no file
                self._poll.register(self._bus.fileno(), 0)
        except BaseException:
            self.close()
            raise
        self.arrivals = Arrivals()

    def close(self) -> None:
        """Closes the bus; never raises, may be called twice."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(self._can.CanError, OSError, ValueError):
                bus.shutdown()
            # slcan's shutdown first writes to the port, and leaves it open when that fails.
            if (port := getattr(bus, "serialPortOrig", None)) is not None:
                with contextlib.suppress(OSError):
                    port.close()
        if self._lock_file is not None:
            os.close(self._lock_file)
            self._lock_file = None

    def receive(self) -> CanFrame | None:
        """Returns the next wanted frame, or None if there was none for a moment (2 to 20 ms).

        Raises:
            DeviceLostError: If the bus went away: unplugged, switched off, bus-off.
        """
        bus = self._bus
        if bus is None:
            raise DeviceLostError(self.device, "the bus is not open")
        began_ns = time.monotonic_ns()
        try:
            # recv() itself measures its timeout by the wall clock: one that is set back makes it wait on.
            message, _ = bus._recv_internal(_WAIT_S if self.stamped else _POLL_S)
        except self._can.CanError as error:
            if not isinstance(error.__cause__, UnicodeDecodeError):
                raise DeviceLostError(self.device, f"{self.address}: {error}") from error
            self._discard(bus)  # slcan keeps what it cannot decode, and would fail on it again and again
            return None
        except OSError as error:
            raise DeviceLostError(self.device, f"{self.address}: {error}") from error
        except (ValueError, LookupError):  # how slcan says that a line is no frame
            self.garbage += 1
            return None
        if message is None:
            self.arrivals.idle(began_ns)
            if began_ns - self._present_ns > _PRESENCE_NS:
                self._must_be_there(bus)
                self._present_ns = began_ns
            return None
        span = self.arrivals.span(message.timestamp if self.stamped else None)
        if message.is_error_frame:
            self._note(message)
            return None
        key = (message.arbitration_id, message.is_extended_id)
        if message.is_remote_frame or (self._wanted is not None and key not in self._wanted):
            return None
        self.frames += 1
        return CanFrame(*key, bytes(message.data), span)

    def send(self, can_id: int, data: bytes, extended: bool = False) -> None:
        """Sends a frame; returns when the adapter has taken it.

        Raises:
            DeviceLostError: If the bus does not take it: gone, or nobody acknowledges.
        """
        if not self._may_send:
            raise DeviceLostError(self.device, f"{self.address} was opened for listening only")
        bus = self._bus
        if bus is None:
            raise DeviceLostError(self.device, "the bus is not open")
        frame = self._can.Message(arbitration_id=can_id, is_extended_id=extended, data=data)
        try:
            bus.send(frame, timeout=_SEND_S)
        except (self._can.CanError, OSError, ValueError) as error:
            raise DeviceLostError(
                self.device, f"{self.address} does not take what is sent (does anybody acknowledge?): {error}"
            ) from error

    def describe(self) -> str:
        """Returns the controller's state and the counts that are not zero."""
        counts = {"error frames": self.error_frames, "lines that are no frame": self.garbage}
        return ", ".join([self.state, *(f"{count} {what}" for what, count in counts.items() if count)])

    def _opened(self) -> can.BusABC:
        options = self.options
        more = dict(options.bus)
        if options.bitrate is not None:
            more["bitrate"] = options.bitrate
        if options.interface == "slcan":
            more["listen_only"] = not self._may_send if options.listen_only is None else options.listen_only
            more.setdefault("sleep_after_open", 0.05)
        filters = None
        if options.interface == "socketcan" and self._wanted is not None:  # the kernel does it
            filters = [
                {"can_id": can_id, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
                for can_id, extended in sorted(self._wanted)
            ]
        where = f"{self.device}: {self.address}"
        try:
            bus: can.BusABC = self._can.Bus(
                interface=options.interface,
                channel=options.channel,
                can_filters=filters,
                ignore_config=True,  # python-can would read files in the home folder and the environment
                **more,
            )
        except (NotImplementedError, ImportError) as error:
            raise DriverUnavailableError(self.device, f"{self.address}: {error}") from error
        except (ValueError, TypeError) as error:
            raise ConfigurationError(f"{where}: {error}") from error
        except self._can.CanError as error:
            if isinstance(error.__cause__, ValueError) and not isinstance(error.__cause__, OSError):
                raise ConfigurationError(f"{where}: {error}") from error
            raise DeviceNotFoundError(self.device, f"{self.address}: {error}") from error
        except OSError as error:
            if error.errno is None:  # as pcan says that its library is missing
                raise DriverUnavailableError(self.device, f"{self.address}: {error}") from error
            raise DeviceNotFoundError(self.device, f"{self.address}: {error}") from error
        except (NameError, AttributeError) as error:  # as kvaser does
            reason = f"the library of the interface's maker is missing ({error})"
            raise DriverUnavailableError(self.device, f"{self.address}: {reason}") from error
        return bus

    def _discard(self, bus: can.BusABC) -> None:
        self.garbage += 1
        flush = getattr(bus, "flush", None)
        if flush is not None:
            try:
                flush()
            except self._can.CanError as error:
                raise DeviceLostError(self.device, f"{self.address}: {error}") from error

    def _must_be_there(self, bus: can.BusABC) -> None:
        """Looks whether a silent bus is there at all: some interfaces go on returning nothing."""
        if any(event for _, event in self._poll.poll(0)):
            raise DeviceLostError(self.device, f"{self.address}: unplugged")
        if self.options.interface == "socketcan" and (why := missing_interface(str(self.options.channel))):
            raise DeviceLostError(self.device, why)
        if bus.state is self._can.BusState.ERROR:
            self.state = "bus-off"
            raise DeviceLostError(self.device, f"{self.address}: the controller is bus-off")

    def _note(self, message: can.Message) -> None:
        """Counts an error frame, and reads the controller's state from it.

        Raises:
            DeviceLostError: If the controller has left the bus.
        """
        self.error_frames += 1
        if self.options.interface not in _LINUX_ERROR_FRAMES:
            return
        kind = message.arbitration_id
        if kind & _RESTARTED:
            self.state = "error-active"
        if kind & _CONTROLLER and len(message.data) > 1:
            self.state = "error-passive" if message.data[1] & _PASSIVE else "error-active"
        if kind & _BUS_OFF:
            self.state = "bus-off"
            reason = "the controller is bus-off: too many errors; check bitrate, wiring and termination"
            raise DeviceLostError(self.device, f"{self.address}: {reason}")
