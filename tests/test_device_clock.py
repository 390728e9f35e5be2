"""Makes a device clock, corrupts what arrives of it, and recovers it."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.device_clock import DeviceClock
from surfclass.errors import InputError


@dataclass
class Made:
    """A device's clock as it truly is: `ticks_at` a host time, and how its stamps arrive."""

    rng: np.random.Generator
    tick_s: float = 1e-6
    drift_ppm: float = 0.0
    offset_s: float = 4321.0
    latency_s: float = 0.0
    latency_sd_s: float = 0.0
    scatter_s: float = 1e-3  # mean of the exponential delay on top
    spikes: float = 0.05  # part of the stamps that come another 50 ms later on average
    wrap_ticks: int | None = None

    def ticks_at(self, t_s):
        ticks = round((t_s * (1 + self.drift_ppm * 1e-6) + self.offset_s) / self.tick_s)
        return ticks if self.wrap_ticks is None else ticks % self.wrap_ticks

    def delay_s(self):
        delay = self.latency_s + self.rng.uniform(-1, 1) * self.latency_sd_s
        delay += self.rng.exponential(self.scatter_s)
        return delay + (self.rng.exponential(0.05) if self.rng.uniform() < self.spikes else 0.0)


def followed(clock, made, times_s, trigger=None):
    """Error and half interval of each stamp as it arrives, ns; never after its arrival, and in order."""
    errors, halves, before_ns, arrival_ns = [], [], 0, 0
    for t_s in times_s:
        ticks = made.ticks_at(t_s)
        arrival_ns = max(arrival_ns + 1, round((t_s + made.delay_s()) * 1e9))  # a bus keeps the order
        sent_ns = None if trigger is None else round((t_s - trigger()) * 1e9)
        clock.observe(ticks, arrival_ns, sent_ns)
        t_ns, half_ns = clock.to_host(ticks)
        assert before_ns < t_ns <= arrival_ns + 1
        errors.append(t_ns - t_s * 1e9)
        halves.append(half_ns)
        before_ns = t_ns
    return np.array(errors), np.array(halves)


def frame_times(rng, n=600, period_s=1 / 30, begin_s=1000.0):
    return begin_s + np.cumsum(rng.uniform(0.95, 1.05, n)) * period_s


