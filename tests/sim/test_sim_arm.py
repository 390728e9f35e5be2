"""The simulated arm against the published figures of the VM-6083."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.sim.arm import LIMITS, Motion, flange_pose, joints_of


@pytest.mark.parametrize(
    ("degrees", "place"),
    [
        ((0, 0, 0, 0, 0, 0), (0.080, 0, 1.389)),
        ((0, 0, 90, 0, 0, 0), (0.709, 0, 0.960)),
        ((0, 45, 90, 0, 45, 0), (0.8376, 0, 0.4193)),
        ((0, 90, 0, 0, 0, 0), (1.094, 0, 0.575)),
    ],
)
def test_the_flange_is_where_the_tables_say(degrees, place):
    assert flange_pose(np.radians(degrees)).translation == pytest.approx(place, abs=6e-5)


def test_the_flange_points_along_its_published_axes():
    assert flange_pose(np.zeros(6)).rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert flange_pose(np.radians([0, 45, 90, 0, 45, 0])).rotation[:, 2] == pytest.approx(
        [0, 0, -1], abs=1e-12
    )


def translation(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    i, j = {"y": (2, 0), "z": (0, 1)}[axis]
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
@settings(deadline=None, max_examples=25)
def test_the_chain_equals_one_of_plain_translations(q):
    steps = [
        ((0, 0, 0.475), "z"),
        ((0.18, 0, 0), "y"),
        ((0, 0, 0.385), "y"),
        ((-0.1, 0, 0), "z"),
        ((0, 0, 0.445), "y"),
        ((0, 0, 0), "z"),
    ]
    pose = np.eye(4)
    for (place, axis), angle in zip(steps, q, strict=True):
        pose = pose @ translation(*place) @ turn(axis, angle)
    pose = pose @ translation(0, 0, 0.084)
    assert flange_pose(np.array(q)).matrix == pytest.approx(pose, abs=1e-12)


def test_the_flange_offset_moves_the_flange_along_its_axis():
    q = np.radians([10, 20, 30, 40, 50, 60])
    short, long = flange_pose(q, 0.084), flange_pose(q, 0.090)
    assert long.translation - short.translation == pytest.approx(0.006 * short.rotation[:, 2], abs=1e-12)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=60)
def test_the_inverse_finds_the_joints_again(seed):
    q = np.random.default_rng(seed).uniform(LIMITS[:, 0] + 0.05, LIMITS[:, 1] - 0.05)
    assert joints_of(flange_pose(q), q) == pytest.approx(q, abs=1e-6)


def test_what_is_out_of_reach_is_refused():
    far = flange_pose(np.radians([0, 90, 0, 0, 0, 0])).matrix.copy()
    far[0, 3] += 0.2
    pose = type(flange_pose(np.zeros(6)))("base", "flange", far)
    with pytest.raises(ValueError, match="no joint angles"):
        joints_of(pose, np.zeros(6))


def test_a_move_is_smooth_straight_and_no_faster_than_allowed():
    start, goal = np.zeros(6), np.radians([40, -20, 10, 0, 5, 90])
    motion = Motion(start, speed_rad_s=0.8)
    end = motion.move_to(goal, 1_000_000_000)
    times = np.arange(1_000_000_000, end + 1, 5_000_000)
    path = np.array([motion.at(int(t)) for t in times])
    speed = np.abs(np.diff(path, axis=0)).max() / 0.005
    assert 0.7 < speed <= 0.8 + 1e-3
    assert motion.at(0) == pytest.approx(start)
    assert motion.at(end) == pytest.approx(goal)
    share = path[len(path) // 3] / np.where(goal == 0, 1, goal)
    assert np.ptp(share[goal != 0]) < 1e-12  # all joints have gone the same part of their way


def test_rest_and_motion_are_told_apart():
    motion = Motion(np.zeros(6), 1.0)
    end = motion.move_to(np.full(6, 0.5), 1_000)
    assert motion.rests(0, 1_000)
    assert motion.rests(end, end + 10)
    assert not motion.rests(end - 10, end + 10)
    assert not motion.rests(1_200, 1_300)
