"""The simulated scenes: what stands in front of the arm, and from where it is looked at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from drivers.sim.materials import CLASS_NAMES
from drivers.sim.shapes import box, upright, wall
from drivers.sim.surfaces import TEXEL_M, Surface, bands, checker, discs
from drivers.sim.views import Look, Viewpoint, reach
from surfclass.errors import ConfigurationError

BOARD_X_M = 1.62
BOARD_Z_M = 0.84
DISC_RADIUS_M = 0.030
CHECKERBOARD_SQUARES = (10, 7)
CHECKERBOARD_SIDE_M = 0.025
DISC_PLACES_M = (
    (0.07, 0.08), (0.25, 0.07), (0.46, 0.09),
    (0.08, 0.22), (0.29, 0.24), (0.47, 0.23),
    (0.07, 0.40), (0.23, 0.39), (0.45, 0.41),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Scene:
    """Surfaces and the views of them."""

    name: str
    surfaces: tuple[Surface, ...]
    looks: tuple[Look, ...]


def _cell() -> Scene:
    steel = ("painted", "blasted", "rusted")
    split = bands(0.42, 0.74)
    web = upright("web", (1.600, 0.0, 0.760), (1.16, 0.30), steel, split)
    flanges = [
        box(upright(f"flange.{side}", (1.530, 0.0, z), (1.16, 0.014), steel, split), 0.14, steel, split)
        for side, z in (("upper", 0.917), ("lower", 0.603))
    ]
    plank = upright("plank", (1.585, 0.27, 1.030), (0.62, 0.180), ("timber",))
    cover = upright(
        "cover", (1.560, -0.27, 1.050), (0.46, 0.220), ("painted", "rusted"), bands(0.33), -12, 28
    )
    carton = upright("carton", (1.555, -0.24, 0.425), (0.52, 0.300), ("cardboard",), yaw=8)
    plate = upright("plate", (1.545, 0.31, 0.440), (0.48, 0.270), ("rusted", "blasted"), bands(0.27), 18, -14)
    side = upright("side", (1.330, 0.602, 0.750), (0.52, 0.420), ("rusted", "timber"), bands(0.29), yaw=90)
    side_boards = upright("end", (1.375, -0.640, 0.780), (0.43, 0.380), ("blasted",), yaw=-58)
    surfaces = (
        web,
        *flanges[0],
        *flanges[1],
        *box(plank, 0.030),
        *box(cover, 0.006),
        *box(carton, 0.180),
        *box(plate, 0.008),
        *box(side, 0.012),
        *box(side_boards, 0.010),
        wall(),
    )
    looks = (
        Look("front_065", (1.600, 0.02, 0.760), 0.65),
        Look("left_065", (1.600, 0.28, 0.760), 0.65, turn=-16),
        Look("right_070", (1.600, -0.30, 0.730), 0.70, turn=12),
        Look("upper_075", (1.575, 0.10, 0.960), 0.75, rise=8),
        Look("lower_075", (1.560, -0.10, 0.500), 0.75, rise=-6),
        Look("plate_070", (1.550, 0.26, 0.470), 0.70, turn=12, rise=-10),
        Look("cover_080", (1.560, -0.22, 1.020), 0.80, turn=14, rise=2),
        Look("middle_090", (1.590, 0.0, 0.760), 0.90, turn=10, rise=10),
        Look("corner_090", (1.580, 0.40, 0.740), 0.90, turn=-38),
        Look("oblique_085", (1.600, -0.05, 0.760), 0.85, turn=30),
        Look("oblique_100", (1.600, 0.22, 0.740), 1.00, turn=-40),
        Look("steep_105", (1.600, -0.38, 0.740), 1.05, turn=49),
        Look("above_100", (1.590, 0.0, 0.740), 1.00, rise=24),
        Look("whole_115", (1.600, 0.03, 0.770), 1.15),
        Look("whole_130", (1.600, 0.0, 0.760), 1.30, turn=4),
    )
    return Scene("cell", surfaces, looks)


def _board(material: str) -> Scene:
    board = upright(f"board.{material}", (BOARD_X_M, 0.0, BOARD_Z_M), (0.80, 0.62), (material,))
    looks = [Look("front_065", (BOARD_X_M, 0.0, BOARD_Z_M), 0.65)]
    shifts = ((0.10, 0.08), (-0.10, 0.08), (-0.10, -0.08), (0.10, -0.08))
    looks += [
        Look(f"shifted_{index}", (BOARD_X_M, y, BOARD_Z_M + z), 0.65)
        for index, (y, z) in enumerate(shifts, start=1)
    ]
    return Scene(f"board:{material}", (*box(board, 0.010), wall()), tuple(looks))


def _limits(material: str) -> Scene:
    centre, yaw = (1.46, 0.0, 0.76), 25.0  # the arm reaches 45° to either side
    board = upright(f"limits.{material}", centre, (0.80, 0.62), (material,), yaw=-yaw)
    distances = (0.52, 0.57, 0.62, 0.68, 0.74, 0.80, 0.88, 0.96, 1.05, 1.20)
    looks = [Look(f"at_{round(1000 * distance):04d}", centre, distance, yaw) for distance in distances]
    angles = (10, 20, 28, 36, 44, 52, 60)
    looks += [Look(f"oblique_{angle:02d}", centre, 0.70, yaw - angle) for angle in angles]
    return Scene(f"limits:{material}", (*box(board, 0.010), wall()), tuple(looks))


def _checkerboard() -> Scene:
    x, side = 1.46, CHECKERBOARD_SIDE_M
    columns, rows = CHECKERBOARD_SQUARES
    # 72 texels a square: its edges then lie on texels' borders, and the board is as true as it says.
    board = upright(
        "checkerboard",
        (x, 0.0, 0.65),
        (0.30, 0.225),
        ("white", "black"),
        checker(side, columns, rows),
        coarseness=side / (72 * TEXEL_M),
    )
    # Chosen from thousands for a small covariance of where the cameras are to each other and of the depth
    # camera's principal point, whose corners the speckle blurs: all round its image, near and far, turned
    # about the line of sight, most in both images. The colour camera sees eight of them in part only.
    places = (
        (0.00, 0.69, 0.62, 0, 0, -6),
        (-0.04, 0.81, 0.45, 8, -31, 0), (0.16, 0.49, 0.88, 0, 0, 180), (-0.09, 0.75, 0.42, 6, -25, 90),
        (-0.14, 0.90, 0.91, -10, -6, 90), (-0.10, 0.63, 0.57, -2, 0, 0), (0.10, 0.79, 0.48, 1, -32, -90),
        (-0.19, 0.42, 0.85, -31, 12, 90), (0.09, 0.63, 0.55, 4, 1, 0), (-0.26, 0.52, 0.87, -21, 18, 0),
        (-0.25, 0.51, 0.82, -23, 15, 180), (-0.13, 0.47, 0.58, 10, 30, 90), (-0.16, 0.43, 0.81, -29, 1, -90),
        (-0.05, 0.55, 0.53, -23, 12, 90), (-0.06, 0.78, 0.40, -12, -28, 0), (-0.01, 0.80, 0.43, 1, -29, 0),
        (0.13, 0.44, 0.78, 16, 1, -90), (0.05, 0.64, 0.49, -20, -4, 180), (0.00, 0.51, 0.59, 5, -3, 90),
        (0.13, 0.56, 0.68, -1, -16, 0), (0.10, 0.73, 0.60, -3, 0, 0), (0.23, 0.82, 0.95, -5, 2, 0),
        (0.22, 0.54, 0.72, 24, 14, 180), (0.07, 0.86, 0.83, 0, -8, 90), (-0.12, 0.90, 0.89, -7, -3, -90),
        (0.07, 0.71, 0.56, -35, -14, 0), (-0.20, 0.78, 0.87, 0, -5, 180), (-0.07, 0.59, 0.52, 2, 2, 180),
        (-0.11, 0.72, 0.62, -1, 14, 180), (0.10, 0.57, 0.42, 0, 26, -90), (0.10, 0.49, 0.68, 33, 12, 90),
        (-0.16, 0.52, 0.75, -2, -1, 180), (0.12, 0.88, 0.86, 6, -8, -90), (-0.16, 0.54, 0.79, 5, -2, 0),
        (0.04, 0.80, 0.43, -7, -20, 0), (0.24, 0.51, 0.88, 11, 3, 0),
    )  # fmt: skip
    looks = tuple(
        Look(f"tilt_{index:02d}", (x, y, z), distance, turn, rise, roll)
        for index, (y, z, distance, turn, rise, roll) in enumerate(places)
    )
    return Scene("checkerboard", (*box(board, 0.004, ("white",)), wall()), looks)


def _reflector_discs() -> Scene:
    centre = (BOARD_X_M, 0.0, 0.66)
    aim = (BOARD_X_M, 0.0, 0.76)  # above it: the depth camera, which is to see it whole, looks lower
    plate = upright(
        "plate",
        centre,
        (0.54, 0.48),
        ("plate", "reflector"),
        discs(DISC_PLACES_M, DISC_RADIUS_M),
    )
    # Chosen for what they tell of the hand-eye: directions and rolls that differ much, all discs in sight.
    tilts = (
        (38, -15, 45, 0.90), (30, -15, -90, 0.80), (-38, -15, -60, 0.80), (-30, 5, 90, 0.80),
        (38, -5, 90, 0.80), (-30, -25, 60, 0.80), (-20, 25, -90, 1.00), (0, 25, 20, 1.00),
        (30, -25, -60, 0.90), (-38, -5, 20, 1.00), (30, 15, 60, 1.00), (-38, 5, -45, 1.00),
        (-10, 25, -45, 0.90),
    )  # fmt: skip
    looks = (
        Look("tilt_00", aim, 0.85),
        *(
            Look(f"tilt_{index:02d}", centre, distance, turn, rise, roll, "depth")
            for index, (turn, rise, roll, distance) in enumerate(tilts, start=1)
        ),
    )
    return Scene("reflector_discs", (*box(plate, 0.006, ("plate",)), wall()), looks)


def _grey_card() -> Scene:
    card = upright("card", (BOARD_X_M, 0.0, BOARD_Z_M), (1.70, 0.90), ("grey",))
    looks = tuple(
        Look(f"at_{round(1000 * distance):04d}", (BOARD_X_M, 0.0, BOARD_Z_M), distance)
        for distance in (0.55, 0.60, 0.65, 0.70, 0.80, 0.90, 1.00, 1.10, 1.20, 1.30)
    )
    tilted = tuple(
        Look(f"turned_{angle:02d}", (BOARD_X_M, -0.007 * angle, 0.72), 1.05, turn=angle)
        for angle in (20, 35, 47)
    )
    return Scene("grey_card", (*box(card, 0.004), wall()), looks + tilted)


def _exposure_card() -> Scene:
    card = _grey_card()
    return Scene("exposure_card", card.surfaces, (Look("at_0800", (BOARD_X_M, 0.0, BOARD_Z_M), 0.80),))


def _highlight_board() -> Scene:
    board = upright("board", (BOARD_X_M, 0.0, BOARD_Z_M), (0.90, 0.70), ("semi-gloss",))
    centre = (BOARD_X_M, 0.0, BOARD_Z_M)
    looks = (
        Look("facing_065", centre, 0.65),
        Look("turned_070", centre, 0.70, turn=10, rise=4),
        Look("risen_080", centre, 0.80, turn=-8, rise=8),
        Look("facing_090", centre, 0.90, turn=-4, rise=-5),
        Look("facing_110", centre, 1.10, turn=3),
        Look("turned_060", centre, 0.60, turn=-14, rise=-2),
        Look("risen_075", centre, 0.75, turn=5, rise=11),
        Look("sunk_095", centre, 0.95, turn=-11, rise=-7),
        Look("turned_098", centre, 0.98, turn=12, rise=5),
    )
    return Scene("highlight_board", (*box(board, 0.004), wall()), looks)


_BUILDERS: dict[str, Callable[[], Scene]] = {
    "cell": _cell,
    **{f"board:{name}": partial(_board, name) for name in CLASS_NAMES},
    **{f"limits:{name}": partial(_limits, name) for name in CLASS_NAMES},
    "checkerboard": _checkerboard,
    "reflector_discs": _reflector_discs,
    "grey_card": _grey_card,
    "exposure_card": _exposure_card,
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
    return reach(scene.looks, scene.surfaces)


def spread(name: str, count: int | None) -> list[Viewpoint]:
    """Returns `count` of the scene's views, in order and evenly spread from the first to the last.

    Raises:
        ConfigurationError: If there is no such scene.
    """
    places = viewpoints(name)
    if count is None or count >= len(places):
        return list(places)
    return [places[round(i)] for i in np.linspace(0, len(places) - 1, count)]
