"""A colour camera in a process of its own, with what it can do besides taking frames: change its exposure."""

from __future__ import annotations

import math

from drivers.isolation.camera import IsolatedCamera
from surfclass.errors import InputError
from surfclass.frames import ColourFrame

_RANGE_S = 2.0
_SET_S = 6.0  # a camera is stopped for it, which waits for the exposure under way, and started again


class IsolatedColourCamera(IsolatedCamera[ColourFrame]):
    """An `IsolatedCamera` that passes on `drivers.interfaces.ExposureControl`."""

    def exposure_range_s(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure; 0 and 0 where the driver cannot change it.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the driver does.
        """
        told = self._ask({"call": "exposure_range"}, _RANGE_S).get("range_s")
        if not isinstance(told, list) or len(told) != 2 or not all(_is_time(value) for value in told):
            raise self._lose("its process said what is no range of exposures")
        return float(told[0]), float(told[1])

    def set_exposure(self, exposure_s: float) -> float:
        """Sets the exposure time, and returns the one that the camera made of it.

        Raises:
            InputError: If it is outside the range (a ValueError).
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the driver does.
        """
        if not 0 < exposure_s < math.inf:
            raise InputError(f"{self.name}: exposure {exposure_s} s, allowed is above 0 and finite")
        told = self._ask({"call": "set_exposure", "exposure_s": exposure_s}, _SET_S).get("exposure_s")
        if not _is_time(told) or not told:
            raise self._lose("its process said what is no exposure time")
        return float(told)


def _is_time(value: object) -> bool:
    return isinstance(value, int | float) and 0 <= value < math.inf
