"""One target from one place with one exposure after the other: what the camera's response is found from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.errors import CaptureRejectedError
from drivers.interfaces import ExposureControl
from drivers.sensor_package import SensorPackage
from surfclass.errors import InputError
from surfclass.frames import Capture

_DARK, _BRIGHT = 0.06, 0.97  # of full scale: what the middle of the image may be at the ends of the series
_BRIGHT_QUANTILE = 0.99
_STRIDE = 3.0  # from trial to trial while an end of the series is looked for,
_CLOSE = 1.2  # and to this factor it is found


@dataclass(frozen=True, slots=True)
class _Level:
    """How bright the middle of an image is in its darkest and its brightest channel, of full scale."""

    dark: float
    bright: float


def exposure_series(package: SensorPackage, count: int, note: Callable[[str], None]) -> list[Capture]:
    """Returns captures of role "exposure", from the shortest to the longest, evenly in the logarithm.

    The longest is the one at which the middle of the image is just not saturated, the shortest the one at
    which it is just not dark, as far as the camera goes. The exposure that was set is set again at the end.

    Args:
        package: The open sensors, before the target, the arm at rest.
        count: How many, at least 3.
        note: Is told what happens, a sentence each.

    Raises:
        InputError: If the exposure cannot be changed, or the middle of the image is dark or saturated
            whatever it is.
        CaptureRejectedError: As `SensorPackage.capture`, and if the arm moved between two captures.
        DriverError: As the devices do.
    """
    if count < 3:
        raise InputError(f"a series of {count} exposures, allowed are 3 or more")
    control = package.exposure_control()
    if control is None:
        raise InputError(
            "the colour camera's exposure cannot be changed from here: capture the target at several "
            "distances instead"
        )
    first = package.capture("exposure_trial", "exposure")
    assert first.colour is not None  # a package has a colour camera
    before_s = first.colour.exposure_s
    if before_s is None:
        raise InputError("the colour camera does not tell its exposure")
    try:
        series = _Series(package, control, first)
        ends_s = series.ends()
        note(f"{count} exposures from {ends_s[0] * 1e3:.3g} to {ends_s[1] * 1e3:.3g} ms")
        steps = np.geomspace(*ends_s, count).tolist()
        return [series.take(exposure_s, f"exposure_{n}") for n, exposure_s in enumerate(steps, start=1)]
    finally:
        control.set_exposure(before_s)


class _Series:
    """Captures from one place with different exposures."""

    def __init__(self, package: SensorPackage, control: ExposureControl, first: Capture) -> None:
        self._package, self._control, self._first = package, control, first
        self._low_s, high_s = control.exposure_range_s()
        # Longer ones would leave colour and depth too far apart in time, or not come before the timeout.
        settings = package.settings
        self._high_s = min(high_s, settings.max_skew_s / 2, settings.colour_timeout_s / 4)

    def take(self, exposure_s: float, name: str) -> Capture:
        """Returns a capture of this exposure, taken from the place of the first.

        Raises:
            CaptureRejectedError: If it was not.
        """
        self._control.set_exposure(exposure_s)
        capture = self._package.capture(name, "exposure")
        if capture.joints is not None and self._first.joints is not None:
            moved = float(np.abs(capture.joints.q - self._first.joints.q).max())
            if moved > self._package.settings.max_joint_motion_rad:
                raise CaptureRejectedError(
                    f"exposure series: the arm moved by {moved:.4f} rad between two captures", "motion"
                )
        return capture

    def ends(self) -> tuple[float, float]:
        """Returns the shortest and the longest exposure of use.

        Raises:
            InputError, CaptureRejectedError, DriverError: As `exposure_series`.
        """
        start_s = self._start()
        longest_s = self._end(start_s, self._high_s, lambda level: level.bright <= _BRIGHT)
        shortest_s = self._end(start_s, self._low_s, lambda level: level.dark >= _DARK)
        if longest_s < 2 * shortest_s:
            raise InputError(
                f"only exposures from {shortest_s * 1e3:.3g} to {longest_s * 1e3:.3g} ms show the target "
                "neither dark nor saturated: show one that is evenly bright"
            )
        return shortest_s, longest_s

    def _start(self) -> float:
        """Returns an exposure that is neither too long nor too short."""
        exposure_s, level = _exposure_s(self._first), _middle(self._first)
        while (saturated := level.bright > _BRIGHT) or level.dark < _DARK:
            if saturated and level.dark < _DARK:
                raise InputError("the middle of the image is partly dark, partly saturated: show one target")
            wanted_s = exposure_s / _STRIDE if saturated else exposure_s * _STRIDE
            next_s = min(max(wanted_s, self._low_s), self._high_s)
            if next_s == exposure_s:
                raise InputError(
                    f"the middle of the image is {'saturated' if saturated else 'dark'} even with "
                    f"{exposure_s * 1e3:.3g} ms: change the light's level, the aperture or the distance"
                )
            exposure_s, level = next_s, self._tried(next_s)
        return exposure_s

    def _end(self, good_s: float, limit_s: float, of_use: Callable[[_Level], bool]) -> float:
        """Returns how far the exposure can go from one that is of use towards a limit."""
        bad_s = None
        while bad_s is None:
            if good_s == limit_s:
                return good_s
            next_s = min(good_s * _STRIDE, limit_s) if limit_s > good_s else max(good_s / _STRIDE, limit_s)
            if of_use(self._tried(next_s)):
                good_s = next_s
            else:
                bad_s = next_s
        while max(good_s / bad_s, bad_s / good_s) > _CLOSE:
            middle_s = math.sqrt(good_s * bad_s)
            if of_use(self._tried(middle_s)):
                good_s = middle_s
            else:
                bad_s = middle_s
        return good_s

    def _tried(self, exposure_s: float) -> _Level:
        return _middle(self.take(exposure_s, "exposure_trial"))


def _exposure_s(capture: Capture) -> float:
    assert capture.colour is not None
    assert capture.colour.exposure_s is not None
    return capture.colour.exposure_s


def _middle(capture: Capture) -> _Level:
    assert capture.colour is not None
    rgb = capture.colour.rgb
    rows, columns = rgb.shape[0] // 3, rgb.shape[1] // 3
    part = rgb[rows:-rows, columns:-columns].reshape(-1, 3)
    full = np.iinfo(rgb.dtype).max
    median = np.median(part, axis=0) / full
    return _Level(float(median.min()), float(np.quantile(part, _BRIGHT_QUANTILE, axis=0).max()) / full)
