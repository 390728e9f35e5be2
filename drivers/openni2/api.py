"""The C interface of libOpenNI2 2.2: numbers, structures and the signatures of its functions.

Source: OniCAPI.h, OniCTypes.h, OniCEnums.h and OniCProperties.h of libopenni2-dev 2.2.0.33. Nothing else
loads the library.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char, c_char_p, c_int, c_uint16, c_uint64, c_void_p
from enum import IntEnum
from pathlib import Path
from typing import Any

from drivers.openni2.call_thread import CallThread, HungError
from drivers.openni2.errors import HangingError, OpenNI2Error

API_VERSION = 2002  # major × 1000 + minor
MAX_TEXT = 256


class Status(IntEnum):
    """OniStatus."""

    OK = 0
    ERROR = 1
    NOT_IMPLEMENTED = 2
    NOT_SUPPORTED = 3
    BAD_PARAMETER = 4
    OUT_OF_FLOW = 5
    NO_DEVICE = 6
    TIME_OUT = 102


class Sensor(IntEnum):
    """OniSensorType."""

    IR = 1
    COLOUR = 2
    DEPTH = 3


class PixelFormat(IntEnum):
    """OniPixelFormat, as far as it is used here."""

    DEPTH_1_MM = 100
    DEPTH_100_UM = 101
    GRAY8 = 202
    GRAY16 = 203


class DeviceProperty(IntEnum):
    """ONI_DEVICE_PROPERTY_…."""

    FIRMWARE_VERSION = 0
    DRIVER_VERSION = 1
    SERIAL_NUMBER = 3
    IMAGE_REGISTRATION = 5
    PLAYBACK_SPEED = 100
    PLAYBACK_REPEAT_ENABLED = 101


class StreamProperty(IntEnum):
    """ONI_STREAM_PROPERTY_…."""

    CROPPING = 0
    HORIZONTAL_FOV = 1
    VERTICAL_FOV = 2
    VIDEO_MODE = 3
    MAX_VALUE = 4
    STRIDE = 6
    MIRRORING = 7
    NUMBER_OF_FRAMES = 8


class Version(ctypes.Structure):
    """OniVersion."""

    _fields_ = [("major", c_int), ("minor", c_int), ("maintenance", c_int), ("build", c_int)]


class VideoMode(ctypes.Structure):
    """OniVideoMode."""

    _fields_ = [("pixel_format", c_int), ("width", c_int), ("height", c_int), ("fps", c_int)]


class SensorInfo(ctypes.Structure):
    """OniSensorInfo."""

    _fields_ = [("sensor", c_int), ("mode_count", c_int), ("modes", POINTER(VideoMode))]


class DeviceInfo(ctypes.Structure):
    """OniDeviceInfo."""

    _fields_ = [
        ("uri", c_char * MAX_TEXT),
        ("vendor", c_char * MAX_TEXT),
        ("name", c_char * MAX_TEXT),
        ("usb_vendor", c_uint16),
        ("usb_product", c_uint16),
    ]


class Frame(ctypes.Structure):
    """OniFrame; its memory is the runtime's until it is released."""

    _fields_ = [
        ("data_size", c_int),
        ("data", c_void_p),
        ("sensor", c_int),
        ("timestamp_us", c_uint64),
        ("index", c_int),
        ("width", c_int),
        ("height", c_int),
        ("mode", VideoMode),
        ("cropping_enabled", c_int),
        ("crop_origin_x", c_int),
        ("crop_origin_y", c_int),
        ("stride", c_int),
    ]


DeviceCallback = ctypes.CFUNCTYPE(None, POINTER(DeviceInfo), c_void_p)
StateCallback = ctypes.CFUNCTYPE(None, POINTER(DeviceInfo), c_int, c_void_p)


class DeviceCallbacks(ctypes.Structure):
    """OniDeviceCallbacks; must live for as long as it is registered."""

    _fields_ = [
        ("connected", DeviceCallback),
        ("disconnected", DeviceCallback),
        ("state_changed", StateCallback),
    ]


