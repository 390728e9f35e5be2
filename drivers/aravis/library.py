"""A thin, typed face of Aravis 0.8 by PyGObject; the one module that imports either.

Calls block for as long as Aravis lets them: a register of a GigE camera that is gone takes 2.5 s, dropping
its stream and its camera 5 s each. `drivers.aravis.control` keeps that from callers. Aravis writes numbers
that do not fit without a word (an exposure of 10¹² µs becomes 3.6 s): look at `bounds` first.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from drivers.errors import DriverUnavailableError

if TYPE_CHECKING:
    from collections.abc import Iterator

Value = bool | int | float | str
Kind = Literal["boolean", "integer", "float", "text"]

# Codes of ArvDeviceError.
_FEATURE_NOT_FOUND, _NOT_CONNECTED, _TRANSFER, _TIMEOUT, _NOT_FOUND, _NOT_CONTROLLER, _DENIED = (
    *(1, 2, 4, 5, 6),
    *(10, 17),
)


class GenicamError(Exception):
    """A call of Aravis failed.

    Attributes:
        gone: The camera did not answer, or is not there.
        denied: Another application controls it.
        missing: It has no such feature.
    """

    def __init__(self, message: str, code: int | None = None) -> None:
        super().__init__(message)
        self.gone = code in (_NOT_CONNECTED, _TRANSFER, _TIMEOUT, _NOT_FOUND)
        self.denied = code in (_NOT_CONTROLLER, _DENIED)
        self.missing = code == _FEATURE_NOT_FOUND


@dataclass(frozen=True, slots=True)
class Found:
    """A camera that answered the search.

    Attributes:
        id: What `Library.open` takes.
        serial: Its serial number; likewise `model`.
        address: Of its network interface, or its USB path.
    """

    id: str
    serial: str
    model: str
    address: str


class Library:
    """Aravis, loaded.

    Args:
        device: The name of the device, for errors.

    Raises:
        DriverUnavailableError: If a package is missing; the message names it.
    """

    def __init__(self, device: str) -> None:
        try:
            gi = importlib.import_module("gi")
            gi.require_version("Aravis", "0.8")
            self._aravis: Any = importlib.import_module("gi.repository.Aravis")
            self._error: Any = importlib.import_module("gi.repository.GLib").Error
        except ModuleNotFoundError as error:
            raise DriverUnavailableError(
                device,
                f"PyGObject is missing; install surfclass[aravis], which needs libgirepository1.0-dev and "
                f"libcairo2-dev to build ({error})",
            ) from error
        except (ImportError, ValueError) as error:  # gi says by ValueError that a namespace is missing
            raise DriverUnavailableError(
                device, f"Aravis is missing; install the package gir1.2-aravis-0.8 ({error})"
            ) from error
        self.version = f"Aravis 0.8, PyGObject {gi.__version__}"  # Debian 12's does not tell the rest

    def search(self) -> list[Found]:
        """Returns all cameras that answer within a second."""
        aravis = self._aravis
        aravis.update_device_list()
        return [
            Found(
                aravis.get_device_id(n),
                aravis.get_device_serial_nbr(n) or "",
                aravis.get_device_model(n) or "",
                aravis.get_device_address(n) or "",
            )
            for n in range(aravis.get_n_devices())
        ]

    def open(self, where: str) -> Camera:
        """Returns a camera by its id, or a GigE camera by its network address.

        Raises:
            GenicamError: If it is not there, does not answer, or is no GenICam camera.
        """
        with self._errors():
            return Camera(self._aravis.Camera.new(where), self._aravis, self._errors)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except self._error as error:
            code = error.code if error.domain == "arv-device-error-quark" else None
            raise GenicamError(error.message, code) from error


class Camera:
    """An open camera; its methods raise GenicamError. Made by `Library.open`."""

    def __init__(self, camera: Any, aravis: Any, errors: Callable[[], Any]) -> None:
        self._camera, self._aravis, self._errors = camera, aravis, errors
        self._device = camera.get_device()
        self._classes: tuple[tuple[Kind, Any], ...] = (
            ("boolean", aravis.GcBoolean),
            ("text", (aravis.GcEnumeration, aravis.GcString, aravis.GcStringRegNode)),
            ("float", aravis.GcFloat),
            ("integer", aravis.GcInteger),
        )

    @property
    def transport(self) -> str:
        """How it is connected."""
        if self._camera.is_gv_device():
            return "GigE Vision"
        return "USB3 Vision" if self._camera.is_uv_device() else "GenICam"

    @property
    def is_controlled(self) -> bool:
        """Whether this application may write to it; a USB camera is opened by one alone."""
        return not self._camera.is_gv_device() or bool(self._device.is_controller())

    def on_loss(self, handler: Callable[[], None]) -> None:
        """Has `handler` called, from a thread of Aravis, when the camera no longer heeds this application."""
        self._device.connect("control-lost", lambda _: handler())

    def has(self, feature: str) -> bool:
        """Whether a feature is there and can be used as other features are set now."""
        with self._errors():
            return bool(self._camera.is_feature_available(feature))

    def kind(self, feature: str) -> Kind | None:
        """What a feature holds; "text" for an enumeration; None for a command, and where there is none."""
        node = self._device.get_feature(feature)
        return next((kind for kind, classes in self._classes if isinstance(node, classes)), None)

    def read(self, feature: str) -> Value:
        """Returns a feature's value."""
        kind = self.kind(feature)
        with self._errors():
            match kind:
                case "boolean":
                    return bool(self._camera.get_boolean(feature))
                case "float":
                    return float(self._camera.get_float(feature))
                case "integer":
                    return int(self._camera.get_integer(feature))
                case _:
                    return str(self._camera.get_string(feature))

    def write(self, feature: str, value: Value) -> None:
        """Sets a feature, by the type that it has."""
        kind = self.kind(feature)
        with self._errors():
            match kind:
                case "boolean":
                    self._camera.set_boolean(feature, bool(value))
                case "float":
                    self._camera.set_float(feature, float(value))
                case "integer":
                    self._camera.set_integer(feature, int(value))
                case _:
                    self._camera.set_string(feature, str(value))

    def execute(self, command: str) -> None:
        """Executes a command."""
        with self._errors():
            self._camera.execute_command(command)

    def bounds(self, feature: str) -> tuple[float, float]:
        """Returns least and greatest value of a number as other features are set now."""
        with self._errors():
            if self.kind(feature) == "float":
                low, high = self._camera.get_float_bounds(feature)
            else:
                low, high = self._camera.get_integer_bounds(feature)
        return low, high

    def step(self, feature: str) -> int:
        """Returns the increment of an integer, at least 1."""
        with self._errors():
            return max(1, int(self._camera.get_integer_increment(feature)))

    def choices(self, feature: str) -> tuple[str, ...]:
        """Returns the entries of an enumeration that can be chosen now."""
        with self._errors():
            return tuple(self._camera.dup_available_enumerations_as_strings(feature))

    def set_packet_bytes(self, size: int) -> None:
        """Sets the size of a GigE camera's image packets, IP header included."""
        with self._errors():
            self._camera.gv_set_packet_size(size)

    def stream(self, buffers: int) -> Stream:
        """Returns a stream with memory for as many frames of the present size."""
        with self._errors():
            size = self._camera.get_payload()
            stream = self._camera.create_stream(None, None)
        for _ in range(buffers):
            stream.push_buffer(self._aravis.Buffer.new_allocate(size))
        return Stream(stream, self._aravis.BufferStatus.SUCCESS)

    def close(self) -> None:
        """Gives up control and lets go of the camera; nothing else may be called then.

        An explicit end: what a traceback still refers to must not keep the camera busy.
        """
        self._device = self._camera = None


