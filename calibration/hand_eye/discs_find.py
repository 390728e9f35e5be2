"""Reflector discs in one depth frame: their centres in the image and in 3D, and what was not a disc."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.discs_image import ROUND, Blob, best_of, find_blobs, saturation_level
from calibration.hand_eye.discs_outline import Circle, circle_points, fit_outline, tangents_at
from calibration.hand_eye.discs_plane import InversePlane, Readings, plane_of_disc
from calibration.hand_eye.discs_seen import Disc, Rejected, Sighting
from surfclass.errors import InputError
from surfclass.frames import DepthFrame
from surfclass.geometry import check_size, project, rays
from surfclass.rig import Camera
from surfclass.types import Bool, Float32, Float64

_RING = (1.3, 2.3)  # of the radius
_CORE = 0.85
_LEAST_RADIUS_PX = 4.0
_SIZE = (0.55, 1.7)  # of a blob against the disc's, before its outline is known
_RADIUS_SHARE = 0.15
_RADIUS_PX = 1.5
_SPREAD_PX = 0.5
_COVERAGE = 0.6
_GAP = 0.25
_ROUGH_PX = 1.2
_DEPTHS = (0.01, 0.98)  # quantiles of the readings between which the plate is
_NEAREST_M = 0.2  # no depth camera of this kind reads nearer
_OUTLINE_POINTS = 64
_FAINT = 0.2  # of the faintest disc's brightness
_DEPTH_FLOOR_M = 1e-4  # whole millimetres, and the sensor's own steps, do not average out on a flat disc


def look_for_discs(
    frame: DepthFrame, camera: Camera, radius_m: float, depth_mm: NDArray[Any] | None = None
) -> Sighting:
    """Finds the reflector discs of known radius in a frame's IR image, and their centres by its depth.

    Args:
        frame: With an IR image of the same grid as the depth image.
        camera: The depth camera.
        radius_m: Of every disc.
        depth_mm: (h, w) what counts instead of the frame's own readings: corrected ones.

    Raises:
        InputError: If there is no IR image, a size does not fit, or the radius is not positive.
    """
    if frame.ir is None:
        raise InputError("discs: the frame has no IR image; record depth with IR (openni2: ir = true)")
    if not (np.isfinite(radius_m) and radius_m > 0):
        raise InputError(f"discs: radius {radius_m} m, allowed is a length above 0")
    readings = frame.depth_mm if depth_mm is None else depth_mm
    check_size(readings, camera)
    check_size(frame.ir, camera)
    look = _Look(frame.ir, readings, camera, radius_m)
    blobs = find_blobs(frame.ir, *look.radii_px())
    brightness = {id(blob): look.brightness(blob) for blob in blobs}
    found: list[tuple[Disc, Circle]] = []
    rejected: list[Rejected] = []
    faintest = np.inf
    for blob in sorted(blobs, key=lambda blob: -brightness[id(blob)]):
        if found and brightness[id(blob)] < _FAINT * faintest:
            break  # nobody takes for a disc what is far darker than all of them
        answers, why = _discs_of(look, blob, blobs)
        if not answers:
            rejected.append(Rejected(blob.pixel, why, blob.outline))
        for answer in answers:
            if all(np.linalg.norm(answer[0].camera_m - other.camera_m) > radius_m for other, _ in found):
                found.append(answer)
                faintest = brightness[id(blob)]
    discs = sorted(_correlated(found), key=lambda disc: (float(disc.pixel[1]), float(disc.pixel[0])))
    apart = [one for one in rejected if not any(_covers(one, disc) for disc in discs)]
    return Sighting(tuple(discs), tuple(apart))


def _discs_of(look: _Look, blob: Blob, blobs: list[Blob]) -> tuple[list[tuple[Disc, Circle]], str]:
    """Returns the disc that a blob is, or those that have run into one in it; or why there is none."""
    answer = look.at(blob, blobs)
    if not isinstance(answer, str):
        return [answer], ""
    inner = best_of(blob.within)
    parts = [look.at(one, blobs + inner) for one in inner]
    return [part for part in parts if not isinstance(part, str)], answer


class _Look:
    """One frame, prepared."""

    def __init__(self, ir: NDArray[Any], depth_mm: NDArray[Any], camera: Camera, radius_m: float) -> None:
        self._ir: Float32 = ir.astype(np.float32)
        self._full = saturation_level(ir)
        self._depth_mm = depth_mm
        self._camera = camera
        self._radius_m = radius_m

    def radii_px(self) -> tuple[float, float]:
        """Returns the radii of a disc at the farthest and at the nearest reading, px."""
        depth = 1e-3 * self._depth_mm[self._depth_mm > 0]
        near, far = np.quantile(depth, _DEPTHS) if len(depth) else (_NEAREST_M, np.inf)
        scale = self._camera.fx * self._radius_m
        return max(_LEAST_RADIUS_PX, scale / float(far)), scale / max(_NEAREST_M, float(near))

    def brightness(self, blob: Blob) -> float:
        """Returns the median of a blob's pixels, counts."""
        rows, columns = self._box(blob.pixel, blob.semi_axes[0])
        return float(np.median(self._ir[rows, columns][blob.reach(columns, rows) < 1]))

    def at(self, blob: Blob, blobs: list[Blob]) -> tuple[Disc, Circle] | str:
        """Returns the disc that a blob is, or why it is none."""
        longer, shorter = blob.semi_axes
        if blob.cut:
            return "cut off by the image's border"
        if blob.roundness < ROUND or shorter < 0.25 * longer:
            return f"not round ({100 * blob.roundness:.0f} % of an ellipse's area)"
        window = self._window(blob.pixel, longer)
        reach = blob.reach(window.column, window.row)
        near = window.inverse[(reach < _RING[1]) & (window.inverse > 0)]
        if len(near):  # most of what is bright but no disc goes without a plane being fitted
            ratio = longer / (self._camera.fx * self._radius_m * float(np.median(near)))
            if not 0.9 * _SIZE[0] < ratio < 1.2 * _SIZE[1]:
                return self._wrong_radius(ratio)
        plane = self._plane(window, reach, blob, blobs)
        if isinstance(plane, str):
            return plane
        tangent = tangents_at(blob.pixel[None], self._camera)
        depth = float(plane.meet(tangent)[0, 2])
        if not depth > 0:
            return "no plane in front of the camera"
        expected_px = self._camera.fx * self._radius_m / depth
        if expected_px < _LEAST_RADIUS_PX:
            return f"too far away: a disc has a radius of {expected_px:.1f} px there"
        if not _SIZE[0] < longer / expected_px < _SIZE[1]:
            return self._wrong_radius(longer / expected_px)
        circle = fit_outline(self._ir, self._camera, plane, blob.pixel, self._radius_m)
        if isinstance(circle, str):
            return circle
        # Now that the circle is known, so is which readings lie on it.
        away = np.linalg.norm(plane.meet(window.tangents) - circle.centre, axis=1) / self._radius_m
        better = self._plane(window, away, blob, blobs)
        if isinstance(better, str):
            return better
        pixel = project(circle.centre, self._camera)
        circle = fit_outline(self._ir, self._camera, better, pixel, self._radius_m, again=True)
        if isinstance(circle, str):
            return circle
        why = self._unfit(circle)
        return why or (self._disc(circle, better, window), circle)

    def _window(self, pixel: Float64, reach_px: float) -> Readings:
        half = int(np.ceil(_RING[1] * reach_px)) + 2
        h, w = self._depth_mm.shape
        x, y = (round(value) for value in pixel.tolist())
        rows, columns = np.mgrid[
            max(0, y - half) : min(h, y + half + 1), max(0, x - half) : min(w, x + half + 1)
        ]
        row, column = rows.ravel(), columns.ravel()
        depth = self._depth_mm[row, column] * 1e-3
        inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
        tangents = rays(self._camera)[:, row, column].T.astype(np.float64)
        return Readings(tangents, inverse, column, row)

    def _box(self, pixel: Float64, reach_px: float) -> tuple[NDArray[Any], NDArray[Any]]:
        half = int(np.ceil(reach_px)) + 2
        h, w = self._depth_mm.shape
        x, y = (round(value) for value in pixel.tolist())
        top, left = max(0, y - half), max(0, x - half)
        rows, columns = np.mgrid[top : min(h, y + half + 1), left : min(w, x + half + 1)]
        return rows, columns

    def _plane(
        self, window: Readings, reach: NDArray[Any], blob: Blob, blobs: list[Blob]
    ) -> InversePlane | str:
        """Returns the plane, with what lies on the disc and around it told by `reach` (in radii)."""
        on: Bool = reach < _CORE
        around: Bool = (reach > _RING[0]) & (reach < _RING[1])
        for other in blobs:
            apart = float(np.abs(other.pixel - blob.pixel).max())
            if other is blob or apart > _RING[1] * blob.semi_axes[0] + 1.2 * other.semi_axes[0]:
                continue
            if float(other.reach(*blob.pixel)) > 1:  # else it is a glow that the disc lies in
                around &= other.reach(window.column, window.row) > 1.2
        clipped = self._ir[window.row[on], window.column[on]] >= self._full
        return plane_of_disc(window, on, around, float(clipped.mean()) if on.any() else 0.0)

    def _wrong_radius(self, ratio: float) -> str:
        return f"radius {1e3 * self._radius_m * ratio:.1f} mm, a disc has {1e3 * self._radius_m:.1f} mm"

    def _unfit(self, circle: Circle) -> str | None:
        radius_px = self._camera.fx * self._radius_m / float(circle.centre[2])
        if abs(circle.spread_px - _SPREAD_PX) > max(_RADIUS_PX, _RADIUS_SHARE * radius_px):
            return self._wrong_radius(1 + circle.spread_px / radius_px)
        if circle.coverage < _COVERAGE or circle.gap > _GAP:
            return f"only {100 * circle.coverage:.0f} % of its outline can be seen"
        if circle.rms_px > max(_ROUGH_PX, 0.06 * radius_px):
            return f"outline not round: {circle.rms_px:.1f} px rms"
        return None

    def _disc(self, circle: Circle, plane: InversePlane, window: Readings) -> Disc:
        away = np.linalg.norm(plane.meet(window.tangents) - circle.centre, axis=1)
        inside = away < _CORE * self._radius_m
        clipped = self._ir[window.row[inside], window.column[inside]] >= self._full
        rim = circle_points(circle.centre, circle.basis, self._radius_m, _OUTLINE_POINTS)
        pixel = np.asarray(project(circle.centre, self._camera), np.float64)
        step = 0.05 * self._radius_m
        pixel_by = (
            project(circle.centre + step * circle.basis, self._camera) - pixel
        ) / step  # (2, 2) px per m
        in_pixel = pixel_by.T @ circle.covariance @ pixel_by
        # Along the line of sight the plane decides: z = 1 / (inverse · ray).
        ray = circle.centre / circle.centre[2]
        variance = float(ray @ plane.covariance @ ray) * float(circle.centre[2]) ** 4 + _DEPTH_FLOOR_M**2
        along = np.outer(ray, ray) * variance
        across = circle.basis.T @ circle.covariance @ circle.basis
        return Disc(
            pixel=pixel,
            pixel_covariance=in_pixel,
            camera_m=circle.centre,
            camera_covariance=across + along,
            normal=plane.normal,
            radius_residual_m=circle.spread_px * float(circle.centre[2]) / self._camera.fx,
            rms_px=circle.rms_px,
            coverage=circle.coverage,
            saturated=float(clipped.mean()) if len(clipped) else 0.0,
            ring_only=plane.ring_only,
            outline=project(rim, self._camera),
        )


def _correlated(found: list[tuple[Disc, Circle]]) -> list[Disc]:
    """Widens the outlines' covariances by what neighbouring points share: one factor for the frame.

    A single outline has too few independent arcs to tell it; the speckle is the same for all.
    """
    if not found:
        return []
    factor = max(1.0, float(np.mean([circle.correlation for _, circle in found])))
    wider = []
    for disc, circle in found:
        more = (factor - 1) * circle.basis.T @ circle.covariance @ circle.basis
        wider.append(
            replace(
                disc,
                pixel_covariance=disc.pixel_covariance * factor,
                camera_covariance=disc.camera_covariance + more,
            )
        )
    return wider


def _covers(rejected: Rejected, disc: Disc) -> bool:
    """Whether a blob is a disc's glow, or a piece of it: their places overlap."""
    low, high = rejected.outline.min(axis=0), rejected.outline.max(axis=0)
    around = disc.outline.min(axis=0), disc.outline.max(axis=0)
    contains = bool(((disc.pixel >= low) & (disc.pixel <= high)).all())
    contained = bool(((rejected.pixel >= around[0]) & (rejected.pixel <= around[1])).all())
    return contains or contained
