"""The whole method on one screen: a capture becomes a view, two posteriors, an observation, a map update."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surfclass import quality
from surfclass.errors import InputError
from surfclass.fingerprint import fingerprints
from surfclass.frames import Capture
from surfclass.kinematics import depth_pose
from surfclass.model import Model
from surfclass.reflectance import subtract_dark
from surfclass.rig import ColourFeature, Rig, SurfaceClasses, TextureLimits
from surfclass.routes import Image
from surfclass.types import Float32, Float64, Int32, MapUpdate, Observation, Posterior, SurfaceView, Transform
from surfclass.viewing import view_surface
from surfclass.voxel_map import VoxelMap

# A posterior below this is taken for this: one pixel can speak against a class, never rule it out.
EVIDENCE_FLOOR = 1e-3


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """How evidence is put together.

    Attributes:
        update: "frame" (one observation a voxel and frame) or "independent" (Eq. 3.9 literally).
        pool: "log-linear", or "linear" (Eq. 3.11).
    """

    update: Literal["frame", "independent"] = "frame"
    pool: Literal["log-linear", "linear"] = "log-linear"


THESIS = PipelineSettings(update="independent", pool="linear")


@dataclass(frozen=True, slots=True, eq=False)
class Classified:
    """One capture, classified by both routes.

    Attributes:
        view: The geometry of its pixels.
        base_T_rgb: The colour camera's pose.
        colour: One posterior for each colour feature asked for.
        texture: The texture route's posterior, in windows.
        weight: (h, w) float32, the probability map of the texture route (Eq. 5.19).
    """

    view: SurfaceView
    base_T_rgb: Transform
    colour: dict[ColourFeature, Posterior]
    texture: Posterior
    weight: Float32


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What one capture did: the map's update, what led to it, and the milliseconds of each stage."""

    update: MapUpdate
    classified: Classified
    stage_ms: dict[str, float]


@dataclass(slots=True)
class StageClock:
    """Milliseconds spent in named stages."""

    ms: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to stage `name`."""
        start = time.perf_counter_ns()
        yield
        self.ms[name] = self.ms.get(name, 0.0) + (time.perf_counter_ns() - start) / 1e6


class Pipeline:
    """Captures in, map updates out; `map` is the only state.

    Raises:
        ConfigurationError: If model and rig do not fit.
    """

    def __init__(self, rig: Rig, model: Model, settings: PipelineSettings | None = None) -> None:
        model.check(rig)
        self.rig = model.complete(rig)
        self.model = model
        self.settings = settings or PipelineSettings()
        self.limits = texture_limits(self.rig, model.classes)
        self.focus = focus_planes(self.rig, model.classes, self.limits)
        self.map = self.new_map()

    def new_map(self) -> VoxelMap:
        """Returns an empty map of this pipeline's voxel size, classes and update rule."""
        return VoxelMap(
            self.rig.voxel_size_m,
            self.model.classes,
            self.settings.update,
            made_with=fingerprints(self.rig),
        )

    def process(self, capture: Capture) -> FrameResult:
        """Adds one capture to the map.

        Raises:
            InputError: If an image has not the rig's size, or the capture has no pose or colour.
            MissingCalibrationError: If the rig lacks what the features need.
        """
        clock = StageClock()
        feature = self.rig.features.colour
        classified = self.classify(capture, (feature,), clock)
        with clock.stage("evidence"):
            observation = self.observe(classified, feature)
        with clock.stage("map"):
            update = self.map.add(observation, capture.t_ns)
        return FrameResult(update, classified, clock.ms)

    def classify(
        self, capture: Capture, features: tuple[ColourFeature, ...], clock: StageClock | None = None
    ) -> Classified:
        """Classifies one capture by the texture route and by each of the colour `features`.

        Raises:
            InputError, MissingCalibrationError: As `process`.
        """
        with naming(capture):
            return self._classify(capture, features, clock or StageClock())

    def _classify(
        self, capture: Capture, features: tuple[ColourFeature, ...], clock: StageClock
    ) -> Classified:
        self.rig.check(capture)
        image = lit_image(capture, self.rig)
        exposure_s = None if capture.colour is None else capture.colour.exposure_s
        with clock.stage("geometry"):
            base_T_rgb = depth_pose(capture, self.rig) @ self.rig.rgb_T_depth.inverse
            view = view_surface(capture.depth.depth_mm, self.rig)
        with clock.stage("colour"):
            colour = {
                feature: self.model.colour_route(feature).classify(image, view, self.rig, exposure_s)
                for feature in features
            }
        with clock.stage("texture"):
            texture = self.model.texture.classify(image)
        with clock.stage("probability map"):
            label = per_pixel(texture.label(), texture.cell_px, view.has_point.shape)
            weight = quality.probability_map(view, self.limits, label, self.focus)
        return Classified(view, base_T_rgb, colour, texture, weight)

    def observe(self, classified: Classified, feature: ColourFeature) -> Observation:
        """Returns what the capture says about its surface points, in `base`."""
        view, colour, texture = classified.view, classified.colour[feature], classified.texture
        shape = view.has_point.shape
        seen = np.flatnonzero(view.has_point)

        def picked(image: NDArray[Any]) -> NDArray[Any]:
            # `take` with a mode does not check every index again: four times as fast as indexing.
            return image.reshape(shape[0] * shape[1], -1).take(seen, axis=0, mode="clip")

        planes = view.point.reshape(3, -1).take(seen, axis=1, mode="clip")
        point = np.ascontiguousarray(classified.base_T_rgb.move_planes(planes).T)

        has_colour = picked(colour.valid)[:, 0]
        colour_prior = self.model.colour_route(feature).classifier.prior
        likelihood = log_likelihood(picked(colour.probability), colour_prior)
        likelihood[~has_colour] = 0

        k = len(self.model.classes.names)
        cell = cell_of_pixel(shape, texture.cell_px).take(seen, mode="clip")
        rows = log_likelihood(texture.probability.reshape(-1, k), self.model.texture.classifier.prior)
        rows[~texture.valid.reshape(-1)] = 0
        rows = np.vstack([rows, np.zeros((1, k), np.float32)])  # what cell -1 points at
        has_texture = np.append(texture.valid.reshape(-1), False).take(cell, mode="wrap")
        weight = np.where(has_texture, picked(classified.weight)[:, 0], np.float32(0))
        return Observation(
            point, likelihood, rows.take(cell, axis=0, mode="wrap"), has_colour, has_texture, weight
        )


