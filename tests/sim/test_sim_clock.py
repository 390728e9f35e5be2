"""The simulated clock: jumps, never runs backwards, and stands while an image is computed."""

import threading
import time

from drivers.sim.clock import SimClock


def test_a_jumping_clock_sleeps_in_no_time():
    clock = SimClock()
    host, start = time.monotonic(), clock.now_ns()
    clock.sleep(1000.0)
    assert clock.now_ns() - start == 1_000_000_000_000
    assert time.monotonic() - host < 1.0


def test_a_jumping_clock_stands_still_by_itself():
    clock = SimClock(start_ns=7)
    assert clock.now_ns() == clock.now_ns() == 7


def test_no_clock_runs_backwards():
    for realtime in (False, True):
        clock = SimClock(realtime)
        now = clock.now_ns()
        clock.sleep_until(now - 1_000_000_000)
        clock.sleep(-1.0)
        assert clock.now_ns() >= now


def test_two_waiters_of_a_jumping_clock_end_at_the_later_time():
    clock = SimClock(start_ns=0)
    threads = [threading.Thread(target=clock.sleep_until, args=(t,)) for t in (5, 3, 9, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert clock.now_ns() == 9


def test_a_real_time_clock_keeps_pace():
    clock = SimClock(realtime=True)
    host, start = time.monotonic_ns(), clock.now_ns()
    clock.sleep(0.05)
    assert clock.now_ns() - start >= 50_000_000
    assert abs((clock.now_ns() - start) - (time.monotonic_ns() - host)) < 5_000_000


def test_a_real_time_clock_stands_while_it_is_held():
    clock = SimClock(realtime=True)
    with clock.held():
        before = clock.now_ns()
        with clock.held():
            time.sleep(0.03)
        assert clock.now_ns() == before
    assert clock.now_ns() - before < 20_000_000
