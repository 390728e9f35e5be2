"""Writes the features of a GenICam camera, and believes nothing that it has not read back."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from drivers.aravis.library import Camera, GenicamError, Value
from drivers.errors import DeviceFaultError
from surfclass.errors import ConfigurationError


@dataclass(slots=True)
class Settings:
    """Writes features, reads them back, and remembers them for a last look at all."""

    camera: Camera
    device: str
    made: list[tuple[str, Value, float, str]] = field(default_factory=list)

    def make(self, feature: str, value: Value, tolerance: float = 0.0, under: str = "") -> Value:
        """Brings a feature to a value and returns what it reads then.

        Raises:
            DeviceFaultError: If it reads anything else.
        """
        got = self.camera.read(feature)
        why = ""
        if not _same(got, value, tolerance):
            try:
                self.camera.write(feature, value)
            except GenicamError as error:
                if error.gone or error.denied:
                    raise
                why = f" ({error})"
            got = self.camera.read(feature)
        if not _same(got, value, tolerance):
            raise DeviceFaultError(self.device, f"{under}{feature}: wanted {value!r}, it reads {got!r}{why}")
        if not under:
            self.made.append((feature, value, tolerance, why))
        return got

    def look_again(self) -> None:
        """Raises if a setting has changed while others were made."""
        for feature, value, tolerance, _ in self.made:
            if self.camera.has(feature) and not _same(got := self.camera.read(feature), value, tolerance):
                raise DeviceFaultError(
                    self.device, f"{feature}: was {value!r}, and reads {got!r} after all was set"
                )

    def within(self, option: str, feature: str, value: float) -> None:
        """Raises unless a value lies in a feature's bounds, since Aravis would let it overflow."""
        low, high = self.camera.bounds(feature)
        if not low <= value <= high:
            raise ConfigurationError(
                f"{self.device}: {option} {value:g}, this camera allows {low:g} to {high:g}"
            )

    def choice(self, option: str, feature: str, value: str) -> None:
        """Raises unless an enumeration has an entry."""
        if value not in (choices := self.camera.choices(feature)):
            raise ConfigurationError(
                f"{self.device}: {option} {value!r}, this camera has {', '.join(choices) or 'none'}"
            )

    def need(self, option: str, *features: str) -> str:
        """Returns the first of these features that the camera has."""
        found = next((feature for feature in features if self.camera.has(feature)), None)
        if found is None:
            raise ConfigurationError(f"{self.device}: {option}: this camera has no {' or '.join(features)}")
        return found


def _same(got: Value, wanted: Value, tolerance: float) -> bool:
    if isinstance(got, int | float) and isinstance(wanted, int | float):
        return math.isfinite(got) and abs(got - wanted) <= tolerance + 1e-9
    return got == wanted
