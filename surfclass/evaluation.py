"""Accuracy against labels: voxel by voxel on a benchmark map (thesis §6.1.4), and pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surfclass.classifiers.reliability import calibration_error
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.kinematics import depth_pose
from surfclass.pipeline import Pipeline
from surfclass.pooling import Pool, fuse, is_known
from surfclass.rig import ColourFeature, Rig
from surfclass.types import Bool, Float32, Int32, Observation
from surfclass.viewing import view_surface
from surfclass.voxel_index import Keys, pack, unpack, voxel_of
from surfclass.voxel_map import MapLayers

SCHEMA = 1
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
        ece: Expected calibration error of the classified samples, as `reliability.calibration_error` has it.
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
            **{name: _figure(value) for name, value in figures.items()},
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
    overall, balanced, confusion = accuracy(truth, result, classified, k)
    chosen = probability[classified].astype(np.float64)
    confidence = chosen.max(axis=1) if len(chosen) else np.zeros(0)
    of_truth = chosen[np.arange(len(chosen)), truth[classified]]
    return Score(
        overall=overall,
        balanced=balanced,
        ece=calibration_error(confidence, right[classified]),
        nll=float(-np.log(np.maximum(of_truth, 1e-12)).mean()) if len(chosen) else np.nan,
        rejected=float(1 - classified.mean()) if n else np.nan,
        voxels=n,
        confusion=confusion,
    )


def accuracy(
    truth: NDArray[np.intp], result: NDArray[np.intp], classified: Bool, k: int
) -> tuple[float, float, NDArray[np.int64]]:
    """Returns overall and balanced accuracy and the confusion matrix, as `Score` has them.

    Args:
        truth: (n,) true classes, 0…k-1.
        result: (n,) classes found; not looked at where not `classified`.
        classified: (n,) bool.
        k: Number of classes.
    """
    confusion = np.bincount(truth[classified] * k + result[classified], minlength=k * k).reshape(k, k)
    total = np.bincount(truth, minlength=k)
    present = total > 0
    if not present.any():
        return np.nan, np.nan, confusion
    right = np.diag(confusion)
    return float(right.sum() / total.sum()), float((right[present] / total[present]).mean()), confusion


class Benchmark:
    """The benchmark map: every labelled pixel's surface point votes for its voxel's class."""

    def __init__(self, voxel_size_m: float, class_count: int) -> None:
        self._size, self._classes = voxel_size_m, class_count
        self._key = np.zeros(0, np.int64)
        self._votes = np.zeros((0, class_count), np.int64)

    def add(self, point_base: Float32, label: NDArray[np.uint8]) -> None:
        """Adds (n, 3) points in `base`, m, with their labels, 1…k."""
        key, voxel = np.unique(pack(voxel_of(point_base, self._size)), return_inverse=True)
        flat = voxel.reshape(-1) * self._classes + (label.astype(np.intp) - 1)
        votes = np.bincount(flat, minlength=len(key) * self._classes)
        self._join(key, votes.reshape(-1, self._classes))

    def merge(self, other: Benchmark) -> None:
        """Adds another benchmark's votes."""
        self._join(other._key, other._votes)

    def _join(self, key: Keys, votes: NDArray[np.int64]) -> None:
        joined, row = np.unique(np.concatenate([self._key, key]), return_inverse=True)
        total = np.zeros((len(joined), self._classes), np.int64)
        np.add.at(total, row.reshape(-1), np.concatenate([self._votes, votes]))
        self._key, self._votes = joined, total

    def truth(self) -> tuple[Int32, NDArray[np.intp]]:
        """Returns the voxels (n, 3), sorted, and the class that most of their pixels have (n,)."""
        return unpack(self._key), self._votes.argmax(axis=1)


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
    main, pool = pipeline.rig.features.colour, pipeline.settings.pool
    feature_of = {route: ROUTES[route] or main for route in routes}
    features = tuple(dict.fromkeys(feature_of.values()))
    k = len(pipeline.model.classes.names)
    benchmark = Benchmark(pipeline.rig.voxel_size_m, k)
    fused = {feature: pipeline.new_map() for feature in features}
    views: dict[str, dict[str, Score]] = {route: {} for route in feature_of}
    pixels: dict[str, dict[str, Any]] = {route: {} for route in feature_of}
    for capture in captures:
        of_pixel = _label(capture)
        progress(capture.name)
        classified = pipeline.classify(capture, features)
        label = of_pixel[classified.view.has_point]  # in the order of an observation's points
        labelled = label > 0
        truth_of_pixel = label[labelled].astype(np.intp) - 1
        of_view = Benchmark(pipeline.rig.voxel_size_m, k)
        for feature in features:
            observation = pipeline.observe(classified, feature)
            said = observation.of(labelled)
            if feature == features[0]:
                of_view.add(said.point_base, label[labelled])
                benchmark.merge(of_view)
            fused[feature].add(observation, capture.t_ns)
            view_map = pipeline.new_map()
            view_map.add(observation, capture.t_ns)
            index, truth = of_view.truth()
            layers = view_map.at(index, pool)
            for route in (route for route in feature_of if feature_of[route] == feature):
                views[route][capture.name] = score_layers(layers, route, truth)
                pixels[route][capture.name] = _score_pixels(said, truth_of_pixel, route, pool)
    index, truth = benchmark.truth()
    if not len(index):
        raise InputError("there is no capture of role 'test' with a labelled surface point to evaluate")
    layers_of = {feature: fused[feature].at(index, pool) for feature in features}
    return {
        "schema": SCHEMA,
        "classes": list(pipeline.model.classes.names),
        "routes": {
            route: {
                "fused": score_layers(layers_of[feature], route, truth).to_json(),
                "views": {name: found.to_json() for name, found in views[route].items()},
                "pixels": pixels[route],
            }
            for route, feature in feature_of.items()
        },
    }


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
    if capture.label is None:
        raise InputError(f"capture {capture.name}: role 'test', but it has no label image")
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
    return score(truth, p, is_known(p))


def _score_pixels(
    observation: Observation, truth: NDArray[np.intp], route: str, pool: Pool
) -> dict[str, Any]:
    """Scores labelled pixels as if each were a voxel that only this capture saw."""
    has_colour, has_texture = observation.has_colour, observation.has_texture
    if route == "texture":
        evidence, classified = observation.texture, has_texture
    elif route == "combined":
        classified = has_colour | has_texture
        evidence = fuse(
            observation.colour, observation.texture, has_colour, has_texture, observation.weight, pool
        )
    else:
        evidence, classified = observation.colour, has_colour
    overall, balanced, confusion = accuracy(truth, evidence.argmax(axis=1), classified, evidence.shape[1])
    return {
        "overall": _figure(overall),
        "balanced": _figure(balanced),
        "rejected": _figure(float(1 - classified.mean()) if len(truth) else np.nan),
        "pixels": len(truth),
        "confusion": confusion.tolist(),
    }


def _figure(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
