"""A thin binding of libdc1394 2.2 (Debian's libdc1394-25): IIDC cameras on USB 2 and FireWire.

Only what `drivers.colour_iidc` needs, and nothing that waits: frames are polled, and a caller waits on
`Camera.fileno` with a timeout of its own. `tests/test_iidc_binding.py` holds the structures and numbers
of `drivers.iidc.dc1394_types` against the C headers. After a camera was unplugged the library may crash or
hang in `capture_stop` and `close`: from then on call nothing of it, and end the process.
"""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Sequence
from ctypes import POINTER, byref, c_char_p, c_float, c_int, c_int32, c_uint32, c_uint64, c_void_p
from typing import Any

from drivers.iidc.dc1394_types import (
    CAPTURE_POLICY_POLL,
    FAILURE,
    IOCTL_FAILURE,
    LIBRARY,
    LOG_ERROR,
    LOG_WARNING,
    RAW1394_FAILURE,
    CameraInfo,
    CameraList,
    ColourCodings,
    Feature,
    FeatureInfo,
    FrameRates,
    VideoFrame,
    VideoModes,
)


class Dc1394Error(Exception):
    """A call of the library failed.

    Attributes:
        code: dc1394error_t.
    """

    def __init__(self, function: str, code: int, text: str) -> None:
        super().__init__(f"{function}: {text} ({code})")
        self.code = code

    @property
    def means_gone(self) -> bool:
        """Whether this is how a camera that no longer answers looks; else the request was wrong."""
        return self.code in (FAILURE, IOCTL_FAILURE, RAW1394_FAILURE)


_LogHandler = ctypes.CFUNCTYPE(None, c_int, c_char_p, c_void_p)
_CAMERA = POINTER(CameraInfo)
_FRAME = POINTER(VideoFrame)
_U32 = POINTER(c_uint32)

# What the calls take besides the camera; each returns dc1394error_t.
CALLS: dict[str, Sequence[Any]] = {
    "camera_get_platform_string": (POINTER(c_char_p),),
    "camera_get_node": (_U32, _U32),
    "camera_set_power": (c_int,),
    "get_control_registers": (c_uint64, _U32, c_uint32),
    "set_control_registers": (c_uint64, _U32, c_uint32),
    "get_strobe_register": (c_uint64, _U32),
    "set_strobe_register": (c_uint64, c_uint32),
    "video_get_supported_modes": (POINTER(VideoModes),),
    "video_get_supported_framerates": (c_int, POINTER(FrameRates)),
    "video_set_mode": (c_int,),
    "video_get_mode": (POINTER(c_int),),
    "video_set_framerate": (c_int,),
    "video_get_framerate": (POINTER(c_int),),
    "video_set_iso_speed": (c_int,),
    "video_set_transmission": (c_int,),
    "video_get_transmission": (POINTER(c_int),),
    "format7_get_color_codings": (c_int, POINTER(ColourCodings)),
    "format7_get_max_image_size": (c_int, _U32, _U32),
    "format7_get_unit_size": (c_int, _U32, _U32),
    "format7_get_unit_position": (c_int, _U32, _U32),
    "format7_get_packet_parameters": (c_int, _U32, _U32),
    "format7_get_color_filter": (c_int, POINTER(c_int)),
    "format7_get_roi": (c_int, POINTER(c_int), _U32, _U32, _U32, _U32, _U32),
    "format7_set_roi": (c_int, c_int, c_int32, c_int32, c_int32, c_int32, c_int32),
    "feature_get": (POINTER(FeatureInfo),),
    "feature_set_power": (c_int, c_int),
    "feature_set_mode": (c_int, c_int),
    "feature_set_value": (c_int, c_uint32),
    "feature_set_absolute_control": (c_int, c_int),
    "feature_set_absolute_value": (c_int, c_float),
    "external_trigger_set_power": (c_int,),
    "external_trigger_set_mode": (c_int,),
    "external_trigger_set_source": (c_int,),
    "external_trigger_set_polarity": (c_int,),
    "software_trigger_set_power": (c_int,),
    "software_trigger_get_power": (POINTER(c_int),),
    "capture_setup": (c_uint32, c_uint32),
    "capture_stop": (),
    "capture_dequeue": (c_int, POINTER(_FRAME)),
    "capture_enqueue": (_FRAME,),
}