CASES = {
    "a good bus": {},
    "a slow clock": {"drift_ppm": -100.0},
    "a fast clock": {"drift_ppm": 100.0},
    "a bad crystal": {"drift_ppm": 450.0},
    "a busy bus": {"scatter_s": 5e-3, "spikes": 0.2},
    "a read-out that is known": {"latency_s": 0.03, "latency_sd_s": 1e-3},
    "a counter that wraps": {"tick_s": 1 / 60e6, "wrap_ticks": 2**32, "drift_ppm": 40.0},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("period_s", [1 / 30, 1.0])
def test_the_truth_is_within_the_half_interval(case, period_s):
    inside, errors, halves = [], [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        made = Made(rng, **case)
        clock = DeviceClock(
            made.tick_s,
            latency_s=made.latency_s,
            latency_sd_s=made.latency_sd_s,
            wrap_ticks=made.wrap_ticks,
        )
        error, half = followed(clock, made, frame_times(rng, 300, period_s))
        inside.append(np.abs(error) <= half)
        errors.append(error[30:])
        halves.append(half[30:])
        assert clock.jumps == clock.frozen == 0
    scale_ns = (made.scatter_s + 2 * made.latency_sd_s) * 1e9
    assert np.mean(inside) >= 0.99
    assert abs(np.mean(errors)) < 0.5 * scale_ns
    assert np.median(halves) < 1.5 * scale_ns


def test_drift_is_found_within_a_few_ppm_of_a_minute():
    for seed, drift_ppm in enumerate((-100.0, -12.0, 0.0, 12.0, 100.0)):
        rng = np.random.default_rng(seed)
        clock, made = DeviceClock(1e-6), Made(rng, drift_ppm=drift_ppm)
        times = frame_times(rng, 1800)
        followed(clock, made, times[:60])
        assert clock.drift_ppm is None, "two seconds say nothing about a drift"
        followed(clock, made, times[60:])
        assert clock.drift_ppm == pytest.approx(drift_ppm, abs=3.0)
        assert clock.offset_ns == pytest.approx(-(4321 + times[-1] * drift_ppm * 1e-6) * 1e9, abs=1e6)


def test_an_unknown_latency_shows_in_the_half_interval_where_triggers_bound_it():
    rng = np.random.default_rng(1)
    clock, made = DeviceClock(1e-9), Made(rng, tick_s=1e-9, latency_s=0.02, drift_ppm=30.0)
    error, half = followed(clock, made, frame_times(rng), lambda: 0.001 + rng.exponential(2e-3))
    assert np.mean(np.abs(error) <= half) >= 0.99
    assert np.all(half[30:] < 12e6)
    assert np.all(half[30:] > 9e6), "20 ms are unknown, and nobody said which"


def test_a_known_latency_and_triggers_together_are_no_worse_than_either():
    halves = {}
    for known in (False, True):
        for triggered in (False, True):
            rng = np.random.default_rng(2)
            made = Made(rng, latency_s=0.02, latency_sd_s=0.001)
            clock = DeviceClock(1e-6, latency_s=0.02 * known, latency_sd_s=0.001 * known)
            trigger = (lambda rng=rng: 0.0005 + rng.exponential(1e-3)) if triggered else None
            error, half = followed(clock, made, frame_times(rng), trigger)
            halves[known, triggered] = np.median(half)
            assert not (known or triggered) or np.mean(np.abs(error) <= half) >= 0.99
    assert halves[True, True] < halves[True, False]
    assert halves[True, True] < halves[False, True]


@pytest.mark.parametrize("step_s", [-4321.0, -2.0, -0.2, 0.2, 2.0, 1e6])
def test_a_clock_that_jumps_is_noticed_counted_and_followed(step_s):
    rng = np.random.default_rng(3)
    clock, made = DeviceClock(1e-6), Made(rng, drift_ppm=20.0)
    followed(clock, made, frame_times(rng, 300))
    made.offset_s += step_s
    error, half = followed(clock, made, frame_times(rng, 300, begin_s=1011.0))
    assert clock.jumps == 1
    assert np.mean(np.abs(error[20:]) <= half[20:]) >= 0.99
    assert np.abs(error[40:]).max() < 2e6
    if step_s < -1 or step_s > 0:  # only of a small step back can the first stamps seem to be delayed
        assert np.abs(error[0]) <= half[0]


def test_a_small_step_back_widens_the_half_interval():
    rng = np.random.default_rng(4)
    clock, made = DeviceClock(1e-6), Made(rng)
    followed(clock, made, frame_times(rng, 300))
    made.offset_s -= 0.02
    error, half = followed(clock, made, frame_times(rng, 100, begin_s=1010.5))
    assert clock.jumps == 0
    assert np.all(np.abs(error[8:]) <= half[8:])
    assert half[8:].min() > 15e6


def test_frames_that_come_late_for_long_are_no_jump_of_the_clock_if_one_comes_in_time():
    rng = np.random.default_rng(5)
    clock, made = DeviceClock(1e-6), Made(rng)
    times = frame_times(rng, 400)
    followed(clock, made, times[:200])
    for n, t_s in enumerate(times[200:]):
        delay_s = 0.3 if n % 5 else rng.exponential(1e-3)
        clock.observe(made.ticks_at(t_s), round((t_s + delay_s) * 1e9))
        t_ns, half_ns = clock.to_host(made.ticks_at(t_s))
        assert abs(t_ns - t_s * 1e9) <= half_ns < 50e6
    assert clock.jumps == 0


def test_first_frames_that_were_held_back_are_forgotten_and_no_jump():
    rng = np.random.default_rng(6)
    clock, made = DeviceClock(1e-6), Made(rng)
    times = frame_times(rng, 60)
    for t_s, delay_s in zip(times[:3], (0.9, 0.7, 0.5), strict=True):
        clock.observe(made.ticks_at(t_s), round((t_s + delay_s) * 1e9))
    error, half = followed(clock, made, times[3:])
    assert clock.jumps == 0
    assert np.all(np.abs(error) <= half)


def test_a_clock_that_stands_still_is_counted_and_gives_nothing_new():
    clock = DeviceClock(1e-3)
    for n in range(50):
        clock.observe(n * 33, n * 33_000_000 + 5_000_000)
    stands_ns = clock.to_host(49 * 33)[0]
    for n in range(50, 60):
        clock.observe(49 * 33, n * 33_000_000 + 5_000_000)
        assert clock.to_host(49 * 33)[0] == stands_ns
    assert (clock.frozen, clock.jumps) == (10, 0)
    assert "10 stamps repeated" in clock.describe()


def test_a_counter_that_wrapped_many_times_while_nothing_was_taken_is_no_jump():
    rng = np.random.default_rng(7)
    made = Made(rng, tick_s=1 / 60e6, wrap_ticks=2**32, drift_ppm=50.0)  # 71.6 s a round
    clock = DeviceClock(made.tick_s, wrap_ticks=2**32)
    for begin_s in (1000.0, 1100.0, 1400.0, 3000.0):
        error, half = followed(clock, made, frame_times(rng, 60, begin_s=begin_s))
        assert np.mean(np.abs(error) <= half) >= 0.98
    assert clock.jumps == 0


def test_an_hour_of_a_crystal_that_warms_up_is_followed():
    rng = np.random.default_rng(8)
    clock, made = DeviceClock(1e-6), Made(rng)
    inside, device_s, before_s = [], 0.0, 0.0
    for t_s in np.arange(0.0, 3600.0, 0.5):
        device_s += (t_s - before_s) * (1 + (20 + 10 * math.exp(-t_s / 900)) * 1e-6)
        before_s = t_s
        ticks = round(device_s * 1e6)
        clock.observe(ticks, round((1000 + t_s + made.delay_s()) * 1e9))
        t_ns, half_ns = clock.to_host(ticks)
        inside.append(abs(t_ns - (1000 + t_s) * 1e9) <= half_ns)
    assert np.mean(inside) >= 0.99
    assert clock.drift_ppm == pytest.approx(20.0, abs=2.0)


def test_a_late_sample_never_moves_an_earlier_time_beyond_its_arrival():
    rng = np.random.default_rng(9)
    clock, made = DeviceClock(1e-6), Made(rng, spikes=0.5, drift_ppm=100.0)
    seen = []
    for t_s in frame_times(rng, 300):
        ticks, arrival_ns = made.ticks_at(t_s), round((t_s + made.delay_s()) * 1e9)
        clock.observe(ticks, arrival_ns)
        seen.append((ticks, arrival_ns))
    for ticks, arrival_ns in seen:
        assert clock.to_host(ticks)[0] <= arrival_ns + 1


def test_words_for_an_operator():
    clock = DeviceClock(1e-6)
    assert clock.describe() == "no stamp seen"
    for n in range(600):
        clock.observe(n * 33_333, 5_000_000_000 + round(n * 33_333e3 * (1 + 12e-6)))
    assert clock.describe() == "offset 5.000240 s, drift −12.0 ppm, ±0.01 ms, 0 jumps"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"tick_s": 0.0}, "tick_s 0.0"),
        ({"tick_s": math.nan}, "tick_s nan"),
        ({"tick_s": 60e6}, "tick_s 60000000.0"),
        ({"tick_s": 1e-6, "latency_s": -0.1}, "latency -0.1"),
        ({"tick_s": 1e-6, "latency_sd_s": math.inf}, "inf s"),
        ({"tick_s": 1e-6, "wrap_ticks": 1}, "wrap_ticks 1"),
        ({"tick_s": 1e-6, "max_drift_ppm": 0.0}, "max_drift_ppm 0.0"),
    ],
)
def test_refuses_arguments_that_are_no_clock(arguments, named):
    with pytest.raises(InputError, match="allowed") as refused:
        DeviceClock(**arguments)
    assert named in str(refused.value)


