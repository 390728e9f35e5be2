"""Sets of joint angles: whatever order, loss and repetition of frames makes, all six are of one moment."""

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canbus.joints import CountedSets, SetCounts, SyncedSets
from drivers.canbus.stamps import Span

PERIOD_NS = 10_000_000
MODULUS = 16
FRAMES = ((0, 1), (2, 3), (4, 5))


def angles(cycle, frame):
    """What a frame says of its joints: no two cycles say the same."""
    return {joint: cycle + joint / 10 for joint in FRAMES[frame]}


def cycle_of(joints):
    """The one cycle that a set's angles are of."""
    cycles = {round(angle - joint / 10, 6) for joint, angle in enumerate(joints.angles)}
    assert len(cycles) == 1, f"a mix of cycles {sorted(cycles)}"
    return int(cycles.pop())


def at(t_ns):
    return Span(t_ns, t_ns)


def counted(window_ns=3 * PERIOD_NS, counts=None):
    return CountedSets(window_ns, PERIOD_NS, MODULUS, SetCounts() if counts is None else counts)


def arrivals(fates):
    """(time, cycle, frame) in the order of arrival; a fate is the delays of a frame's copies."""
    events = [
        (cycle * PERIOD_NS + frame * 200_000 + delay_ns, cycle, frame)
        for cycle, frames in enumerate(fates)
        for frame, delays in enumerate(frames)
        for delay_ns in delays
    ]
    return sorted(events)


DELAYS = st.lists(st.integers(0, 5 * PERIOD_NS), max_size=2)
FATES = st.lists(st.tuples(DELAYS, DELAYS, DELAYS), min_size=1, max_size=40)


@settings(deadline=None, max_examples=60)
@given(fates=FATES, window_periods=st.integers(1, 4))
def test_no_order_loss_or_repetition_mixes_two_counters(fates, window_periods):
    sets = counted(window_periods * PERIOD_NS)
    delivered = []
    for t_ns, cycle, frame in arrivals(fates):
        joints = sets.add(angles(cycle, frame), at(t_ns), cycle % MODULUS)
        if joints is not None:
            delivered.append(cycle_of(joints))
            assert joints.span.end_ns == t_ns
            assert joints.span.end_ns - joints.span.begin_ns <= window_periods * PERIOD_NS
            assert joints.span.begin_ns >= delivered[-1] * PERIOD_NS
    assert delivered == sorted(set(delivered)), "in their order, each once"


@settings(deadline=None, max_examples=60)
@given(
    lost=st.sets(st.tuples(st.integers(0, 39), st.integers(0, 2))),
    order=st.lists(st.permutations(range(3)), min_size=40, max_size=40),
)
def test_a_lost_frame_costs_its_own_set_alone(lost, order):
    counts = SetCounts()
    sets = counted(PERIOD_NS - 1, counts)
    delivered = []
    for cycle in range(40):
        for place, frame in enumerate(order[cycle]):
            if (cycle, frame) not in lost:
                t_ns = cycle * PERIOD_NS + place * 200_000
                joints = sets.add(angles(cycle, frame), at(t_ns), cycle % MODULUS)
                if joints is not None:
                    delivered.append(cycle_of(joints))
    broken = {cycle for cycle, _ in lost}
    longest = max((run for run in runs(sorted(broken))), default=0)
    if longest < MODULUS // 2:  # longer gaps look like a sender that started anew
        assert delivered == [cycle for cycle in range(40) if cycle not in broken]
    assert counts.complete == len(delivered)


def runs(numbers):
    length = 0
    for index, number in enumerate(numbers):
        length = length + 1 if index and number == numbers[index - 1] + 1 else 1
        yield length


class TestCountedSets:
    def fill(self, sets, cycle, t_ns, counter=None):
        counter = cycle % MODULUS if counter is None else counter
        return [sets.add(angles(cycle, frame), at(t_ns), counter) for frame in range(3)][-1]

    def test_a_set_lasts_from_its_first_frame_to_its_last(self):
        sets = counted()
        assert sets.add(angles(1, 0), Span(100, 200), 1) is None
        assert sets.add(angles(1, 2), Span(300, 300), 1) is None
        assert sets.add(angles(1, 1), Span(400, 500), 1).span == Span(100, 500)

    def test_a_counter_that_stands_still_gives_no_set(self):
        counts = SetCounts()
        sets = counted(counts=counts)
        assert self.fill(sets, 0, 0) is not None
        for cycle in range(1, 100):
            assert self.fill(sets, cycle, cycle * PERIOD_NS, counter=0) is None
        assert (counts.complete, counts.repeated) == (1, 297)

    def test_a_frame_beyond_the_window_costs_its_set(self):
        counts = SetCounts()
        sets = counted(PERIOD_NS, counts)
        sets.add(angles(0, 0), at(0), 0)
        sets.add(angles(0, 1), at(1), 0)
        assert sets.add(angles(0, 2), at(PERIOD_NS + 1), 0) is None
        assert counts.late == 1
        assert self.fill(sets, 1, PERIOD_NS + 2) is not None

    def test_a_frame_that_contradicts_one_of_its_set_costs_the_set(self):
        counts = SetCounts()
        sets = counted(counts=counts)
        sets.add(angles(0, 0), at(0), 0)
        sets.add(angles(7, 0), at(1), 0)
        sets.add(angles(0, 1), at(2), 0)
        assert sets.add(angles(0, 2), at(3), 0) is None
        assert (counts.conflicting, counts.complete) == (1, 0)

    def test_a_sender_that_started_anew_is_followed(self):
        counts = SetCounts()
        sets = counted(counts=counts)
        for cycle in range(7):
            self.fill(sets, cycle, cycle * PERIOD_NS)
        later = [self.fill(sets, cycle, (cycle + 7) * PERIOD_NS, cycle % 4) for cycle in range(30)]
        assert later[0] is None, "a moment ago these counters were past ones"
        assert later[-1] is not None
        assert counts.old > 0

    def test_what_is_kept_is_bounded(self):
        sets = CountedSets(10**12, PERIOD_NS, 1 << 16, SetCounts())
        for counter in range(1000):
            sets.add(angles(counter, 0), at(counter), counter)
        assert len(sets._open) <= 8