_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "oniInitialize": (c_int, [c_int]),
    "oniShutdown": (None, []),
    "oniGetVersion": (Version, []),
    "oniGetExtendedError": (c_char_p, []),
    "oniGetDeviceList": (c_int, [POINTER(POINTER(DeviceInfo)), POINTER(c_int)]),
    "oniReleaseDeviceList": (c_int, [POINTER(DeviceInfo)]),
    "oniRegisterDeviceCallbacks": (c_int, [POINTER(DeviceCallbacks), c_void_p, POINTER(c_void_p)]),
    "oniUnregisterDeviceCallbacks": (None, [c_void_p]),
    "oniWaitForAnyStream": (c_int, [POINTER(c_void_p), c_int, POINTER(c_int), c_int]),
    "oniDeviceOpen": (c_int, [c_char_p, POINTER(c_void_p)]),
    "oniDeviceClose": (c_int, [c_void_p]),
    "oniDeviceGetInfo": (c_int, [c_void_p, POINTER(DeviceInfo)]),
    "oniDeviceGetSensorInfo": (POINTER(SensorInfo), [c_void_p, c_int]),
    "oniDeviceCreateStream": (c_int, [c_void_p, c_int, POINTER(c_void_p)]),
    "oniDeviceSetProperty": (c_int, [c_void_p, c_int, c_void_p, c_int]),
    "oniDeviceGetProperty": (c_int, [c_void_p, c_int, c_void_p, POINTER(c_int)]),
    "oniDeviceIsPropertySupported": (c_int, [c_void_p, c_int]),
    "oniStreamDestroy": (None, [c_void_p]),
    "oniStreamStart": (c_int, [c_void_p]),
    "oniStreamStop": (None, [c_void_p]),
    "oniStreamReadFrame": (c_int, [c_void_p, POINTER(POINTER(Frame))]),
    "oniStreamSetProperty": (c_int, [c_void_p, c_int, c_void_p, c_int]),
    "oniStreamGetProperty": (c_int, [c_void_p, c_int, c_void_p, POINTER(c_int)]),
    "oniStreamIsPropertySupported": (c_int, [c_void_p, c_int]),
    "oniFrameRelease": (None, [POINTER(Frame)]),
    "oniCreateRecorder": (c_int, [c_char_p, POINTER(c_void_p)]),
    "oniRecorderAttachStream": (c_int, [c_void_p, c_void_p, c_int]),
    "oniRecorderStart": (c_int, [c_void_p]),
    "oniRecorderStop": (None, [c_void_p]),
    "oniRecorderDestroy": (c_int, [POINTER(c_void_p)]),
}

LIBRARY = "libOpenNI2.so.0"


_CALL_S = 10.0  # no call takes long, but that for a wait, which says for how long


class Api:
    """The functions, typed, called in `call_thread`'s thread; other Python threads run meanwhile.

    Args:
        path: The library, under the path from which it is to look for `OpenNI2/Drivers`.

    Raises:
        OSError: If it cannot be loaded.
        AttributeError: If it is another library.
    """

    def __init__(self, path: Path) -> None:
        library = ctypes.CDLL(str(path))
        self._functions: dict[str, Any] = {}
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
            self._functions[name] = function
        self._thread = CallThread()

    def call(self, name: str, *arguments: Any, wait_s: float = 0.0) -> Any:
        """Returns what the function `oni<name>` returns.

        Args:
            name: The function's.
            arguments: As of C.
            wait_s: How long it may wait by itself.

        Raises:
            HangingError: If it or an earlier call does not come back.
        """
        return self._run(name, self._functions[f"oni{name}"], arguments, wait_s)

    def must(self, what: str, name: str, *arguments: Any) -> None:
        """Calls a function that returns a status.

        Raises:
            OpenNI2Error: "`what`: …" with the status and the runtime's own words, unless it is OK.
            HangingError: As `call`.
        """
        self.status(what, name, arguments, (Status.OK,))

    def status(
        self,
        what: str,
        name: str,
        arguments: tuple[Any, ...],
        allowed: tuple[Status, ...],
        wait_s: float = 0.0,
    ) -> Status:
        """Returns the status of such a function, one of those allowed.

        Raises:
            OpenNI2Error: As `must`.
            HangingError: As `call`.
        """
        function, words = self._functions[f"oni{name}"], self._functions["oniGetExtendedError"]

        def run() -> tuple[int, bytes]:
            status = function(*arguments)
            return status, b"" if status in allowed else words()  # the next call of anybody clears them

        status, told = self._run(name, run, (), wait_s)
        if status not in allowed:
            raise OpenNI2Error(what, status, " ".join((told or b"").decode(errors="replace").split()))
        return Status(status)

    @property
    def hangs(self) -> bool:
        """Whether a call has not come back: then none ever will in this process."""
        return self._thread.hangs

    def _run(self, name: str, function: Any, arguments: tuple[Any, ...], wait_s: float) -> Any:
        try:
            return self._thread.call(function, *arguments, timeout_s=wait_s + _CALL_S)
        except HungError:
            raise HangingError(f"oni{name}", Status.ERROR, "the library does not come back") from None
