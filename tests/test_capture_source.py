"""Live sensors and recordings as one kind of source, the triggers, and the table of backends."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from capture_values import CLASSES_TOML, RIG_TOML, assert_same, capture
from fake_devices import FakeArm, FakeClock, FakeColour, FakeDepth, FakeLight

from drivers import backends
from drivers.capture_source import (
    CaptureRequest,
    CaptureSource,
    IntervalTrigger,
    LiveSource,
    RequestTrigger,
    RestTrigger,
    Trigger,
)
from drivers.clock import SystemClock
from drivers.errors import CaptureRejectedError, DriverUnavailableError
from drivers.recordings import Recording, RecordingWriter
from drivers.recordings.replay import RecordingSource
from drivers.sensor_package import SensorPackage
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture


class Bench:
    """Live sensors on a jumping clock, with an arm that moves 1 rad/s towards `goal`."""

    def __init__(self, trigger: Trigger) -> None:
        log: list[str] = []
        self.clock = FakeClock()
        colour, depth = FakeColour("colour", self.clock, log), FakeDepth("depth", self.clock, log)
        light, self.arm = FakeLight("light", self.clock, log), FakeArm("arm", self.clock, log)
        colour.light = light
        self.light = light
        package = SensorPackage(self.clock, colour, depth, light, self.arm)
        self.source = LiveSource(package, trigger, self.clock, with_dark=True)
        self.source.open()
        self.stay(0.0)

    def stay(self, angle: float) -> None:
        self.arm.path = lambda _: np.array([0, angle, 0, 0, 0, 0])

    def move(self, start: float, goal: float) -> None:
        begin = self.clock.now_ns()
        self.arm.path = lambda t_ns: np.array([0, min(goal, start + (t_ns - begin) / 1e9), 0, 0, 0, 0])

    def run(self, seconds: float) -> list[Capture]:
        """The captures of the next seconds."""
        end, found = self.clock.now_ns() + round(seconds * 1e9), []
        while self.clock.now_ns() < end:
            one = self.source.next(min(0.1, (end - self.clock.now_ns()) / 1e9))
            found += [] if one is None else [one]
        return found


def test_captures_are_taken_on_request_only() -> None:
    b = Bench(RequestTrigger())
    assert b.run(5) == []
    one = b.source.next(0.1, CaptureRequest("asked", "light", with_dark=False))
    assert one is not None
    assert (one.name, one.role, one.dark) == ("asked", "light", None)
    before = b.clock.now_ns()
    two = b.source.next(60.0, CaptureRequest())
    assert two is not None
    assert b.clock.now_ns() - before < 1e9  # at once
    assert not b.source.finished


def test_captures_without_a_name_are_numbered() -> None:
    b = Bench(IntervalTrigger(1.0))
    b.source.next(0.1, CaptureRequest("asked"))
    assert [one.name for one in b.run(2.5)] == ["000001", "000002", "000003"]
    assert all(one.dark is not None and one.role == "map" for one in b.run(2))


def test_the_interval_is_kept_without_drift_or_backlog() -> None:
    b = Bench(IntervalTrigger(1.0))
    start = b.clock.now_ns()
    times = [one.t_ns - start for one in b.run(4.5)]
    assert [round(t / 1e9) for t in times] == [0, 1, 2, 3, 4]
    assert max(t % 1_000_000_000 for t in times) < 20_000_000
    b.clock.sleep(10.3)  # busy with something else
    # One for all that were missed, and then the ticks again.
    assert [(one.t_ns - start) // 1_000_000_000 for one in b.run(2)] == [14, 15, 16]


def test_one_capture_at_each_rest() -> None:
    b = Bench(RestTrigger(rest_s=0.5))
    assert len(b.run(3)) == 1  # where it stands first
    b.move(0.0, 0.7)
    assert b.run(1.1) == []  # 0.7 s under way, then not yet 0.5 s at rest
    found = b.run(3)
    assert [one.joints.q[1] for one in found if one.joints is not None] == [0.7]
    b.move(0.7, 0.705)
    assert b.run(3) == []  # not far enough to be another view
    b.move(0.705, 0.72)
    assert len(b.run(3)) == 1


def test_a_view_that_was_asked_for_needs_no_trigger() -> None:
    b = Bench(RestTrigger())
    b.source.next(0.1, CaptureRequest("asked"))
    assert b.run(3) == []


def test_a_slow_creep_is_no_rest() -> None:
    b = Bench(RestTrigger(rest_s=0.5, still_rad=0.001))
    b.arm.path = lambda t_ns: np.array([0.004 * t_ns / 1e9, 0, 0, 0, 0, 0])
    assert b.run(4) == []


def test_a_rejected_capture_waits_for_another_rest() -> None:
    b = Bench(RestTrigger(rest_s=0.5, still_rad=0.01, moved_rad=0.05))
    b.arm.path = lambda t_ns: np.array([0.005 * np.sin(60 * t_ns / 1e9), 0, 0, 0, 0, 0])  # trembles
    with pytest.raises(CaptureRejectedError, match="moved"):
        b.run(3)
    assert b.light.level == 0
    b.stay(0.0)
    at = b.clock.now_ns()
    found = b.run(3)
    assert [one.name for one in found] == ["000001"]  # the rejected one used no number up
    assert found[0].t_ns - at >= 500_000_000


def test_the_rest_trigger_needs_an_arm() -> None:
    with pytest.raises(ConfigurationError, match="needs an arm"):
        RestTrigger().due(0, lambda: None)
    with pytest.raises(ConfigurationError, match="0 < still_rad < moved_rad"):
        RestTrigger(still_rad=0.1, moved_rad=0.1)
    with pytest.raises(ConfigurationError, match="interval_s 0"):
        IntervalTrigger(0)


def test_waiting_is_bounded_by_the_timeout() -> None:
    b = Bench(RequestTrigger())
    before = b.clock.now_ns()
    assert b.source.next(0.2) is None
    assert b.clock.now_ns() - before == 200_000_000


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Four captures, 0.1 s apart, without joints as a set of hand-held views has them."""
    with RecordingWriter(tmp_path / "a.mcap", RIG_TOML, CLASSES_TOML) as writer:
        for seed, role in enumerate(["train", "map", "test", "map"]):
            writer.write(capture(seed, role=role, joints=None))
    return tmp_path / "a.mcap"


