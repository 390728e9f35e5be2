"""From where a scene is looked at: wanted views, and the joint angles that bring the camera there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import Literal

import numpy as np

from drivers.sim.arm import joints_of
from drivers.sim.package import standard_package
from drivers.sim.raycast import cast, faces_from
from drivers.sim.surfaces import Surface
from surfclass.types import Float64, Transform

_HOME = np.radians([0.0, 20.0, 90.0, 0.0, -20.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """Where the colour camera looks from.

    Attributes:
        name: Unique in the scene.
        q: (6,) rad, what brings the camera there.
        base_T_rgb: Its pose.
        distance_m: To the surface at the middle of the image.
        angle_rad: Between the line of sight and that surface's normal.
    """

    name: str
    q: Float64
    base_T_rgb: Transform
    distance_m: float
    angle_rad: float


@dataclass(frozen=True, slots=True)
class Look:
    """A wanted view of `target`.

    `turn` is in degrees around the vertical (positive: from the left), `rise` from above, `roll`
    about the line of sight. `camera`, "rgb" or "depth", is the one that has the target in its middle
    and at that distance.
    """

    name: str
    target: tuple[float, float, float]
    distance_m: float
    turn: float = 0.0
    rise: float = 0.0
    roll: float = 0.0
    camera: Literal["rgb", "depth"] = "rgb"


def reach(looks: Sequence[Look], surfaces: Sequence[Surface]) -> tuple[Viewpoint, ...]:
    """Returns the wanted views with the joint angles that give them, each near the one before.

    Raises:
        ValueError: If the arm cannot reach one of them.
    """
    package = standard_package()
    near = _HOME
    found = []
    for look in looks:
        base_T_rgb = _camera_pose(look)
        if look.camera == "depth":
            base_T_rgb = base_T_rgb @ package.rgb_T_depth.inverse
        near = joints_of(base_T_rgb @ package.flange_T_rgb.inverse, near, package.flange_offset_m)
        middle = cast(faces_from(surfaces, base_T_rgb.inverse), np.zeros((2, 1, 1), np.float32))
        normal = middle.faces[int(middle.face[0, 0])].normal
        angle = float(np.arccos(np.clip(-normal[2], -1, 1)))
        found.append(Viewpoint(look.name, near, base_T_rgb, float(middle.z[0, 0]), angle))
    return tuple(found)


def _camera_pose(look: Look) -> Transform:
    """The camera's pose: z forward, x to the right, y down, then rolled about z."""
    turn, rise, roll = radians(look.turn), radians(look.rise), radians(look.roll)
    to_camera = np.array([-np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
    forward = -to_camera
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    x = np.cos(roll) * right + np.sin(roll) * down
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([x, np.cross(forward, x), forward])
    matrix[:3, 3] = np.array(look.target) + look.distance_m * to_camera
    return Transform("base", look.camera, matrix)