class Library:
    """The loaded library with one context.

    Raises:
        OSError: If the library is not installed.
    """

    def __init__(self) -> None:
        lib = self._lib = ctypes.CDLL(LIBRARY)
        self._log: deque[str] = deque(maxlen=3)
        # Kept: the library holds it for as long as it is loaded, and calls it from its own thread too.
        self._on_log = _LogHandler(self._logged)
        for kind in (LOG_ERROR, LOG_WARNING):
            lib.dc1394_log_register_handler(c_int(kind), self._on_log, None)
        for name, arguments in CALLS.items():
            getattr(lib, f"dc1394_{name}").argtypes = (_CAMERA, *arguments)
        lib.dc1394_new.restype = c_void_p
        lib.dc1394_free.argtypes = (c_void_p,)
        lib.dc1394_free.restype = None
        lib.dc1394_camera_enumerate.argtypes = (c_void_p, POINTER(POINTER(CameraList)))
        lib.dc1394_camera_free_list.argtypes = (POINTER(CameraList),)
        lib.dc1394_camera_free_list.restype = None
        lib.dc1394_camera_new.argtypes = (c_void_p, c_uint64)
        lib.dc1394_camera_new.restype = _CAMERA
        lib.dc1394_camera_free.argtypes = (_CAMERA,)
        lib.dc1394_camera_free.restype = None
        lib.dc1394_error_get_string.argtypes = (c_int,)
        lib.dc1394_error_get_string.restype = c_char_p
        lib.dc1394_capture_get_fileno.argtypes = (_CAMERA,)
        lib.dc1394_capture_is_frame_corrupt.argtypes = (_CAMERA, _FRAME)
        self._context: int | None = lib.dc1394_new()

    def guids(self) -> list[int]:
        """Returns the cameras that are there and may be opened; none where there is no bus either."""
        if self._context is None:
            return []
        found = POINTER(CameraList)()
        self.must("dc1394_camera_enumerate", self._lib.dc1394_camera_enumerate(self._context, byref(found)))
        guids = [found[0].ids[n].guid for n in range(found[0].num)]
        self._lib.dc1394_camera_free_list(found)
        return guids

    def camera(self, guid: int) -> Camera:
        """Opens a camera.

        Raises:
            Dc1394Error: If it went away or another program holds it.
        """
        handle = self._lib.dc1394_camera_new(self._context, guid)
        if not handle:
            raise Dc1394Error("dc1394_camera_new", FAILURE, self._heard() or "it could not be opened")
        return Camera(self, self._lib, handle)

    def close(self) -> None:
        """Frees the context, once every camera of it is closed."""
        if self._context is not None:
            self._lib.dc1394_free(self._context)
        self._context = None

    def must(self, function: str, code: int) -> None:
        """Raises Dc1394Error for a code that is not success."""
        if code != 0:
            said = self._lib.dc1394_error_get_string(code) or b"unknown error"
            heard = self._heard()
            raise Dc1394Error(function, code, heard or said.decode(errors="replace"))

    def _heard(self) -> str:
        """What the library logged since the last error: what it was about, first."""
        heard = "; ".join(self._log)
        self._log.clear()
        return heard

    def _logged(self, _kind: int, message: bytes | None, _user: object) -> None:
        self._log.append((message or b"").decode(errors="replace").strip())


