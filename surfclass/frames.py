"""What the sensors deliver: one object for one device read, and one Capture for one viewpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float64, Transform, freeze


def _image(array: NDArray[Any], what: str, kinds: tuple[type, ...], dims: int) -> NDArray[Any]:
    names = ", ".join(np.dtype(kind).name for kind in kinds)
    if array.dtype not in [np.dtype(kind) for kind in kinds]:
        raise InputError(f"{what}: {array.dtype} pixels, allowed are {names}")
    if array.ndim != dims or (dims == 3 and array.shape[2] != 3):
        wanted = "height × width" + (" × 3" if dims == 3 else "")
        raise InputError(f"{what}: shape {array.shape}, allowed is {wanted}")
    return freeze(array)


@dataclass(frozen=True, slots=True, eq=False)
class ColourFrame:
    """One exposure of the colour camera, in the camera's own response.

    Attributes:
        t_ns: Mid-exposure, CLOCK_MONOTONIC.
        sequence: The device's frame counter.
        exposure_s: None where it is not known.
        rgb: (h, w, 3) uint8 or uint16, channels red, green, blue.
        t_sd_ns: Half the interval in which mid-exposure can have been.
        gain_db: None where it is not known.
    """

    t_ns: int
    sequence: int
    exposure_s: float | None
    rgb: NDArray[np.uint8] | NDArray[np.uint16]
    t_sd_ns: int = 0
    gain_db: float | None = None

    def __post_init__(self) -> None:
        kinds = (np.uint8, np.uint16)
        object.__setattr__(self, "rgb", _image(self.rgb, "colour image", kinds, 3))


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """One exposure of the depth camera.

    Attributes:
        t_ns: Mid-exposure, CLOCK_MONOTONIC.
        sequence: The device's frame counter.
        exposure_s: None where it is not known.
        depth_mm: (h, w) uint16, millimetres along the optical axis, 0 = no return.
        ir: (h, w) uint8 or uint16 of the same exposure, or None.
        t_sd_ns: Half the interval in which mid-exposure can have been.
    """

    t_ns: int
    sequence: int
    exposure_s: float | None
    depth_mm: NDArray[np.uint16]
    ir: NDArray[np.uint8] | NDArray[np.uint16] | None = None
    t_sd_ns: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth_mm", _image(self.depth_mm, "depth image", (np.uint16,), 2))
        if self.ir is not None:
            ir = _image(self.ir, "IR image", (np.uint8, np.uint16), 2)
            object.__setattr__(self, "ir", ir)


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """The arm's joint angles at one time.

    Attributes:
        t_ns: When they held, CLOCK_MONOTONIC.
        t_sd_ns: Half the interval in which they can have been read.
        q: (6,) float64, rad.
    """

    t_ns: int
    t_sd_ns: int
    q: Float64

    def __post_init__(self) -> None:
        q = np.array(self.q, dtype=np.float64)
        if q.shape != (6,) or not np.isfinite(q).all():
            raise InputError(f"joint angles: {self.q!r:.80}, allowed are 6 finite numbers")
        object.__setattr__(self, "q", freeze(q))


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Everything that was seen from one viewpoint, paired and checked.

    Attributes:
        name: Unique within a recording.
        role: What it is for: "map", "train", "test", "light", "response", "exposure",
            "hand_eye" or "board".
        depth: The depth frame.
        colour: The lit colour frame; None only where a set has no colour (`hand_eye`).
        dark: The same view with the light off, or None.
        joints: Interpolated to the colour frame's mid-exposure, or None.
        base_T_depth: The depth camera's pose as recorded, or None where `joints` gives it.
        label: (h, w) uint8 in the colour image's grid, 0 = unlabelled, or None.
        light_level: 0…1 of the light during `colour`, or None where it is not controlled.
        joint_motion_rad: Largest joint change between the reads before and after, or None.
        skew_ns: Mid-exposure of depth minus that of colour.
        light_timing: "software": the light was told and waited for; "hardware": the camera's strobe
            line fired it; None where it is not controlled or not known.
    """

    name: str
    role: str
    depth: DepthFrame
    colour: ColourFrame | None
    dark: ColourFrame | None = None
    joints: JointState | None = None
    base_T_depth: Transform | None = None
    label: NDArray[np.uint8] | None = None
    light_level: float | None = None
    joint_motion_rad: float | None = None
    skew_ns: int = 0
    light_timing: Literal["software", "hardware"] | None = None

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise InputError(f"capture {self.name}: role {self.role!r}, allowed: {', '.join(ROLES)}")
        if self.label is not None:
            label = _image(self.label, f"capture {self.name}: label image", (np.uint8,), 2)
            object.__setattr__(self, "label", label)
            if self.colour is not None and label.shape != self.colour.rgb.shape[:2]:
                raise InputError(
                    f"capture {self.name}: label image {label.shape[1]} × {label.shape[0]}, the "
                    f"colour image is {self.colour.rgb.shape[1]} × {self.colour.rgb.shape[0]}"
                )

    @property
    def skew_sd_ns(self) -> int:
        """How uncertain `skew_ns` is: by both frames' times."""
        return self.depth.t_sd_ns + (0 if self.colour is None else self.colour.t_sd_ns)

    @property
    def t_ns(self) -> int:
        """Mid-exposure of the colour frame, or of the depth frame where there is no colour."""
        return self.depth.t_ns if self.colour is None else self.colour.t_ns


ROLES = ("train", "test", "map", "light", "response", "exposure", "hand_eye", "board")

# What goes into a map: views of the place itself. Training boards and calibration targets may stand
# anywhere, at other times.
MAP_ROLES = ("map", "test")
