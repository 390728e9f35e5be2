"""What the joints of an arm can be: readings beyond its limits, or faster than any arm, are not believed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from surfclass.errors import InputError
from surfclass.frames import JointState

# Denso VM-6083, data sheet.
VM_6083_DEG = (
    (-170.0, 170.0),
    (-90.0, 135.0),
    (-80.0, 165.0),
    (-185.0, 185.0),
    (-120.0, 120.0),
    (-360.0, 360.0),
)

_NOISE_RAD = 0.01  # of a reading, beside what the arm moves between two


class JointLimits:
    """Judges readings one after another, against the limits and the last one that was believed.

    Args:
        limits_deg: Least and greatest angle of each of six joints.
        margin_deg: How far beyond them an arm may still stand; soft limits differ from these.
        max_speed_deg_s: Faster than this no joint turns.

    Raises:
        InputError: If these are no limits.
    """

    def __init__(
        self, limits_deg: Sequence[tuple[float, float]], margin_deg: float, max_speed_deg_s: float
    ) -> None:
        limits = np.radians(np.array(limits_deg, dtype=np.float64))
        if limits.shape != (6, 2) or not (limits[:, 0] < limits[:, 1]).all():
            raise InputError(f"limits {limits_deg!r:.120}, allowed are 6 × [least, greatest] in degrees")
        if not (0 <= margin_deg < math.inf and 0 < max_speed_deg_s < math.inf):
            raise InputError(f"margin {margin_deg}° or speed {max_speed_deg_s}°/s, allowed is above 0")
        self._least = limits[:, 0] - math.radians(margin_deg)
        self._greatest = limits[:, 1] + math.radians(margin_deg)
        self._max_speed = math.radians(max_speed_deg_s)
        self._last: JointState | None = None

    def forget(self) -> None:
        """What comes next is the first reading again."""
        self._last = None

    def complaint(self, state: JointState) -> str:
        """Returns what is impossible about a reading, or "" and remembers it."""
        outside = (state.q < self._least) | (state.q > self._greatest)
        if outside.any():
            joint = int(outside.argmax())
            least, greatest = math.degrees(self._least[joint]), math.degrees(self._greatest[joint])
            return f"joint {joint + 1} at {_deg(state.q[joint])}, allowed are {least:g}° to {greatest:g}°"
        if self._last is not None:
            longest_s = (state.t_ns - self._last.t_ns + state.t_sd_ns + self._last.t_sd_ns) / 1e9
            turned = np.abs(state.q - self._last.q)
            if turned.max() > self._max_speed * longest_s + _NOISE_RAD:
                joint = int(turned.argmax())
                return (
                    f"joint {joint + 1} turned by {_deg(turned[joint])} in {longest_s * 1e3:.1f} ms, allowed "
                    f"are {_deg(self._max_speed)}/s"
                )
        self._last = state
        return ""


def _deg(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.4g}°"
