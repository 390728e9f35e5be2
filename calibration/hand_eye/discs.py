"""The plate of reflector discs, seen by the depth camera on the flange: what hand-eye is found from (A.1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibration.hand_eye.discs_find import look_for_discs
from calibration.hand_eye.discs_match import LEAST_DISCS, Arrangement, arrangements
from calibration.hand_eye.discs_seen import Disc
from calibration.hand_eye.observations import Intrinsics, Observations, Pixels, Positions, Probed, View
from calibration.hand_eye.single_pose import align
from calibration.outcome import Note, RefusedError
from drivers.recordings.plate import Plate
from surfclass.frames import Capture
from surfclass.geometry import corrected_depth
from surfclass.kinematics import corrected, flange_pose, pose_difference
from surfclass.rig import DepthRig
from surfclass.types import Float64, Transform

TOUCHED_SD_M = 0.0003
"""Of a disc's centre that was touched with a pointer."""

_SAME_MOUNT_M = 0.025
_SAME_MOUNT_RAD = np.radians(3.0)
_MOST = 0.7
_WRONG_M = 0.002
_WRONG = 5.0  # times the other discs'
_LEFT = 5  # discs that must remain for one to be named wrong
_LEAST_VIEWS = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A view with enough discs, and the ways they can lie on the plate."""

    name: str
    q: Float64
    base_T_flange: Transform
    discs: list[Disc]
    ways: list[Arrangement]

    @property
    def camera_m(self) -> Float64:
        return np.array([disc.camera_m for disc in self.discs])


def observe(captures: Iterable[Capture], rig: DepthRig, plate: Plate, note: Note) -> Observations:
    """Returns the discs of every capture as hand-eye observations, matched to the plate's positions.

    The target's frame is `base`: its points are named by their probed positions, so the joint
    adjustment's `base_T_target` comes out near the identity.

    Args:
        captures: With joint angles and IR; those in which too few discs are found are left out, with a note.
        rig: The depth camera and the arm.
        plate: The discs' radius and positions, in any order.
        note: Is told of what is left out and why.

    Raises:
        RefusedError: If no view is left, or the layout looks the same after a turn and the views cannot
            tell either.
        InputError: If a capture's images have not the camera's size.
    """
    known = np.array(plate.positions_base_m)
    seen = [one for capture in captures if (one := _look(capture, rig, plate, known, note)) is not None]
    if not seen:
        raise RefusedError(
            f"discs: no view shows {LEAST_DISCS} or more discs of {1e3 * plate.disc_radius_m:.1f} mm radius "
            "that lie as plate.toml says; check disc_radius_m and positions_base_m, and turn the camera "
            "so that the whole plate is in its image"
        )
    chosen = _told_apart(seen)
    wrong = _wrong_positions(seen, chosen, known)
    for number, off in wrong.items():
        x, y, z = known[number]
        note(
            f"plate.toml: position {number + 1} ({x:.4f}, {y:.4f}, {z:.4f}) is {1e3 * off:.1f} mm from "
            "where its disc is seen; it is left out: touch it again"
        )
    views = [_view(one, way, known, set(wrong)) for one, way in zip(seen, chosen, strict=True)]
    views = [view for view in views if view.count >= LEAST_DISCS - 1]
    used = np.unique(np.concatenate([view.pixels.target_m for view in views]), axis=0)
    return Observations(
        mounting="eye_in_hand",
        views=tuple(views),
        intrinsics=Intrinsics(rig.depth.fx, rig.depth.fy, rig.depth.cx, rig.depth.cy, rig.depth.distortion),
        image_size=rig.depth.size,
        probed=Probed(used, used, np.full(len(used), TOUCHED_SD_M)),
    )


def _look(capture: Capture, rig: DepthRig, plate: Plate, known: Float64, note: Note) -> _Seen | None:
    rig.check(capture)
    if capture.joints is None:
        note(f"capture {capture.name}: left out, it has no joint angles")
        return None
    if capture.depth.ir is None:
        note(f"capture {capture.name}: left out, it has no IR image")
        return None
    depth_mm = corrected_depth(capture.depth.depth_mm, rig)
    sighting = look_for_discs(capture.depth, rig.depth, plate.disc_radius_m, depth_mm)
    discs = list(sighting.discs)
    if len(discs) < LEAST_DISCS:
        why = sorted({one.reason for one in sighting.rejected})
        note(
            f"capture {capture.name}: left out, {len(discs)} discs found, needed are {LEAST_DISCS}"
            + (f" (not taken: {'; '.join(why[:3])})" if why else "")
        )
        return None
    ways = arrangements(np.array([disc.camera_m for disc in discs]), known)
    if not ways:
        note(
            f"capture {capture.name}: left out, its {len(discs)} discs do not lie as plate.toml says, "
            f"no {LEAST_DISCS} of them"
        )
        return None
    q = corrected(capture.joints.q, rig.arm)
    return _Seen(capture.name, q, flange_pose(capture.joints.q, rig.arm), discs, ways)


def _told_apart(seen: list[_Seen]) -> list[Arrangement]:
    """Returns one arrangement for each view: the one by which all views agree on the camera's mounting.

    Where a view allows one alone, that one is taken whatever it says of the mounting: a pose that was
    read wrong is for the adjustment to find.
    """
    if all(len(one.ways) == 1 for one in seen):
        return [one.ways[0] for one in seen]
    mounts = [[one.base_T_flange.inverse @ way.base_T_depth for way in one.ways] for one in seen]
    every = [mount for view in mounts for mount in view]
    votes = [sum(any(_alike(mount, other) for other in view) for view in mounts) for mount in every]
    best = every[int(np.argmax(votes))]
    rest = [vote for vote, mount in zip(votes, every, strict=True) if not _alike(mount, best)]
    if max(votes) < max(2, _MOST * len(seen)) or max(rest, default=0) > _MOST * max(votes):
        count = max(len(one.ways) for one in seen)
        raise RefusedError(
            f"discs: the layout is symmetric: it fits in {count} ways equally well, so it cannot be told "
            "which disc is which, and the views do not tell either; move one disc by 20 mm or more and "
            "touch it again, or add views that are turned about other axes"
        )
    return [
        one.ways[int(np.argmin([_far(mount, best) for mount in view]))]
        for one, view in zip(seen, mounts, strict=True)
    ]


def _far(mount: Transform, other: Transform) -> float:
    """How far two mountings differ, as a share of what still counts as the same."""
    away, turn = pose_difference(mount, other)
    return max(away / _SAME_MOUNT_M, turn / float(_SAME_MOUNT_RAD))


def _alike(mount: Transform, other: Transform) -> bool:
    return _far(mount, other) <= 1


def _wrong_positions(seen: list[_Seen], chosen: list[Arrangement], known: Float64) -> dict[int, float]:
    """Returns which of the known positions are wrong, and by how many metres: where their discs are seen.

    One at a time, the worst first: a wrong one pulls the plate's pose and with it all others.
    """
    wrong: dict[int, float] = {}
    while len(known) - len(wrong) > _LEFT:
        gaps = _gaps(seen, chosen, known, set(wrong))
        if len(gaps) < _LEFT:
            break
        worst = max(gaps, key=lambda number: gaps[number])
        others = float(np.median([gap for number, gap in gaps.items() if number != worst]))
        if gaps[worst] <= max(_WRONG_M, _WRONG * others):
            break
        wrong[worst] = gaps[worst]
    return wrong


def _gaps(
    seen: list[_Seen], chosen: list[Arrangement], known: Float64, without: set[int]
) -> dict[int, float]:
    """Returns for each position how far from it its disc is seen on average, the plate laid on the others."""
    away: dict[int, list[Float64]] = {}
    for one, way in zip(seen, chosen, strict=True):
        partner = dict(zip(way.known.tolist(), way.found.tolist(), strict=True))
        camera_m = one.camera_m
        moved = way.base_T_depth @ camera_m
        free = sorted(set(range(len(camera_m))) - set(way.found.tolist()))
        for number in sorted(set(range(len(known))) - without):
            others = [other for other in partner if other != number and other not in without]
            if len(others) < LEAST_DISCS - 1:
                continue
            found = partner.get(number)
            if found is None and free:
                # No disc lies there: the nearest one that lies nowhere else may be the one that is meant.
                found = min(free, key=lambda f: float(np.linalg.norm(moved[f] - known[number])))
            if found is None:
                continue
            pose = align(camera_m[[partner[other] for other in others]], known[others], "base", "depth")
            away.setdefault(number, []).append(pose @ camera_m[found] - known[number])
    enough = min(_LEAST_VIEWS, len(seen))
    return {
        number: float(np.linalg.norm(np.median(gap, axis=0)))
        for number, gap in away.items()
        if len(gap) >= enough
    }


def _view(one: _Seen, way: Arrangement, known: Float64, without: set[int]) -> View:
    pairs = [
        (known[k], one.discs[f])
        for f, k in zip(way.found.tolist(), way.known.tolist(), strict=True)
        if k not in without
    ]
    target = np.array([point for point, _ in pairs]).reshape(-1, 3)
    discs = [disc for _, disc in pairs]
    pixel_sd = [float(np.sqrt(np.trace(disc.pixel_covariance) / 2)) for disc in discs]
    return View(
        name=one.name,
        base_T_flange=one.base_T_flange,
        pixels=Pixels(target, np.array([disc.pixel for disc in discs]).reshape(-1, 2), np.array(pixel_sd)),
        positions=Positions(
            target,
            np.array([disc.camera_m for disc in discs]).reshape(-1, 3),
            np.array([disc.depth_sd_m for disc in discs]),
        ),
        q=one.q,
    )
