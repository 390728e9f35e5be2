"""The ring of joint readings: interpolation, waiting, staleness, and what a loss leaves behind."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceLostError, DeviceTimeoutError
from drivers.joint_history import JointHistory
from surfclass.errors import InputError
from surfclass.frames import JointState

MS = 1_000_000


def reading(t_ns, angle, sd_ns=0):
    return JointState(t_ns, sd_ns, np.full(6, angle))


def later(seconds, call):
    timer = threading.Timer(seconds, call)
    timer.start()
    return timer


@pytest.fixture
def now():
    return time.monotonic_ns()


def test_angles_between_two_readings_are_linear(now):
    history = JointHistory("arm")
    history.add(reading(now - 20 * MS, 1.0, sd_ns=MS))
    history.add(reading(now - 12 * MS, 2.0, sd_ns=3 * MS))
    quarter = history.at(now - 18 * MS, 0.1)
    assert quarter.t_ns == now - 18 * MS
    assert quarter.q == pytest.approx(np.full(6, 1.25))
    assert quarter.t_sd_ns == pytest.approx(1.5 * MS)


def test_the_time_of_a_reading_gives_that_reading(now):
    history = JointHistory("arm")
    state = reading(now - MS, 1.0, sd_ns=7)
    history.add(state)
    assert history.at(state.t_ns, 0.1) is state


@given(
    steps=st.lists(st.integers(1, 50), min_size=2, max_size=30),
    part=st.floats(0, 1),
    slope=st.floats(-3, 3),
    sd_ms=st.integers(0, 5),
)
def test_a_steady_motion_is_known_at_every_time_to_within_its_uncertainty(steps, part, slope, sd_ms):
    begin = time.monotonic_ns() - 2_000 * MS
    times = begin + np.cumsum(steps) * MS
    errors = np.where(np.arange(len(times)) % 2, 1, -1) * sd_ms * MS
    history = JointHistory("arm", max_gap_s=1.0)
    for t_ns, error_ns in zip(times, errors, strict=True):
        history.add(reading(int(t_ns), slope * (t_ns + error_ns - begin) / 1e9, sd_ms * MS))
    t_ns = int(times[0] + part * (times[-1] - times[0]))
    found = history.at(t_ns, 0.1)
    wrong_s = abs(found.q[0] - slope * (t_ns - begin) / 1e9)
    assert wrong_s <= abs(slope) * found.t_sd_ns / 1e9 + 1e-9


def test_the_reading_after_is_waited_for(now):
    history = JointHistory("arm")
    history.add(reading(now - 4 * MS, 0.0))
    timer = later(0.05, lambda: history.add(reading(now + 4 * MS, 1.0)))
    assert history.at(now, 5.0).q == pytest.approx(np.full(6, 0.5))
    timer.join()


def test_a_reading_that_never_comes_is_a_timeout(now):
    history = JointHistory("arm")
    history.add(reading(now - 4 * MS, 0.0))
    history.why = "the wire is cut"
    with pytest.raises(DeviceTimeoutError, match=r"within 0\.05 s; the wire is cut"):
        history.at(now, 0.05)
    assert 0.04 < (time.monotonic_ns() - now) / 1e9 < 1.0
    assert history.stale == 1


def test_the_timeout_of_a_time_ahead_counts_from_that_time(now):
    history = JointHistory("arm", max_gap_s=10.0)
    history.add(reading(now, 0.0))
    timer = later(0.5, lambda: history.add(reading(now + 600 * MS, 6.0)))
    assert history.at(now + 500 * MS, 0.4).q[0] == pytest.approx(5.0)  # not 0.4 s from now
    timer.join()


def test_readings_too_far_apart_say_nothing_of_the_time_between(now):
    history = JointHistory("arm", max_gap_s=0.02)
    history.add(reading(now - 30 * MS, 0.0))
    history.add(reading(now - 8 * MS, 0.0))
    with pytest.raises(DeviceTimeoutError, match=r"22\.0 ms"):
        history.at(now - 10 * MS, 0.1)
    assert history.at(now - 8 * MS, 0.1).q[0] == 0.0


def test_a_time_before_the_oldest_reading_is_refused_at_once(now):
    history = JointHistory("arm", capacity=2)
    for ms in (30, 20, 10):
        history.add(reading(now - ms * MS, 0.0))
    with pytest.raises(DeviceTimeoutError, match="oldest"):
        history.at(now - 25 * MS, 60.0)


def test_the_ring_keeps_no_more_than_its_capacity(now):
    history = JointHistory("arm", capacity=3)
    for ms in range(10):
        history.add(reading(now - 50 * MS + ms * MS, float(ms)))
    assert history.accepted == 10
    assert history.at(now - 43 * MS, 0.1).q[0] == 7.0
    with pytest.raises(DeviceTimeoutError):
        history.at(now - 44 * MS, 0.1)


def test_a_reading_that_is_not_later_is_dropped_and_counted(now):
    history = JointHistory("arm")
    assert history.add(reading(now, 1.0))
    assert not history.add(reading(now, 2.0))
    assert not history.add(reading(now - 1, 3.0))
    assert (history.accepted, history.dropped) == (1, 2)
    assert history.latest().q[0] == 1.0


def test_since_waits_for_a_reading_that_certainly_began_after(now):
    history = JointHistory("arm")
    history.add(reading(now - MS, 1.0))
    history.add(reading(now + MS, 2.0, sd_ns=2 * MS))
    timer = later(0.05, lambda: history.add(reading(now + 9 * MS, 3.0, sd_ns=2 * MS)))
    assert history.since(now, 5.0).q[0] == 3.0
    timer.join()


def test_after_clear_nothing_from_before_is_given(now):
    history = JointHistory("arm")
    for ms in (20, 10):
        history.add(reading(now - ms * MS, 1.0))
    history.clear()
    assert history.latest() is None
    with pytest.raises(DeviceTimeoutError):
        history.at(now - 15 * MS, 0.02)
    history.add(reading(now, 5.0))
    with pytest.raises(DeviceTimeoutError, match="oldest"):
        history.at(now - 15 * MS, 0.02)


def test_the_end_wakes_who_waits_and_is_raised_until_cleared(now):
    history = JointHistory("arm")
    history.add(reading(now - MS, 1.0))
    timer = later(0.05, lambda: history.end(DeviceLostError, "the cable is out"))
    with pytest.raises(DeviceLostError, match="arm: the cable is out"):
        history.at(now, 60.0)
    timer.join()
    history.end(DeviceTimeoutError, "a later reason does not replace the first")
    for ask in (history.latest, lambda: history.since(0, 1.0), lambda: history.at(now - MS, 1.0)):
        with pytest.raises(DeviceLostError, match="cable"):
            ask()
    history.clear()
    assert history.latest() is None


def test_one_writer_and_a_reader_agree(now):
    history = JointHistory("arm", capacity=16, max_gap_s=1.0)
    done = threading.Event()

    def write():
        while not done.is_set():
            t_ns = time.monotonic_ns()
            history.add(reading(t_ns, (t_ns - now) / 1e9))
            done.wait(0.002)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(50):
            t_ns = time.monotonic_ns()
            assert history.at(t_ns, 5.0).q[0] == pytest.approx((t_ns - now) / 1e9, abs=1e-6)
    finally:
        done.set()
        writer.join()


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan"), float("inf")])
def test_a_timeout_that_is_none_is_refused(now, timeout):
    with pytest.raises(InputError, match="timeout"):
        JointHistory("arm").at(now, timeout)


def test_a_time_of_another_clock_is_refused():
    with pytest.raises(InputError, match="ahead"):
        JointHistory("arm").at(time.time_ns() + 10**18, 0.1)


@pytest.mark.parametrize("options", [{"capacity": 1}, {"max_gap_s": 0.0}, {"max_gap_s": float("nan")}])
def test_a_history_that_could_hold_nothing_is_refused(options):
    with pytest.raises(InputError, match="2 readings or more"):
        JointHistory("arm", **options)
