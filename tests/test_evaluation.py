"""Figures: accuracy, balance, calibration and rejection, by hand; and the benchmark map."""

import numpy as np
import pytest

from surfclass.classifiers.reliability import calibration_error
from surfclass.evaluation import Benchmark, score, score_layers
from surfclass.voxel_map import MapLayers

P = np.array([[0.8, 0.1, 0.1], [0.2, 0.7, 0.1], [0.5, 0.3, 0.2], [0.1, 0.1, 0.8]], np.float32)


def test_a_rejected_sample_is_wrong_and_counted_apart():
    truth = np.array([0, 1, 1, 2])
    found = score(truth, P, np.array([True, True, True, False]))
    assert found.overall == pytest.approx(2 / 4)
    assert found.balanced == pytest.approx((1 + 1 / 2 + 0) / 3)
    assert found.rejected == pytest.approx(1 / 4)
    assert found.confusion.tolist() == [[1, 0, 0], [1, 1, 0], [0, 0, 0]]
    assert found.nll == pytest.approx(-np.log([0.8, 0.7, 0.3]).mean())
    assert found.voxels == 4


def test_a_class_that_is_absent_does_not_enter_the_balance():
    found = score(np.array([0, 0, 1]), P[:3], np.ones(3, bool))
    assert found.balanced == pytest.approx((1 / 2 + 0) / 2)


def test_no_sample_gives_no_figure_instead_of_a_number():
    found = score(np.zeros(0, int), np.zeros((0, 3), np.float32), np.zeros(0, bool))
    assert found.to_json()["overall"] is None
    assert found.to_json()["ece"] is None


def test_calibration_error_is_the_gap_weighted_by_share():
    # Two bins: confidence 0.9 of which half are right, confidence 0.3 of which none is.
    confidence = np.array([0.9, 0.9, 0.3])
    right = np.array([True, False, False])
    assert calibration_error(confidence, right) == pytest.approx((2 * 0.4 + 1 * 0.3) / 3)


def test_calibrated_confidence_has_a_small_error():
    rng = np.random.default_rng(1)
    confidence = rng.uniform(0.3, 1, 200_000)
    right = rng.random(confidence.size) < confidence
    assert calibration_error(confidence, right) < 0.01
    assert calibration_error(np.full(confidence.size, 0.99), right) > 0.3


def test_the_benchmark_takes_the_class_that_most_pixels_have():
    benchmark = Benchmark(0.01, 3)
    point = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.003, 0, 0], [-0.001, 0, 0]], np.float32)
    benchmark.add(point, np.array([1, 2, 2, 3], np.uint8))
    index, truth = benchmark.truth()
    assert index.tolist() == [[-1, 0, 0], [0, 0, 0]]
    assert truth.tolist() == [2, 1]
    for _ in range(2):  # another view outvotes it
        benchmark.add(point[:1], np.array([1], np.uint8))
    assert benchmark.truth()[1].tolist() == [2, 0]


def test_a_layer_without_evidence_names_no_class():
    uniform = np.full((2, 3), 1 / 3, np.float32)
    known = P[:2]
    index = np.zeros((2, 3), np.int32)
    layers = MapLayers(index, known, uniform, known, np.ones(2, np.float32), np.ones(2, np.int32))
    truth = np.array([0, 1])
    assert score_layers(layers, "kd", truth).overall == 1
    assert score_layers(layers, "combined", truth).overall == 1
    assert score_layers(layers, "texture", truth).rejected == 1
