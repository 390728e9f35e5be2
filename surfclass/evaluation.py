"""Accuracy against labels: voxel by voxel on a benchmark map (thesis §6.1.4), and pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.kinematics import depth_pose
from surfclass.pipeline import Pipeline
from surfclass.pooling import Pool, fuse, softmax
from surfclass.rig import ColourFeature, Rig
from surfclass.types import Bool, Float32, Float64, Int32, Observation
from surfclass.viewing import view_surface
from surfclass.voxel_map import MapLayers, VoxelMap, voxel_of

SCHEMA = 1
CALIBRATION_BINS = 15
ROUTES: dict[str, ColourFeature | None] = {
    "rgb": "RGB",
    "ab": "a*b*",
    "kd": "K_d",
    "texture": None,
    "combined": None,
}


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """How well distributions over classes agree with the truth.

    Attributes:
        overall: Share of all n samples whose most probable class is the true one.
        balanced: Mean over the classes present of the share that is right.
        ece: Expected calibration error of the classified samples, in CALIBRATION_BINS equal bins.
        nll: Mean of -log of the true class's probability over the classified samples, nats.
        rejected: Share of samples without a distribution; they count as wrong above.
        voxels: Number of samples.
        confusion: (k, k) counts; row: truth, column: result. Rejected samples are in no column.
    """

    overall: float
    balanced: float
    ece: float
    nll: float
    rejected: float
    voxels: int
    confusion: NDArray[np.int64]

    def to_json(self) -> dict[str, Any]:
        """As `evaluate --json` writes it; a figure that does not exist (no sample) is null."""
        figures = {name: getattr(self, name) for name in ("overall", "balanced", "ece", "nll", "rejected")}
        return {
            **{name: None if np.isnan(value) else float(value) for name, value in figures.items()},
            "voxels": self.voxels,
            "confusion": self.confusion.tolist(),
        }


def score(truth: NDArray[np.intp], probability: NDArray[Any], classified: Bool) -> Score:
    """Compares distributions with the truth.

    Args:
        truth: (n,) true class, 0…k-1.
        probability: (n, k); rows where not `classified` are not looked at.
        classified: (n,) bool.
    """
    n, k = probability.shape
    result = probability.argmax(axis=1)
    right = (result == truth) & classified
    confusion = np.zeros((k, k), np.int64)
    np.add.at(confusion, (truth[classified], result[classified]), 1)
    total = np.bincount(truth, minlength=k)
    present = total > 0
    recall = np.bincount(truth[right], minlength=k)[present] / total[present]
    chosen = probability[classified].astype(np.float64)
    confidence = chosen.max(axis=1) if len(chosen) else np.zeros(0)
    of_truth = chosen[np.arange(len(chosen)), truth[classified]]
    return Score(
        overall=float(right.mean()) if n else np.nan,
        balanced=float(recall.mean()) if n else np.nan,
        ece=calibration_error(confidence, right[classified]),
        nll=float(-np.log(np.maximum(of_truth, 1e-12)).mean()) if len(chosen) else np.nan,
        rejected=float(1 - classified.mean()) if n else np.nan,
        voxels=n,
        confusion=confusion,
    )


def calibration_error(confidence: Float64, right: Bool) -> float:
    """Returns the expected calibration error: the mean gap between confidence and accuracy.

    The gap is taken in CALIBRATION_BINS equal bins of confidence and weighted by their share.
    """
    if not len(confidence):
        return np.nan
    bins = np.minimum((confidence * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    gap = np.bincount(bins, confidence - right, CALIBRATION_BINS)
    return float(np.abs(gap).sum() / len(confidence))


class Benchmark:
    """The benchmark map: every labelled pixel's surface point votes for its voxel's class."""

    def __init__(self, voxel_size_m: float, class_count: int) -> None:
        self._size = voxel_size_m
        self._votes: dict[tuple[int, int, int], NDArray[np.int64]] = {}
        self._classes = class_count

    def add(self, point_base: Float32, label: NDArray[np.uint8]) -> None:
        """Adds (n, 3) points in `base`, m, with their labels, 1…k."""
        voxels, which = np.unique(voxel_of(point_base, self._size), axis=0, return_inverse=True)
        key = which.reshape(-1) * self._classes + (label.astype(np.intp) - 1)
        counts = np.bincount(key, minlength=len(voxels) * self._classes).reshape(-1, self._classes)
        for voxel, count in zip(map(tuple, voxels.tolist()), counts, strict=True):
            if voxel in self._votes:
                self._votes[voxel] += count
            else:
                self._votes[voxel] = count

    def truth(self) -> tuple[Int32, NDArray[np.intp]]:
        """Returns the voxels (n, 3), sorted, and the class that most of their pixels have (n,)."""
        if not self._votes:
            return np.zeros((0, 3), np.int32), np.zeros(0, np.intp)
        voxels = sorted(self._votes)
        counts = np.array([self._votes[voxel] for voxel in voxels])
        return np.array(voxels, np.int32), counts.argmax(axis=1)


@dataclass(slots=True)
class _RouteMaps:
    """The maps of one route: all test captures fused."""

    fused: VoxelMap
    views: dict[str, Score] = field(default_factory=dict)
    pixels: dict[str, Score] = field(default_factory=dict)


def evaluate(
    captures: Iterable[Capture],
    pipeline: Pipeline,
    routes: Iterable[str],
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Returns the figures of every route on labelled captures, as `evaluate --json` writes them.

    Args:
        captures: Of role "test"; one at a time is held in memory.
        pipeline: Its rig, model and settings are used, its map is not.
        routes: Names out of ROUTES.
        progress: Called with each capture's name before it is classified.

    Raises:
        InputError: If no capture has a label.
        ConfigurationError: If the model has not the colour feature of a route.
    """
    routes = list(routes)
    main = pipeline.rig.features.colour
    feature_of = {route: ROUTES[route] or main for route in routes}
    k = len(pipeline.model.classes.names)
    maps = {route: _RouteMaps(pipeline.new_map()) for route in routes}
    benchmark = Benchmark(pipeline.rig.voxel_size_m, k)
    for capture in captures:
        of_pixel = _label(capture)
        progress(capture.name)
        classified = pipeline.classify(capture, tuple(dict.fromkeys(feature_of.values())))
        label = of_pixel[classified.view.has_point]  # in the order of an observation's points
        labelled = label > 0
        of_view = Benchmark(pipeline.rig.voxel_size_m, k)
        for route, feature in feature_of.items():
            observation = pipeline.observe(classified, feature)
            if route == routes[0]:
                for truth_map in (benchmark, of_view):
                    truth_map.add(observation.point_base[labelled], label[labelled])
            maps[route].fused.add(observation, capture.t_ns)
            view_map = pipeline.new_map()
            view_map.add(observation, capture.t_ns)
            index, truth = of_view.truth()
            layers = view_map.at(index, pipeline.settings.pool)
            maps[route].views[capture.name] = score_layers(layers, route, truth)
            maps[route].pixels[capture.name] = _score_pixels(
                observation.of(labelled), label[labelled].astype(np.intp) - 1, route, pipeline.settings.pool
            )
    if not any(route_maps.views for route_maps in maps.values()):
        raise InputError("there is no capture of role 'test' to evaluate")
    index, truth = benchmark.truth()
    return {
        "schema": SCHEMA,
        "classes": list(pipeline.model.classes.names),
        "routes": {
            route: {
                "fused": score_layers(found.fused.at(index, pipeline.settings.pool), route, truth).to_json(),
                "views": {name: of_view.to_json() for name, of_view in found.views.items()},
                "pixels": {name: _without_voxels(of_view) for name, of_view in found.pixels.items()},
            }
            for route, found in maps.items()
        },
    }


