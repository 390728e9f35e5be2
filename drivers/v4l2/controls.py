"""The controls of a V4L2 camera: what must be off, what the configuration sets, and that it stays so."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from typing import NamedTuple

from drivers.errors import DeviceFaultError
from drivers.v4l2.node import Control, VideoNode

# Kernel documentation, "User Control Reference" and "Camera Control Reference", by number, for drivers
# and kernel versions name them differently; with the value that is off, or by hand. In this order: the
# first makes others writable.
_AUTOMATIC = {
    0x009A0901: 1,  # auto_exposure: manual
    0x009A0903: 0,  # exposure_dynamic_framerate
    0x00980912: 0,  # gain_automatic
    0x0098090C: 0,  # white_balance_automatic
    0x009A0914: 0,  # white_balance_auto_preset: manual
    0x00980919: 0,  # hue_automatic
    0x00980920: 0,  # brightness_automatic
    0x0098091D: 0,  # chroma_agc
    0x009A0915: 0,  # wide_dynamic_range
    0x009A0916: 0,  # image_stabilization
    0x009A0918: 0,  # iso_sensitivity_auto: manual
    0x009A091A: 0,  # scene_mode: none
    0x009A090C: 0,  # focus_automatic_continuous
}
# These are switched off, too, unless the configuration has another value: some cameras cannot do without.
_CORRECTING = {
    0x0098091C: 0,  # backlight_compensation
    0x00980918: 0,  # power_line_frequency
}
_EXPOSURE = 0x009A0902  # in units of 100 µs
_GAIN = 0x00980913
_EXPOSURE_UNIT_US = 100.0


class Wanted(NamedTuple):
    """What the configuration asks for; None leaves a control as it is."""

    exposure_us: float | None
    gain: int | None
    others: Mapping[str, int]


class Settings:
    """The controls that were set, all read back; `verify` says whether they still hold.

    Args:
        name: How messages call the camera.
        node: The open node.
        wanted: Values to set.

    Raises:
        DeviceFaultError: If a control is missing, refuses its value or has another one afterwards.
        OSError: As the node does.
    """

    def __init__(self, name: str, node: VideoNode, wanted: Wanted) -> None:
        self._name, self._node = name, node
        self.held: dict[Control, int] = {}
        self._switch_off(wanted)
        controls = node.controls()  # anew: switching the automatic ones off makes others writable
        by_id = {each.id: each for each in controls.values()}
        self._exposure, self._gain = by_id.get(_EXPOSURE), by_id.get(_GAIN)
        if wanted.exposure_us is not None:
            units = round(wanted.exposure_us / _EXPOSURE_UNIT_US)
            self._set(self._must("exposure_us", self._exposure), units)
        if wanted.gain is not None:
            self._set(self._must("gain", self._gain), wanted.gain)
        for key, value in wanted.others.items():
            if key not in controls:
                raise self._fault(f"it has no control {key!r}; it has: {', '.join(sorted(controls))}")
            off = _AUTOMATIC.get(controls[key].id, value)
            if value != off:
                raise self._fault(f"control {key} = {value} is automatic, allowed is {off}")
            self._set(controls[key], int(value))
        for measured in (self._exposure, self._gain):  # what was not set must not change unnoticed, either
            if measured is not None and measured not in self.held:
                self.held[measured] = node.read(measured)
        self.verify()

    @property
    def exposure_ns(self) -> int | None:
        """The exposure in force; None where the camera does not tell."""
        if self._exposure is None:
            return None
        return round(self.held[self._exposure] * _EXPOSURE_UNIT_US * 1e3)

    def exposure_range_s(self, period_ns: int) -> tuple[float, float]:
        """Returns the shortest and the longest exposure that fits into a frame's period.

        Both are that of now where it cannot be changed, and 0 where the camera does not tell it.
        """
        control, now_s = self._exposure, (self.exposure_ns or 0) / 1e9
        if control is None or not control.writable:
            return now_s, now_s
        step = max(1, control.step)
        most = min(control.maximum, int(period_ns / (_EXPOSURE_UNIT_US * 1e3)))
        most = control.minimum + max(0, most - control.minimum) // step * step
        low, high = (units * _EXPOSURE_UNIT_US / 1e6 for units in (max(step, control.minimum), most))
        return low, max(low, high)

    def set_exposure(self, exposure_s: float) -> None:
        """Sets the exposure to the step nearest to a value within the range.

        Raises:
            DeviceFaultError: If it refuses the value, or has another one afterwards.
            OSError: As the node does.
        """
        control = self._must("exposure_us", self._exposure)
        step = max(1, control.step)
        steps = round((exposure_s * 1e6 / _EXPOSURE_UNIT_US - control.minimum) / step)
        self._set(control, control.minimum + steps * step)
        self.verify()

    @property
    def gain(self) -> int | None:
        """The gain in force, in the driver's own unit; None where the camera has no such control."""
        return None if self._gain is None else self.held[self._gain]

    def verify(self) -> None:
        """Reads all of them back; any program may have changed one.

        Raises:
            DeviceFaultError: If one has another value than it was given.
            OSError: As the node does.
        """
        for control, value in self.held.items():
            told = self._node.read(control)
            if told != value:
                raise self._fault(
                    f"control {control.name} is {told}, it was set to {value} (allowed: {control.minimum} to "
                    f"{control.maximum} in steps of {control.step}); is another program changing it?"
                )

    def __str__(self) -> str:
        return ", ".join(f"{control.name} = {value}" for control, value in self.held.items())

    def _switch_off(self, wanted: Wanted) -> None:
        first, *others = _AUTOMATIC
        for ids in ([first], [*others, *_CORRECTING]):
            by_id = {each.id: each for each in self._node.controls().values()}
            for control in (by_id[each] for each in ids if each in by_id):
                if control.id in _AUTOMATIC or control.name not in wanted.others:
                    self._set(control, {**_AUTOMATIC, **_CORRECTING}[control.id])

    def _must(self, option: str, control: Control | None) -> Control:
        if control is None:
            known = ", ".join(sorted(self._node.controls())) or "none"
            raise self._fault(f"{option} is set, but the camera has no such control; it has: {known}")
        return control

    def _set(self, control: Control, value: int) -> None:
        step = max(1, control.step)
        if not control.minimum <= value <= control.maximum or (value - control.minimum) % step:
            raise self._fault(
                f"control {control.name} = {value}, allowed: {control.minimum} to {control.maximum} in "
                f"steps of {step}"
            )
        if control.writable:
            try:
                self._node.write(control, value)
            except OSError as error:
                if error.errno not in (errno.EINVAL, errno.ERANGE, errno.EACCES, errno.EBUSY):
                    raise
                raise self._fault(f"control {control.name} refuses {value}: {error.strerror}") from error
        elif (told := self._node.read(control)) != value:
            raise self._fault(f"control {control.name} is {told} and cannot be set to {value}")
        self.held[control] = value

    def _fault(self, message: str) -> DeviceFaultError:
        return DeviceFaultError(self._name, message)
