"""The only door to Zenoh's set-up: sessions without discovery, the keys of a robot, queries with answers."""

from __future__ import annotations

import atexit
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import zenoh
from pydantic import ConfigDict, Field
from zenoh.handlers import Callback

from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import SurfaceClasses
from surfclass.schema import Positive, Table, validate
from surfclass.voxel_evidence import Update
from surfclass.voxel_map import VoxelMap

Mode = Literal["router", "peer", "client"]
T = TypeVar("T")

_SOCKET_PATH_BYTES = 107  # sun_path of a Unix socket, less its terminating zero
_SOURCE_LINE = re.compile(r" at \S+\.rs:\d+\.?")  # where in Zenoh's source an error arose

# Without these a default session listens on every interface and joins a multicast group; shared
# memory would leave files behind a killed process. A deeper queue lets a frame of a dozen parts pass
# without a drop.
_SETTINGS: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/queue/size/data_high": 16,
}

# Zenoh has one thread that sends, and one link that is closed while a reply waits in its queue stops
# that thread, and with it all other links, for up to 5 s. Zenoh reads this variable once.
_RUNTIME = "(tx: (worker_threads: 4), net: (worker_threads: 4))"

_open_sessions: list[zenoh.Session] = []


class TransportError(ConnectionError):
    """Nothing can be reached, or listened on, at an endpoint; or nobody answers there."""


class RefusedError(Exception):
    """A command was understood and refused; `kind` is the robot's name of the reason."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one robot.

    Raises:
        ConfigurationError: If the name has other characters than a–z, 0–9 and _.
    """

    robot: str

    def __post_init__(self) -> None:
        if not re.fullmatch("[a-z0-9_]+", self.robot):
            raise ConfigurationError(f"robot: {self.robot!r} may have only the characters a-z, 0-9 and _")

    def _key(self, rest: str) -> str:
        return f"surfclass/v1/{self.robot}/{rest}"

    @property
    def delta(self) -> str:
        """Published: `surfclass.v1.MapUpdate`, in parts."""
        return self._key("map/delta")

    @property
    def beat(self) -> str:
        """Published: `{"epoch", "sequence"}` of the last delta, as JSON, some times a second."""
        return self._key("map/beat")

    @property
    def missed(self) -> str:
        """Query with `{"epoch", "after"}`: the deltas after that number, or an error if not all are kept."""
        return self._key("map/missed")

    @property
    def snapshot(self) -> str:
        """Query: `surfclass.v1.MapUpdate`, one reply a part."""
        return self._key("map/snapshot")

    @property
    def meta(self) -> str:
        """Query: `MapMeta` as JSON."""
        return self._key("map/meta")

    @property
    def status(self) -> str:
        """Published: JSON."""
        return self._key("status")

    def alive(self, who: str) -> str:
        """Liveliness token of one run of the daemon; `*` for any."""
        return self._key(f"alive/{who}")

    def command(self, name: str) -> str:
        """Query with a JSON object, replied with one, or with an error `{"kind", "error"}`."""
        return self._key(f"cmd/{name}")


class MapMeta(Table):
    """What a console must know of a map before it can hold a copy."""

    model_config = ConfigDict(extra="ignore", frozen=True)  # a newer daemon may say more

    schema_version: Literal[1] = 1
    voxel_size_m: Positive
    classes: SurfaceClasses
    update: Update
    made_with: dict[str, str] = Field(default_factory=dict)

    @classmethod
    def of(cls, voxels: VoxelMap) -> MapMeta:
        """Returns what there is to know of this map."""
        return cls(
            voxel_size_m=voxels.size_m,
            classes=voxels.classes,
            update=voxels.update,
            made_with=voxels.made_with,
        )

    @classmethod
    def parse(cls, data: bytes | Mapping[str, Any]) -> MapMeta:
        """Returns the meta data that JSON or its object holds.

        Raises:
            ConfigurationError: Naming every fault.
        """
        return validate(cls, parse_object(data, "map/meta") if isinstance(data, bytes) else data, "map/meta")


