"""Guides the capture for a hand-eye calibration: where to look from next, and whether a view is of use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import find_board
from calibration.guide import Look
from calibration.hand_eye.boards_seen import Eye, eye_of, image_of
from calibration.hand_eye.discs_find import look_for_discs
from calibration.hand_eye.observability import axis_spread, motion_faults
from calibration.rotations import rotation_vector
from drivers.recordings.board import Board
from drivers.recordings.plate import Plate
from surfclass.frames import Capture
from surfclass.geometry import corrected_depth
from surfclass.kinematics import flange_pose
from surfclass.rig import DepthRig
from surfclass.types import Float64

VIEWS = 14
_NEW_TURN_RAD = np.radians(10.0)
_NEW_PLACE_M = 0.10  # a view from so far away is new even with less of a turn
_STILL_RAD = 5e-4  # of the joints during an exposure; at 1 m that is half a millimetre
_BLUR_PX = 6.0  # width of an edge
_WHOLE = 0.75  # of the plate's discs
_COLUMNS, _ROWS = 4, 3
_WANTED_TURN_RAD = np.radians(60.0)
_GREEN, _RED = (60, 200, 60), (230, 60, 60)

_PLAN = (
    "bring the target to the middle of the image, from its front, so that it fills about half of it",
    "from there move to the right by as much as the distance allows (30°) and look back at the target",
    "go to the left by 30° and look back at the target",
    "go up by 30° and look down at the target",
    "go down by 30° and look up at the target",
    "from the front, roll the camera by 90°",
    "from the front, roll the camera by 90° the other way",
    "from the right and above, roll the camera by 45°",
    "from the left and below, roll the camera by 45° the other way",
    "from the left and above, roll the camera by 90°",
    "from the right and below, roll the camera by 90° the other way",
    "from the front, go a quarter nearer and roll the camera by 45°",
    "from the front, go a quarter further away and roll the camera by 45° the other way",
    "from the right, 35° and a quarter nearer, roll the camera by 90°",
)


@dataclass(frozen=True, slots=True, eq=False)
class _Target:
    """What was found: where in the image, whether enough of it, and why not."""

    points: Float64
    faults: tuple[str, ...]


class HandEyeGuide:
    """Of a hand-eye calibration; the arm is moved by hand or by its own program.

    Args:
        rig: The cameras and the arm.
        target: The plate of reflector discs or the board to look at.
        eye: Which camera looks at a board; None: the colour camera where its place is known, else IR. The
            discs shine in the IR camera alone.
        views: How many are wanted.
    """

    def __init__(
        self, rig: DepthRig, target: Plate | Board, eye: Eye | None = None, views: int = VIEWS
    ) -> None:
        self.role = "hand_eye" if isinstance(target, Plate) else "board"
        self._rig = rig
        self._target = target
        self._eye: Eye | None = "depth" if isinstance(target, Plate) else eye
        self._views = views
        self._poses: list[Float64] = []
        self._grid = np.zeros((_ROWS, _COLUMNS), np.int64)

    def next_step(self) -> str:
        """Returns what to do now: a motion that is missing, or the next of a plan that covers all."""
        count = len(self._poses)
        if count >= self._views:
            return "there are enough views; more of them make the result better"
        if count >= 4:
            faults = motion_faults(np.stack(self._poses))
            if faults:
                return faults[0]
        return _PLAN[count % len(_PLAN)]

    def look(self, capture: Capture) -> Look:
        """Judges a view; one that is accepted is remembered."""
        eye = self._eye or eye_of(self._rig, capture.colour is not None)[0]
        image = image_of(capture, eye)
        if image is None:
            black = np.zeros((*capture.depth.depth_mm.shape, 3), np.uint8)
            what = "IR" if eye == "depth" else "colour"
            return Look(False, (f"there is no {what} image; switch it on in the configuration",), black)
        grey = _grey(image)
        found = self._found(capture, image)
        reasons = list(found.faults)
        if capture.joint_motion_rad is not None and capture.joint_motion_rad > _STILL_RAD:
            moved = np.degrees(capture.joint_motion_rad)
            reasons.append(f"the arm moved by {moved:.2f}° during the exposure; wait until it stands still")
        if len(found.points) and (width := edge_width_px(grey, found.points)) > _BLUR_PX:
            reasons.append(f"the image is blurred: edges are {width:.0f} px wide; go to where it is in focus")
        pose = None
        if capture.joints is None:
            reasons.append("there are no joint angles; check the arm's connection")
        else:
            pose = flange_pose(capture.joints.q, self._rig.arm).matrix
            reasons += self._too_near(pose)
        if not reasons and pose is not None:
            self._poses.append(pose)
            self._count(found.points, grey.shape)
        return Look(not reasons, tuple(reasons), _drawn(grey, found.points, not reasons))

    def progress(self) -> tuple[int, int]:
        """Returns how many views are there, and how many are wanted."""
        return len(self._poses), self._views

    def coverage(self) -> dict[str, Any]:
        """Returns how often each part of the image has seen the target, and how far the flange has turned."""
        turned = np.zeros(3)
        if len(self._poses) > 1:
            turned = axis_spread(np.stack([pose[:3, :3] for pose in self._poses]))[0]
        shares = np.minimum(turned / _WANTED_TURN_RAD, 1.0).tolist()
        names = ("turns about the first axis", "about the second", "about the third")
        return {"image": self._grid.tolist(), **dict(zip(names, shares, strict=True))}

    def _found(self, capture: Capture, image: NDArray[Any]) -> _Target:
        if isinstance(self._target, Board):
            board = find_board(image, self._target, quick=True)
            if board is None:
                none = f"the {self._target} is not found: bring all of it into the image, without glare"
                return _Target(np.zeros((0, 2)), (none,))
            return _Target(board.corners, _at_border(board.corners, image.shape))
        sighting = look_for_discs(
            capture.depth,
            self._rig.depth,
            self._target.disc_radius_m,
            corrected_depth(capture.depth.depth_mm, self._rig),
        )
        points = np.array([disc.pixel for disc in sighting.discs]).reshape(-1, 2)
        all_ = len(self._target.positions_base_m)
        if len(points) < _WHOLE * all_:
            why = sorted({one.reason for one in sighting.rejected})[:2]
            told = f" ({'; '.join(why)})" if why else ""
            few = f"{len(points)} of {all_} discs found{told}: bring the whole plate into the image"
            return _Target(points, (few,))
        return _Target(points, ())

    def _too_near(self, pose: Float64) -> list[str]:
        if not self._poses:
            return []
        turns = rotation_vector(np.stack([one[:3, :3].T @ pose[:3, :3] for one in self._poses]))
        least = np.linalg.norm(turns, axis=1)
        apart = np.array([np.linalg.norm(one[:3, 3] - pose[:3, 3]) for one in self._poses])
        same = np.where((least < _NEW_TURN_RAD) & (apart < _NEW_PLACE_M), least, np.inf)
        nearest = int(same.argmin())
        if not np.isfinite(same[nearest]):
            return []
        fault = (
            f"too like view {nearest + 1}: turned by {np.degrees(least[nearest]):.1f}° only, needed are "
            f"{np.degrees(_NEW_TURN_RAD):.0f}°; roll the camera or look from another side"
        )
        return [fault]

    def _count(self, points: Float64, shape: tuple[int, ...]) -> None:
        cells = (points / [shape[1], shape[0]] * [_COLUMNS, _ROWS]).astype(int)
        for column, row in np.unique(np.clip(cells, 0, [_COLUMNS - 1, _ROWS - 1]), axis=0):
            self._grid[row, column] += 1


def edge_width_px(grey: NDArray[np.uint8], points: NDArray[Any]) -> float:
    """Returns how wide the edges around some points (n, 2) are: the range of brightness by the slope."""
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - 8, 0)
    high = np.ceil(points.max(axis=0)).astype(int) + 9
    part = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if part.size < 64:
        return 0.0
    slope = np.hypot(cv2.Scharr(part, cv2.CV_32F, 1, 0), cv2.Scharr(part, cv2.CV_32F, 0, 1)) / 32
    brightness = float(np.ptp(np.percentile(part, [5, 95])))
    steep = float(np.percentile(slope, 99))
    return brightness / steep if steep > 0 else float("inf")


def _at_border(points: Float64, shape: tuple[int, ...]) -> tuple[str, ...]:
    size = np.array([shape[1], shape[0]])
    if (points < 2).any() or (points > size - 3).any():
        return ("part of the target is cut off by the image's border; move it inwards",)
    return ()


def _grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    flat = image if image.ndim == 2 else image.mean(axis=2)
    bright = float(np.percentile(flat, 99.5))
    return np.clip(flat * (255.0 / max(bright, 1.0)), 0, 255).astype(np.uint8)


def _drawn(grey: NDArray[np.uint8], points: Float64, good: bool) -> NDArray[np.uint8]:
    picture = np.ascontiguousarray(np.repeat(grey[:, :, None], 3, axis=2))
    size = max(3, grey.shape[1] // 160)
    for x, y in np.round(points).astype(int).tolist():
        cv2.circle(picture, (x, y), size, _GREEN if good else _RED, max(1, size // 3), cv2.LINE_AA)
    return picture
