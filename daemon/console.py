"""A console's copy of a robot's map: equal to it bit for bit, or said to be not."""

from __future__ import annotations

import atexit
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Any, Literal, Self

import zenoh

from daemon.transport import Keys, MapMeta, RefusedError, TransportError, direct, fetch, parse_object
from surfclass.errors import InputError
from surfclass.types import MapUpdate
from surfclass.voxel_map import VoxelMap
from surfclass.wire import Assembler

log = logging.getLogger(__name__)

State = Literal["live", "stale", "resyncing", "disconnected"]

_RETRY_S = (0.1, 0.2, 0.5, 1.0, 2.0)  # between tries to get a snapshot; the last for ever


class _Job(Enum):
    """What the worker does next: it reads what came, or fetches what did not."""

    DELTA = auto()
    BEAT = auto()
    FETCH_MISSED = auto()
    FETCH_ALL = auto()


@dataclass(slots=True)
class Counters:
    """What happened to a console since it was made.

    Attributes:
        deltas: Applied.
        duplicates: Not applied, being in the map already or of an epoch that is over.
        gaps: Times that deltas were missing.
        recovered: Of the applied ones, those that had to be asked for.
        refused: Messages that were no map update.
        overflows: Times that messages came faster than they were applied.
        resyncs: Snapshots taken after the first one.
    """

    deltas: int = 0
    duplicates: int = 0
    gaps: int = 0
    recovered: int = 0
    refused: int = 0
    overflows: int = 0
    resyncs: int = 0


