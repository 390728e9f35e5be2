"""The one configuration file: TOML, strict, with units in the key names and paths relative to the file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, Strict, field_validator, model_validator

from calibration.gates import Gates
from surfclass.errors import ConfigurationError
from surfclass.schema import Number, Positive, Table, validate

SCHEMA = 1
KINDS = ("colour", "depth", "light", "arm")

Whole = Annotated[int, Strict(), Field(ge=0)]
Count = Annotated[int, Strict(), Field(ge=1)]
Switch = Annotated[bool, Strict()]
T = TypeVar("T", bound=Table)
Endpoint = Annotated[str, Field(pattern=r"^[a-z0-9-]+/.+$")]


class RestSettings(Table):
    """What it means that the arm has come to rest.

    Attributes:
        rest_s: So long no joint may have moved.
        still_rad: Up to here a joint has not moved (encoder noise, vibration).
        moved_rad: A joint must have gone this far from the last captured pose for another capture.
    """

    rest_s: Positive = 0.5
    still_rad: Positive = 0.001
    moved_rad: Positive = 0.01


class TriggerSettings(Table):
    """When to capture, besides requests, which are always taken.

    Attributes:
        interval_s: Every so often; None: not on a timer.
        rest: Each time the arm comes to rest; None: not.
    """

    interval_s: Positive | None = None
    rest: RestSettings | None = None

    @model_validator(mode="after")
    def _one_of_them(self) -> TriggerSettings:
        if self.interval_s is not None and self.rest is not None:
            raise ValueError("interval_s and rest exclude each other")
        return self


class CaptureOptions(Table):
    """How a capture is taken.

    Attributes:
        dark: Also take an unlit frame, so that ambient light can be subtracted.
        level: The light's level, 0…1.
        max_skew_s: Colour and depth may be this far apart; the arm stands still meanwhile, or the
            capture is rejected for that.
    """

    dark: Switch = False
    level: Annotated[Number, Field(ge=0, le=1)] = 1.0
    max_skew_s: Positive = 0.15


class RecordingSettings(Table):
    """Where captures are kept.

    Attributes:
        directory: Every run writes new files there.
        part_mb: A file is closed and the next begun above this size.
        min_free_mb: Below this free space nothing is captured any more, and health says so.
    """

    directory: Path
    part_mb: Count = 2000
    min_free_mb: Whole = 500


class ZenohSettings(Table):
    """How the map leaves the process; scouting is off, so only these endpoints count.

    Attributes:
        settings: More of Zenoh's own configuration by its keys, such as `"transport/link/tls"`.
    """

    mode: Literal["router", "peer", "client"] = "router"
    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[Endpoint, ...] = ()
    settings: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _reachable(self) -> ZenohSettings:
        if self.mode == "client" and not self.connect:
            raise ValueError("a client needs a `connect` endpoint")
        if self.mode == "client" and "listen" in self.model_fields_set and self.listen:
            raise ValueError("a client listens nowhere; leave `listen` out")
        return self


class PipelineOptions(Table):
    """How evidence is put together; the defaults are the recommended ones."""

    update: Literal["frame", "independent"] = "frame"
    pool: Literal["log-linear", "linear"] = "log-linear"


class Limits(Table):
    """Queues and times that may not grow without bound.

    Attributes:
        waiting_captures: Taken and not yet mapped; when full, capturing waits.
        waiting_requests: Asked for and not yet taken; when full, a request is refused.
        request_s: A request that was not served after this is answered with an error.
        device_s: Timeout of one device call.
        heartbeat_s: The acquisition may be silent for so long before the watchdog is no longer fed.
        stop_s: What stopping may take.
    """

    waiting_captures: Count = 2
    waiting_requests: Count = 8
    request_s: Positive = 30.0
    device_s: Positive = 2.0
    heartbeat_s: Positive = 20.0
    stop_s: Positive = 20.0

    @model_validator(mode="after")
    def _a_slow_capture_is_no_hang(self) -> Limits:
        # light, two joint readings, depth, colour, light, unlit colour; each may run into its timeout
        if self.heartbeat_s < 8 * self.device_s:
            raise ValueError(
                f"heartbeat_s {self.heartbeat_s:g} is below 8 × device_s {self.device_s:g}: a capture of "
                "slow devices would be taken for a hang"
            )
        return self


class DeviceSettings(BaseModel):
    """One device: the driver's `backend`, and the options which that driver knows."""

    model_config = ConfigDict(extra="allow", frozen=True)
    backend: Annotated[str, Field(min_length=1)]

    @property
    def options(self) -> dict[str, Any]:
        """Everything but `backend`."""
        return dict(self.model_extra or {})

    def anchored(self, directory: Path) -> DeviceSettings:
        """Returns the settings with every option that is a file's path starting from `directory`."""
        paths = {
            key: str(directory / value)
            for key, value in self.options.items()
            if key.endswith("_path") and isinstance(value, str)
        }
        return self.model_validate({**self.model_dump(), **paths})


class SimFault(Table):
    """One thing that goes wrong on purpose; as `drivers.sim.faults.Fault`, times in the world's seconds."""

    device: str
    kind: str
    from_s: Annotated[Number, Field(ge=0)] = 0.0
    to_s: Positive | None = None
    every: Count = 1
    delay_s: Annotated[Number, Field(ge=0)] = 0.5


