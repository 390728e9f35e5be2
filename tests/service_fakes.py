"""Small stand-ins for the service's parts, which write what happened into one list."""

import json
import queue
import threading
import time
from types import SimpleNamespace

import numpy as np

from daemon.acquisition import Acquisition
from daemon.config import Limits
from daemon.recovery import Backoff
from daemon.requests import RequestQueue
from daemon.service import Service
from daemon.sink import RecordingSink
from surfclass.frames import Capture, ColourFrame, DepthFrame
from surfclass.rig import SurfaceClasses
from surfclass.types import Observation
from surfclass.voxel_map import VoxelMap

CLASSES = SurfaceClasses(names=("rusted", "painted"), colours=("#b7410e", "#336699"))


def capture(name="c1", t_ns=1):
    depth = DepthFrame(t_ns, 1, None, np.ones((2, 2), np.uint16))
    colour = ColourFrame(t_ns, 1, None, np.zeros((2, 2, 3), np.uint8))
    return Capture(name, "map", depth, colour)


class Source:
    """Plays a script: a Capture is returned, an exception raised, a callable called, the end is silence.

    Requests are served with a new capture whenever the script is at its end.
    """

    def __init__(self, script=(), events=None, opens=(), finite=False):
        self.name, self.is_open = "fake", False
        self.script, self.opens, self.finite = list(script), list(opens), finite
        self.events = [] if events is None else events
        self.taken = 0
        self.requests = []

    @property
    def finished(self):
        return self.finite and not self.script

    def open(self):
        if self.opens:
            outcome = self.opens.pop(0)
            if outcome is not None:
                raise outcome
        self.is_open = True
        self.events.append("open")

    def close(self):
        if self.is_open:
            self.events.append("close source")
        self.is_open = False

    def release(self, device):
        self.close()

    def next(self, timeout_s, request=None):
        assert self.is_open, "used while closed"
        self.requests.append(request)
        step = self.script.pop(0) if self.script else None
        if isinstance(step, Exception):
            raise step
        if callable(step):
            step = step()
        if step is None and request is not None:
            self.taken += 1
            step = capture(request.name or f"{self.taken:06d}")
        if step is None:
            time.sleep(min(timeout_s, 0.01))
        return step


class Pipeline:
    def __init__(self, events):
        self.map = VoxelMap(0.01, CLASSES, epoch="0" * 32)
        self.events = events
        self.fail = {}
        self.gate = threading.Event()
        self.gate.set()

    def process(self, capture):
        assert self.gate.wait(10)
        if capture.name in self.fail:
            raise self.fail[capture.name]
        yes = np.array([True])
        row = np.log(np.array([[0.9, 0.1]], np.float32))
        point = np.array([[0.01 * len(self.map) + 0.005, 0, 0]], np.float32)
        seen = Observation(point, row, row, yes, yes, np.ones(1, np.float32))
        self.events.append(f"map {capture.name}")
        return SimpleNamespace(update=self.map.add(seen, capture.t_ns), stage_ms={"geometry": 2.0})


class Publisher:
    def __init__(self, events):
        self.events, self.statuses = events, []

    def publish(self, update):
        self.events.append(f"publish {update.sequence}")

    def publish_status(self, status):
        json.dumps(status)
        self.statuses.append(status)

    def close(self):
        self.events.append("close publisher")


class Writer:
    def __init__(self, events, path, fail):
        self.events, self.path, self.fail = events, path, fail

    def write(self, capture, encoded=None):
        if self.fail:
            raise self.fail[0]
        self.events.append(f"record {capture.name}")

    def write_update(self, data, t_ns):
        self.events.append("record update")

    def sync(self):
        pass

    def close(self):
        self.events.append(f"close {self.path.name}")


class Rig:
    """A service out of fakes, run in a thread."""

    def __init__(
        self,
        tmp_path,
        script=(),
        *,
        opens=(),
        finite=False,
        recording=True,
        dark=False,
        backoff=None,
        **options,
    ):
        self.events = []
        limits = Limits(**{"request_s": 5.0, "stop_s": 5.0, **options.pop("limits", {})})
        self.source = Source(script, self.events, opens, finite)
        self.requests = RequestQueue(limits.waiting_requests, limits.request_s)
        self.shots = queue.Queue(limits.waiting_captures)
        self.acquisition = Acquisition(
            self.source,
            self.requests,
            self.shots,
            dark=dark,
            finite=finite,
            backoff=backoff or Backoff(0.01, 0.02),
        )
        self.pipeline, self.publisher = Pipeline(self.events), Publisher(self.events)
        self.disk_fault = []
        sink = RecordingSink(
            tmp_path,
            "run",
            lambda path, part: Writer(self.events, path, self.disk_fault),
            options.pop("part_bytes", 1 << 30),
            options.pop("min_free_bytes", 0),
        )
        self.map_path = tmp_path / "map.npz"
        self.service = Service(
            acquisition=self.acquisition,
            pipeline=self.pipeline,
            publisher=self.publisher,
            requests=self.requests,
            shots=self.shots,
            limits=limits,
            sink=sink if recording else None,
            encode=lambda update: b"update",
            map_bytes=options.pop("map_bytes", lambda voxels: f"{len(voxels)} voxels".encode()),
            map_path=self.map_path,
            **options,
        )
        self.outcome = None
        self.thread = threading.Thread(target=self._run)

    def _run(self):
        try:
            self.outcome = self.service.run()
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.outcome = error

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.pipeline.gate.set()
        self.service.stop()
        self.join()

    def join(self):
        self.thread.join(15)
        assert not self.thread.is_alive()

    def until(self, condition, what="it"):
        for _ in range(1500):
            if condition():
                return
            time.sleep(0.01)
        raise AssertionError(f"{what} did not happen; events {self.events}, status {self.service.status()}")

    def health(self):
        return self.service.status()["health"]