class Camera:
    """An open camera. `call(name, …)` is dc1394_<name>(camera, …) and raises Dc1394Error."""

    def __init__(self, library: Library, lib: ctypes.CDLL, handle: Any) -> None:
        self._library, self._lib, self._handle = library, lib, handle
        self._frame = _FRAME()
        info = handle[0]
        self.guid: int = info.guid
        self.vendor: str = (info.vendor or b"").decode(errors="replace")
        self.model: str = (info.model or b"").decode(errors="replace")
        self.vendor_id: int = info.vendor_id
        self.strobe_offset: int = info.strobe_control_csr
        self.can_switch_on_off = bool(info.can_switch_on_off)

    def call(self, name: str, *arguments: Any) -> None:
        """Calls dc1394_<name>.

        Raises:
            Dc1394Error: If it fails.
        """
        function: Callable[..., int] = getattr(self._lib, f"dc1394_{name}")
        self._library.must(f"dc1394_{name}", function(self._handle, *arguments))

    def number(self, name: str, *arguments: Any) -> int:
        """Calls dc1394_<name>, whose last argument is an int that it fills in, and returns that."""
        value = c_int()
        self.call(name, *arguments, byref(value))
        return value.value

    def pair(self, name: str, *arguments: Any) -> tuple[int, int]:
        """Calls dc1394_<name>, whose last two arguments are uint32 that it fills in."""
        first, second = c_uint32(), c_uint32()
        self.call(name, *arguments, byref(first), byref(second))
        return first.value, second.value

    def read(self, offset: int) -> int:
        """Returns the command register at this offset from the command base (CSR map of IIDC 1.31)."""
        value = c_uint32()
        self.call("get_control_registers", offset, byref(value), 1)
        return value.value

    def write(self, offset: int, value: int) -> None:
        """Writes the command register at this offset."""
        self.call("set_control_registers", offset, byref(c_uint32(value)), 1)

    def feature(self, feature: Feature) -> FeatureInfo:
        """Returns what the camera says of a feature: whether it has it, its limits, mode and value."""
        info = FeatureInfo(id=feature)
        self.call("feature_get", byref(info))
        return info

    def listed(self, name: str, *arguments: Any, into: Any) -> list[int]:
        """Calls dc1394_<name>, whose last argument is a structure of a count and an array."""
        self.call(name, *arguments, byref(into))
        (_, _), (array, _) = into._fields_
        return list(getattr(into, array)[: into.num])

    def region(self, mode: int) -> tuple[int, ...]:
        """Returns Format_7's coding, packet size in bytes, and left, top, width, height in pixels."""
        coding, rest = c_int(), [c_uint32() for _ in range(5)]
        self.call("format7_get_roi", mode, byref(coding), *map(byref, rest))
        return (coding.value, *(value.value for value in rest))

    def platform(self) -> str:
        """Returns which of its buses the library reaches the camera by: "usb" or "juju" (FireWire)."""
        name = c_char_p()
        self.call("camera_get_platform_string", byref(name))
        return (name.value or b"").decode()

    def fileno(self) -> int:
        """Returns a descriptor that is readable while a frame waits; -1 without a capture."""
        return int(self._lib.dc1394_capture_get_fileno(self._handle))

    def take(self) -> bytes | None:
        """Returns the oldest image in the ring and gives its buffer back; does not wait.

        Returns:
            The image without padding; empty for a frame that came short or damaged; None where the ring
            has none.

        Raises:
            Dc1394Error: If the camera is gone, or the ring broke.
        """
        self.call("capture_dequeue", CAPTURE_POLICY_POLL, byref(self._frame))
        if not self._frame:
            return None
        frame = self._frame[0]
        corrupt = self._lib.dc1394_capture_is_frame_corrupt(self._handle, self._frame)
        image = b"" if corrupt else ctypes.string_at(frame.image, frame.image_bytes)
        self.call("capture_enqueue", self._frame)
        return image

    def close(self) -> None:
        """Frees the camera, after its capture was stopped."""
        self._lib.dc1394_camera_free(self._handle)
