"""The simulated scenes: what stands in front of the arm, and from where it is looked at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from math import radians

import numpy as np

from drivers.sim.arm import joints_of
from drivers.sim.materials import CLASS_NAMES
from drivers.sim.package import standard_package
from drivers.sim.surfaces import Layout, Surface, bands, checker, discs
from surfclass.errors import ConfigurationError
from surfclass.types import Float64, Transform

BOARD_X_M = 1.62
BOARD_Z_M = 0.84
DISC_RADIUS_M = 0.030
DISC_PLACES_M = (
    (0.07, 0.08), (0.25, 0.07), (0.46, 0.09),
    (0.08, 0.22), (0.29, 0.24), (0.47, 0.23),
    (0.07, 0.40), (0.23, 0.39), (0.45, 0.41),
)  # fmt: skip
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
class _Look:
    """A wanted view of `target`.

    `turn` is in degrees around the vertical (positive: from the left), `rise` from above, `roll`
    about the line of sight.
    """

    name: str
    target: tuple[float, float, float]
    distance_m: float
    turn: float = 0.0
    rise: float = 0.0
    roll: float = 0.0
    normal: tuple[float, float, float] = (-1.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Scene:
    """Surfaces and the views of them."""

    name: str
    surfaces: tuple[Surface, ...]
    looks: tuple[_Look, ...]


def _upright(
    name: str,
    centre: tuple[float, float, float],
    size_m: tuple[float, float],
    materials: tuple[str, ...],
    layout: Layout | None = None,
    yaw: float = 0.0,
    pitch: float = 0.0,
    coarseness: float = 1.0,
) -> Surface:
    """A rectangle facing the arm (−x), turned by `yaw` degrees to the left and leaning back by `pitch`.

    Along s runs to the right as the arm sees it (−y), along t downwards.
    """
    y, p = radians(yaw), radians(pitch)
    turn = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    lean = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    along_s, along_t = turn @ lean @ [0.0, -1.0, 0.0], turn @ lean @ [0.0, 0.0, -1.0]
    corner = np.array(centre) - along_s * size_m[0] / 2 - along_t * size_m[1] / 2
    return Surface(name, corner, along_s, along_t, size_m, materials, layout, coarseness)


def _box(
    front: Surface, depth_m: float, sides: tuple[str, ...] | None = None, layout: Layout | None = None
) -> tuple[Surface, ...]:
    """A plate `depth_m` thick: `front`, its four edges and its back."""
    s, t, back = front.along_s, front.along_t, -front.normal
    w, h = front.size_m
    a = front.corner
    edge = sides or front.materials
    # Each face's t × s points outward; the edges above and below share the front's s, and so its bands.
    upper, lower = a + back * depth_m, a + t * h
    left, right = a + back * depth_m, a + s * w
    return (
        front,
        Surface(f"{front.name}.top", upper, s, front.normal, (w, depth_m), edge, layout),
        Surface(f"{front.name}.bottom", lower, s, back, (w, depth_m), edge, layout),
        Surface(f"{front.name}.left", left, front.normal, t, (depth_m, h), edge[:1]),
        Surface(f"{front.name}.right", right, back, t, (depth_m, h), edge[-1:]),
        Surface(f"{front.name}.back", a + back * depth_m + s * w, -s, t, (w, h), edge[:1], None, 4.0),
    )


def _wall() -> Surface:
    return _upright("wall", (2.05, 0.0, 0.80), (3.6, 2.8), ("concrete",), coarseness=5.0)


def _cell() -> Scene:
    steel = ("painted", "blasted", "rusted")
    split = bands(0.42, 0.74)
    web = _upright("web", (1.600, 0.0, 0.760), (1.16, 0.30), steel, split)
    flanges = [
        _box(_upright(f"flange.{side}", (1.530, 0.0, z), (1.16, 0.014), steel, split), 0.14, steel, split)
        for side, z in (("upper", 0.917), ("lower", 0.603))
    ]
    plank = _upright("plank", (1.585, 0.27, 1.030), (0.62, 0.180), ("timber",))
    cover = _upright(
        "cover", (1.560, -0.27, 1.050), (0.46, 0.220), ("painted", "rusted"), bands(0.33), -12, 28
    )
    carton = _upright("carton", (1.555, -0.24, 0.425), (0.52, 0.300), ("cardboard",), yaw=8)
    plate = _upright(
        "plate", (1.545, 0.31, 0.440), (0.48, 0.270), ("rusted", "blasted"), bands(0.27), 18, -14
    )
    side = _upright("side", (1.330, 0.602, 0.750), (0.52, 0.420), ("rusted", "timber"), bands(0.29), yaw=90)
    side_boards = _upright("end", (1.375, -0.640, 0.780), (0.43, 0.380), ("blasted",), yaw=-58)
    surfaces = (
        web,
        *flanges[0],
        *flanges[1],
        *_box(plank, 0.030),
        *_box(cover, 0.006),
        *_box(carton, 0.180),
        *_box(plate, 0.008),
        *_box(side, 0.012),
        *_box(side_boards, 0.010),
        _wall(),
    )
    looks = (
        _Look("front_065", (1.600, 0.02, 0.760), 0.65),
        _Look("left_065", (1.600, 0.28, 0.760), 0.65, turn=-16),
        _Look("right_070", (1.600, -0.30, 0.730), 0.70, turn=12),
        _Look("upper_075", (1.575, 0.10, 0.960), 0.75, rise=8),
        _Look("lower_075", (1.560, -0.10, 0.500), 0.75, rise=-6),
        _Look("plate_070", (1.550, 0.26, 0.470), 0.70, turn=12, rise=-10),
        _Look("cover_080", (1.560, -0.22, 1.020), 0.80, turn=14, rise=2),
        _Look("middle_090", (1.590, 0.0, 0.760), 0.90, turn=10, rise=10),
        _Look("corner_090", (1.580, 0.40, 0.740), 0.90, turn=-38),
        _Look("oblique_085", (1.600, -0.05, 0.760), 0.85, turn=30),
        _Look("oblique_100", (1.600, 0.22, 0.740), 1.00, turn=-40),
        _Look("steep_105", (1.600, -0.38, 0.740), 1.05, turn=49),
        _Look("above_100", (1.590, 0.0, 0.740), 1.00, rise=24),
        _Look("whole_115", (1.600, 0.03, 0.770), 1.15),
        _Look("whole_130", (1.600, 0.0, 0.760), 1.30, turn=4),
    )
    return Scene("cell", surfaces, looks)


def _board(material: str) -> Scene:
    board = _upright(f"board.{material}", (BOARD_X_M, 0.0, BOARD_Z_M), (0.80, 0.62), (material,))
    looks = [_Look("front_065", (BOARD_X_M, 0.0, BOARD_Z_M), 0.65)]
    shifts = ((0.10, 0.08), (-0.10, 0.08), (-0.10, -0.08), (0.10, -0.08))
    looks += [
        _Look(f"shifted_{index}", (BOARD_X_M, y, BOARD_Z_M + z), 0.65)
        for index, (y, z) in enumerate(shifts, start=1)
    ]
    return Scene(f"board:{material}", (*_box(board, 0.010), _wall()), tuple(looks))


def _checkerboard() -> Scene:
    x, z = 1.46, 0.65
    centre = (x, 0.0, z)
    board = _upright("checkerboard", centre, (0.30, 0.225), ("white", "black"), checker(0.025, 10, 7))
    tilts = (
        (0, 0),
        (25, 0),
        (-25, 0),
        (0, 25),
        (0, -25),
        (20, 18),
        (-20, 18),
        (20, -18),
        (-20, -18),
        (38, 0),
    )
    looks = [
        _Look(f"tilt_{index:02d}", centre, 0.62 + 0.03 * index, turn, rise, 6.0 * (index % 3 - 1))
        for index, (turn, rise) in enumerate(tilts)
    ]
    places = ((0.12, 0.09), (-0.12, 0.09), (-0.12, -0.09), (0.12, -0.09))
    looks += [
        _Look(f"corner_{index}", (x, y, z + up), 0.72, 10.0 * (-1) ** index, 8.0)
        for index, (y, up) in enumerate(places)
    ]
    return Scene("checkerboard", (*_box(board, 0.004, ("white",)), _wall()), tuple(looks))


def _reflector_discs() -> Scene:
    centre = (BOARD_X_M, 0.0, 0.66)
    aim = (BOARD_X_M, 0.0, 0.76)  # above it: the depth camera, which is to see it whole, looks lower
    plate = _upright(
        "plate",
        centre,
        (0.54, 0.48),
        ("plate", "reflector"),
        discs(DISC_PLACES_M, DISC_RADIUS_M),
    )
    tilts = (
        (0, 0, 0), (22, 0, 15), (-22, 0, -15), (0, 22, 0), (0, -20, 10), (18, 16, -10), (-18, 16, 20),
        (18, -16, 0), (-18, -14, -20), (30, 5, 8), (-30, 5, -8), (8, 16, 12), (0, 0, 30), (12, -8, -25),
    )  # fmt: skip
    looks = tuple(
        _Look(f"tilt_{index:02d}", aim, 0.85 + 0.03 * (index % 7), turn, rise, roll)
        for index, (turn, rise, roll) in enumerate(tilts)
    )
    return Scene("reflector_discs", (*_box(plate, 0.006, ("plate",)), _wall()), looks)


def _grey_card() -> Scene:
    card = _upright("card", (BOARD_X_M, 0.0, BOARD_Z_M), (1.70, 0.90), ("grey",))
    looks = tuple(
        _Look(f"at_{round(1000 * distance):04d}", (BOARD_X_M, 0.0, BOARD_Z_M), distance)
        for distance in (0.55, 0.60, 0.65, 0.70, 0.80, 0.90, 1.00, 1.10, 1.20, 1.30)
    )
    tilted = tuple(
        _Look(f"turned_{angle:02d}", (BOARD_X_M, -0.007 * angle, 0.72), 1.05, turn=angle)
        for angle in (20, 35, 47)
    )
    return Scene("grey_card", (*_box(card, 0.004), _wall()), looks + tilted)


def _highlight_board() -> Scene:
    board = _upright("board", (BOARD_X_M, 0.0, BOARD_Z_M), (0.90, 0.70), ("semi-gloss",))
    centre = (BOARD_X_M, 0.0, BOARD_Z_M)
    looks = (
        _Look("facing_065", centre, 0.65),
        _Look("turned_070", centre, 0.70, turn=10, rise=4),
        _Look("risen_080", centre, 0.80, turn=-8, rise=8),
        _Look("facing_090", centre, 0.90, turn=-4, rise=-5),
        _Look("facing_110", centre, 1.10, turn=3),
    )
    return Scene("highlight_board", (*_box(board, 0.004), _wall()), looks)


_BUILDERS: dict[str, Callable[[], Scene]] = {
    "cell": _cell,
    **{f"board:{name}": partial(_board, name) for name in CLASS_NAMES},
    "checkerboard": _checkerboard,
    "reflector_discs": _reflector_discs,
    "grey_card": _grey_card,
    "highlight_board": _highlight_board,
}
SCENES = tuple(_BUILDERS)


@cache
def build(name: str) -> Scene:
    """Returns the scene.

    Raises:
        ConfigurationError: If there is none of that name; the message lists all.
    """
    if name not in _BUILDERS:
        raise ConfigurationError(f"simulated scene {name!r}, allowed: {', '.join(SCENES)}")
    return _BUILDERS[name]()


@cache
def viewpoints(name: str) -> tuple[Viewpoint, ...]:
    """Returns the scene's named views, each within the arm's reach; the first is where the arm starts.

    Raises:
        ConfigurationError: If there is no such scene.
    """
    scene = build(name)
    package = standard_package()
    near = _HOME
    found = []
    for look in scene.looks:
        base_T_rgb = _camera_pose(look)
        base_T_flange = base_T_rgb @ package.flange_T_rgb.inverse
        near = joints_of(base_T_flange, near, package.flange_offset_m)
        cosine = float(-base_T_rgb.rotation[:, 2] @ np.array(look.normal))
        found.append(Viewpoint(look.name, near, base_T_rgb, look.distance_m, float(np.arccos(cosine))))
    return tuple(found)


def _camera_pose(look: _Look) -> Transform:
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
    return Transform("base", "rgb", matrix)