def drain(source: CaptureSource) -> list[Capture]:
    found = []
    while not source.finished:
        one = source.next(1.0)
        found += [] if one is None else [one]
    return found


def test_a_recording_gives_its_captures_as_they_are(recording: Path) -> None:
    clock = FakeClock()
    with RecordingSource(recording, clock) as source:
        assert source.is_open
        assert source.recording.rig.name == "bench"
        found = drain(source)
        assert source.next(1.0) is None
    assert not source.is_open
    assert clock.now_ns() == FakeClock().now_ns()  # no waiting
    for one, other in zip(found, Recording.open(recording).captures(), strict=True):
        assert_same(one, other)


def test_roles_and_requests_on_a_recording(recording: Path) -> None:
    with RecordingSource(recording, FakeClock(), roles=("map",)) as source:
        first = source.next(1.0, CaptureRequest("asked", "light"))
        assert first is not None
        assert (first.name, first.role) == ("c001", "map")
        assert [one.name for one in drain(source)] == ["c003"]


def test_a_recording_starts_anew_when_it_is_opened_again(recording: Path) -> None:
    source = RecordingSource(recording, FakeClock())
    for _ in range(2):
        with source:
            assert len(drain(source)) == 4


def test_the_recorded_pace(recording: Path) -> None:
    clock = FakeClock()
    with RecordingSource(recording, clock, pace="recorded") as source:
        start, times = clock.now_ns(), []
        while not source.finished:
            before = clock.now_ns()
            if source.next(0.03) is not None:
                times.append(clock.now_ns() - start)
            assert clock.now_ns() - before <= 30_000_000
    assert times == [0, 100_000_000, 200_000_000, 300_000_000]


def test_a_request_hurries_the_recorded_pace(recording: Path) -> None:
    clock = FakeClock()
    with RecordingSource(recording, clock, pace="recorded") as source:
        source.next(1.0)
        source.next(1.0, CaptureRequest())
        assert clock.now_ns() == FakeClock().now_ns()
        source.next(1.0)
        assert clock.now_ns() == FakeClock().now_ns() + 100_000_000


def test_a_bad_recording_is_an_input_error(recording: Path) -> None:
    source = RecordingSource(recording, FakeClock())
    with pytest.raises(InputError, match="not open"):
        source.next(1.0)
    recording.write_bytes(recording.read_bytes()[:-20])
    with pytest.raises(InputError, match="unfinished"):
        source.open()
    assert not source.is_open
    with pytest.raises(ConfigurationError, match="pace 'slow', allowed: fast, recorded"):
        RecordingSource(recording, FakeClock(), pace="slow")


def test_real_poses_without_joints_run(shared: Path, tmp_path: Path) -> None:
    from drivers.recordings.folder import read_folder

    folder = read_folder(shared / "data" / "kitchen")
    with RecordingWriter(tmp_path / "k.mcap", folder.rig_text, folder.classes_text) as writer:
        for one, encoded in folder.captures():
            writer.write(one, encoded)
    with RecordingSource(tmp_path / "k.mcap", SystemClock()) as source:
        assert len(drain(source)) == 14


def test_the_system_clock_is_monotonic() -> None:
    clock = SystemClock()
    before = clock.now_ns()
    clock.sleep(-1.0)
    clock.sleep(0.01)
    assert 10_000_000 <= clock.now_ns() - before < 2_000_000_000


def test_every_backend_of_the_table_is_there() -> None:
    from drivers.sim.world import SimWorld

    world = SimWorld("grey_card", 0, scale=0.05)
    for kind in backends.KINDS:
        assert "sim" in backends.backends(kind)
        device = backends.create(kind, "sim", clock=world.clock, shared={"sim": world})
        assert (device.name, device.is_open) == (kind, False)


def test_unknown_backends_and_options_are_named() -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"colour\.backend: 'simm', allowed: sim, aravis, iidc, v4l2; did you mean 'sim'\?",
    ):
        backends.create("colour", "simm", clock=FakeClock())
    with pytest.raises(
        ConfigurationError, match="kind of device 'color', allowed: colour, depth, light, arm"
    ):
        backends.create("color", "sim", clock=FakeClock())
    with pytest.raises(ConfigurationError, match="colour: options exposure_us"):
        backends.create("colour", "sim", clock=FakeClock(), options={"exposure_us": 1})
    with pytest.raises(ConfigurationError, match="needs a simulated world"):
        backends.create("colour", "sim", clock=FakeClock())


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "acme_driver.py").write_text("import acme_sdk\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(backends._TABLE, ("light", "acme"), "acme_driver:light")
    with pytest.raises(
        DriverUnavailableError, match=r"lamp: .*'acme' needs the library 'acme_sdk'"
    ) as caught:
        backends.create("light", "acme", name="lamp", clock=FakeClock())
    assert caught.value.device == "lamp"


def test_the_table_imports_no_driver() -> None:
    code = "import sys, drivers.backends; sys.exit('drivers.sim' in sys.modules or 'cv2' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], check=False).returncode
        == 0
    )
