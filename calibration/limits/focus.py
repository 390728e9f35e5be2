"""Depth of field from captures at several distances: how blurred edges are, against their depth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.outcome import RefusedError
from calibration.resampling import jackknife_covariance
from surfclass.frames import Capture
from surfclass.geometry import register
from surfclass.pipeline import lit_image
from surfclass.rig import Rig
from surfclass.texture import grey_levels
from surfclass.types import Float64

_DERIVATIVE_PX, _BLUR_PX = 0.7, 1.2  # of the Gaussian derivative, and what edges are blurred with again
_STRONG = 0.85  # quantile of the gradient above which there is an edge
_LEAST_CONTRAST = 6.0  # grey levels a pixel, above the noise
_STEP_PER_M = 0.05  # of the inverse depth: within it the blur is one
_FEWEST_EDGES = 60
_FEWEST_STEPS = 5
_LEAST_GROWTH = 3.0  # of the squared blur, over its scatter
_ENOUGH_EDGES = 2000  # more say no more


@dataclass(frozen=True, slots=True, eq=False)
class Blur:
    """Measured blur.

    Attributes:
        depth_m: (n,) depth along the optical axis.
        squared_px2: (n,) squared standard deviation of the Gaussian that edges are blurred with, but for
            a constant: texture is not made of steps alone.
        edges: (n,) how many edge pixels.
        capture: (n,) number of the capture.
    """

    depth_m: Float64
    squared_px2: Float64
    edges: Float64
    capture: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Focus:
    """What the lens does: `sigma² = sharpest + (spread (1/z − 1/distance))²`.

    Attributes:
        distance_m: Of the plane of focus.
        spread_px_m: Growth of the blur with inverse depth; a quarter of aperture times focal length in px,
            a disc's standard deviation being a quarter of its diameter.
        sharpest_px2: Squared blur in the plane of focus; below 0 where texture looks sharper than steps.
        sd: (3,) standard deviations of the three, by the jackknife over captures.
        blur: What it was fitted to.
    """

    distance_m: float
    spread_px_m: float
    sharpest_px2: float
    sd: Float64
    blur: Blur

    def aperture_m(self, fx: float) -> float:
        """Returns the entrance pupil's diameter."""
        return 4 * self.spread_px_m / fx

    def sigma_px(self, depth_m: NDArray[Any]) -> Float64:
        """Returns the blur at depths along the axis."""
        spread = self.spread_px_m * (1 / np.asarray(depth_m) - 1 / self.distance_m)
        return np.asarray(np.sqrt(np.maximum(0, self.sharpest_px2 + spread**2)))


def measure(captures: Iterable[Capture], rig: Rig) -> Blur:
    """Measures the blur of the edges of captures by blurring them once more.

    A step that a Gaussian has blurred loses the more of its gradient when it is blurred again, the
    sharper it was; how high the step is falls out (Zhuo and Sim, "Defocus map estimation from a single
    image", 2011). Texture scales with distance, its steps' sharpness does not.
    """
    depth, blur, edges, number = [], [], [], []
    for index, capture in enumerate(captures):
        if capture.colour is None:
            continue
        rig.check(capture)
        registered = register(capture.depth.depth_mm, rig)
        grey = grey_levels(lit_image(capture, rig)).astype(np.float32)
        squared, chosen = _edge_blur(grey)
        z = registered.point[2]
        usable = chosen & registered.has_point & (z > 0)
        if not usable.any():
            continue
        step = np.floor(1 / z[usable] / _STEP_PER_M).astype(np.intp)
        for one in np.unique(step):
            inside = step == one
            if inside.sum() >= _FEWEST_EDGES:
                depth.append(float(1 / np.mean(1 / z[usable][inside])))
                blur.append(float(np.median(squared[usable][inside])))
                edges.append(float(inside.sum()))
                number.append(index)
    return Blur(np.array(depth), np.array(blur), np.array(edges), np.array(number, np.intp))


