"""Five closed forms of A X = X B, on exact and on real pose pairs."""

import json

import numpy as np
import pytest
from hand_eye_world import transform
from scipy.spatial.transform import Rotation

from calibration.hand_eye.closed_forms import METHODS, pair_motions, solve_all
from calibration.rotations import difference
from surfclass.errors import InputError
from surfclass.types import Transform

PUBLISHED_SHIFT = np.array([0.659, -0.249, 0.830])
PUBLISHED_EULER = (0.230, -2.540, 1.950)


def pairs(x, count=8, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    y = transform("a", "b", [1, 2, 0.1], [1, 0, 0.5]).matrix
    flange = np.stack(
        [transform("a", "b", rng.normal(size=3), rng.normal(size=3)).matrix for _ in range(count)]
    )
    shaken = [
        transform("a", "b", noise * rng.normal(size=3), noise * rng.normal(size=3)).matrix
        for _ in range(count)
    ]
    return flange, np.linalg.inv(flange @ x) @ y @ np.stack(shaken)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "vector",
    [
        (0.3, -1, 2),
        (0, 0, 0),
        (np.pi, 0, 0),  # half a turn, where Tsai's vector has no value
        (0, np.pi * np.sqrt(0.5), np.pi * np.sqrt(0.5)),
        (0, 0, np.pi - 1e-9),
    ],
)
def test_exact_pairs_give_the_exact_transform(method, vector):
    x = transform("a", "b", vector, [0.1, 0.2, 0.3]).matrix
    np.testing.assert_allclose(solve_all(*pairs(x))[method], x, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_three_poses_are_enough(method):
    x = transform("a", "b", [0.3, -1, 2], [0.1, 0.2, 0.3]).matrix
    np.testing.assert_allclose(solve_all(*pairs(x, count=3))[method], x, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_the_order_of_the_poses_does_not_matter(method):
    x = transform("a", "b", [0.3, -1, 2], [0.1, 0.2, 0.3]).matrix
    flange, target = pairs(x, noise=1e-3)
    order = np.random.default_rng(1).permutation(len(flange))
    first, again = (solve_all(flange, target), solve_all(flange[order], target[order]))
    np.testing.assert_allclose(again[method], first[method], atol=1e-10)


def test_two_poses_are_refused():
    with pytest.raises(InputError, match="3 or more"):
        pair_motions(np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(4), (2, 1, 1)))


def test_poses_that_do_not_turn_are_refused():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    with pytest.raises(InputError, match="no two poses differ by a turn"):
        solve_all(poses, poses)


@pytest.mark.parametrize("method", METHODS)
def test_real_pairs_give_the_published_answer_within_one_percent(method, shared):
    told = np.array(json.loads((shared / "data/hand_eye_pairs/pose_samples.json").read_text()))
    flange, target = told[:, 0], told[:, 1]
    x = solve_all(np.linalg.inv(flange), target)[method]
    shift = x[:3, 3]
    assert np.linalg.norm(shift - PUBLISHED_SHIFT) < 0.01 * np.linalg.norm(PUBLISHED_SHIFT)
    published = np.eye(4)
    published[:3, :3] = Rotation.from_euler("XYZ", PUBLISHED_EULER).as_matrix()
    published[:3, 3] = PUBLISHED_SHIFT
    turn = difference(Transform("base", "camera", x), Transform("base", "camera", published))[:3]
    assert np.linalg.norm(turn) < 0.01
