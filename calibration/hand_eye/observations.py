"""What was seen from each pose of the arm: the values that every detector fills."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float64, Transform, freeze

Mounting = Literal["eye_in_hand", "eye_to_hand"]

PROBE_SD_M = 0.0005
"""Of a probed point whose file does not say how well it was probed."""

# A camera_T_target becomes the pair of points at this distance on each axis of the target. It sets only
# what a turn of the target counts beside a shift of it.
_VIRTUAL_ARM_M = 0.1


def _none() -> Float64:
    return np.zeros(0)


def _rows(array: NDArray[Any], columns: int, what: str) -> Float64:
    rows = np.asarray(array, np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise InputError(f"{what}: {rows.shape}, needed are finite rows of {columns}")
    return freeze(rows.copy())


def _spread(sd: NDArray[Any], count: int, default: float, what: str) -> Float64:
    values = np.array(sd, np.float64) if np.size(sd) else np.full(count, default)
    if values.shape != (count,) or not (np.isfinite(values).all() and (values > 0).all()):
        raise InputError(f"{what}: {values.shape}, needed are {count} positive numbers")
    return freeze(values)


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Target points where the image shows them.

    Attributes:
        target_m: (n, 3) each point in the target's own frame: what identifies it in all views.
        pixel: (n, 2) where it was seen, px; pixel (0, 0) is the centre of the top-left pixel.
        sd_px: (n,) how well, px; only the ratios between points count, the level is estimated. Left
            out: all alike.
    """

    target_m: Float64
    pixel: Float64
    sd_px: Float64 = field(default_factory=_none)

    def __post_init__(self) -> None:
        object.__setattr__(self, "target_m", _rows(self.target_m, 3, "pixels: target_m"))
        object.__setattr__(self, "pixel", _rows(self.pixel, 2, "pixels: pixel"))
        if len(self.target_m) != len(self.pixel):
            raise InputError(f"pixels: {len(self.target_m)} target points but {len(self.pixel)} pixels")
        object.__setattr__(self, "sd_px", _spread(self.sd_px, len(self.pixel), 1.0, "pixels: sd_px"))


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Target points where the depth camera measured them.

    Attributes:
        target_m: (n, 3) each point in the target's own frame: what identifies it in all views.
        camera_m: (n, 3) where it was measured in the camera's frame.
        sd_m: (n,) how well, m; only the ratios between points count, the level is estimated, along
            the ray and across it apart. Left out: all alike.
    """

    target_m: Float64
    camera_m: Float64
    sd_m: Float64 = field(default_factory=_none)

    def __post_init__(self) -> None:
        object.__setattr__(self, "target_m", _rows(self.target_m, 3, "positions: target_m"))
        object.__setattr__(self, "camera_m", _rows(self.camera_m, 3, "positions: camera_m"))
        if len(self.target_m) != len(self.camera_m):
            raise InputError(
                f"positions: {len(self.target_m)} target points but {len(self.camera_m)} measured"
            )
        object.__setattr__(self, "sd_m", _spread(self.sd_m, len(self.camera_m), 1.0, "positions: sd_m"))


def _no_pixels() -> Pixels:
    return Pixels(np.zeros((0, 3)), np.zeros((0, 2)))


def _no_positions() -> Positions:
    return Positions(np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The target from one pose of the arm.

    Attributes:
        name: The capture's.
        base_T_flange: The arm's pose as it was read.
        pixels: What the image shows.
        positions: What the depth camera measured; a point may be in both.
        q: (6,) the joint angles of `base_T_flange`, rad, or None.
        sizeless: Whether the points stand for a known `camera_T_target`, so that their number and
            distances mean nothing.
    """

    name: str
    base_T_flange: Transform
    pixels: Pixels = field(default_factory=_no_pixels)
    positions: Positions = field(default_factory=_no_positions)
    q: Float64 | None = None
    sizeless: bool = False

    def __post_init__(self) -> None:
        pose = self.base_T_flange
        if (pose.dst, pose.src) != ("base", "flange"):
            raise InputError(
                f"view {self.name}: needed is base_T_flange, its pose is {pose.dst}_T_{pose.src}"
            )
        if self.q is not None:
            q = np.asarray(self.q, np.float64)
            if q.shape != (6,) or not np.isfinite(q).all():
                raise InputError(f"view {self.name}: q {self.q!r:.80}, needed are 6 finite numbers")
            object.__setattr__(self, "q", freeze(q.copy()))

    @property
    def count(self) -> int:
        """How many points were seen, by pixel, position or both."""
        seen = np.concatenate([self.pixels.target_m, self.positions.target_m])
        return len(np.unique(seen, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Probed:
    """Target points that are known where the target is fixed: in `base`, or on the flange (eye_to_hand).

    Attributes:
        target_m: (k, 3) in the target's own frame.
        fixed_m: (k, 3) in `base` (eye_in_hand) or in `flange` (eye_to_hand).
        sd_m: (k,) how well, m. Left out: `PROBE_SD_M`.
    """

    target_m: Float64
    fixed_m: Float64
    sd_m: Float64 = field(default_factory=_none)

    def __post_init__(self) -> None:
        object.__setattr__(self, "target_m", _rows(self.target_m, 3, "probed: target_m"))
        object.__setattr__(self, "fixed_m", _rows(self.fixed_m, 3, "probed: fixed_m"))
        if len(self.target_m) != len(self.fixed_m) or not len(self.target_m):
            raise InputError(f"probed: {len(self.target_m)} target points but {len(self.fixed_m)} probed")
        if len(np.unique(self.target_m, axis=0)) != len(self.target_m):
            raise InputError("probed: a target point appears twice")
        object.__setattr__(self, "sd_m", _spread(self.sd_m, len(self.fixed_m), PROBE_SD_M, "probed: sd_m"))


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera with OpenCV's distortion k1 k2 p1 p2 k3."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def vector(self) -> Float64:
        """(9,) fx, fy, cx, cy, then the distortion."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Everything a hand-eye calibration knows.

    Attributes:
        mounting: "eye_in_hand": the camera is on the flange and the target fixed in `base`;
            "eye_to_hand": the camera is fixed in `base` and the target on the flange.
        views: One for each pose.
        intrinsics: Of the camera, or None: they are estimated where the views allow it.
        image_size: Width and height, px, or None.
        probed: Target points that are known in the frame the target is fixed in, or None.
    """

    mounting: Mounting
    views: tuple[View, ...]
    intrinsics: Intrinsics | None = None
    image_size: tuple[int, int] | None = None
    probed: Probed | None = None


def virtual_points(camera_T_target: Transform) -> Positions:
    """Returns points that stand for a pose of the target which some other tool found."""
    target = _VIRTUAL_ARM_M * np.concatenate([np.eye(3), -np.eye(3)])
    return Positions(target, camera_T_target @ target)