class SimSettings(Table):
    """The simulated world that every device with `backend = "sim"` shares.

    Attributes:
        scene: Its name.
        seed: Of everything random in it.
        realtime: Whether its clock runs with ours, or jumps instead of sleeping.
        viewpoints: How many of the scene's viewpoints the simulated arm visits; None: all.
        scale: Of the images, 0.05 to 1; the field of view stays.
        ambient: Light that does not come from the LED, as a fraction of full scale.
        faults: What goes wrong, from when to when.
    """

    scene: str = "cell"
    seed: Whole = 0
    realtime: Switch = False
    viewpoints: Count | None = None
    scale: Annotated[Number, Field(ge=0.05, le=1)] = 1.0
    ambient: Annotated[Number, Field(ge=0, le=1)] = 0.0
    faults: tuple[SimFault, ...] = ()


class CalibrationSettings(Table):
    """Commissioning: where its results are, which the service uses on top of `rig`, and their limits.

    Attributes:
        directory: Of the results; `surfclass calibrate` writes there.
        plate: The plate of reflector discs, a `plate.toml`; needed for hand-eye captures.
        board: The checkerboard, a `board.toml`.
        gates: The limits that a result has to keep.
    """

    directory: Path
    plate: Path | None = None
    board: Path | None = None
    gates: Gates = Gates()


class Config(Table):
    """The whole file.

    Attributes:
        robot: Its name in keys and file names.
        rig: The sensor package; may only be missing where a recording brings its own.
        model: What frames are classified with.
        map: Where the map is written when the service stops; None: it is not kept.
        replay: Take the captures from this recording instead of from devices.
    """

    schema_version: Annotated[int, Field(alias="schema")] = SCHEMA
    robot: Annotated[str, Field(pattern="^[a-z0-9_]+$", max_length=64)] = "robot"
    rig: Path | None = None
    model: Path
    map: Path | None = None
    replay: Path | None = None
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    trigger: TriggerSettings = TriggerSettings()
    capture: CaptureOptions = CaptureOptions()
    recording: RecordingSettings | None = None
    zenoh: ZenohSettings = ZenohSettings()
    pipeline: PipelineOptions = PipelineOptions()
    limits: Limits = Limits()
    calibration: CalibrationSettings | None = None
    sim: SimSettings | None = None
    colour: DeviceSettings | None = None
    depth: DeviceSettings | None = None
    light: DeviceSettings | None = None
    arm: DeviceSettings | None = None

    @field_validator("schema_version")
    @classmethod
    def _schema_is_known(cls, version: int) -> int:
        if version != SCHEMA:
            raise ValueError(f"unknown schema, allowed is {SCHEMA}")
        return version

    @model_validator(mode="after")
    def _parts_fit(self) -> Config:
        simulated = [kind for kind, device in self.devices.items() if device.backend == "sim"]
        if self.replay is None:
            if self.rig is None:
                raise ValueError("rig is missing (only a replayed recording brings its own)")
            missing = [kind for kind in ("colour", "depth") if getattr(self, kind) is None]
            if missing:
                raise ValueError(f"no [{'] and no ['.join(missing)}] table; or give `replay` a recording")
            if self.arm is None and self.trigger.rest is not None:
                raise ValueError("trigger.rest needs an [arm]")
        if simulated and len(simulated) < len(self.devices):
            raise ValueError(
                f"{', '.join(simulated)} simulated and the rest not: all share one world and its clock"
            )
        if self.sim is not None and not simulated:
            raise ValueError('[sim] is given, but no device has backend = "sim"')
        return self

    @property
    def devices(self) -> dict[str, DeviceSettings]:
        """The configured devices by kind."""
        found = {kind: getattr(self, kind) for kind in KINDS}
        return {kind: device for kind, device in found.items() if device is not None}

    @property
    def simulated(self) -> bool:
        """Whether the devices are the simulated world's."""
        return any(device.backend == "sim" for device in self.devices.values())


# What a running service takes over from an edited file; everything else needs a restart.
RELOADABLE = ("trigger", "capture", "log_level")


def load_config(path: Path | None, overrides: Iterable[str] = (), replay: Path | None = None) -> Config:
    """Reads the file at `path`, applies `--set` overrides and returns the validated configuration.

    Args:
        path: The TOML file; None for a configuration that consists of overrides, whose paths are
            then relative to the working directory.
        overrides: Each "table.key=value"; the value is TOML, or a plain string where it is none.
        replay: Take the captures from this recording; relative to the working directory.

    Raises:
        ConfigurationError: With every fault, its key, and what is allowed there.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
        except OSError as error:
            raise ConfigurationError(f"{path}: cannot be read ({error.strerror})") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"{path}: not a TOML file: {error}") from None
    for override in overrides:
        _override(data, override)
    if replay is not None:
        data["replay"] = str(replay.absolute())
    config = validate(Config, data, "--set" if path is None else str(path))
    return _anchored(config, Path.cwd() if path is None else path.resolve().parent)


def _override(data: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    steps = key.strip().split(".")
    if not equals or not all(steps):
        raise ConfigurationError(f"--set {override}: allowed is table.key=value")
    table = data
    for step in steps[:-1]:
        table = table.setdefault(step, {})
        if not isinstance(table, dict):
            raise ConfigurationError(f"--set {override}: {step} is a value in the file, not a table")
    try:
        table[steps[-1]] = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        table[steps[-1]] = text.strip()  # `--set colour.backend=sim` without quotes within quotes


def _anchored(table: T, directory: Path) -> T:
    """Returns `table` with every relative path below it starting from `directory`."""
    changes: dict[str, Any] = {}
    for name in type(table).model_fields:
        value = getattr(table, name)
        if isinstance(value, Path):
            changes[name] = directory / value
        elif isinstance(value, DeviceSettings):
            changes[name] = value.anchored(directory)
        elif isinstance(value, Table):
            changes[name] = _anchored(value, directory)
    return table.model_copy(update=changes)
