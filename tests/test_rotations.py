"""Rigid motions as six numbers, and the jackknife."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.resampling import jackknife_covariance
from calibration.rotations import difference, motion, rotation_matrix, rotation_vector, six_of, skew
from surfclass.errors import InputError

vectors = st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3).map(np.array)


@given(vectors)
def test_a_rotation_is_opencvs_and_comes_back(vector):
    matrix = rotation_matrix(vector)
    np.testing.assert_allclose(matrix, cv2.Rodrigues(vector)[0], atol=1e-12)
    if np.linalg.norm(vector) < np.pi:
        np.testing.assert_allclose(rotation_vector(matrix), vector, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, -0.8), (-0.48, 0.6, 0.64)])
def test_no_angle_and_half_a_turn_are_exact(angle, axis):
    again = rotation_matrix(rotation_vector(rotation_matrix(np.array(axis) * angle)))
    np.testing.assert_allclose(again, rotation_matrix(np.array(axis) * angle), atol=1e-9)


def test_many_rotations_at_once_are_each_by_itself():
    many = np.random.default_rng(0).normal(size=(4, 5, 3))
    matrices = rotation_matrix(many)
    np.testing.assert_array_equal(matrices[2, 3], rotation_matrix(many[2, 3]))
    np.testing.assert_array_equal(rotation_vector(matrices)[1, 4], rotation_vector(matrices[1, 4]))


@given(vectors, vectors)
def test_skew_is_the_cross_product(vector, point):
    np.testing.assert_allclose(skew(vector) @ point, np.cross(vector, point), atol=1e-12)


def test_a_motion_comes_back_and_differs_from_another_by_what_was_added():
    first = np.array([0.3, -0.2, 0.9, 0.1, 0.2, -0.3])
    there = motion(first, "base", "flange")
    np.testing.assert_allclose(six_of(there), first, atol=1e-12)
    small = np.array([1e-4, -2e-4, 3e-4])
    turned = motion([*small, 0.0, 0.0, 0.0], "flange", "flange")
    np.testing.assert_allclose(difference(there @ turned, there), [*small, 0, 0, 0], atol=1e-12)


def test_the_jackknife_of_a_mean_is_the_variance_of_the_mean():
    data = np.random.default_rng(1).normal(size=(40, 2))
    left_out = (data.sum(axis=0) - data) / 39
    np.testing.assert_allclose(jackknife_covariance(left_out), np.cov(data.T) / 40, rtol=1e-9)


def test_one_estimate_has_no_jackknife():
    with pytest.raises(InputError, match="2 or more"):
        jackknife_covariance(np.zeros((1, 3)))
