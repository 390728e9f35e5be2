"""The five errors that leave a driver, whose class is the recovery policy; and the rejection of a capture."""

from typing import Literal


class DriverError(Exception):
    """Base of the five; `device` is the name of the device that raised it."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device


class DeviceNotFoundError(DriverError):
    """Nothing answers at the address. Policy: try again after 0.5, 1, 2, 2 … s, for ever."""


class DeviceLostError(DriverError):
    """It was open and went away. Policy: close, reopen with backoff."""


class DeviceTimeoutError(DriverError, TimeoutError):
    """It is open but silent. Policy: retry the capture once, then treat as lost."""


class DeviceFaultError(DriverError):
    """It reports a fault, or impossible data. Policy: stop retrying and tell the operator."""


class DriverUnavailableError(DriverError, ImportError):
    """A vendor library is missing; the message names the package. Policy: exit 78."""


class CaptureRejectedError(Exception):
    """What was taken is no capture, though every device works; the same request may be made again.

    Attributes:
        reason: "motion" (the arm moved), "skew" (colour and depth are too far apart in time), or
            "stale" (a frame or a joint reading is not of the time that it was asked for).
    """

    def __init__(self, message: str, reason: Literal["motion", "skew", "stale"]) -> None:
        super().__init__(message)
        self.reason = reason
