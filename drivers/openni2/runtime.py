"""The runtime: libOpenNI2 with only the driver plug-ins that were chosen, and what it tells of devices.

libOpenNI2 loads whatever lies in `OpenNI2/Drivers` beside the path that it was itself loaded from. That is
a private folder with links, which exists only while the runtime starts: nothing is left behind by a
process that is killed.
"""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable
from ctypes import POINTER, byref, c_int, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.openni2 import api, plugins
from drivers.openni2.api import Api
from drivers.openni2.errors import HangingError, OpenNI2Error, PluginMissingError

_in_use = threading.Lock()
_loaded: tuple[Api, Path] | None = None  # for the life of the process, as is the library's own state


@dataclass(frozen=True)
class Listed:
    """A device as the runtime lists it."""

    uri: str
    vendor: str
    name: str


class Runtime:
    """libOpenNI2, started with the chosen driver plug-ins; close() unloads them.

    Its state is the process's: there is one at a time.

    Args:
        drivers: Names out of `plugins.OWN` and `plugins.SYSTEM`.
        on_disconnect: Called with the URI of each device that goes, from a thread of the runtime.

    Raises:
        PluginMissingError: If the library or a plug-in is missing or cannot be loaded.
        OpenNI2Error: If the runtime does not start, or is in use by something else in this process.
        HangingError: If it hangs in this process.
    """

    def __init__(self, drivers: Iterable[str], on_disconnect: Callable[[str], None] | None = None) -> None:
        if _loaded is not None and _loaded[0].hangs:
            raise HangingError("OpenNI2", api.Status.ERROR, "the library hangs in this process")
        if not _in_use.acquire(blocking=False):
            raise OpenNI2Error("OpenNI2", api.Status.OUT_OF_FLOW, "another camera of this process uses it")
        self._callback: c_void_p | None = None
        try:
            self.api = _started({name: plugins.find(name) for name in drivers})
            self._listen(on_disconnect)
        except BaseException:
            _in_use.release()
            raise
        self._open = True

    def close(self) -> None:
        """Stops listening and unloads the plug-ins; devices must be closed before. May be called twice.

        Raises:
            OpenNI2Error: If the library does not come back; then it stays in use.
        """
        if not self._open:
            return
        self._open = False
        self._stop_listening()
        self.api.call("Shutdown")
        _in_use.release()

    @property
    def version(self) -> str:
        """The library's, such as "2.2.0.33"."""
        told = self.api.call("GetVersion")
        return f"{told.major}.{told.minor}.{told.maintenance}.{told.build}"

    def devices(self) -> list[Listed]:
        """Returns the devices that are connected now.

        Raises:
            OpenNI2Error: If the runtime has no list.
        """
        first, count = POINTER(api.DeviceInfo)(), c_int()
        self.api.must("list of devices", "GetDeviceList", byref(first), byref(count))
        try:
            return [_listed(first[place]) for place in range(count.value)]
        finally:
            self.api.call("ReleaseDeviceList", first)

    def _listen(self, on_disconnect: Callable[[str], None] | None) -> None:
        def disconnected(info: Any, _: Any) -> None:
            if on_disconnect is not None:
                on_disconnect(_listed(info[0]).uri)

        # Kept: the runtime calls them for as long as they are registered.
        self._callbacks = api.DeviceCallbacks(
            api.DeviceCallback(lambda info, _: None),
            api.DeviceCallback(disconnected),
            api.StateCallback(lambda info, state, _: None),
        )
        handle = c_void_p()
        try:
            self.api.must("listening", "RegisterDeviceCallbacks", byref(self._callbacks), None, byref(handle))
        except OpenNI2Error:
            self.api.call("Shutdown")
            raise
        self._callback = handle

    def _stop_listening(self) -> None:
        handle, self._callback = self._callback, None
        if handle is not None:
            self.api.call("UnregisterDeviceCallbacks", handle)


def _listed(info: Any) -> Listed:
    uri, vendor, name = (text.decode(errors="replace") for text in (info.uri, info.vendor, info.name))
    return Listed(uri, vendor, name)


def _started(drivers: dict[str, Path]) -> Api:
    """Returns the library, initialised with these plug-ins."""
    global _loaded
    _must_load({name: path for name, path in drivers.items() if name in plugins.OWN})
    try:
        folder = _folder()
        try:
            _link(folder, drivers)
            if _loaded is None:
                _loaded = _load(folder / api.LIBRARY), folder
            _initialize(_loaded[0])
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise OpenNI2Error("a private folder for OpenNI2", api.Status.ERROR, str(error)) from None
    return _loaded[0]


def _initialize(library: Api) -> None:
    try:
        library.must("OpenNI2 does not start", "Initialize", api.API_VERSION)
    except OpenNI2Error:
        library.call(
            "Shutdown"
        )  # it counts starts, also those that fail, and takes the next for a repeated one
        raise


def _must_load(own: dict[str, Path]) -> None:
    for name, path in own.items():
        try:
            ctypes.CDLL(str(path))  # the runtime would leave it out in silence
        except OSError as error:
            hint = "; install the Debian package libfreenect0.5" if "libfreenect" in str(error) else ""
            raise PluginMissingError(f"the OpenNI2 plug-in {name} cannot be loaded: {error}{hint}") from None


def _folder() -> Path:
    if _loaded is None:
        return Path(tempfile.mkdtemp(prefix="surfclass-openni2-"))
    folder = _loaded[1]
    folder.mkdir(mode=0o700)  # refuses what another user put there meanwhile
    return folder


def _link(folder: Path, drivers: dict[str, Path]) -> None:
    (folder / api.LIBRARY).symlink_to(plugins.system_folder() / api.LIBRARY)
    where = folder / "OpenNI2" / "Drivers"
    where.mkdir(parents=True)
    for name, path in drivers.items():
        (where / f"lib{name}.so.0").symlink_to(path)


def _load(library: Path) -> Api:
    try:
        return Api(library)
    except (OSError, AttributeError) as error:
        raise PluginMissingError(f"{library.resolve()} cannot be used: {error}") from None
