"""The Aravis driver's clocks, counters and its control thread, without a camera."""

from __future__ import annotations

import threading
import time

import pytest

from drivers.aravis import timing as aravis_timing
from drivers.aravis.control import ControlThread
from drivers.aravis.library import Buffer, GenicamError
from drivers.aravis.timing import Arrivals, Exposures, FrameCount, Trigger
from drivers.errors import DeviceFaultError

MS = 1_000_000


def buffer(device_ns=0, wall_ns=0, frame_id=1):
    return Buffer(True, "success", frame_id, device_ns, wall_ns, (8, 8), b"")


def trigger(sent_ns, accepted_ns=None, prompt=True):
    return Trigger(sent_ns, accepted_ns or sent_ns + MS, prompt)


class TestExposures:
    def exposures(self, **more):
        return Exposures(**{"device": "colour", "exposure_s": 0.005, "stamped_at_end": False, **more})

    @pytest.fixture
    def make(self):
        return lambda **more: self.exposures(**{"trigger_latency_s": 0.02, **more})

    @pytest.mark.parametrize("at_end", [False, True])
    def test_a_triggered_exposure_lies_between_its_trigger_and_its_packets(self, make, at_end):
        exposures = make(stamped_at_end=at_end)
        for n in range(12):
            sent_ns = 1_000 * MS + 100 * n * MS
            true_ns = sent_ns + (2 + n % 3) * MS
            stamp = true_ns + 777_000 * MS + (5 * MS if at_end else 0)
            began_ns, half_ns = exposures.began(
                buffer(stamp), true_ns + 15 * MS, true_ns + 20 * MS, trigger(sent_ns, sent_ns + MS)
            )
            assert began_ns - half_ns <= true_ns <= began_ns + half_ns
            assert began_ns - half_ns >= sent_ns
        assert half_ns < 12 * MS

    def test_without_stamps_the_trigger_alone_says_when(self, make):
        began_ns, half_ns = make().began(buffer(0), 30 * MS, 32 * MS, trigger(10 * MS))
        assert began_ns - half_ns >= 10 * MS
        assert began_ns + half_ns <= 27 * MS + 1
        with pytest.raises(DeviceFaultError, match="no time stamps"):
            make().began(buffer(0), 30 * MS, 32 * MS, None)

    def test_a_trigger_that_is_not_prompt_bounds_nothing_from_above(self, make):
        began_ns, half_ns = make().began(buffer(0), 200 * MS, 210 * MS, trigger(10 * MS, prompt=False))
        assert began_ns + half_ns == pytest.approx(200 * MS, abs=2)

    def test_a_clock_gone_wrong_never_moves_a_frame_out_of_its_bounds(self, make):
        exposures = make()
        for n in range(10):
            sent_ns = 1_000 * MS + 100 * n * MS
            jump = 3_000 * MS if n > 7 else 0
            began_ns, half_ns = exposures.began(
                buffer(sent_ns + 5_000 * MS + jump), sent_ns + 8 * MS, sent_ns + 9 * MS, trigger(sent_ns)
            )
            assert sent_ns <= began_ns - half_ns
            assert began_ns + half_ns <= sent_ns + 8 * MS

    def test_a_repeated_stamp_is_a_clock_that_stands_still(self, make):
        exposures = make()
        exposures.began(buffer(5 * MS), 30 * MS, 32 * MS, trigger(10 * MS))
        with pytest.raises(DeviceFaultError, match="stands still: frame 2"):
            exposures.began(buffer(5 * MS, frame_id=2), 130 * MS, 132 * MS, trigger(110 * MS))

    def test_a_late_frame_of_before_is_known_by_its_stamp(self, make):
        exposures = make()
        assert not exposures.is_from_before(buffer(5 * MS), 10**18)  # nothing is known yet
        for n in range(10):
            sent_ns = 1_000 * MS + 100 * n * MS
            exposures.began(buffer(sent_ns), sent_ns + 8 * MS, sent_ns + 9 * MS, trigger(sent_ns))
        assert exposures.is_from_before(buffer(sent_ns + 50 * MS), sent_ns + 100 * MS)
        assert not exposures.is_from_before(buffer(sent_ns + 120 * MS), sent_ns + 100 * MS)
        assert not exposures.is_from_before(buffer(0), sent_ns + 100 * MS)