def _edge_blur(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Squared blur (px²) of each pixel as if it lay on an edge, and where it does."""
    once = _gradient(cv2.GaussianBlur(grey, (0, 0), _DERIVATIVE_PX))
    twice = _gradient(cv2.GaussianBlur(grey, (0, 0), float(np.hypot(_DERIVATIVE_PX, _BLUR_PX))))
    length, again = np.hypot(*once), np.hypot(*twice)
    # An edge is where the gradient is largest along its own direction.
    horizontal = np.abs(once[0]) >= np.abs(once[1])
    beside = [
        np.where(horizontal, np.roll(length, shift, axis=1), np.roll(length, shift, axis=0))
        for shift in (1, -1)
    ]
    chosen = (length >= beside[0]) & (length > beside[1])
    chosen &= length > max(_LEAST_CONTRAST, float(np.quantile(length, _STRONG)))
    border = 4
    chosen[:border] = chosen[-border:] = False
    chosen[:, :border] = chosen[:, -border:] = False
    ratio2 = np.square(np.divide(length, again, out=np.ones_like(length), where=chosen & (again > 0)))
    chosen &= ratio2 > 1 + 1e-3
    squared = np.divide(_BLUR_PX**2, ratio2 - 1, out=np.zeros_like(length), where=chosen)
    return squared - np.float32(_DERIVATIVE_PX**2 + 1 / 3), chosen  # central differences add a third


def _gradient(image: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    kernel = np.array([[-0.5, 0, 0.5]], np.float32)
    along, across = cv2.filter2D(image, cv2.CV_32F, kernel), cv2.filter2D(image, cv2.CV_32F, kernel.T)
    return np.asarray(along, np.float32), np.asarray(across, np.float32)


def find_focus(blur: Blur) -> Focus:
    """Returns the plane of focus and how fast sharpness is lost beside it.

    Raises:
        RefusedError: If the captures do not tell: too few depths, or a blur that does not change.
    """
    if len(blur.depth_m) < _FEWEST_STEPS or len(np.unique(blur.capture)) < 3:
        raise RefusedError(
            f"depth of field: edges at {len(blur.depth_m)} depths of {len(np.unique(blur.capture))} "
            f"captures, needed are {_FEWEST_STEPS} depths in 3 captures of something textured"
        )
    x = _fitted(blur, None)
    low, high = float(blur.depth_m.min()), float(blur.depth_m.max())
    found = Focus(float(1 / x[0]), float(x[1]), float(x[2]), np.zeros(3), blur)
    growth = found.spread_px_m**2 * (1 / np.array([low, high]) - x[0]) ** 2
    scatter = 1.4826 * float(np.median(np.abs(_residuals(x, blur))))
    if growth.max() < _LEAST_GROWTH * scatter or not low < found.distance_m < high:
        raise RefusedError(
            f"depth of field: from {low:.2f} to {high:.2f} m the squared blur of edges grows by "
            f"{growth.max():.2f} px² and scatters by {scatter:.2f}, least at {found.distance_m:.2f} m; "
            "needed are captures well before and well behind the plane of focus, of something with sharp "
            "edges (a checkerboard)"
        )
    numbers = np.unique(blur.capture)
    without = []
    for number in numbers:
        kept = blur.capture != number
        part = Blur(blur.depth_m[kept], blur.squared_px2[kept], blur.edges[kept], blur.capture[kept])
        again = _fitted(part, x)
        without.append([1 / again[0], again[1], again[2]])
    sd = np.sqrt(np.diag(jackknife_covariance(np.array(without))))
    return Focus(found.distance_m, found.spread_px_m, found.sharpest_px2, sd, blur)


def _fitted(blur: Blur, start: Float64 | None) -> Float64:
    """(3,) inverse distance of focus, spread, squared blur in focus."""
    from scipy.optimize import least_squares

    inverse = 1 / blur.depth_m
    weight = np.sqrt(np.minimum(blur.edges, _ENOUGH_EDGES) / _ENOUGH_EDGES)
    spread = np.sqrt(max(0.05, float(np.ptp(blur.squared_px2)))) / max(1e-3, float(np.ptp(inverse)))
    starts = (
        [start]
        if start is not None
        else [
            np.array([place, spread, float(blur.squared_px2.min())])
            for place in np.linspace(inverse.min(), inverse.max(), 7)
        ]
    )
    bounds = ([0.02, 1e-3, -20.0], [20.0, 100.0, 400.0])

    def residual(x: Float64) -> Float64:
        return np.asarray(weight * _residuals(x, blur))

    settings: dict[str, Any] = {"loss": "soft_l1", "f_scale": 0.1, "x_scale": [0.1, 0.5, 0.1]}
    found = [least_squares(residual, x, bounds=bounds, **settings) for x in starts]
    return np.asarray(min(found, key=lambda one: float(one.cost)).x)


def _residuals(x: Float64, blur: Blur) -> Float64:
    return np.asarray(x[2] + (x[1] * (1 / blur.depth_m - x[0])) ** 2 - blur.squared_px2)
