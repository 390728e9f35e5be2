"""Guides the capture of board views: found, sharp, tilted, all over the image of both cameras."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.cameras.boards import Board, Found, find_board
from calibration.cameras.conditions import PARTS
from calibration.cameras.detection import grey_image, stretched
from calibration.guide import Look
from surfclass.frames import Capture
from surfclass.rig import DepthRig

NEEDED = 36  # the depth camera's principal point needs them: its corners are blurred by speckle
_TILT = 0.26  # sine of 15°: from here on a board counts as tilted
_TOO_ALIKE = 0.06  # of the image's width: how far some corner must have moved
_WIDEST_EDGE = 0.25  # of a square's side: a checkerboard's edges that are wider are not sharp
_PREVIEW_WIDTH = 640
_SIDES = {
    "left": (0, -1, "Turn the board by 25 to 40° so that its left side is nearer"),
    "right": (0, 1, "Turn the board by 25 to 40° so that its right side is nearer"),
    "top": (1, -1, "Tilt the board by 25 to 40° so that its top is nearer"),
    "bottom": (1, 1, "Tilt the board by 25 to 40° so that its bottom is nearer"),
}
_NAMES = {"depth": "IR", "rgb": "colour"}


class CamerasGuide:
    """The guide of `calibrate cameras`.

    Args:
        rig: What is known of the cameras: sizes, and focal lengths to a tenth.
        board: What is looked at.
    """

    role = "board"

    def __init__(self, rig: DepthRig, board: Board) -> None:
        self._rig, self._board = rig, board
        self._seen: list[dict[str, Found]] = []
        self._parts = {name: np.zeros(PARTS, int) for name in ("depth", "rgb")}
        self._sides: set[str] = set()
        self._turned = False

    def next_step(self) -> str:
        """What the engineer should do now."""
        if not self._seen:
            return f"Hold the {self._board} flat before both cameras, so that it fills half of the image."
        for side, (*_, sentence) in _SIDES.items():
            if side not in self._sides:
                return f"{sentence}."
        if not self._turned:
            return "Turn the board, or the camera, by about 90° about the line of sight."
        name, parts = max(self._parts.items(), key=lambda item: (item[1] == 0).sum())
        if (parts == 0).any():
            return f"Hold the board, tilted, so that it reaches {_where(parts)} of the {_NAMES[name]} image."
        if len(self._seen) < NEEDED:
            return "Hold the board, tilted another way, nearer or farther than before."
        return "Enough: every further view that differs makes the result better."

    def look(self, capture: Capture) -> Look:
        """Judges a view; one that is accepted is remembered."""
        images: dict[str, NDArray[Any]] = {}
        if capture.depth.ir is not None:
            images["depth"] = capture.depth.ir
        if capture.colour is not None:
            images["rgb"] = capture.colour.rgb
        found = {}
        for name, image in images.items():
            seen = find_board(image, self._board, quick=True)
            if seen is not None:
                found[name] = seen
        picture = _preview(images, found)
        reasons = [*self._not_found(images, found), *self._blurred(images, found)]
        if not reasons and self._is_known(found, images):
            reasons = ["this view is like one that is there: tilt, turn or move the board"]
        if reasons:
            return Look(False, tuple(reasons), picture)
        self._remember(found, images)
        return Look(True, (), picture)

    def progress(self) -> tuple[int, int]:
        """Returns how many views are there, and how many are needed."""
        return len(self._seen), NEEDED

    def coverage(self) -> dict[str, Any]:
        """Returns the corners by parts of each image, and which tilts there are."""
        return {
            **{f"{_NAMES[name]} image": parts.tolist() for name, parts in self._parts.items()},
            "tilts": len(self._sides) / len(_SIDES),
        }

    def _not_found(self, images: dict[str, NDArray[Any]], found: dict[str, Found]) -> list[str]:
        if not images:
            return ["there is neither an IR nor a colour image"]
        if found:
            return []
        return [f"the {self._board} is in no image: it has to be whole in one of them, lit evenly and sharp"]

    def _blurred(self, images: dict[str, NDArray[Any]], found: dict[str, Found]) -> list[str]:
        seen = found.get("rgb")
        if seen is None or self._board.kind != "checkerboard" or len(seen.ids) < len(self._board.points_m):
            return []  # speckle looks like blur, and a ChArUco board that is blurred is not found
        size = self._board.columns, self._board.rows
        corners = seen.corners.astype(np.float32).reshape(-1, 1, 2)
        grey = stretched(grey_image(images["rgb"]))
        figures, _ = cv2.estimateChessboardSharpness(grey, size, corners)
        width = float(np.ravel(figures)[0])
        grid = seen.corners.reshape(size[1], size[0], 2)
        side = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
        if width <= max(_WIDEST_EDGE * side, 3.0):
            return []
        edges = f"its edges are {width:.1f} px wide at squares of {side:.0f} px"
        return [f"the colour image is blurred: {edges}; hold still, and stay in focus"]

    def _is_known(self, found: dict[str, Found], images: dict[str, NDArray[Any]]) -> bool:
        return any(self._alike(found, old, images) for old in self._seen)

    def _alike(self, found: dict[str, Found], old: dict[str, Found], images: dict[str, NDArray[Any]]) -> bool:
        for name in found.keys() & old.keys():
            both, here, there = np.intersect1d(found[name].ids, old[name].ids, return_indices=True)
            if both.size:
                shift = np.linalg.norm(found[name].corners[here] - old[name].corners[there], axis=1).max()
                return bool(shift < _TOO_ALIKE * images[name].shape[1])
        return False

    def _remember(self, found: dict[str, Found], images: dict[str, NDArray[Any]]) -> None:
        self._seen.append(found)
        for name, seen in found.items():
            height, width = images[name].shape[:2]
            limits = [(-0.5, height - 0.5), (-0.5, width - 0.5)]
            counts, *_ = np.histogram2d(seen.corners[:, 1], seen.corners[:, 0], bins=PARTS, range=limits)
            self._parts[name] += counts.astype(int)
        name = "rgb" if "rgb" in found and self._rig.rgb is not None else next(iter(found))
        camera = self._rig.depth if name == "depth" else self._rig.rgb
        if camera is None:
            return
        seen = found[name]
        points = self._board.points_m[seen.ids]
        good, turn, _ = cv2.solvePnP(
            points, seen.corners, camera.matrix, np.array(camera.distortion), flags=cv2.SOLVEPNP_IPPE
        )
        if not good:
            return
        rotation = cv2.Rodrigues(turn)[0]
        normal = rotation[:, 2]  # away from the camera; it leans to the side that is farther
        for side, (axis, sign, _) in _SIDES.items():
            if sign * normal[axis] > _TILT:
                self._sides.add(side)
        self._turned |= abs(rotation[0, 0]) < 0.5


def _where(parts: NDArray[np.int_]) -> str:
    """The part of an image that has fewest corners, in words."""
    row, column = np.unravel_index(int(parts.argmin()), parts.shape)
    down = ("the top", "the upper half", "the lower half", "the bottom")[int(row)]
    across = ("left", "left", "middle", "right", "right")[int(column)]
    return f"{down} {across}"


def _preview(images: dict[str, NDArray[Any]], found: dict[str, Found]) -> NDArray[np.uint8]:
    """The images side by side with their corners drawn in."""
    panels = []
    for name, image in images.items():
        scale = _PREVIEW_WIDTH / image.shape[1]
        size = (_PREVIEW_WIDTH, round(image.shape[0] * scale))
        small = cv2.resize(stretched(image.astype(np.float32)), size, interpolation=cv2.INTER_AREA)
        panel = np.ascontiguousarray(small if small.ndim == 3 else np.repeat(small[..., None], 3, axis=2))
        if name in found:
            for u, v in (found[name].corners + 0.5) * scale - 0.5:
                cv2.circle(panel, (round(u), round(v)), 4, (40, 220, 40), 1, cv2.LINE_AA)
        panels.append(panel)
    if not panels:
        return np.zeros((1, 1, 3), np.uint8)
    height = max(panel.shape[0] for panel in panels)
    padded = [np.pad(panel, ((0, height - panel.shape[0]), (0, 0), (0, 0))) for panel in panels]
    return np.concatenate(padded, axis=1).astype(np.uint8)