@dataclass(frozen=True, slots=True)
class Buffer:
    """A frame as it came.

    Attributes:
        complete: Whether every packet came; if not, `content` is empty.
        status: Of Aravis, such as "timeout" or "missing-packets".
        frame_id: The device's counter.
        device_ns: The device's time stamp; 0 if it gives none.
        host_wall_ns: When its first packet came, host wall clock.
        size: Width and height.
        content: The pixels, a copy.
    """

    complete: bool
    status: str
    frame_id: int
    device_ns: int
    host_wall_ns: int
    size: tuple[int, int]
    content: bytes


class Stream:
    """Frames of one camera. Made by `Camera.stream`."""

    def __init__(self, stream: Any, success: Any) -> None:
        self._stream, self._success = stream, success

    def pop(self, timeout_s: float) -> Buffer | None:
        """Returns the oldest frame not seen yet, or None if there is none within `timeout_s`."""
        buffer = self._stream.timeout_pop_buffer(max(0, round(timeout_s * 1e6)))
        if buffer is None:
            return None
        try:
            status = buffer.get_status()
            complete = status == self._success
            return Buffer(
                complete,
                status.value_nick,
                buffer.get_frame_id(),
                buffer.get_timestamp(),
                buffer.get_system_timestamp(),
                (buffer.get_image_width(), buffer.get_image_height()) if complete else (0, 0),
                buffer.get_image_data() if complete else b"",
            )
        finally:
            self._stream.push_buffer(buffer)

    def drop_all(self) -> int:
        """Forgets the frames that are there, and returns how many."""
        count = 0
        while (buffer := self._stream.try_pop_buffer()) is not None:
            self._stream.push_buffer(buffer)
            count += 1
        return count

    def close(self) -> None:
        """Ends the stream; nothing else may be called then."""
        self._stream = None