def test_refuses_to_tell_a_time_before_the_first_stamp():
    with pytest.raises(InputError, match="first stamp"):
        DeviceClock(1e-6).to_host(1)


TICKS = st.integers(-(2**63), 2**64) | st.integers(0, 1000)
HOST_NS = st.integers(-(2**63), 2**63) | st.integers(0, 10**9)
STAMPS = st.lists(st.tuples(TICKS, HOST_NS, HOST_NS | st.none()), min_size=1, max_size=80)


@given(
    stamps=STAMPS,
    asked=st.lists(TICKS, max_size=5),
    tick_s=st.floats(1e-12, 1.0),
    latency_s=st.sampled_from([0.0, 1e-3, 1e3]),
    wrap_ticks=st.none() | st.integers(2, 2**64),
)
def test_never_fails_whatever_a_device_says(stamps, asked, tick_s, latency_s, wrap_ticks):
    clock = DeviceClock(tick_s, latency_s=latency_s, wrap_ticks=wrap_ticks)
    for ticks, not_after_ns, not_before_ns in stamps:
        clock.observe(ticks, not_after_ns, not_before_ns)
        for t_ns, half_ns in map(clock.to_host, [ticks, *asked]):
            assert isinstance(t_ns, int)
            assert isinstance(half_ns, int)
            assert half_ns >= 0
        assert clock.describe()


@given(st.lists(st.tuples(st.integers(1, 10**5), st.integers(0, 10**8)), min_size=2, max_size=80))
def test_rising_stamps_get_rising_times_whatever_their_delays(steps):
    clock, ticks, before_ns = DeviceClock(1e-6), 0, -1
    for step, delay_ns in steps:
        ticks += step
        clock.observe(ticks, ticks * 1000 + delay_ns)
        t_ns = clock.to_host(ticks)[0]
        assert t_ns > before_ns
        before_ns = t_ns
    every = [clock.to_host(n)[0] for n in range(ticks + 1, ticks + 10**6, 99_999)]
    assert every == sorted(every)
