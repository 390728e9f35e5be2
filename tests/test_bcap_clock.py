"""When joints were read, out of a call's times and a controller's stamps that may be wrong in every way."""

from __future__ import annotations

import math
import random

import pytest

from drivers.bcap.stamps import ReplyClock, Stamp

MS = 1_000_000
BOOT = 5_000 * MS


def stamps(count, every_ms=8.0, round_trip_ms=2.0, rate=1.0, unit=1.0, begin_ms=0.0, lag_ms=0.0, seed=1):
    """Replies whose stamp was taken somewhere within the call; and when that was, host ns."""
    draw = random.Random(seed)
    for number in range(count):
        sent_ns = BOOT + round((begin_ms + number * every_ms) * MS)
        length_ns = round(round_trip_ms * MS * (1 + min(1.5, draw.expovariate(2))))
        taken_ns = sent_ns + round(draw.random() * length_ns) - round(lag_ms * MS)
        ms = float(math.floor(((taken_ns - BOOT) / MS * rate + 70_000) / unit))
        yield Stamp(ms, sent_ns, sent_ns + length_ns), taken_ns


def trial(**how):
    return [stamp for stamp, _ in stamps(20, **how)]


@pytest.mark.parametrize("rate", [1.0, 1.0002])
def test_every_reading_was_taken_in_the_interval_given(rate):
    clock = ReplyClock(trial(rate=rate))
    assert clock.trusted
    for stamp, taken_ns in stamps(2000, rate=rate, begin_ms=200, seed=2):
        begin_ns, end_ns = clock.interval(stamp)
        assert begin_ns <= taken_ns <= end_ns
        assert stamp.sent_ns <= begin_ns
        assert end_ns <= stamp.came_ns


def test_a_reply_that_was_slow_to_come_is_not_uncertain_by_its_slowness():
    clock = ReplyClock(trial())
    for stamp, _ in stamps(300, begin_ms=160, seed=2):
        clock.interval(stamp)
    (stamp, taken_ns), *_ = stamps(1, begin_ms=2600, round_trip_ms=2.0, seed=3)
    slow = Stamp(stamp.ms, stamp.sent_ns, stamp.came_ns + 60 * MS)
    begin_ns, end_ns = clock.interval(slow)
    assert begin_ns <= taken_ns <= end_ns
    assert end_ns - begin_ns < 10 * MS


def test_joints_read_before_they_were_asked_for_get_the_time_of_their_stamp():
    clock = ReplyClock(trial())
    late = [stamps(1, begin_ms=200 + 80 * n, lag_ms=12.0, seed=n) for n in range(1, 20)]
    on_time = [stamps(6, begin_ms=200 + 80 * n + 8, seed=n + 100) for n in range(1, 20)]
    for held, usual in zip(late, on_time, strict=True):
        ((stamp, taken_ns),) = held
        begin_ns, end_ns = clock.interval(stamp)
        if (begin_ns, end_ns) != (stamp.sent_ns, stamp.came_ns):  # what the clock is too young to tell
            assert begin_ns <= taken_ns <= end_ns < stamp.sent_ns
        for stamp, taken_ns in usual:
            begin_ns, end_ns = clock.interval(stamp)
            assert begin_ns <= taken_ns <= end_ns
    assert clock.older >= 15


def test_the_same_stamp_again_is_no_reading():
    clock = ReplyClock(trial())
    (stamp, _), *_ = stamps(1, begin_ms=200)
    assert clock.interval(stamp) is not None
    assert clock.interval(Stamp(stamp.ms, stamp.sent_ns + 8 * MS, stamp.came_ns + 8 * MS)) is None


@pytest.mark.parametrize("jump_ms", [-50_000.0, 50_000.0, 900.0])
def test_a_clock_that_jumps_is_counted_and_gives_no_false_time(jump_ms):
    clock = ReplyClock(trial())
    for stamp, taken_ns in stamps(200, begin_ms=160, seed=2):
        jumped = Stamp(stamp.ms + jump_ms, stamp.sent_ns, stamp.came_ns)
        begin_ns, end_ns = clock.interval(jumped)
        assert begin_ns <= taken_ns <= end_ns
    assert clock.jumps >= 1


@pytest.mark.parametrize("ms", [math.nan, math.inf, -math.inf, 1e300])
def test_a_stamp_that_is_no_time_leaves_the_time_of_the_call(ms):
    clock = ReplyClock(trial())
    assert clock.interval(Stamp(ms, BOOT + 500 * MS, BOOT + 502 * MS)) == (BOOT + 500 * MS, BOOT + 502 * MS)
    assert clock.refuted == 1


@pytest.mark.parametrize(
    "first",
    [
        [],
        trial()[:1],
        trial(unit=8.0),
        trial(unit=0.001),
        list(reversed(trial())),
        [Stamp(math.nan, 0, 1), Stamp(math.nan, 100 * MS, 101 * MS)],
    ],
    ids=["none", "one", "in units of 8 ms", "in µs", "backwards", "no numbers"],
)
def test_stamps_that_count_no_milliseconds_are_not_used(first):
    clock = ReplyClock(first)
    assert not clock.trusted
    assert not clock.stands
    assert clock.interval(Stamp(1.0, 5, 9)) == (5, 9)
    assert clock.interval(Stamp(1.0, 15, 19)) == (15, 19)
    assert "host" in clock.describe()


def test_stamps_that_stand_still_are_noticed():
    first = [Stamp(7.0, stamp.sent_ns, stamp.came_ns) for stamp in trial()]
    clock = ReplyClock(first)
    assert clock.stands
    assert not clock.trusted


def test_fractions_of_a_millisecond_narrow_the_interval():
    whole, fine = ReplyClock(trial()), ReplyClock([Stamp(s.ms + 0.25, s.sent_ns, s.came_ns) for s in trial()])
    stamp = Stamp(70_600.0, BOOT + 590 * MS, BOOT + 640 * MS)
    widths = [end_ns - begin_ns for begin_ns, end_ns in (whole.interval(stamp), fine.interval(stamp))]
    assert widths[1] < widths[0]
