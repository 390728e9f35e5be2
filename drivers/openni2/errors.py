"""What the binding raises, and which of the drivers' five errors that is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DriverError,
    DriverUnavailableError,
)

_OUT_OF_FLOW = 5  # api.Status.OUT_OF_FLOW: what cannot be done now, as something else is under way


class OpenNI2Error(Exception):
    """A call that did not succeed.

    Attributes:
        status: The OniStatus.
    """

    def __init__(self, what: str, status: int, words: str) -> None:
        super().__init__(f"{what}: {words or f'OpenNI2 status {status}'}")
        self.status = status


class HangingError(OpenNI2Error):
    """A call of the library that does not come back; only ending the process helps."""


class PluginMissingError(Exception):
    """A library or a plug-in is not there, or not as this version of the project needs it."""


class SettingError(Exception):
    """A device that cannot do what measuring needs, or does not keep to it."""


class GoneError(Exception):
    """The device was unplugged."""


class BrokenError(Exception):
    """What the device sends, or what the file holds, cannot be used."""


def _driver_error(name: str, error: Exception, is_open: bool) -> DriverError:
    match error:
        case PluginMissingError():
            return DriverUnavailableError(name, str(error))
        case GoneError():
            return DeviceLostError(name, "it was unplugged")
        case HangingError():
            return DeviceLostError(name, str(error))
        case OpenNI2Error() if error.status != _OUT_OF_FLOW:
            return (DeviceLostError if is_open else DeviceNotFoundError)(name, str(error))
        case _:  # a setting, impossible data, or a library that something else uses
            return DeviceFaultError(name, str(error))


@contextmanager
def driver_errors(name: str, *, is_open: bool) -> Iterator[None]:
    """Makes one of the drivers' five errors of what the binding raises inside.

    Args:
        name: The device's.
        is_open: Whether it was open before: then a call that fails is a loss, else nothing was found.
    """
    try:
        yield
    except (PluginMissingError, SettingError, OpenNI2Error, GoneError, BrokenError) as error:
        raise _driver_error(name, error, is_open) from error