class MapClient:
    """Holds a copy of one robot's map; every method may be called from any thread.

    It subscribes, then asks for a snapshot, then applies the deltas with a higher number. A number
    that is missing, in a delta or in the robot's beat, makes it ask for what it missed, and if the
    robot has that no more, or has begun another epoch, for a snapshot again. It may be made before
    the robot is there, and outlives the robot's restarts.

    Args:
        session: An open session; it stays the caller's to close, after this object.
        robot: The robot's name.
        stale_after_s: So long nothing may be heard (not even the beat, which comes some times a
            second) before the state is "stale".
        timeout_s: What a snapshot may take.
        waiting: Messages that may wait to be applied; with more, they are dropped and asked for again.

    Raises:
        ConfigurationError: If the robot's name cannot be.
    """

    def __init__(
        self,
        session: zenoh.Session,
        robot: str,
        *,
        stale_after_s: float = 5.0,
        timeout_s: float = 20.0,
        waiting: int = 1024,
    ) -> None:
        self._session, self._keys = session, Keys(robot)
        self._stale_after_s, self._timeout_s, self._waiting = stale_after_s, timeout_s, waiting
        # All below is guarded by the condition, but for what is inside `_map`, which guards itself,
        # and the assembler, which only the worker touches.
        self._changed = threading.Condition()
        self._inbox: deque[tuple[_Job, bytes]] = deque()
        self._robots: set[str] = set()
        self._heard = False
        self._status: dict[str, Any] = {}
        self._heard_s = time.monotonic()
        self._need: _Job | None = _Job.FETCH_ALL
        self._fetching = False
        self._closing = False
        self._map: VoxelMap | None = None
        self._counters = Counters()
        self._assembler = Assembler(0)  # of no use before the first snapshot
        self._ended: deque[str] = deque(maxlen=64)
        self._cancel = zenoh.CancellationToken()
        self._worker = threading.Thread(target=self._run, name=f"map of {robot}", daemon=True)
        self._declared: list[Any] = [
            session.declare_subscriber(self._keys.delta, direct(self._take_delta)),
            session.declare_subscriber(self._keys.beat, direct(self._take_beat)),
            session.declare_subscriber(self._keys.status, direct(self._take_status)),
            session.liveliness().declare_subscriber(
                self._keys.alive("*"), direct(self._take_life), history=True
            ),
        ]
        self._worker.start()
        atexit.register(self.close)  # the worker must not be inside Zenoh when the interpreter goes

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def map(self) -> VoxelMap | None:
        """The copy, None before the first snapshot; another object after each further one."""
        return self._map

    @property
    def state(self) -> State:
        """Whether `map` is the robot's map.

        "live": it is, up to what is on its way. "stale": it was when the robot was last heard.
        "resyncing": it is not, and is being fetched. "disconnected": there is no such robot here.
        """
        with self._changed:
            if not self._is_there() or not self._worker.is_alive():
                return "disconnected"
            if self._need or self._fetching or self._map is None:
                return "resyncing"
            return "live" if self.silent_s < self._stale_after_s else "stale"

    @property
    def silent_s(self) -> float:
        """Seconds since the robot was last heard."""
        return time.monotonic() - self._heard_s

    @property
    def status(self) -> dict[str, Any]:
        """What the robot last said of itself; empty before."""
        with self._changed:
            return dict(self._status)

    @property
    def counters(self) -> Counters:
        """What happened so far."""
        with self._changed:
            return replace(self._counters)

    def wait_until(
        self,
        condition: Callable[[VoxelMap], bool] | None = None,
        *,
        epoch: str | None = None,
        sequence: int = 0,
        timeout_s: float = 10.0,
    ) -> VoxelMap:
        """Returns the map once it is synchronised, of that epoch, up to that delta, and `condition` holds.

        Raises:
            TimeoutError: Saying what state the map is in instead.
        """

        def there() -> bool:
            found = self._map
            return (
                found is not None
                and self.state in ("live", "stale")
                and found.epoch == (epoch or found.epoch)
                and found.sequence >= sequence
                and (condition is None or condition(found))
            )

        with self._changed:
            if not self._changed.wait_for(there, timeout_s) or self._map is None:
                at = "no map" if self._map is None else f"map {self._map.epoch:.8} at {self._map.sequence}"
                raise TimeoutError(f"{self._keys.delta}: {self.state}, {at} after {timeout_s:g} s")
            return self._map

    def close(self) -> None:
        """Ends the subscription; `map` stays as it was. Never raises on a session that is closed."""
        atexit.unregister(self.close)
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._cancel.cancel()
        if not self._session.is_closed():
            for declared in self._declared:
                declared.undeclare()
        self._worker.join(timeout=5.0)

    # In Zenoh's threads: hand over and return.

    def _take_delta(self, sample: zenoh.Sample) -> None:
        self._take(_Job.DELTA, sample)

    def _take_beat(self, sample: zenoh.Sample) -> None:
        self._take(_Job.BEAT, sample)

    def _take(self, kind: _Job, sample: zenoh.Sample) -> None:
        with self._changed:
            if not self._is_there():
                self._need = self._need or _Job.FETCH_MISSED
            self._heard, self._heard_s = True, time.monotonic()
            self._inbox.append((kind, sample.payload.to_bytes()))
            if len(self._inbox) > self._waiting:
                self._inbox.clear()
                self._counters.overflows += 1
                self._need = self._need or _Job.FETCH_MISSED
            self._changed.notify_all()

    def _take_status(self, sample: zenoh.Sample) -> None:
        try:
            status = parse_object(sample.payload.to_bytes(), str(sample.key_expr))
        except InputError:
            with self._changed:
                self._counters.refused += 1
            return
        with self._changed:
            self._heard_s = time.monotonic()
            self._status = status
            self._changed.notify_all()

    def _is_there(self) -> bool:
        # By the beat as well: routers that find each other again have been seen to lose tokens.
        return bool(self._robots) or (self._heard and self.silent_s < self._stale_after_s)

    def _take_life(self, sample: zenoh.Sample) -> None:
        who = str(sample.key_expr)
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._robots.add(who)
                self._heard_s = time.monotonic()
                # A new run of the robot, or the same after the link was down.
                self._need = self._need or _Job.FETCH_MISSED
            else:
                self._robots.discard(who)
                self._heard = False
            self._changed.notify_all()

    # In the worker.

    def _run(self) -> None:
        failures = 0
        while (job := self._next_job()) is not None:
            kind, message = job
            if kind in (_Job.DELTA, _Job.BEAT):
                self._read(kind, message)
                continue
            fetched = self._fetch_missed() if kind is _Job.FETCH_MISSED else self._fetch_all()
            failures = 0 if fetched or kind is _Job.FETCH_MISSED else failures + 1
            with self._changed:
                self._fetching = False
                self._need = self._need if fetched else _Job.FETCH_ALL
                self._changed.notify_all()
                if failures:
                    pause_s = _RETRY_S[min(failures, len(_RETRY_S)) - 1]
                    self._changed.wait_for(lambda: self._closing, pause_s)

    def _next_job(self) -> tuple[_Job, bytes] | None:
        """Waits for something to do; None is the end."""
        with self._changed:
            while not self._closing:
                if self._need is not None and self._is_there():
                    need, self._need, self._fetching = self._need, None, True
                    return need if self._map is not None else _Job.FETCH_ALL, b""
                if self._map is None:
                    self._inbox.clear()  # from before the first snapshot, which will contain it
                elif self._inbox:
                    return self._inbox.popleft()
                self._changed.wait()
            return None

    def _read(self, kind: _Job, message: bytes) -> None:
        """Applies a delta if it is the next one, and sees from a delta or a beat whether one is missing."""
        known = self._map
        assert known is not None
        try:
            if kind is _Job.DELTA:
                update = self._assembler.take(message)
                if update is None or self._apply(known, update):
                    return
                epoch, sequence = update.epoch, update.sequence
            else:
                beat = parse_object(message, self._keys.beat)
                epoch, sequence = str(beat.get("epoch")), int(beat.get("sequence", 0))
        except (InputError, TypeError, ValueError) as error:
            log.warning("%s: %s", self._keys.robot, error)
            with self._changed:
                self._counters.refused += 1
                self._need = self._need or _Job.FETCH_MISSED
                self._changed.notify_all()
            return
        with self._changed:
            if epoch in self._ended or (epoch == known.epoch and sequence <= known.sequence):
                self._counters.duplicates += kind is _Job.DELTA
            elif epoch != known.epoch:
                self._need = _Job.FETCH_ALL
            else:
                self._counters.gaps += 1
                self._need = self._need or _Job.FETCH_MISSED
            self._changed.notify_all()

    def _apply(self, known: VoxelMap, update: MapUpdate) -> bool:
        """Applies a delta if it is the very next one; whether it was."""
        if update.epoch != known.epoch or update.sequence != known.sequence + 1:
            return False
        known.apply(update)
        with self._changed:
            self._counters.deltas += 1
            self._changed.notify_all()
        return True

    def _fetch_missed(self) -> bool:
        """Gets the deltas that are missing, if any; whether the robot has them."""
        known = self._map
        assert known is not None
        question = json.dumps({"epoch": known.epoch, "after": known.sequence}).encode()
        assembler = Assembler(len(known.classes.names))
        try:
            for part in self._ask(self._keys.missed, question):
                update = assembler.take(part)
                if update is not None and self._apply(known, update):
                    with self._changed:
                        self._counters.recovered += 1
        except (TransportError, TimeoutError, RefusedError, InputError) as error:
            log.info("what is missing cannot be had: %s", error)
            return False
        return True

    def _ask(self, key: str, payload: bytes | None = None) -> Iterator[bytes]:
        return fetch(self._session, key, payload, timeout_s=self._timeout_s, cancel=self._cancel)

    def _fetch_all(self) -> bool:
        """Gets the whole map; whether that worked."""
        try:
            *_, answer = self._ask(self._keys.meta)
            meta = MapMeta.parse(answer)
            assembler, snapshot = Assembler(len(meta.classes.names)), None
            for part in self._ask(self._keys.snapshot):
                snapshot = assembler.take(part) or snapshot
            if snapshot is None or snapshot.epoch in self._ended:
                return False
            fresh = VoxelMap(
                meta.voxel_size_m,
                meta.classes,
                meta.update,
                epoch=snapshot.epoch,
                made_with=meta.made_with,
            )
            fresh.apply(snapshot)
        except (TransportError, TimeoutError, RefusedError, InputError) as error:
            log.info("no map yet: %s", error)
            return False
        self._install(fresh, len(meta.classes.names))
        return True

    def _install(self, fresh: VoxelMap, classes: int) -> None:
        with self._changed:
            if self._map is not None:
                self._counters.resyncs += 1
                if self._map.epoch != fresh.epoch:
                    self._ended.append(self._map.epoch)
            self._map = fresh
            self._assembler = Assembler(classes)
            self._heard_s = time.monotonic()
