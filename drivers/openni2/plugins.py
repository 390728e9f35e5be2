"""Where OpenNI2's library and driver plug-ins are: the system's, and those that `build` made."""

from __future__ import annotations

import functools
import hashlib
import re
import sys
import sysconfig
from pathlib import Path

from drivers.openni2.api import LIBRARY
from drivers.openni2.errors import PluginMissingError

OWN = ("kinect1", "virtual")
SYSTEM = ("OniFile", "PS1080", "PSLink", "DummyDevice")
SOURCES = Path(__file__).with_name("src")
BUILD = "python -m drivers.openni2.build"
_MARK = re.compile(rb"surfclass-plugin:([0-9a-f]{16})-([0-9a-f]{16})")


def build_folder() -> Path:
    """Returns where built plug-ins live: in the installation, where a service may read and not write."""
    return Path(sys.prefix) / "lib" / "surfclass" / "openni2"


@functools.cache
def system_folder() -> Path:
    """Returns the folder of the system's libOpenNI2.

    Raises:
        PluginMissingError: If it is not installed.
    """
    multiarch = sysconfig.get_config_var("MULTIARCH") or ""
    folders = (Path("/usr/lib", multiarch), Path("/usr/lib"), Path("/usr/local/lib"), Path("/usr/lib64"))
    for folder in folders:
        if (folder / LIBRARY).is_file():
            return folder
    raise PluginMissingError(f"{LIBRARY} is not installed; install the Debian package libopenni2-0")


def sources_digest(name: str) -> str:
    """Returns a digest of what the plug-in is built from in this project."""
    digest = hashlib.sha256()
    for path in (SOURCES / "frame_stream.hpp", SOURCES / f"{name}.cpp"):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def built_of(path: Path) -> tuple[str, str] | None:
    """Returns the digests of sources and system headers that a built plug-in carries; None: it is none."""
    try:
        mark = _MARK.search(path.read_bytes())
    except OSError:
        return None
    return None if mark is None else (mark[1].decode(), mark[2].decode())


def find(name: str) -> Path:
    """Returns the file of a driver plug-in.

    Args:
        name: One of `OWN` or `SYSTEM`.

    Raises:
        PluginMissingError: If it is not there, or was built of other sources; the message says what to do.
    """
    if name in SYSTEM:
        path = system_folder() / "OpenNI2" / "Drivers" / f"lib{name}.so.0"
        if not path.is_file():
            raise PluginMissingError(f"{path} is missing; install the Debian package libopenni2-0")
        return path
    path = build_folder() / f"lib{name}.so.0"
    built = built_of(path)
    if built is None:
        raise PluginMissingError(f"the OpenNI2 plug-in {path} is not built, or cannot be read; run: {BUILD}")
    if built[0] != sources_digest(name):
        raise PluginMissingError(f"the OpenNI2 plug-in {path} was built of another version; run: {BUILD}")
    return path
