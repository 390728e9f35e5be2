"""A thin binding of Aravis's own GigE Vision camera emulator, GvFakeCamera (libaravis 0.8, by ctypes).

Not by PyGObject: it frees the callback that fills the frames after its first call.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Callable
from ctypes import (
    CFUNCTYPE,
    POINTER,
    byref,
    c_char_p,
    c_double,
    c_int,
    c_size_t,
    c_uint8,
    c_uint32,
    c_uint64,
    c_void_p,
)
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverUnavailableError
from surfclass.errors import InputError

LIBRARY = "libaravis-0.8.so.0"
GVCP_PORT = 3956

_POLLS_HZ = 250.0  # how often a software trigger is looked for
_FILL = CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)
_SIDES = ("width", "height")
_FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_gv_fake_camera_new_full": (c_void_p, (c_char_p, c_char_p, c_char_p)),
    "arv_gv_fake_camera_is_running": (c_int, (c_void_p,)),
    "arv_gv_fake_camera_get_fake_camera": (c_void_p, (c_void_p,)),
    "arv_fake_camera_set_trigger_frequency": (None, (c_void_p, c_double)),
    "arv_fake_camera_set_fill_pattern": (None, (c_void_p, _FILL, c_void_p)),
    "arv_fake_camera_read_register": (c_int, (c_void_p, c_uint32, POINTER(c_uint32))),
    "arv_fake_camera_write_register": (c_int, (c_void_p, c_uint32, c_uint32)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_set_timestamp": (None, (c_void_p, c_uint64)),
    **{f"arv_buffer_get_part_{what}": (c_int, (c_void_p, c_uint32)) for what in _SIDES},
    "g_object_unref": (None, (c_void_p,)),
    "g_object_set": (None, (c_void_p, c_char_p, c_double, c_void_p)),
}


class FakeCamera:
    """A running emulator; one for each network address, since GigE Vision has one port.

    Args:
        address: Of a network interface of this host.
        serial: The camera's serial number, at most 15 characters.
        features: The GenICam description.
        frame: Called in the emulator's thread when a frame is to be sent; returns its device time, ns,
            and its bytes. Must not raise, nor take long: until it returns no command is answered.

    Raises:
        DriverUnavailableError: If Aravis is not installed.
        InputError: If the address is not of this host, or its port is taken.
    """

    def __init__(
        self,
        address: str,
        serial: str,
        features: Path,
        frame: Callable[[], tuple[int, NDArray[np.uint8]] | None],
    ) -> None:
        self._library = _loaded()
        _must_be_free(address)
        self._frame = frame
        self._filler = _FILL(self._fill)  # C keeps no reference to it
        self._camera: int | None = self._library.arv_gv_fake_camera_new_full(
            address.encode(), serial.encode(), str(features).encode()
        )
        if not self._library.arv_gv_fake_camera_is_running(self._camera):
            self.close()
            raise InputError(f"address {address}: no network interface of this host has it")
        self._registers = self._library.arv_gv_fake_camera_get_fake_camera(self._camera)
        self._library.arv_fake_camera_set_trigger_frequency(self._registers, _POLLS_HZ)
        self._library.arv_fake_camera_set_fill_pattern(self._registers, self._filler, None)

    def close(self) -> None:
        """Ends the emulator's thread, after the exposure under way; nothing else may be called then."""
        camera, self._camera = self._camera, None
        if camera is not None:
            self._library.g_object_unref(camera)

    def read(self, register: int) -> int:
        """Returns a register."""
        value = c_uint32()
        self._library.arv_fake_camera_read_register(self._registers, register, byref(value))
        return value.value

    def write(self, register: int, value: int) -> None:
        """Sets a register, without a client's knowing."""
        self._library.arv_fake_camera_write_register(self._registers, register, value)

    def write_text(self, register: int, text: str) -> None:
        """Sets the text that begins at a register, and ends it with a zero."""
        padded = text.encode() + bytes(4 - len(text.encode()) % 4)
        for n in range(0, len(padded), 4):
            self.write(register + n, int.from_bytes(padded[n : n + 4], "big"))

    def lose_packets(self, share: float) -> None:
        """From now on this share, 0…1, of all image packets is not sent."""
        self._library.g_object_set(self._camera, b"gvsp-lost-ratio", share, None)

    def _fill(self, buffer: int, _: int, exposure_us: int, gain: int, code: int) -> None:
        found = self._frame()
        if found is None:
            return
        ticks_ns, content = found
        self._library.arv_buffer_set_timestamp(buffer, ticks_ns)
        # The buffer's own idea of its size is 0 until it is filled; it was allocated for its format.
        width, height = (getattr(self._library, f"arv_buffer_get_part_{side}")(buffer, 0) for side in _SIDES)
        size = width * height * (code >> 16 & 0xFF) // 8
        data = self._library.arv_buffer_get_data(buffer, byref(c_size_t()))
        target = np.ctypeslib.as_array((c_uint8 * size).from_address(data))
        target[: content.size] = content[:size]
        target[content.size :] = 0  # of a region that leaves the sensor


def _loaded() -> Any:
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise DriverUnavailableError(
            "gige_camera", f"Aravis is missing; install the package libaravis-0.8-0 ({error})"
        ) from error
    for name, (result, arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _must_be_free(address: str) -> None:
    """The emulator would run without its port, deaf."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind((address, GVCP_PORT))
        except OSError as error:
            raise InputError(
                f"UDP port {GVCP_PORT} of {address} cannot be had ({error}); does another camera run there?"
            ) from error
