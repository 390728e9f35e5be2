"""When a device's time stamps were taken, on the host's clock: the least-delay envelope.

A stamp arrives some delay after it was taken, never before. Where arrival times are drawn over stamps,
the truth is therefore a line below all points, and the points with the least delay touch it. The line is
that of Moon, Skelly and Towsley ("Estimation and removal of clock skew from network delay measurements",
INFOCOM 1999): the edge of the lower convex hull below the middle of the window. A delayed arrival lies
above it and changes nothing, which is what an average or a least-squares line cannot say of itself.
"""

from __future__ import annotations

import itertools
import math
from collections import deque

from surfclass.errors import InputError

WINDOW_S = 300.0  # a crystal's drift changes by about 1 ppm in this time: 0.1 ms of curvature
_HULL_POINTS = 64
_SAMPLES = 128  # half of them the newest, the rest the thinner the older
_JUMP_NS = 50e6  # further off than this, a stamp is of another clock
_LATE_RUN = 16  # so many stamps in a row, all late by a jump: it is the clock that moved
_WANDER = 1e-6  # how far the drift may be from that of a straight line
_NEWEST = 8  # say how late stamps are now, against what is known from before
# Where longer delays are the rarer ones, the least of n is further from none than from the k-th least with
# a chance of 2^(1-k); the line touches two of them. Below k stamps, what a frame takes to arrive is all
# that is known.
_ORDER = 10
_FIRST_DELAY_NS = 20e6
_DRIFT_SPAN_S = 5.0  # drift is told from here on


