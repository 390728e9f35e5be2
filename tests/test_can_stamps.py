"""When a frame arrived: stamps of a wall clock that may be set, and no stamps at all."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canbus.stamps import Arrivals

START_NS = 5_000_000_000_000
WALL_NS = 1_790_000_000_000_000_000
TOLERANCE_NS = 2_000  # a stamp is a float of seconds since 1970


class Clocks:
    """A host whose wall clock is `WALL_NS` ahead, and more from each step on."""

    def __init__(self, steps=()):
        self.t_ns = START_NS
        self.steps = dict(steps)

    def now(self):
        return self.t_ns

    def wall(self, t_ns=None):
        at_ns = self.t_ns if t_ns is None else t_ns
        return at_ns + WALL_NS + sum(by_ns for when_ns, by_ns in self.steps.items() if when_ns <= at_ns)

    def stamp(self, t_ns):
        return self.wall(t_ns) / 1e9


def arrivals_of(clocks):
    return Arrivals(clocks.now, clocks.wall)


def test_a_stamp_becomes_the_host_time_of_the_reception():
    clocks = Clocks()
    arrivals = arrivals_of(clocks)
    received_ns = START_NS + 10_000_000
    clocks.t_ns = received_ns + 3_000_000
    span = arrivals.span(clocks.stamp(received_ns))
    assert span.begin_ns <= received_ns + 500
    assert span.end_ns >= received_ns - 500
    assert span.end_ns - span.begin_ns <= TOLERANCE_NS
    assert (arrivals.steps, arrivals.refused) == (0, 0)


def test_setting_the_wall_clock_moves_no_frame():
    for step_ns in (3_600_000_000_000, -3_600_000_000_000, 50_000_000, -50_000_000):
        clocks = Clocks({START_NS + 25_000_000: step_ns})
        arrivals = arrivals_of(clocks)
        for received_ns in range(START_NS + 10_000_000, START_NS + 60_000_000, 10_000_000):
            arrivals.idle(clocks.t_ns)
            clocks.t_ns = received_ns + 1_000_000
            span = arrivals.span(clocks.stamp(received_ns))
            assert abs((span.begin_ns + span.end_ns) // 2 - received_ns) <= TOLERANCE_NS, step_ns
        assert arrivals.steps == 1


def test_a_frame_that_waited_while_the_clock_was_set_has_its_own_time():
    clocks = Clocks({START_NS + 20_000_000: -7_200_000_000_000})
    arrivals = arrivals_of(clocks)
    clocks.t_ns = START_NS + 100_000_000
    for received_ns in (START_NS + 10_000_000, START_NS + 15_000_000, START_NS + 30_000_000):
        span = arrivals.span(clocks.stamp(received_ns))
        assert abs((span.begin_ns + span.end_ns) // 2 - received_ns) <= TOLERANCE_NS


def test_a_small_step_is_doubted_only_until_the_frames_from_before_it_are_read():
    clocks = Clocks({START_NS + 11_500_000: 600_000})
    arrivals = arrivals_of(clocks)
    widths = []
    for received_ns in (START_NS + 11_000_000, START_NS + 12_000_000, START_NS + 20_000_000):
        clocks.t_ns = received_ns + 1_500_000
        span = arrivals.span(clocks.stamp(received_ns))
        assert span.begin_ns - TOLERANCE_NS <= received_ns <= span.end_ns + TOLERANCE_NS
        widths.append(span.end_ns - span.begin_ns)
        arrivals.idle(clocks.t_ns)
    assert max(widths[:2]) > 500_000, "either clock may have stamped them"
    assert widths[2] <= TOLERANCE_NS + 500


def test_a_stamp_of_another_clock_is_not_used():
    clocks = Clocks()
    arrivals = arrivals_of(clocks)
    arrivals.idle(START_NS + 5_000_000)
    clocks.t_ns = START_NS + 9_000_000
    span = arrivals.span(12.5)  # seconds since the adapter was switched on
    assert (span.begin_ns, span.end_ns) == (START_NS + 5_000_000, START_NS + 9_000_000)
    assert arrivals.refused == 1


def test_without_stamps_a_frame_came_since_the_last_look():
    clocks = Clocks()
    arrivals = arrivals_of(clocks)
    arrivals.idle(START_NS + 2_000_000)
    clocks.t_ns = START_NS + 4_000_000
    first = arrivals.span(None)
    clocks.t_ns = START_NS + 5_000_000
    second = arrivals.span(None)
    assert (first.begin_ns, first.end_ns) == (START_NS + 2_000_000, START_NS + 4_000_000)
    assert (second.begin_ns, second.end_ns) == (START_NS + 2_000_000, START_NS + 5_000_000)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_the_span_holds_the_true_time_however_the_wall_clock_is_set(data):
    gaps = data.draw(st.lists(st.integers(1_000, 40_000_000), min_size=2, max_size=8))
    delays = data.draw(st.lists(st.integers(0, 60_000_000), min_size=len(gaps), max_size=len(gaps)))
    received = [START_NS + sum(gaps[: index + 1]) for index in range(len(gaps))]
    read, last = [], START_NS
    for t_ns, delay_ns in zip(received, delays, strict=True):
        last = max(last + 1_000, t_ns + delay_ns)
        read.append(last)
    looks = [START_NS, *read]
    steps = {}
    for begin_ns, end_ns in pairwise(looks):  # between two looks the clock is set once at most
        if data.draw(st.integers(0, 3)) == 0:
            steps[data.draw(st.integers(begin_ns + 1, end_ns))] = data.draw(
                st.one_of(st.integers(-(10**13), 10**13), st.integers(-(10**7), 10**7))
            )
    clocks = Clocks(steps)
    arrivals = arrivals_of(clocks)
    for t_ns, read_ns in zip(received, read, strict=True):
        clocks.t_ns = read_ns
        span = arrivals.span(clocks.stamp(t_ns))
        assert span.begin_ns - TOLERANCE_NS <= t_ns <= span.end_ns + TOLERANCE_NS
        assert span.end_ns <= read_ns
        if not steps:
            assert span.end_ns - span.begin_ns <= TOLERANCE_NS + 500