@contextmanager
def naming(capture: Capture) -> Iterator[None]:
    """Puts the capture's name before the message of an InputError that does not have it yet."""
    try:
        yield
    except InputError as error:
        if capture.name in str(error):
            raise
        raise type(error)(f"capture {capture.name}: {error}") from None


def lit_image(capture: Capture, rig: Rig) -> Image:
    """Returns the (h, w, 3) image; an unlit frame, if there is one, is taken off in linear light.

    Raises:
        InputError: If the capture has no colour image.
        MissingCalibrationError: If there is an unlit frame and the rig has no response.
    """
    if capture.colour is None:
        raise InputError(f"capture {capture.name}: has no colour image, so it cannot be classified")
    if capture.dark is None:
        return capture.colour.rgb
    return subtract_dark(capture.colour.rgb, capture.dark.rgb, rig.response)


def log_likelihood(posterior: Float32, prior: Float64) -> Float32:
    """Returns log(posterior / training prior), with posteriors clipped to EVIDENCE_FLOOR.

    Args:
        posterior: (n, k).
        prior: (k,) class shares of the training set.
    """
    clipped = np.log(np.maximum(posterior, np.float32(EVIDENCE_FLOOR)))
    clipped -= np.log(prior).astype(np.float32)
    return clipped


def texture_limits(rig: Rig, classes: SurfaceClasses) -> tuple[TextureLimits, ...]:
    """Returns each class's limits: its own, or the rig's for every class."""
    return tuple(rig.class_texture_limits.get(name, rig.texture_limits) for name in classes.names)


def focus_planes(
    rig: Rig, classes: SurfaceClasses, limits: tuple[TextureLimits, ...]
) -> tuple[float, float] | None:
    """Returns the depth of field (Eq. 5.1, 5.2), m along the axis; None where the rig has no lens.

    Raises:
        ConfigurationError: If a class has nothing in focus within its limits (Eq. 5.16).
    """
    if rig.lens is None:
        return None
    lens = rig.lens
    near, far = quality.depth_of_field(
        lens.focal_length_m, lens.f_number, lens.circle_of_confusion_m, lens.focus_distance_m
    )
    for name, limit in zip(classes.names, limits, strict=True):
        quality.range_of(near, far, limit.near_m, limit.far_m, name)
    return near, far


@lru_cache(maxsize=8)
def cell_of_pixel(shape: tuple[int, int], cell_px: int) -> Int32:
    """Returns for each pixel of a (h, w) image, flattened, its cell; -1 outside the whole cells."""
    rows, cols = shape[0] // cell_px, shape[1] // cell_px
    cell = np.full(shape, -1, np.int32)
    index = np.arange(rows * cols, dtype=np.int32).reshape(rows, cols)
    cell[: rows * cell_px, : cols * cell_px] = index.repeat(cell_px, 0).repeat(cell_px, 1)
    flat = cell.reshape(-1)
    flat.flags.writeable = False
    return flat


def per_pixel(cells: NDArray[np.uint8], cell_px: int, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Returns an image of cells, (rows, cols), as an image of `shape` pixels; 0 outside the cells."""
    padded = np.append(cells.reshape(-1), np.uint8(0))
    return padded[cell_of_pixel(shape, cell_px)].reshape(shape)
