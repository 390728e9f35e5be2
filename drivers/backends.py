"""Which driver a configuration means: a table of factories, imported only when they are chosen."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from typing import Any

from drivers.errors import DriverUnavailableError
from drivers.interfaces import Clock
from surfclass.errors import ConfigurationError

KINDS = ("colour", "depth", "light", "arm")

# A factory is called as factory(name=, clock=, options=, shared=) and returns a device that is not open
# yet; it raises ConfigurationError for options that it does not know.
_TABLE = {
    ("colour", "sim"): "drivers.sim.backend:colour",
    ("colour", "aravis"): "drivers.colour_aravis:colour",
    ("colour", "iidc"): "drivers.colour_iidc:colour",
    ("colour", "v4l2"): "drivers.colour_v4l2:colour",
    ("depth", "sim"): "drivers.sim.backend:depth",
    ("depth", "openni2"): "drivers.depth_openni2:depth",
    ("light", "sim"): "drivers.sim.backend:light",
    ("light", "gardasoft"): "drivers.light_gardasoft:light",
    ("arm", "sim"): "drivers.sim.backend:arm",
    ("arm", "bcap"): "drivers.arm_bcap:arm",
    ("arm", "can"): "drivers.arm_can:dbc",
    ("arm", "canopen"): "drivers.arm_can:canopen",
}


def backends(kind: str) -> tuple[str, ...]:
    """Returns the backends that there are for a kind of device.

    Raises:
        ConfigurationError: If there is no such kind.
    """
    if kind not in KINDS:
        raise ConfigurationError(f"kind of device {kind!r}, allowed: {', '.join(KINDS)}")
    return tuple(backend for known, backend in _TABLE if known == kind)


def create(
    kind: str,
    backend: str,
    *,
    clock: Clock,
    name: str | None = None,
    options: Mapping[str, Any] | None = None,
    shared: dict[str, Any] | None = None,
) -> Any:
    """Returns the driver of a device, not open yet: what `drivers.interfaces` says of its kind.

    Args:
        kind: One of `KINDS`.
        backend: One of `backends(kind)`.
        clock: What its frames are stamped with.
        name: How messages call it; None: as its kind.
        options: The backend's own.
        shared: One dict for all devices of a package, for what a backend's devices have in common: a
            simulated world under "sim".

    Raises:
        ConfigurationError: For an unknown kind or backend, with those that are known and the nearest
            one, and for options that the backend does not know.
        DriverUnavailableError: If the backend's library is not installed.
    """
    known = backends(kind)
    if backend not in known:
        near = difflib.get_close_matches(backend, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ConfigurationError(f"{kind}.backend: {backend!r}, allowed: {', '.join(known)}{hint}")
    module, _, factory = _TABLE[kind, backend].partition(":")
    try:
        make = getattr(importlib.import_module(module), factory)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("drivers", "surfclass"):
            raise
        raise DriverUnavailableError(
            name or kind,
            f"backend {backend!r} needs the library {error.name!r}; install the package that has it",
        ) from error
    return make(
        name=name or kind,
        clock=clock,
        options={} if options is None else options,
        shared={} if shared is None else shared,
    )
