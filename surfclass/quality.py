"""How far texture can be trusted at a pixel: focus, resolution and viewing angle (chapter 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import TextureLimits
from surfclass.types import Bool, Float32, SurfaceView

Floats = NDArray[np.floating]

_ROWS = 32  # of an image at once, so that all intermediate planes stay in the cache


def depth_of_field(F: float, N: float, c: float, d: float) -> tuple[float, float]:
    """Returns the nearest and the farthest plane in focus, m (Eq. 5.1, 5.2, corrected).

    As c goes to 0 both go to the focus distance. The farthest plane is infinite from the hyperfocal
    distance on.

    Args:
        F: Focal length, m.
        N: f-number.
        c: Circle of confusion, m.
        d: Distance of the plane of focus, m.

    Raises:
        ConfigurationError: If a number is not positive, or d is not beyond the focal length.
    """
    _check_lens(F, N, d)
    if not (c > 0 and math.isfinite(c)):
        raise ConfigurationError(f"lens: circle of confusion {c} m, must be positive")
    blur = N * c * (d - F)
    near = F**2 * d / (F**2 + blur)
    far = F**2 * d / (F**2 - blur) if blur < F**2 else math.inf
    return near, far


def circle_of_confusion(F: float, N: float, d: float, far: float) -> float:
    """Returns the circle of confusion, m, whose farthest plane in focus is `far` (Eq. 5.4, corrected).

    Args:
        F: Focal length, m.
        N: f-number.
        d: Distance of the plane of focus, m.
        far: Farthest plane on which texture was still told apart, m; infinity is allowed.

    Raises:
        ConfigurationError: If a number is not positive, or not F < d < far.
    """
    _check_lens(F, N, d)
    if not far > d:
        raise ConfigurationError(f"lens: far limit {far} m, must be beyond the focus distance {d} m")
    return F**2 * (1 - d / far) / (N * (d - F))


def in_focus(z: Floats, near: float, far: float) -> NDArray[np.bool_]:
    """Returns where a surface lies within the depth of field (Eq. 5.3).

    Args:
        z: Depth along the optical axis, m: what is in focus is a slab between two planes, so the
            distance to the camera would be wrong off the axis.
        near: Nearest plane in focus, m.
        far: Farthest plane in focus, m.
    """
    return np.asarray((z >= near) & (z <= far))


def pixels_per_area(distance_m: Floats, cosine: Floats) -> Floats:
    """Returns pixels for each square metre of surface, in units of fx · fy (Eq. 5.9 with the angle).

    A pixel's footprint grows with the square of the distance, and with 1 / cosine on a tilted surface.
    """
    return np.asarray(cosine / distance_m**2)


def range_of(
    near_1: float, far_1: float, near_2: float, far_2: float, class_name: str
) -> tuple[float, float]:
    """Returns the distances, m, that both of two ranges allow (Eq. 5.16).

    Args:
        near_1: Of the depth of field, m; `far_1` likewise, possibly infinite.
        far_1: See `near_1`.
        near_2: Of the spatial resolution that the class tolerates, m; `far_2` likewise.
        far_2: See `near_2`.
        class_name: For the message.

    Raises:
        ConfigurationError: If no distance is left, naming the class and both ranges.
    """
    near, far = max(near_1, near_2), min(far_1, far_2)
    if not near < far:
        raise ConfigurationError(
            f"class {class_name}: no viewing distance is both in focus ({near_1:g} to {far_1:g} m) and "
            f"within its texture limits ({near_2:g} to {far_2:g} m); refocus the lens or change the limits"
        )
    return near, far


def viewing_probability(distance_m: Floats, angle_rad: Floats, limits: TextureLimits) -> Floats:
    """Returns the probability that texture seen so is as it was trained (Eq. 5.17–5.19).

    Args:
        distance_m: Viewing distance d_c.
        angle_rad: Viewing angle θ_c.
        limits: Range, angle and slopes; per metre and per radian, 1 per mm being 1000 per metre.
    """
    slope = limits.slope_per_m
    return np.asarray(
        _between(distance_m, limits.near_m, limits.far_m, slope)
        * _rising((limits.angle_rad - angle_rad) * limits.slope_per_rad)
    )


def probability_map(
    view: SurfaceView,
    limits_per_class: Sequence[TextureLimits],
    label: NDArray[np.uint8],
    focus: tuple[float, float] | None = None,
) -> Float32:
    """Returns (h, w) float32: `viewing_probability` of each pixel for the class it was given.

    0 where a pixel has no class or no normal.

    Args:
        view: What each pixel looks at.
        limits_per_class: k limits.
        label: (h, w) uint8, 1 … k; 0: no class.
        focus: Nearest and farthest plane in focus, m; the depth along the axis must then lie between
            them (Eq. 5.3), with the same slope as the distance. None: the limits say it all.

    Raises:
        InputError: If the label image has another size than the view, or a label above k.
    """
    shape = view.viewing_distance_m.shape
    if label.shape != shape:
        raise InputError(f"label image: shape {label.shape}, the view has {shape}")
    if label.max(initial=0) > len(limits_per_class):
        raise InputError(f"label image: label {label.max()}, there are {len(limits_per_class)} classes")
    weight = np.zeros(shape, np.float32)
    if not limits_per_class:
        return weight
    # Row 0 is never used: pixels without a class take any limits, and 0 in the end.
    table = {
        name: np.array([getattr(limits, name) for limits in (limits_per_class[0], *limits_per_class)], "f4")
        for name in ("near_m", "far_m", "angle_rad", "slope_per_m", "slope_per_rad")
    }
    alike = {name: bool((values == values[0]).all()) for name, values in table.items()}
    for start in range(0, shape[0], _ROWS):
        rows = slice(start, start + _ROWS)
        near, far, limit, per_m, per_rad = (
            values[0] if alike[name] else values.take(label[rows]) for name, values in table.items()
        )
        p = _between(view.viewing_distance_m[rows], near, far, per_m)
        angle = np.arccos(np.clip(view.viewing_cosine[rows], np.float32(-1), np.float32(1)))
        p *= _rising((limit - angle) * per_rad)
        if focus is not None:
            p *= _between(view.point[2, rows], np.float32(focus[0]), np.float32(focus[1]), per_m)
        known: Bool = view.has_normal[rows] & (label[rows] > 0)
        np.multiply(p, known, out=weight[rows])
    return weight


def _between(value: Floats, near: Any, far: Any, slope: Any) -> Floats:
    """Eq. 5.17: 0 outside, 1 well inside. The hyperbolic tangent saturates where exp overflows."""
    half = slope / 2
    return np.asarray((np.tanh((value - near) * half) - np.tanh((value - far) * half)) / 2)


def _rising(z: Floats) -> Floats:
    """1 / (1 + exp(−z)), which Eq. 5.18 is."""
    return np.asarray((1 + np.tanh(z / 2)) / 2)


def _check_lens(F: float, N: float, d: float) -> None:
    if not (F > 0 and N > 0 and math.isfinite(N) and F < d < math.inf):
        raise ConfigurationError(
            f"lens: focal length {F} m, f-number {N}, focus distance {d} m; all must be positive and "
            "the focus distance beyond the focal length"
        )
