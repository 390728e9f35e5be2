"""The host's clock: CLOCK_MONOTONIC, which neither time servers nor operators can set."""

from __future__ import annotations

import time


class SystemClock:
    """A `drivers.interfaces.Clock` on which time passes by itself."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Returns after `seconds`; at once for a negative number."""
        time.sleep(max(0.0, seconds))
