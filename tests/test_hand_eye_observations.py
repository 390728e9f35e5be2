"""The observations file: what it says comes back, and every fault is named by its path."""

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.hand_eye.observations import Observations, Pixels, Positions, Probed, View
from calibration.hand_eye.observations_file import parse_observations, read_observations
from surfclass.errors import ConfigurationError, InputError
from surfclass.types import Transform

EYE = np.eye(4).tolist()
numbers = st.floats(-10, 10).map(lambda value: round(value, 6))
triples = st.lists(numbers, min_size=3, max_size=3)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


def told(**changes):
    point = {"target_m": [0, 0, 0], "pixel": [10, 20], "camera_m": [0.1, 0.2, 0.9]}
    pose = {"base_T_flange": EYE, "points": [point]}
    return {
        "schema": 1,
        "mounting": "eye_in_hand",
        "image_size": [640, 480],
        "intrinsics": {"fx": 500, "fy": 501.0, "cx": 320, "cy": 240, "distortion": [0, 0, 0, 0, 0]},
        "poses": [pose],
        **changes,
    }


def parsed(data):
    return parse_observations(json.dumps(data), "obs.json")


def with_point(**changes):
    data = told()
    data["poses"][0]["points"][0] |= changes
    return {**data, "poses": json.loads(json.dumps(data["poses"]))}


def test_a_file_says_all_that_it_holds():
    data = told(target_prior_base_m=[{"target_m": [0, 0, 0], "position_m": [1, 2, 3], "sd_m": 0.001}])
    data["poses"][0] |= {"name": "left", "q": [0, 0.1, 0.2, 0.3, 0.4, 0.5]}
    data["poses"][0]["points"].append({"target_m": [1, 0, 0], "camera_m": [0, 0, 1], "sd_m": 0.5})
    seen = parsed(data)
    view = seen.views[0]
    assert (seen.mounting, seen.image_size, view.name, view.count) == ("eye_in_hand", (640, 480), "left", 2)
    assert seen.intrinsics.vector[:4].tolist() == [500, 501, 320, 240]
    assert view.pixels.pixel.tolist() == [[10, 20]]
    assert view.positions.sd_m.tolist() == [1.0, 0.5]
    assert view.q[5] == 0.5
    assert seen.probed.fixed_m.tolist() == [[1, 2, 3]]


def test_a_pose_of_the_target_stands_for_points():
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.2, 0.7]
    seen = parsed(told(poses=[{"base_T_flange": EYE, "camera_T_target": pose.tolist()}], intrinsics=None))
    positions = seen.views[0].positions
    np.testing.assert_allclose(positions.camera_m - positions.target_m, np.tile(pose[:3, 3], (6, 1)))
    assert seen.views[0].sizeless


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (told(schema=2), "schema: unknown schema, allowed is 1"),
        (told(mounting="hand_in_eye"), "mounting: input should be 'eye_in_hand' or 'eye_to_hand'"),
        (told(poses=[]), "poses"),
        (told(pose=[]), "pose: unknown key; did you mean 'poses'?"),
        (told(image_size=[640, 0]), "image_size.1"),
        (with_point(pixel=[1, 2, 3]), "poses.0.points.0.pixel"),
        (with_point(pixel="1, 2"), "poses.0.points.0.pixel"),
        (with_point(target_m=[1, "2", 3]), "poses.0.points.0.target_m.1"),
        (with_point(camera_m=[0, 0, -1]), "poses.0.points.0.camera_m: z must be positive"),
        (with_point(pixel=None, camera_m=None), "poses.0.points.0: a point needs a pixel, camera_m, or both"),
        (with_point(pixel=None, sd_px=1.0), "poses.0.points.0: sd_px without pixel"),
        (with_point(pixl=[1, 2]), "poses.0.points.0.pixl: unknown key; did you mean 'pixel'?"),
        (told(poses=[{"base_T_flange": EYE}]), "poses.0: needed is either points or camera_T_target"),
        (told(poses=[{"base_T_flange": (2 * np.eye(4)).tolist(), "points": []}]), "poses.0.base_T_flange"),
        (told(intrinsics={"fx": 0, "fy": 1, "cx": 1, "cy": 1}), "intrinsics.fx"),
        (
            told(target_prior_flange_m=[{"target_m": [0, 0, 0], "position_m": [0, 0, 0]}]),
            "not fixed in flange",
        ),
        (told(poses=told()["poses"] + [{"base_T_flange": EYE, "camera_T_target": EYE}]), "all need the same"),
        (told(poses=[{**told()["poses"][0], "name": "a"}] * 2), "two poses have the same name"),
        (
            told(poses=[{"base_T_flange": EYE, "points": told()["poses"][0]["points"] * 2}]),
            "the same target_m",
        ),
    ],
)
def test_faults_are_named_by_their_path(data, said):
    with pytest.raises(ConfigurationError, match=r"obs\.json") as caught:
        parsed(data)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "not a JSON file"),
        ("[]", "needed is an object"),
        ('{"schema": 1, "schema": 1}', "'schema' appears twice"),
        ('{"schema": NaN}', "schema"),
        (b"\xff\xfe", "not a JSON file"),
        ("[" * 100000, "not a JSON file"),
    ],
)
def test_what_is_no_such_file_says_so(text, said):
    with pytest.raises(ConfigurationError, match=said):
        parse_observations(text, "obs.json")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.json"):
        read_observations(tmp_path / "none.json")


@settings(max_examples=60, deadline=None)
@given(json_values)
def test_any_json_is_read_or_refused(value):
    with pytest.raises(ConfigurationError):
        parse_observations(json.dumps(value), "x")


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(["schema", "mounting", "image_size", "intrinsics", "poses"]), json_values)
def test_any_value_of_any_key_is_read_or_refused(key, value):
    with contextlib.suppress(ConfigurationError):
        assert isinstance(parsed(told(**{key: value})), Observations)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(triples, st.lists(numbers, min_size=2, max_size=2)), min_size=1, max_size=6))
def test_points_come_back_as_they_were(points):
    unique = {tuple(target): pixel for target, pixel in points}
    listed = [{"target_m": list(target), "pixel": pixel} for target, pixel in unique.items()]
    view = parsed(told(poses=[{"base_T_flange": EYE, "points": listed}])).views[0]
    assert view.pixels.target_m.tolist() == [list(target) for target in unique]
    assert view.pixels.pixel.tolist() == list(unique.values())
    assert not len(view.positions.target_m)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Pixels(np.zeros((2, 3)), np.zeros((3, 2))), "2 target points but 3"),
        (lambda: Pixels(np.zeros((2, 2)), np.zeros((2, 2))), "target_m"),
        (lambda: Pixels(np.zeros((1, 3)), np.full((1, 2), np.nan)), "finite"),
        (lambda: Pixels(np.zeros((1, 3)), np.zeros((1, 2)), np.zeros(1)), "positive"),
        (lambda: Positions(np.zeros((1, 3)), np.zeros((2, 3))), "1 target points but 2"),
        (lambda: Probed(np.zeros((2, 3)), np.zeros((2, 3))), "twice"),
        (lambda: Probed(np.zeros((0, 3)), np.zeros((0, 3))), "0 target points"),
        (lambda: View("a", Transform("base", "depth", np.eye(4))), "base_T_depth"),
        (lambda: View("a", Transform("base", "flange", np.eye(4)), q=np.zeros(5)), "6 finite"),
    ],
)
def test_values_refuse_what_makes_no_sense(make, said):
    with pytest.raises(InputError, match=said):
        make()
