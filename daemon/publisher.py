"""The daemon's side of the live map: deltas, snapshots and status go out, commands come in."""

from __future__ import annotations

import atexit
import json
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Self

import zenoh

from daemon.requests import CommandError
from daemon.transport import Keys, MapMeta, direct, parse_object
from surfclass.errors import InputError
from surfclass.types import MapUpdate
from surfclass.wire import ENCODING, encode_parts

log = logging.getLogger(__name__)

_KEPT_MESSAGES = 256  # 16 MB: what a console can have missed and still get without a snapshot
_BEAT_S = 0.25  # so late at most a console learns that the last delta was lost
_WAITING_QUERIES = 16

Handler = Callable[[dict[str, Any]], Mapping[str, Any]]


class MapPublisher:
    """Publishes one robot's map; every method may be called from any thread.

    What a console needs in order to hold the same map is kept by four rules. Deltas go out in the
    order of their numbers, all parts of a delta under its one number. A snapshot taken at number s
    contains the deltas up to s, whole, since the map takes both under its own lock; so a console
    applies to it exactly what has a higher number. A beat tells the number of the last delta, behind
    it in the same queue; so who hears the beat and has not the delta has lost it. And a delta is put
    without ever waiting for a slow console: what one misses it asks for.

    (Zenoh's own advanced publisher has a cache and a heartbeat too, but answers from that cache in
    the threads that receive, under a lock that its `put` needs: one slow console then stalls both.)

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
        now = snapshot()
        self._last = (now.epoch, now.sequence)
        self._kept: deque[tuple[int, list[bytes]]] = deque()  # of the last epoch
        self._delta, self._beat = (
            session.declare_publisher(
                key,
                encoding=encoding,
                # Any other choice lets one frozen console stall the capture loop, for 5 s measured.
                congestion_control=zenoh.CongestionControl.DROP,
                # Not that of the replies: one that waits for a frozen console holds up its priority.
                priority=zenoh.Priority.DATA_HIGH,
            )
            for key, encoding in ((keys.delta, ENCODING), (keys.beat, "application/json"))
        )
        self._status = session.declare_publisher(
            keys.status,
            encoding="application/json",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH,
        )
        self._answering = [
            _Answering(session, keys.meta, lambda query: query.reply(keys.meta, meta)),
            _Answering(session, keys.snapshot, self._reply_snapshot, threads=4),
            _Answering(session, keys.missed, self._reply_missed, threads=4),
        ]
        self._closing = threading.Event()
        self._beating = threading.Thread(target=self._beat_on, name=f"beat of {robot}", daemon=True)
        self._beating.start()
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
            if update.epoch != epoch:
                self._kept.clear()
            self._last = (update.epoch, update.sequence)
            self._kept.append((update.sequence, parts))
            while sum(len(kept) for _, kept in self._kept) > _KEPT_MESSAGES:
                self._kept.popleft()
            for part in parts:
                self._delta.put(part)

    def publish_status(self, status: Mapping[str, Any]) -> None:
        """Sends how the robot is; once a second or so."""
        self._status.put(json.dumps(dict(status)))

    def serve(self, command: str, handler: Handler, threads: int = 1) -> None:
        """Answers a command from now on, in threads of its own: so many at a time.

        The handler gets the command's JSON object and returns the answer's. What it raises becomes
        an error reply, so that the one who asked always hears: an InputError or CommandError with its
        text, anything else also in the log.
        """
        key = self._keys.command(command)

        def answer(query: zenoh.Query) -> None:
            parameters = parse_object(query.payload.to_bytes(), key) if query.payload is not None else {}
            query.reply(key, json.dumps(dict(handler(parameters))), encoding="application/json")

        self._answering.append(_Answering(self._session, key, answer, threads))

    def _reply_snapshot(self, query: zenoh.Query) -> None:
        for part in encode_parts(self._snapshot()):
            query.reply(self._keys.snapshot, part, encoding=ENCODING)

    def _reply_missed(self, query: zenoh.Query) -> None:
        """Replies with the deltas of an epoch after a number, if all are kept; with the last one at least."""
        payload = query.payload.to_bytes() if query.payload is not None else b""
        asked = parse_object(payload, self._keys.missed)
        after = asked.get("after")
        with self._lock:
            epoch, last = self._last
            kept = dict(self._kept)
        wanted = range(min(after + 1, last), last + 1) if isinstance(after, int) else range(0)
        if asked.get("epoch") != epoch or not wanted or not kept.keys() >= set(wanted):
            raise CommandError(f"{asked}: not all of that is kept; ask for a snapshot")
        for number in wanted:
            for part in kept[number]:
                query.reply(self._keys.missed, part, encoding=ENCODING)

    def _beat_on(self) -> None:
        while not self._closing.wait(_BEAT_S):
            with self._lock:
                epoch, sequence = self._last
                self._beat.put(json.dumps({"epoch": epoch, "sequence": sequence}))

    def close(self) -> None:
        """Withdraws everything; the map and the session stay. Never raises on a session that is closed."""
        atexit.unregister(self.close)
        self._closing.set()
        self._beating.join(timeout=5.0)
        if not self._session.is_closed():
            self._alive.undeclare()
        for answering in self._answering:
            answering.close()
        if not self._session.is_closed():
            for declared in (self._delta, self._beat, self._status):
                declared.undeclare()


class _Answering:
    """A queryable whose queries are answered by threads of its own; none is left unanswered.

    With more than one thread, one that waits for a frozen console does not keep the next one waiting.
    """

    def __init__(
        self, session: zenoh.Session, key: str, answer: Callable[[zenoh.Query], None], threads: int = 1
    ) -> None:
        self._session = session
        self._answer = answer
        self._waiting: queue.Queue[zenoh.Query | None] = queue.Queue(_WAITING_QUERIES)
        self._threads = [
            threading.Thread(target=self._run, name=f"answers {key}", daemon=True) for _ in range(threads)
        ]
        for thread in self._threads:
            thread.start()
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
                query = self._waiting.get_nowait()
            except queue.Empty:
                break
            if query is not None:
                _refuse(query, "Stopping", "the robot is stopping")
                query.drop()
        for _ in self._threads:
            self._waiting.put(None)
        for thread in self._threads:
            thread.join(timeout=5.0)


def _refuse(query: zenoh.Query, kind: str, message: str) -> None:
    try:
        query.reply_err(json.dumps({"kind": kind, "error": message}), encoding="application/json")
    except zenoh.ZError:
        log.warning("%s: the one who asked is gone", query.key_expr)