def open_session(
    mode: Mode,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """Returns an open session that finds nobody and is found by nobody but through its endpoints.

    Close it, best by `with`; where that is forgotten it is closed when the interpreter ends.

    Args:
        mode: "router" for the daemon, "client" for a console; "router" needs no other program.
        listen: Endpoints such as `tcp/127.0.0.1:7447` or `unixsock-stream//run/surfclass/z.sock`.
        connect: Endpoints likewise.
        settings: More of Zenoh's configuration by key (`transport/link/tls`, `access_control`).

    Raises:
        ConfigurationError: If a setting or an endpoint is not one.
        TransportError: If an endpoint cannot be reached or listened on.
    """
    if mode == "client" and not connect:
        raise ConfigurationError("zenoh: a client needs an endpoint to connect to")
    for endpoint in (*listen, *connect):
        protocol, _, path = endpoint.partition("/")
        if protocol == "unixsock-stream" and len(path.encode()) > _SOCKET_PATH_BYTES:
            raise ConfigurationError(
                f"zenoh: {endpoint}: a socket's path may have {_SOCKET_PATH_BYTES} bytes, "
                f"this has {len(path.encode())}"
            )
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    configuration = zenoh.Config()
    wanted = {"mode": mode, "listen/endpoints": list(listen), "connect/endpoints": list(connect)}
    for key, value in {**wanted, **_SETTINGS, **(settings or {})}.items():
        try:
            configuration.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigurationError(f"zenoh: {key} = {value!r}: {_plain(error)}") from None
    try:
        session = zenoh.open(configuration)
    except zenoh.ZError as error:
        raise TransportError(f"zenoh {mode}: {_plain(error)}") from None
    # Not closed, the threads below would call into an interpreter that is going down, and abort it.
    _open_sessions[:] = [other for other in _open_sessions if not other.is_closed()] + [session]
    return session


@atexit.register
def _close_sessions() -> None:
    for session in _open_sessions:
        if not session.is_closed():
            session.close()


def direct(callback: Callable[[T], None]) -> Callback[T]:
    """Returns a handler that runs `callback` in Zenoh's own thread.

    (Given plainly, a callback gets a thread that keeps a process alive for ever unless the session is
    closed first.) It must not block and not call Zenoh: it hands over and returns.
    """
    return Callback(callback, indirect=False)


def fetch(
    session: zenoh.Session,
    key: str,
    payload: bytes | None = None,
    *,
    timeout_s: float = 10.0,
    cancel: zenoh.CancellationToken | None = None,
) -> Iterator[bytes]:
    """Yields the replies to a query.

    Raises:
        TransportError: If there are none (nobody has that key here, or the link is gone).
        TimeoutError: If the answer did not come in time.
        RefusedError: If the answer is an error.
    """
    count = 0
    try:
        replies = session.get(
            key,
            payload=payload,
            timeout=timeout_s,
            cancellation_token=cancel,
            # Replies are sent as the query was: none is dropped, and they make way for the live map.
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_LOW,
            # Else all replies but the last are taken for outdated, as they have one key.
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            if reply.err is not None:
                raise _refusal(key, reply.err.payload.to_bytes(), timeout_s)
            if reply.ok is not None:
                count += 1
                yield reply.ok.payload.to_bytes()
    except zenoh.ZError as error:
        raise TransportError(f"{key}: {_plain(error)}") from None
    if count == 0:
        raise TransportError(f"{key}: nobody answers")


def ask(
    session: zenoh.Session,
    robot: str,
    command: str,
    parameters: Mapping[str, Any] | None = None,
    *,
    timeout_s: float = 30.0,
) -> dict[str, Any]:
    """Sends a command and returns its answer, a JSON object.

    Raises:
        TransportError: If there is no such robot, or it has no such command.
        TimeoutError: If the answer did not come in time.
        RefusedError: If the robot refused.
        InputError: If the answer is not a JSON object.
    """
    key = Keys(robot).command(command)
    *_, answer = fetch(session, key, json.dumps(dict(parameters or {})).encode(), timeout_s=timeout_s)
    return parse_object(answer, key)


def parse_object(data: bytes, source: str) -> dict[str, Any]:
    """Returns the JSON object that `data` holds.

    Raises:
        InputError: If it holds none.
    """
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source}: not JSON: {error}") from None
    if not isinstance(value, dict):
        raise InputError(f"{source}: needs a JSON object, got {type(value).__name__}")
    return value


def _refusal(key: str, data: bytes, timeout_s: float) -> Exception:
    if data == b"Timeout":  # Zenoh's own word
        return TimeoutError(f"{key}: no answer within {timeout_s:g} s")
    try:
        answer = parse_object(data, key)
    except InputError:
        return RefusedError("unknown", data.decode(errors="replace"))
    return RefusedError(str(answer.get("kind", "unknown")), str(answer.get("error", answer)))


def _plain(error: zenoh.ZError) -> str:
    return _SOURCE_LINE.sub("", str(error)).strip()
