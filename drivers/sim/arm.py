"""A Denso VM-6083 of its own: plain D-H chain, analytic inverse, and motion along straight joint paths."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from math import acos, atan2, cos, hypot, pi, radians, sin

import numpy as np

from surfclass.types import Float64, Transform

# alpha, a, d, theta offset of each joint, standard Denavit–Hartenberg; the last d is the flange's.
_LINKS = (
    (radians(-90), 0.180, 0.475, 0.0),
    (0.0, 0.385, 0.0, radians(-90)),
    (radians(90), -0.100, 0.0, radians(90)),
    (radians(-90), 0.0, 0.445, 0.0),
    (radians(90), 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.084, 0.0),
)
LIMITS = np.radians([[-170, 170], [-90, 135], [-80, 165], [-185, 185], [-120, 120], [-360, 360]])


def _link(alpha: float, a: float, d: float, theta: float) -> Float64:
    ct, st, ca, sa = cos(theta), sin(theta), cos(alpha), sin(alpha)
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _chain(q: Float64, joints: int, flange_offset_m: float) -> Float64:
    matrix = np.eye(4)
    for index in range(joints):
        alpha, a, d, offset = _LINKS[index]
        matrix = matrix @ _link(alpha, a, flange_offset_m if index == 5 else d, float(q[index]) + offset)
    return matrix


def flange_pose(q: Float64, flange_offset_m: float = 0.084) -> Transform:
    """Returns `base_T_flange` of the joint angles q (6,) rad, as a plain product of D-H links."""
    return Transform("base", "flange", _chain(q, 6, flange_offset_m))


def joints_of(base_T_flange: Transform, near: Float64, flange_offset_m: float = 0.084) -> Float64:
    """Returns the joint angles (6,) rad within the limits that reach the pose, closest to `near`.

    Raises:
        ValueError: If no solution lies within the arm's reach and limits.
    """
    wrist = base_T_flange.translation - flange_offset_m * base_T_flange.rotation[:, 2]
    upper, fore = 0.385, hypot(0.445, 0.100)
    bend = atan2(0.100, 0.445)  # the forearm's line against joint 3's zero
    solutions = []
    for facing in (1.0, -1.0):
        q1 = atan2(facing * wrist[1], facing * wrist[0])
        out = facing * hypot(wrist[0], wrist[1]) - 0.180
        up = wrist[2] - 0.475
        reach = hypot(out, up)
        if not abs(upper - fore) < reach < upper + fore:
            continue
        inner = acos((upper**2 + fore**2 - reach**2) / (2 * upper * fore))
        lift = acos((upper**2 + reach**2 - fore**2) / (2 * upper * reach))
        for side in (1.0, -1.0):
            q2 = atan2(out, up) - side * lift
            q3 = side * (pi - inner) + bend
            solutions += _wrist_solutions(q1, q2, q3, base_T_flange)
    wrapped = [_nearest_turns(q, near) for q in solutions]
    allowed = [q for q in wrapped if ((q > LIMITS[:, 0] + 0.02) & (q < LIMITS[:, 1] - 0.02)).all()]
    if not allowed:
        raise ValueError(
            f"no joint angles of the arm reach the flange at {base_T_flange.translation.round(3)} m"
        )
    best = min(allowed, key=lambda q: float(np.abs(q - near).max()))
    error = np.abs(flange_pose(best, flange_offset_m).matrix - base_T_flange.matrix).max()
    if error > 1e-9:
        raise AssertionError(f"inverse kinematics is off by {error:g}")
    return best


def _wrist_solutions(q1: float, q2: float, q3: float, base_T_flange: Transform) -> list[Float64]:
    fore = _chain(np.array([q1, q2, q3]), 3, 0.0)[:3, :3]
    r = fore.T @ base_T_flange.rotation
    found = []
    for flip in (1.0, -1.0):
        sin5 = flip * hypot(r[0, 2], r[1, 2])
        q4 = atan2(flip * r[1, 2], flip * r[0, 2])
        q5 = atan2(sin5, r[2, 2])
        q6 = atan2(flip * r[2, 1], -flip * r[2, 0])
        found.append(np.array([q1, q2, q3, q4, q5, q6]))
    return found


def _nearest_turns(q: Float64, near: Float64) -> Float64:
    """Takes whole turns off each joint so that it is closest to `near` within the limits."""
    turned = q.copy()
    for index in range(6):
        turns = [q[index] + 2 * pi * k for k in (-2, -1, 0, 1, 2)]
        inside = [angle for angle in turns if LIMITS[index, 0] < angle < LIMITS[index, 1]]
        turned[index] = min(inside or [float(q[index])], key=lambda angle: abs(angle - near[index]))
    return turned


@dataclass(frozen=True, slots=True)
class _Move:
    start_ns: int
    end_ns: int
    q_from: Float64
    q_to: Float64


class Motion:
    """Where the arm was, is and will be: moves along straight joint paths, resting in between.

    Args:
        q: (6,) where it starts.
        speed_rad_s: The fastest joint's top speed.
    """

    def __init__(self, q: Float64, speed_rad_s: float) -> None:
        self._rest = np.array(q, dtype=np.float64)
        self._speed = speed_rad_s
        self._moves: list[_Move] = []

    def move_to(self, q: Float64, start_ns: int) -> int:
        """Appends a move that starts at `start_ns`, or when the last one ends, and returns its end."""
        start_ns = max(start_ns, self._moves[-1].end_ns if self._moves else start_ns)
        q_from = self._moves[-1].q_to if self._moves else self._rest
        # 1.5: the smooth profile 3s² − 2s³ has its top speed there.
        seconds = max(0.2, 1.5 * float(np.abs(q - q_from).max()) / self._speed)
        self._moves.append(_Move(start_ns, start_ns + round(seconds * 1e9), q_from, np.array(q)))
        return self._moves[-1].end_ns

    def at(self, t_ns: int) -> Float64:
        """(6,) rad at `t_ns`."""
        index = bisect_right([move.start_ns for move in self._moves], t_ns) - 1
        if index < 0:
            return self._rest.copy()
        move = self._moves[index]
        part = min(1.0, (t_ns - move.start_ns) / (move.end_ns - move.start_ns))
        return move.q_from + (3 - 2 * part) * part * part * (move.q_to - move.q_from)

    def rests(self, begin_ns: int, end_ns: int) -> bool:
        """Whether the arm stands still from `begin_ns` to `end_ns`."""
        return not any(move.start_ns < end_ns and begin_ns < move.end_ns for move in self._moves)
