"""Builds the service and its parts from the configuration; the only place that knows all of them."""

from __future__ import annotations

import logging
import os
import queue
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh

from calibration.rig_file import rig_text
from calibration.store import Store
from daemon import logs
from daemon.acquisition import Acquisition, Shot
from daemon.config import RELOADABLE, Config, SimSettings, TriggerSettings
from daemon.notify import notify
from daemon.publisher import MapPublisher
from daemon.requests import RequestQueue
from daemon.service import EXIT_FAILED, Service
from daemon.sink import open_sink
from daemon.transport import MapMeta, TransportError, open_session
from drivers import backends
from drivers.capture_source import (
    CaptureSource,
    IntervalTrigger,
    LiveSource,
    RequestTrigger,
    RestTrigger,
    Trigger,
)
from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.files import read_file
from drivers.interfaces import Clock, Light
from drivers.recordings import Recording
from drivers.recordings.replay import RecordingSource
from drivers.sensor_package import SensorPackage, SensorSettings
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import MAP_ROLES
from surfclass.kinematics import forward_kinematics
from surfclass.map_file import to_npz_bytes
from surfclass.model import Model
from surfclass.pipeline import Pipeline, PipelineSettings
from surfclass.rig import DepthRig, Rig, parse_depth_rig
from surfclass.wire import encode_update

if TYPE_CHECKING:
    from drivers.sim.world import SimWorld

logger = logging.getLogger("surfclass.wiring")

_SIMULATED_S = 120.0


@dataclass(frozen=True, eq=False)
class Sensors:
    """The configured devices, closed, and the package that captures with all of them.

    Attributes:
        clock: Theirs; the host's, or the simulated world's.
        devices: By kind.
        package: Opens and closes all of them.
        device_s: Timeout of one call.
        world: The simulated world, or None.
    """

    clock: Clock
    devices: dict[str, Any]
    package: SensorPackage
    device_s: float
    world: SimWorld | None


def build_sensors(config: Config, with_ir: bool = False) -> Sensors:
    """Returns the configured devices; none is opened yet.

    Args:
        config: What to build.
        with_ir: Whether captures keep the IR image.

    Raises:
        ConfigurationError: If a backend or an option is unknown, or a needed device is missing.
        DriverUnavailableError: If a vendor library is missing.
    """
    missing = [kind for kind in ("colour", "depth") if kind not in config.devices]
    if missing:
        raise ConfigurationError(f"no [{'] and no ['.join(missing)}] table: there is nothing to capture with")
    clock: Clock = SystemClock()
    world = build_world(config) if config.simulated else None
    shared: dict[str, object] = {}
    if world is not None:
        clock, shared["sim"] = world.clock, world
    devices: dict[str, Any] = {}
    for kind, device in config.devices.items():
        devices[kind] = backends.create(
            kind, device.backend, name=kind, clock=clock, options=device.options, shared=shared
        )
    return Sensors(
        clock, devices, build_package(config, clock, devices, with_ir), config.limits.device_s, world
    )


def build_package(
    config: Config, clock: Clock, devices: Mapping[str, Any], with_ir: bool = False
) -> SensorPackage:
    """Returns the sensor package of these devices, which takes captures as configured."""
    seconds = config.limits.device_s
    settings = SensorSettings(
        light_level=config.capture.level,
        max_skew_s=config.capture.max_skew_s,
        colour_timeout_s=seconds,
        depth_timeout_s=seconds,
        joints_timeout_s=seconds,
        with_ir=with_ir,
    )
    light, arm = devices.get("light"), devices.get("arm")
    return SensorPackage(clock, devices["colour"], devices["depth"], light, arm, settings)


def build_world(config: Config) -> SimWorld:
    """Returns the simulated world of [sim], its arm about to visit the scene's viewpoints.

    Raises:
        ConfigurationError: If the scene, a number or a fault cannot be.
    """
    from drivers.sim import scenes
    from drivers.sim.clock import SimClock
    from drivers.sim.faults import Fault, Faults
    from drivers.sim.world import SimWorld

    sim = config.sim or SimSettings()
    faults = [Fault(**fault.model_dump(exclude_none=True)) for fault in sim.faults]
    return SimWorld(
        sim.scene,
        sim.seed,
        SimClock(sim.realtime),
        Faults(tuple(faults)),
        scale=sim.scale,
        program=scenes.spread(sim.scene, sim.viewpoints),
        ambient=sim.ambient,
    )


