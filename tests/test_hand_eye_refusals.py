"""What hand-eye calibration refuses, and that it says why."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hand_eye_world import arm_looks, board, observed, transform, with_poses

from calibration.hand_eye.observability import axis_spread, motion_faults
from calibration.hand_eye.solution import solve
from calibration.outcome import RefusedError
from surfclass.kinematics import forward_kinematics


def refusal(observations):
    with pytest.raises(RefusedError) as caught:
        solve(observations, 0.084, lambda _: None)
    return " ".join(caught.value.reasons)


def inverted(observations):
    return with_poses(observations, lambda _, matrix: np.linalg.inv(matrix))


def test_two_poses_are_not_enough():
    clean = observed(0)
    assert "not enough poses: 2" in refusal(replace(clean, views=clean.views[:2]))


def test_the_same_pose_again_is_not_another_one():
    clean = observed(0)
    again = [replace(clean.views[k % 2], name=str(k)) for k in range(8)]
    assert "only 2 of 8 differ" in refusal(replace(clean, views=tuple(again)))


def test_poses_too_alike_are_refused_with_how_alike():
    said = refusal(observed(1, turns=(0.03, 0.03, 0.03)))
    assert "poses too alike" in said
    assert "needed are 10°" in said


@pytest.mark.parametrize(("joint", "seed"), [(0, 0), (5, 1)])
@pytest.mark.parametrize("probed_sd", [None, 3e-4])
def test_turns_about_one_axis_name_it_and_the_motion_that_is_missing(joint, seed, probed_sd):
    still = tuple(k for k in range(6) if k != joint)
    said = refusal(arm_looks(np.random.default_rng(seed), 3, board(), still=still, probed_sd=probed_sd))
    assert "insufficient rotation" in said
    middle = forward_kinematics(np.radians([0.0, 20.0, 90.0, 0.0, -20.0, 0.0]))
    axis = np.array([0.0, 0.0, 1.0]) if joint == 0 else middle.rotation[:, 2]
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    named = re.search(r"one axis only, base \((.*?)\)", said)
    assert [float(part) for part in named[1].split(",")] == pytest.approx(axis.tolist(), abs=0.006)
    assert "turn the flange about another axis" in said
    assert "by 30° or more" in said


def test_a_second_axis_is_enough():
    poses = [transform("base", "flange", vector, [1, 0, 0.1 * k]).matrix for k, vector in enumerate(
        [(0, 0, 0), (0, 0, 0.5), (0.5, 0, 0)])]  # fmt: skip
    assert motion_faults(np.stack(poses)) == []
    spread, axes = axis_spread(np.stack([pose[:3, :3] for pose in poses]))
    assert spread[0] > spread[1] > spread[2]
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_base_and_hand_swapped_are_found_by_trying_both(mounting):
    said = refusal(inverted(observed(2, mounting=mounting)))
    assert "base and hand look swapped" in said
    assert "as flange_T_base to" in said
    assert "as base_T_flange to" in said


def test_the_wrong_mounting_is_the_same_mistake():
    said = refusal(replace(observed(3), mounting="eye_to_hand"))
    assert "the mounting is eye_in_hand, not eye_to_hand" in said


@pytest.mark.parametrize("kind", [{}, {"pixel_sd": None, "position_sd": 3e-4}])
def test_a_wrong_square_size_is_told_by_the_arms_motions(kind):
    said = refusal(observed(4, target=board(5, 4, 0.024), stated_scale=25 / 24, **kind))
    assert "squares (nearest points) look like 24.0 mm, not 25 mm" in said


def test_a_size_that_is_right_within_one_percent_passes():
    solve(observed(5, stated_scale=1.003), 0.084, lambda _: None)


def test_a_target_on_a_line_is_refused():
    line = np.column_stack([0.03 * np.arange(6), np.zeros(6), np.zeros(6)])
    assert "lie on a line" in refusal(observed(6, target=line))
    assert "2 points" in refusal(observed(6, target=line[:2]))


def test_views_of_other_poses_do_not_fit_together():
    clean = observed(7)
    mixed = with_poses(clean, lambda number, _: clean.views[(number + 5) % 14].base_T_flange.matrix)
    assert "do not fit" in refusal(mixed)


def test_too_many_wrong_poses_are_named_and_refused():
    def change(number, matrix):
        return matrix @ transform("flange", "flange", [0, 0, 0.1 * number], [0.01 * number, 0, 0]).matrix

    said = refusal(with_poses(observed(8, poses=8), lambda k, m: change(k, m) if k >= 3 else m))
    assert "do not fit" in said


def test_missing_intrinsics_that_the_views_cannot_tell_are_refused():
    clean = replace(observed(9), intrinsics=None)
    assert "intrinsics are missing" in refusal(replace(clean, views=clean.views[:3]))
    assert "both pixels and camera_m" in refusal(replace(observed(9, position_sd=1e-4), intrinsics=None))