class DeviceClock:
    """Maps the ticks of a device's clock to host CLOCK_MONOTONIC.

    Observe each stamp once, as its frame arrives; then ask for its time. Times get sure within the first
    ten stamps: without triggers, the first is held to be up to 20 ms off, the n-th up to 20 ms / n.

    A stamp that goes back, or is further off than drift and the delays seen allow, is of a clock that was
    reset: what was known is dropped and `jumps` counts it. One that repeats the last says that the clock
    stands still, or that the frame is the last one again; `frozen` counts those.

    Args:
        tick_s: One tick, s.
        latency_s: Known part of the delay from stamp to arrival, such as the read-out of a frame.
        latency_sd_s: Half the interval in which that is known. Where both are 0 and triggers give a bound
            from below, nothing is taken as known of the delay; without triggers, the least is taken as 0.
        wrap_ticks: Ticks at which the counter starts again at 0, such as 2**32; None: it does not.
        max_drift_ppm: The clock's rate is within this of its nominal one.

    Attributes:
        jumps: How often the clock was found to be another one.
        frozen: How often a stamp repeated the one before.

    Raises:
        InputError: If an argument is outside what is allowed.
    """

    def __init__(
        self,
        tick_s: float,
        *,
        latency_s: float = 0.0,
        latency_sd_s: float = 0.0,
        wrap_ticks: int | None = None,
        max_drift_ppm: float = 500.0,
    ) -> None:
        if not 1e-12 <= tick_s <= 1:
            raise InputError(f"tick_s {tick_s}, allowed is 1e-12 to 1")
        if not (0 <= latency_s < math.inf and 0 <= latency_sd_s < math.inf):
            raise InputError(f"latency {latency_s} ± {latency_sd_s} s, allowed is 0 or more and finite")
        if wrap_ticks is not None and wrap_ticks < 2:
            raise InputError(f"wrap_ticks {wrap_ticks}, allowed is above 1")
        if not 0 < max_drift_ppm < 1e5:
            raise InputError(f"max_drift_ppm {max_drift_ppm}, allowed is above 0 and below 100000")
        self._tick_ns, self._wrap, self._max_drift = tick_s * 1e9, wrap_ticks, max_drift_ppm * 1e-6
        self._latency_ns, self._latency_sd_ns = latency_s * 1e9, latency_sd_s * 1e9
        self.jumps = 0
        self.frozen = 0
        # Points are (x, y): device time since the origin, and host minus device time, ns.
        self._origin_ticks, self._origin_ns = 0, 0
        self._ticks, self._arrival_ns = 0, 0  # the newest stamp, unwrapped
        self._issued: tuple[float, int] | None = None  # the newest time given out, for order
        self._forget()

    @property
    def drift_ppm(self) -> float | None:
        """How much too fast the device's clock runs; None until 5 s were seen."""
        seen_ns = self._hull[-1][0] - self._hull[0][0] if self._hull else 0.0
        if seen_ns < _DRIFT_SPAN_S * 1e9 or len(self._samples) < _ORDER:
            return None
        return -self._slope * 1e6

    @property
    def offset_ns(self) -> int | None:
        """Host minus device time at the newest stamp; None before the first."""
        if not self._hull:
            return None
        device_ns = self._ticks * self._tick_ns
        return self._origin_ns + round(self._x(self._ticks) + self._line(self._x(self._ticks)) - device_ns)

    def describe(self) -> str:
        """Returns offset, drift, uncertainty and what went wrong, in words."""
        offset_ns, drift = self.offset_ns, self.drift_ppm
        if offset_ns is None:
            return "no stamp seen"
        _, half_ns = self._estimate(self._x(self._ticks))
        rate = "drift not known yet" if drift is None else f"drift {drift:+.1f} ppm".replace("-", "−")
        words = [f"offset {offset_ns / 1e9:.6f} s", rate, f"±{half_ns / 1e6:.2f} ms", f"{self.jumps} jumps"]
        return ", ".join([*words, f"{self.frozen} stamps repeated"] if self.frozen else words)

    def observe(self, ticks: int, not_after_ns: int, not_before_ns: int | None = None) -> None:
        """Takes note of a stamp.

        Args:
            ticks: As the device gave it, up to 64 bits.
            not_after_ns: When it arrived.
            not_before_ns: When the trigger was sent that it answers, or None.
        """
        if not self._hull:
            self._restart(ticks, not_after_ns)
        unwrapped = self._unwrapped(ticks, not_after_ns)
        x, before = self._x(unwrapped), self._x(self._ticks)
        if self._hull and unwrapped >= self._ticks and x <= before:
            self.frozen += 1
            return
        if self._hull and self._is_another_clock(x, before, not_after_ns, not_before_ns):
            # Not counted: first frames that were held back for long, so that a prompt one seems early.
            self.jumps += x < before or len(self._samples) >= _ORDER
            self._restart(ticks, not_after_ns)
            unwrapped, x = ticks, 0.0
        elif self._hull and x - before > WINDOW_S * 1e9:
            self._forget()
        self._ticks, self._arrival_ns = unwrapped, not_after_ns
        point = (x, not_after_ns - self._origin_ns - self._latency_ns - x)
        self._samples.append(point)
        if not_before_ns is not None and not_before_ns <= not_after_ns:
            self._lower.append((x, not_before_ns - self._origin_ns - x))
        self._add(point)

    def to_host(self, ticks: int) -> tuple[int, int]:
        """Returns when a stamp was taken, host ns, and the half interval in which that can have been, ns.

        Asked in the order of the stamps, times rise as they do, also where the envelope has come down
        meanwhile. The time of a stamp that was observed last is never after its arrival.

        Raises:
            InputError: If no stamp was observed yet.
        """
        if not self._hull:
            raise InputError("a device's clock before its first stamp was observed")
        x = self._x(self._near(ticks))
        estimate, half = self._estimate(x)
        time_ns = self._origin_ns + round(x + estimate)
        if self._issued is not None:
            at, issued_ns = self._issued
            ordered_ns = max(time_ns, issued_ns + 1) if x > at else min(time_ns, issued_ns - (x < at))
            half += abs(ordered_ns - time_ns)
            time_ns = ordered_ns
        if x <= self._x(self._ticks) and (self._issued is None or x > self._issued[0]):
            self._issued = x, time_ns
        return time_ns, math.ceil(half)

    def _x(self, unwrapped: int) -> float:
        return (unwrapped - self._origin_ticks) * self._tick_ns

    def _line(self, x: float) -> float:
        return self._slope * x + self._intercept

    def _near(self, ticks: int, expected: int | None = None) -> int:
        """The unwrapped ticks nearest to what is expected: the newest ones, if nothing else."""
        if self._wrap is None:
            return ticks
        expected = self._ticks if expected is None else expected
        return expected + (ticks - expected + self._wrap // 2) % self._wrap - self._wrap // 2

    def _unwrapped(self, ticks: int, arrival_ns: int) -> int:
        """Counts the wraps since the newest stamp by the host's clock."""
        return self._near(ticks, self._ticks + round((arrival_ns - self._arrival_ns) / self._tick_ns))

    def _restart(self, ticks: int, arrival_ns: int) -> None:
        self._origin_ticks, self._origin_ns = ticks, arrival_ns
        self._ticks, self._arrival_ns = ticks, arrival_ns
        if self._issued is not None:
            self._issued = -math.inf, self._issued[1]
        self._forget()

    def _forget(self) -> None:
        self._hull: list[tuple[float, float]] = []
        self._samples: list[tuple[float, float]] = []
        self._lower: deque[tuple[float, float]] = deque(maxlen=_SAMPLES)
        self._slope = self._intercept = 0.0
        self._touching = 0.0, 0.0  # x of the points that the line touches
        self._late = 0

    def _is_another_clock(self, x: float, before: float, arrival_ns: int, sent_ns: int | None) -> bool:
        if x < before:
            return True
        allowed = _JUMP_NS + self._latency_sd_ns + 2 * self._max_drift * (x - before)
        late = arrival_ns - self._origin_ns - self._latency_ns - x - self._line(x)
        self._late = self._late + 1 if late > allowed else 0
        if late < -allowed or self._late >= _LATE_RUN:
            return True
        return sent_ns is not None and sent_ns - self._origin_ns - x - self._line(x) > allowed

    def _add(self, point: tuple[float, float]) -> None:
        """Extends the hull to the right and lays the line below it."""
        hull = self._hull
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
        first = point[0] - WINDOW_S * 1e9
        while len(hull) > _HULL_POINTS or hull[0][0] < first:
            hull.pop(0)
        while self._lower and self._lower[0][0] < first:
            self._lower.popleft()
        if len(self._samples) > _SAMPLES:
            newest = self._samples[-_SAMPLES // 2 :]
            self._samples = [at for at in self._samples[: -_SAMPLES // 2 : 2] if at[0] >= first] + newest
        middle = (hull[0][0] + point[0]) / 2
        for left, right in itertools.pairwise(hull):
            if left[0] <= middle <= right[0]:
                slope = (right[1] - left[1]) / (right[0] - left[0])
                self._slope = min(self._max_drift, max(-self._max_drift, slope))
                self._touching = left[0], right[0]
        self._intercept, x = min((y - self._slope * x, x) for x, y in hull)
        if len(hull) == 1 or abs(self._slope) == self._max_drift:
            self._touching = x, x

    def _too_high(self, x: float) -> tuple[float, float]:
        """How far the line may be above the truth at x, ns, and how far its slope may be off."""
        left, right = self._touching
        widest = self._max_drift + abs(self._slope)
        residuals = [y - self._line(at) for at, y in self._samples]
        if left == right:
            return _scatter(residuals) + widest * abs(x - left), widest
        # Each of the two points has its delay from the samples on its side.
        middle = (self._hull[0][0] + self._hull[-1][0]) / 2
        before = sum(at < middle for at, _ in self._samples)
        at_left, at_right = _scatter(residuals[:before]), _scatter(residuals[before:])
        part = min(1.0, max(0.0, (x - left) / (right - left)))
        here = at_left * (1 - part) + at_right * part
        beyond = max(0.0, left - x, x - right)
        turn = min(widest, here / (right - left) + _WANDER)
        slack = min(widest, max(at_left, at_right) / (right - left) + _WANDER)
        return here + turn * beyond, slack

    def _estimate(self, x: float) -> tuple[float, float]:
        """Host minus device time at x, and the half interval, ns."""
        line, sd = self._line(x), self._latency_sd_ns
        too_high, slack = self._too_high(x)
        low = line - sd - too_high
        newest = self._samples[-_NEWEST:]
        high = line + sd + min(y - self._line(at) + slack * abs(x - at) for at, y in newest)
        if self._lower:
            sent = max(y + self._slope * (x - at) - slack * abs(x - at) for at, y in self._lower)
            if not (self._latency_ns or sd):
                low, line = sent, (sent + high) / 2
            else:
                low = max(low, sent)
                line = min(max(line, sent), max(high, sent))
            if low > high:  # the bounds contradict each other: between them, or as far again
                low, high, line = high, low, (low + high) / 2
        return line, max(high - line, line - low)


def _scatter(residuals: list[float]) -> float:
    """How far the least of these may be from no delay at all, ns."""
    if len(residuals) >= _ORDER:
        return sorted(residuals)[_ORDER - 1]
    return max([_FIRST_DELAY_NS / max(1, len(residuals)), *residuals])


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Above 0 where a → b → c turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