def build_pipeline(config: Config) -> Pipeline:
    """Returns the pipeline of the configured rig, or of the replayed recording's, and the model.

    Raises:
        InputError: If the recording cannot be read.
        ConfigurationError: If a file is missing or not valid, or they do not fit each other.
    """
    rig = rig_of(config)[1]
    model = Model.from_bytes(_read(config.model, "model"), str(config.model))
    if config.replay is not None:
        model.check(rig, Recording.open(config.replay).classes)
    return Pipeline(rig, model, PipelineSettings(config.pipeline.update, config.pipeline.pool))


def rig_of(config: Config) -> tuple[str, Rig]:
    """Returns the text of the rig and the rig, which is whole.

    Raises:
        InputError, ConfigurationError: As `build_pipeline`.
    """
    text, rig = depth_rig_of(config)
    return text, rig.whole()


def depth_rig_of(config: Config) -> tuple[str, DepthRig]:
    """Returns the rig as far as it is known, and its text: the recording's own where one is replayed.

    Otherwise it is the configured one with the results of commissioning on top.

    Raises:
        InputError, ConfigurationError: As `build_pipeline`.
    """
    if config.replay is not None:
        recording = Recording.open(config.replay)
        return recording.rig_text, recording.depth_rig
    if config.rig is None:
        raise ConfigurationError("rig is missing (only a replayed recording brings its own)")
    data = _read(config.rig, "rig")
    rig = parse_depth_rig(data, str(config.rig))
    if config.calibration is None:
        return data.decode(errors="replace"), rig
    try:
        values = Store(config.calibration.directory).values()
    except InputError as error:
        raise ConfigurationError(str(error)) from None
    if not values:
        return data.decode(errors="replace"), rig
    rig = rig.with_values(values)
    return rig_text(rig), rig


def _read(path: Path, what: str) -> bytes:
    """The bytes of a file that the configuration names: without it the service cannot ever start."""
    try:
        return read_file(path, what)
    except InputError as error:
        raise ConfigurationError(str(error)) from None


def build_trigger(settings: TriggerSettings) -> Trigger:
    """Returns the configured trigger; requests are taken with every one of them."""
    if settings.rest is not None:
        return RestTrigger(settings.rest.rest_s, settings.rest.still_rad, settings.rest.moved_rad)
    return RequestTrigger() if settings.interval_s is None else IntervalTrigger(settings.interval_s)


def build_source(config: Config, sensors: Sensors, first_number: int = 1) -> LiveSource:
    """Returns the sensors as a source of captures, triggered as configured."""
    return LiveSource(
        build_package(config, sensors.clock, sensors.devices),
        build_trigger(config.trigger),
        sensors.clock,
        with_dark=config.capture.dark,
        first_number=first_number,
    )


def open_zenoh(config: Config) -> zenoh.Session:
    """Returns the session of [zenoh].

    Raises:
        ConfigurationError: If a setting is not one.
        TransportError: If an endpoint cannot be reached or listened on.
    """
    told = config.zenoh
    listen = () if told.mode == "client" else told.listen
    return open_session(told.mode, listen, told.connect, told.settings)


def build_service(
    config: Config,
    session: zenoh.Session,
    *,
    load: Callable[[], Config] | None = None,
    exit_when_done: bool = False,
) -> Service:
    """Returns the service, wired and not started.

    Args:
        config: What to build.
        session: An open Zenoh session; it stays the caller's to close.
        load: Reads the configuration again on a reload; None: a reload only clears faults.
        exit_when_done: Stop at the end of the replayed recording.

    Raises:
        InputError, ConfigurationError: If anything cannot be used as it stands.
        DriverUnavailableError: If a vendor library is missing.
    """
    if config.map is not None and not config.map.parent.is_dir():
        raise ConfigurationError(f"map: there is no folder {config.map.parent}")
    pipeline = build_pipeline(config)
    sensors = build_sensors(config) if config.replay is None else None
    if sensors is not None and "arm" in sensors.devices:
        # Loads and builds the arm's model now, and not with the first capture.
        forward_kinematics(np.zeros(6), pipeline.rig.arm.flange_offset_m)
    world = None if sensors is None else sensors.world
    sink = None
    if sensors is not None:  # what comes from a recording is recorded already
        sink = open_sink(config, rig_of(config)[0], pipeline.model.classes, pipeline.map.epoch)
    requests = RequestQueue(config.limits.waiting_requests, config.limits.request_s)
    shots: queue.Queue[Shot] = queue.Queue(config.limits.waiting_captures)
    source: CaptureSource
    if sensors is None:
        assert config.replay is not None
        source = RecordingSource(config.replay, SystemClock(), roles=MAP_ROLES)
    else:
        source = build_source(config, sensors)
    jump = world.clock.sleep if world is not None and not world.clock.realtime else None
    acquisition = Acquisition(
        source, requests, shots, dark=config.capture.dark, finite=config.replay is not None, jump=jump
    )
    limits = config.limits
    if world is not None:
        # A simulated exposure is computed, and the first one bakes all textures: slow, but no hang.
        slow = {name: max(_SIMULATED_S, getattr(limits, name)) for name in ("heartbeat_s", "stop_s")}
        limits = limits.model_copy(update=slow)
    meta = MapMeta.of(pipeline.map).model_dump()
    publisher = MapPublisher(session, config.robot, meta, pipeline.map.snapshot)
    service = Service(
        acquisition=acquisition,
        pipeline=pipeline,
        publisher=publisher,
        requests=requests,
        shots=shots,
        limits=limits,
        robot=config.robot,
        sink=sink,
        encode=encode_update,
        map_bytes=partial(to_npz_bytes, pool=config.pipeline.pool),
        map_path=config.map,
        devices=None if sensors is None else partial(_devices_told, config, sensors),
        program_done=None if world is None else lambda: world.program_done,
        reload=None if load is None else Reload(config, load, acquisition, sensors),
        exit_when_done=exit_when_done,
    )
    # One more than may wait, so that the next one hears at once that the robot is busy.
    publisher.serve("capture", service.capture, threads=config.limits.waiting_requests + 1)
    return service


