"""Makes simulated devices for the table of backends; they share the world in `shared["sim"]`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.interfaces import Clock
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError


def colour(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> SimColourCamera:
    """A simulated colour camera."""
    return SimColourCamera(_world(name, clock, options, shared))


def depth(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> SimDepthCamera:
    """A simulated depth camera."""
    return SimDepthCamera(_world(name, clock, options, shared))


def light(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> SimLight:
    """A simulated light."""
    return SimLight(_world(name, clock, options, shared))


def arm(*, name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> SimArm:
    """A simulated arm."""
    return SimArm(_world(name, clock, options, shared))


def _world(name: str, clock: Clock, options: Mapping[str, Any], shared: dict[str, Any]) -> SimWorld:
    if options:
        raise ConfigurationError(f"{name}: options {', '.join(options)}; the sim backend has none: see [sim]")
    world = shared.get("sim")
    if not isinstance(world, SimWorld):
        raise ConfigurationError(f"{name}: the sim backend needs a simulated world in shared['sim']")
    if clock is not world.clock:
        raise ConfigurationError(f"{name}: simulated devices live by their world's clock")
    return world
