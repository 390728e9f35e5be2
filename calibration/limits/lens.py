"""From lens data or a focus series to `[lens]`: depth of field (Eq. 5.1, 5.2), circle of confusion (5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from calibration.limits.focus import Focus
from surfclass import quality
from surfclass.errors import ConfigurationError
from surfclass.rig import TextureLimits


@dataclass(frozen=True, slots=True)
class LensData:
    """What is written on the lens, or known otherwise; None: not known.

    Attributes:
        focal_length_m: Focal length.
        f_number: Focal length over the entrance pupil's diameter.
        focus_distance_m: Distance of the plane of focus.
        circle_of_confusion_m: Greatest blur circle that is still sharp.
    """

    focal_length_m: float | None = None
    f_number: float | None = None
    focus_distance_m: float | None = None
    circle_of_confusion_m: float | None = None


@dataclass(frozen=True, slots=True)
class DepthOfField:
    """A lens and the planes between which it is sharp.

    Attributes:
        lens: The keys of `[lens]`.
        near_m: Nearest plane in focus.
        far_m: Farthest plane in focus; infinite from the hyperfocal distance on.
        measured: Which of the lens' keys came from the focus series.
        circle_from: Where the circle of confusion is from: "given", or "limits" by Eq. 5.4.
    """

    lens: dict[str, float]
    near_m: float
    far_m: float
    measured: tuple[str, ...]
    circle_from: str

    def to_json(self) -> dict[str, Any]:
        """As the result has it; an infinite plane is null."""
        far = self.far_m if self.far_m < float("inf") else None
        return {
            "lens": self.lens, "near_m": self.near_m, "far_m": far, "measured": list(self.measured),
            "circle_from": self.circle_from,
        }  # fmt: skip


def depth_of_field(
    told: LensData, focus: Focus | None, fx: float, limits: Sequence[TextureLimits]
) -> DepthOfField | None:
    """Returns the depth of field; None where lens data and focus series together do not determine it.

    What is told is taken; the plane of focus and the f-number that are not are the focus series'. Without
    a circle of confusion the smallest is taken that keeps in focus what each class' limits allow (Eq. 5.4 for
    the far one, and the same of the near one): accuracy was measured with the blur in it, and must not be
    cut twice.

    Args:
        told: Lens data.
        focus: What a focus series gave, or None.
        fx: Focal length of the colour camera, px.
        limits: Of every class.

    Raises:
        ConfigurationError: If lens data contradict each other.
    """
    focal, number, distance = told.focal_length_m, told.f_number, told.focus_distance_m
    if focal is None or (focus is None and (number is None or distance is None)):
        return None
    measured: tuple[str, ...] = ()
    if focus is not None and distance is None:
        distance, measured = focus.distance_m, (*measured, "focus_distance_m")
    if focus is not None and number is None:
        number, measured = focal / focus.aperture_m(fx), (*measured, "f_number")
    if number is None or distance is None:
        return None
    circle, circle_from = told.circle_of_confusion_m, "given"
    if circle is None:
        circle, circle_from = _circle(focal, number, distance, limits), "limits"
    near, far = quality.depth_of_field(focal, number, circle, distance)
    lens = {
        "focal_length_m": focal, "f_number": number, "focus_distance_m": distance,
        "circle_of_confusion_m": circle,
    }  # fmt: skip
    return DepthOfField(lens, near, far, measured, circle_from)


def _circle(focal: float, number: float, distance: float, limits: Sequence[TextureLimits]) -> float:
    """The smallest circle that has every class' near and far limit in focus."""
    circles = [
        quality.circle_of_confusion(focal, number, distance, one.far_m)
        for one in limits
        if one.far_m > distance
    ]
    # Eq. 5.1 for the circle: near = F² d / (F² + N c (d − F)).
    circles += [
        focal**2 * (distance / one.near_m - 1) / (number * (distance - focal))
        for one in limits
        if focal < one.near_m < distance
    ]
    if not circles:
        raise ConfigurationError(
            f"lens: no class' limits hold the focus distance {distance:g} m, so that they say nothing of the "
            "circle of confusion; give it"
        )
    return max(circles)