def _devices_told(config: Config, sensors: Sensors) -> dict[str, Any]:
    """What the status says of each device: its backend, whether it is open, its process if it has one."""
    return {
        kind: {
            "backend": config.devices[kind].backend,
            "open": device.is_open,
            "process": getattr(device, "pid", None),
        }
        for kind, device in sensors.devices.items()
    }


class Reload:
    """Reads the configuration again and takes over what can change under way."""

    def __init__(
        self,
        config: Config,
        load: Callable[[], Config],
        acquisition: Acquisition,
        sensors: Sensors | None,
    ) -> None:
        self._config, self._load = config, load
        self._acquisition, self._sensors = acquisition, sensors

    def __call__(self) -> str:
        """Returns a sentence on what was taken over and what needs a restart; empty for no change.

        Raises:
            ConfigurationError: If the file is not valid; then nothing was changed.
        """
        new = self._load()
        changed = [name for name in Config.model_fields if getattr(new, name) != getattr(self._config, name)]
        taken = [name for name in changed if name in RELOADABLE]
        if "log_level" in taken:
            logs.configure(new.log_level)
        if self._sensors is not None and ("capture" in taken or "trigger" in taken):
            make = partial(build_source, new, self._sensors)
            self._acquisition.replace(make, new.capture.dark)
        self._config = self._config.model_copy(update={name: getattr(new, name) for name in taken})
        rest = [name for name in changed if name not in RELOADABLE]
        told = [f"taken over: {', '.join(taken)}"] if taken else []
        told += [f"needs a restart: {', '.join(rest)}"] if rest else []
        return "; ".join(told)


def run(load: Callable[[], Config], *, exit_when_done: bool = False) -> int:
    """Runs the service until it is stopped and returns the exit code.

    Args:
        load: Reads the configuration; called again on a reload.
        exit_when_done: Stop at the end of the replayed recording.

    Raises:
        InputError, ConfigurationError: If anything cannot be used as it stands.
        DriverUnavailableError: If a vendor library is missing.
    """
    config = load()
    logs.configure(config.log_level)
    try:
        with open_zenoh(config) as session:
            return build_service(config, session, load=load, exit_when_done=exit_when_done).run()
    except (InputError, DriverError):
        raise  # the command line says it in one line
    except ImportError as error:
        logs.log(logger, logging.CRITICAL, "not installed", error=error)
        return os.EX_CONFIG
    except TransportError as error:
        logs.log(logger, logging.CRITICAL, "no way to the consoles", error=error)
        notify(f"STATUS={error}")
        return os.EX_UNAVAILABLE
    except Exception:
        logger.exception("the service broke")
        return EXIT_FAILED


def lights_off(config: Config) -> None:
    """Turns the light off, whatever became of the service; for ExecStopPost=.

    Raises:
        DriverError: If the light cannot be reached.
    """
    if "light" in config.devices and not config.simulated:
        device = config.devices["light"]
        light: Light = backends.create(
            "light", device.backend, name="light", clock=SystemClock(), options=device.options, shared={}
        )
        with light:  # off after open, and off in close
            light.set_level(0.0)
