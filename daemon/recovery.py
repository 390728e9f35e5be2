"""What to do about a device error: the error's class is the policy, and this is its table."""

from __future__ import annotations

from enum import Enum

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)

FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 2.0  # a device that comes back is used again within five seconds, opening included


class Remedy(Enum):
    """What the service does next."""

    REOPEN = "close, and open again with a growing wait, for ever"
    RETRY = "try the same once more, then reopen"
    STOP = "stop retrying, report FAILED and stay alive until an operator reloads"
    EXIT = "end with the exit code for a wrong installation"


POLICY: dict[type[DriverError], Remedy] = {
    DeviceNotFoundError: Remedy.REOPEN,
    DeviceLostError: Remedy.REOPEN,
    DeviceTimeoutError: Remedy.RETRY,
    DeviceFaultError: Remedy.STOP,
    DriverUnavailableError: Remedy.EXIT,
}


def remedy(error: DriverError) -> Remedy:
    """Returns the policy for `error`; a class that the table does not know is a fault.

    A driver that raises something new may not be retried blindly: nobody has said that it is safe.
    """
    for kind in type(error).__mro__:
        if kind in POLICY:
            return POLICY[kind]
    return Remedy.STOP


class Backoff:
    """The waits between attempts: 0.5, 1, 2, 2 … s, from the start again after a success."""

    def __init__(self, first_s: float = FIRST_WAIT_S, longest_s: float = LONGEST_WAIT_S) -> None:
        self._first, self._longest = first_s, longest_s
        self.attempts = 0

    def next_s(self) -> float:
        """Returns how long to wait before the next attempt, s."""
        wait = min(self._longest, self._first * 2.0 ** min(self.attempts, 32))
        self.attempts += 1
        return wait

    def reset(self) -> None:
        """Call when an attempt succeeded."""
        self.attempts = 0