def _without_voxels(found: Score) -> dict[str, Any]:
    figures = found.to_json()
    figures["pixels"] = figures.pop("voxels")
    return figures


def benchmark_of(
    captures: Iterable[Capture], rig: Rig, class_count: int, progress: Callable[[str], None] = lambda _: None
) -> Benchmark:
    """Returns the benchmark map of labelled captures, which needs no model.

    Raises:
        InputError: If a capture has no label, or there is none.
    """
    benchmark = Benchmark(rig.voxel_size_m, class_count)
    empty = True
    for capture in captures:
        empty = False
        label = _label(capture)
        progress(capture.name)
        rig.check(capture)
        view = view_surface(capture.depth.depth_mm, rig)
        chosen = view.has_point & (label > 0)
        base_T_rgb = depth_pose(capture, rig) @ rig.rgb_T_depth.inverse
        benchmark.add(base_T_rgb.move_planes(view.point[:, chosen]).T, label[chosen])
    if empty:
        raise InputError("there is no capture of role 'test' to evaluate")
    return benchmark


def _label(capture: Capture) -> NDArray[np.uint8]:
    if capture.label is None or not capture.label.any():
        raise InputError(f"capture {capture.name}: role 'test', but it has no label")
    return capture.label


def score_layers(layers: MapLayers, route: str, truth: NDArray[np.intp]) -> Score:
    """Scores one layer of a map, or its fusion, on the benchmark's voxels.

    A layer without evidence is uniform; a uniform distribution names no class and is a rejection.

    Args:
        layers: The map at the benchmark's voxels.
        route: "texture" and "combined" as they say; every other name means the colour layer.
        truth: (n,) the benchmark's classes.
    """
    by_route = {"texture": layers.p_texture, "combined": layers.p}
    p = by_route.get(route, layers.p_colour)
    return score(truth, p, p.max(axis=1) > 1 / p.shape[1] + 1e-6)


def _score_pixels(observation: Observation, truth: NDArray[np.intp], route: str, pool: Pool) -> Score:
    """Scores labelled pixels as if each were a voxel that only this capture saw."""
    has_colour, has_texture = observation.has_colour, observation.has_texture
    if route == "texture":
        return score(truth, softmax(observation.texture), has_texture)
    if route != "combined":
        return score(truth, softmax(observation.colour), has_colour)
    both = fuse(observation.colour, observation.texture, has_colour, has_texture, observation.weight, pool)
    return score(truth, both, has_colour | has_texture)