# on: in time. twice: in time, two times. lost. late: after the next SYNC.
FATE = st.sampled_from(["on", "on", "on", "twice", "lost", "late"])


@settings(deadline=None, max_examples=60)
@given(fates=st.lists(st.tuples(FATE, FATE, FATE), min_size=2, max_size=40), data=st.data())
def test_no_loss_repetition_or_lateness_mixes_two_syncs(fates, data):
    """But for a node that is late again and again, which nobody could tell."""
    events = []
    for cycle, frames in enumerate(fates):
        events.append((cycle * PERIOD_NS, -1, cycle, None))
        for frame, fate in enumerate(frames):
            if fate == "late" and cycle and fates[cycle - 1][frame] == "late":
                fate = "on"
                fates[cycle] = tuple(
                    "on" if index == frame else old for index, old in enumerate(fates[cycle])
                )
            for _ in range({"twice": 2, "lost": 0}.get(fate, 1)):
                delay_ns = data.draw(st.integers(1, PERIOD_NS - 1)) + (fate == "late") * PERIOD_NS
                events.append((cycle * PERIOD_NS + delay_ns, frame, cycle, frame))
    sets = SyncedSets(PERIOD_NS, SetCounts())
    delivered = []
    for t_ns, _, cycle, frame in sorted(events, key=lambda event: event[:3]):
        if frame is None:
            sets.sync(at(t_ns))
            continue
        joints = sets.add(angles(cycle, frame), at(t_ns))
        if joints is not None:
            delivered.append(cycle_of(joints))
            assert joints.span == at(delivered[-1] * PERIOD_NS), "the time of its SYNC"
    assert delivered == sorted(set(delivered))


class TestSyncedSets:
    def fill(self, sets, cycle, t_ns, frames=(0, 1, 2)):
        return [sets.add(angles(cycle, frame), at(t_ns)) for frame in frames][-1]

    def synced(self, window_ns=PERIOD_NS):
        """Sets whose first SYNC is past: of the one before it nobody knows what was missing."""
        counts = SetCounts()
        sets = SyncedSets(window_ns, counts)
        sets.sync(at(0))
        self.fill(sets, 0, 1)
        assert counts.doubtful == 1
        return sets, counts

    def test_frames_before_the_first_sync_are_of_no_set(self):
        counts = SetCounts()
        sets = SyncedSets(PERIOD_NS, counts)
        assert self.fill(sets, 0, 0) is None
        assert counts.unsynchronised == 3

    def test_a_set_is_of_the_time_of_its_sync(self):
        sets, _ = self.synced()
        sets.sync(Span(1000, 1100))
        assert self.fill(sets, 1, 5000).span == Span(1000, 1100)

    def test_a_sync_sent_from_here_reached_the_bus_before_its_first_answer(self):
        sets, _ = self.synced()
        sets.sync(at(1000), sent=True)
        sets.add(angles(1, 0), Span(4000, 4010))
        sets.add(angles(1, 1), Span(5000, 5010))
        assert sets.add(angles(1, 2), Span(6000, 6010)).span == Span(1000, 4010)

    def test_a_set_that_lacks_a_frame_is_dropped_and_the_next_one_doubted(self):
        sets, counts = self.synced()
        sets.sync(at(1000))
        assert self.fill(sets, 1, 2000, frames=(0, 1)) is None
        sets.sync(at(3000))
        assert self.fill(sets, 2, 4000) is None
        sets.sync(at(5000))
        assert self.fill(sets, 3, 6000) is not None
        assert (counts.incomplete, counts.doubtful) == (1, 2)

    def test_a_frame_beyond_the_window_costs_its_set(self):
        sets, counts = self.synced(window_ns=500)
        sets.sync(at(1000))
        self.fill(sets, 1, 1100, frames=(0, 1))
        assert self.fill(sets, 1, 1501, frames=(2,)) is None
        assert counts.late == 1
        sets.sync(at(2000))
        assert self.fill(sets, 2, 2001) is not None

    def test_a_frame_that_comes_twice_costs_nothing(self):
        sets, counts = self.synced()
        sets.sync(at(1000))
        self.fill(sets, 1, 1100, frames=(0, 0, 1, 1))
        assert self.fill(sets, 1, 1200, frames=(2,)) is not None
        assert self.fill(sets, 1, 1300) is None
        assert counts.complete == 1


def test_counts_tell_what_is_not_zero():
    before = SetCounts(complete=3, late=1)
    now = SetCounts(complete=5, late=1, malformed=2)
    assert now.since(before).describe() == "2 complete, 2 malformed"
    assert SetCounts().describe() == "none"
