"""Plates, boxes and the wall that the simulated scenes are made of."""

from __future__ import annotations

from math import radians

import numpy as np

from drivers.sim.surfaces import Layout, Surface


def upright(
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


def box(
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


def wall() -> Surface:
    """The bare concrete behind everything: it has no class."""
    return upright("wall", (2.05, 0.0, 0.80), (3.6, 2.8), ("concrete",), coarseness=5.0)
