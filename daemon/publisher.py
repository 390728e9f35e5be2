"""The daemon's side of the live map: deltas, snapshots and status go out, commands come in."""

from __future__ import annotations

import atexit
import json
import logging
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, Self

import zenoh
import zenoh.ext

from daemon.requests import CommandError
from daemon.transport import Keys, MapMeta, direct, parse_object
from surfclass.errors import InputError
from surfclass.types import MapUpdate
from surfclass.wire import ENCODING, encode_parts

log = logging.getLogger(__name__)

_CACHED_MESSAGES = 256  # 16 MB: what a console can have missed and still get without a snapshot
_HEARTBEAT_S = 0.2  # so late at most a console learns that the last message was lost
_WAITING_QUERIES = 16

Handler = Callable[[dict[str, Any]], Mapping[str, Any]]


class MapPublisher:
    """Publishes one robot's map; every method may be called from any thread.

    What a console needs in order to hold the same map is kept by three rules. Deltas go out in the
    order of their numbers, all parts of a delta under its one number. A snapshot taken at number s
    contains the deltas up to s, whole, since the map takes both under its own lock; so a console
    applies to it exactly what has a higher number. And a delta is put without ever waiting for a slow
    console: what one misses it sees by the number, and asks again.

    Args:
        session: An open session; it stays the caller's to close.
        robot: The robot's name.
        map_meta: `MapMeta` of the map, as an object of JSON.
        snapshot: Returns the whole map as it is now; called from this object's own thread.

    Raises:
        ConfigurationError: If the robot's name or the meta data cannot be.
    """

    def __init__(
        self,
        session: zenoh.Session,
        robot: str,
        map_meta: Mapping[str, Any],
        snapshot: Callable[[], MapUpdate],
    ) -> None:
        self._session = session
        self._keys = keys = Keys(robot)
        meta = MapMeta.parse(map_meta).model_dump_json().encode()
        self._snapshot = snapshot
        self._lock = threading.Lock()
        self._last = ("", -1)
        self._delta = zenoh.ext.declare_advanced_publisher(
            session,
            keys.delta,
            encoding=ENCODING,
            # Any other choice lets one frozen console stall the capture loop, for 5 s measured.
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(max_samples=_CACHED_MESSAGES),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S
            ),
        )
        self._status = session.declare_publisher(
            keys.status, encoding="application/json", congestion_control=zenoh.CongestionControl.DROP
        )
        self._answering = [
            _Answering(session, keys.meta, lambda query: query.reply(keys.meta, meta)),
            _Answering(session, keys.snapshot, self._reply_snapshot),
        ]
        # Last, so that who sees the robot alive finds everything else in place.
        self._alive = session.liveliness().declare_token(keys.alive(str(session.zid())))
        atexit.register(self.close)  # no thread may be inside Zenoh when the interpreter goes

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, update: MapUpdate) -> None:
        """Sends a delta, in parts; returns without waiting for any console.

        Raises:
            ValueError: If this epoch's update with that number, or a later one, was sent before.
        """
        parts = encode_parts(update)
        with self._lock:
            epoch, sequence = self._last
            if update.epoch == epoch and update.sequence <= sequence:
                raise ValueError(f"map update {update.sequence} after {sequence}: deltas go out in order")
            self._last = (update.epoch, update.sequence)
            for part in parts:
                self._delta.put(part)

    def publish_status(self, status: Mapping[str, Any]) -> None:
        """Sends how the robot is, with the epoch and number of the last delta sent; once a second or so."""
        with self._lock:
            epoch, sequence = self._last
        known = {"epoch": epoch, "sequence": sequence} if epoch else {}
        self._status.put(json.dumps({**status, **known}))

    def serve(self, command: str, handler: Handler) -> None:
        """Answers a command from now on, one at a time, in a thread of its own.

        The handler gets the command's JSON object and returns the answer's. What it raises becomes
        an error reply, so that the one who asked always hears: an InputError or CommandError with its
        text, anything else also in the log.
        """
        key = self._keys.command(command)

        def answer(query: zenoh.Query) -> None:
            parameters = parse_object(query.payload.to_bytes(), key) if query.payload is not None else {}
            query.reply(key, json.dumps(dict(handler(parameters))), encoding="application/json")

        self._answering.append(_Answering(self._session, key, answer))

    def _reply_snapshot(self, query: zenoh.Query) -> None:
        for part in encode_parts(self._snapshot()):
            query.reply(self._keys.snapshot, part, encoding=ENCODING)

    def close(self) -> None:
        """Withdraws everything; the map and the session stay. Never raises on a session that is closed."""
        atexit.unregister(self.close)
        if not self._session.is_closed():
            self._alive.undeclare()
        for answering in self._answering:
            answering.close()
        if not self._session.is_closed():
            self._delta.undeclare()
            self._status.undeclare()


class _Answering:
    """A queryable whose queries are answered in order by a thread of its own; none is left unanswered."""

    def __init__(self, session: zenoh.Session, key: str, answer: Callable[[zenoh.Query], None]) -> None:
        self._session = session
        self._answer = answer
        self._waiting: queue.Queue[zenoh.Query | None] = queue.Queue(_WAITING_QUERIES)
        self._thread = threading.Thread(target=self._run, name=f"answers {key}", daemon=True)
        self._thread.start()
        self._queryable = session.declare_queryable(key, direct(self._take))

    def _take(self, query: zenoh.Query) -> None:
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            _refuse(query, "Busy", f"{_WAITING_QUERIES} such queries are waiting already")

    def _run(self) -> None:
        while (query := self._waiting.get()) is not None:
            try:
                self._answer(query)
            except (InputError, CommandError) as error:
                _refuse(query, type(error).__name__, str(error))
            except zenoh.ZError:
                log.warning("%s: the one who asked is gone", query.key_expr)
            except Exception as error:
                log.exception("%s: failed", query.key_expr)
                _refuse(query, type(error).__name__, f"internal error: {error}")
            finally:
                query.drop()

    def close(self) -> None:
        if not self._session.is_closed():
            self._queryable.undeclare()
        while True:
            try:
                self._waiting.put_nowait(None)
                break
            except queue.Full:
                query = self._waiting.get()
                if query is not None:
                    _refuse(query, "Stopping", "the robot is stopping")
        self._thread.join(timeout=5.0)


def _refuse(query: zenoh.Query, kind: str, message: str) -> None:
    try:
        query.reply_err(json.dumps({"kind": kind, "error": message}), encoding="application/json")
    except zenoh.ZError:
        log.warning("%s: the one who asked is gone", query.key_expr)