class TestArrivals:
    def test_the_first_packet_came_as_long_ago_as_the_wall_clock_says(self, monkeypatch):
        now = {"host": 500 * MS, "wall": 10**18}
        monkeypatch.setattr(aravis_timing.time, "time_ns", lambda: now["wall"])
        arrivals = Arrivals(lambda: now["host"])
        now["host"] += 100 * MS
        now["wall"] += 100 * MS
        assert arrivals.of(buffer(wall_ns=now["wall"] - 30 * MS)) == (570 * MS, 600 * MS)
        assert arrivals.of(buffer(wall_ns=now["wall"] + 30 * MS)) == (600 * MS, 600 * MS)

    @pytest.mark.parametrize("step_ns", [-(10**12), 10**12])
    def test_a_wall_clock_that_was_set_meanwhile_says_nothing(self, monkeypatch, step_ns):
        now = {"host": 500 * MS, "wall": 10**18}
        monkeypatch.setattr(aravis_timing.time, "time_ns", lambda: now["wall"])
        arrivals = Arrivals(lambda: now["host"])
        stamped = now["wall"]
        now["host"] += 20 * MS
        now["wall"] += 20 * MS + step_ns
        assert arrivals.of(buffer(wall_ns=stamped)) == (520 * MS, 520 * MS)
        assert arrivals.of(buffer(wall_ns=now["wall"] - 5 * MS)) == (515 * MS, 520 * MS)


class TestFrameCount:
    def test_numbers_rise_over_the_counters_end_and_gaps_are_counted(self):
        count = FrameCount()
        assert [count.number(one) for one in (65_533, 65_534, 65_535, 1, 2, 5)] == [1, 2, 3, 4, 5, 8]
        assert count.missing == 2

    def test_a_counter_that_starts_again_leaves_no_gap(self):
        count = FrameCount()
        count.number(900)
        count.restart()
        assert count.number(1) == 2
        assert count.missing == 0

    def test_counters_of_64_bits_are_counters_too(self):
        count = FrameCount()
        assert [count.number(one) for one in (10**12, 10**12 + 1, 10**12 + 4)] == [1, 2, 5]


class TestControlThread:
    @pytest.fixture
    def control(self):
        made = ControlThread("colour", period_s=0.02, silence_s=0.3)
        yield made
        made.end()

    def soon(self, s=5.0):
        return time.monotonic_ns() + round(s * 1e9)

    def until(self, condition):
        end = time.monotonic() + 5
        while not condition():
            assert time.monotonic() < end
            time.sleep(0.01)

    def test_results_and_errors_come_back(self, control):
        assert control.call(lambda: 42, self.soon()) == 42
        with pytest.raises(GenicamError, match="no"):
            control.call(self.fails, self.soon())

    def fails(self):
        raise GenicamError("no")

    def test_nobody_waits_longer_than_he_said(self, control):
        gate = threading.Event()
        start = time.monotonic()
        with pytest.raises(TimeoutError):
            control.call(gate.wait, self.soon(0.1))
        assert time.monotonic() - start < 1
        done = []
        with pytest.raises(TimeoutError):
            control.call(lambda: done.append(1), self.soon(0.1))
        gate.set()
        assert control.call(lambda: 7, self.soon()) == 7
        assert not done  # nobody was waiting for it any more

    def test_a_call_without_an_answer_is_a_loss(self, control):
        gate = threading.Event()
        control.look_after(lambda: "", lambda answers: None)
        with pytest.raises(TimeoutError):
            control.call(gate.wait, self.soon(0.05))
        assert control.how_lost() == ""
        self.until(lambda: "has not answered for 0.3 s" in control.how_lost())
        gate.set()

    @pytest.mark.parametrize(
        ("look", "how"),
        [
            (lambda: "it was reset", "it was reset"),
            (lambda: [][1], "see the log"),
        ],
    )
    def test_what_the_look_finds_is_a_loss(self, control, look, how):
        control.look_after(look, lambda answers: None)
        self.until(lambda: how in control.how_lost())

    def test_a_look_that_fails_is_a_loss(self, control):
        control.look_after(self.fails, lambda answers: None)
        self.until(lambda: "no longer answers (no)" in control.how_lost())

    def test_the_first_loss_is_the_one_that_is_told(self, control):
        control.mark_lost("first")
        control.mark_lost("second")
        assert control.lost == "first"

    def test_the_camera_is_released_once_in_the_end_and_told_whether_it_is_there(self):
        released = []
        for lost in ("", "gone"):
            control = ControlThread("colour", period_s=0.02)
            control.look_after(lambda: "", released.append)
            if lost:
                control.mark_lost(lost)
            control.end()
            control.end()
            self.until(lambda: len(released) == (2 if lost else 1))  # noqa: B023 - called at once
        assert released == [True, False]

    def test_an_end_does_not_wait_for_a_camera_that_is_lost(self):
        control, gate, released = ControlThread("colour", silence_s=0.5), threading.Event(), []
        control.look_after(lambda: "", released.append)
        with pytest.raises(TimeoutError):
            control.call(gate.wait, self.soon(0.05))
        control.mark_lost("gone")
        start = time.monotonic()
        control.end()
        assert time.monotonic() - start < 0.5
        gate.set()
        self.until(lambda: released == [False])
