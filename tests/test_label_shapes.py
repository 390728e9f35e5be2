"""Polygons to label images and back."""

import json
from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from calibration.label.shapes import Shape, outlines, rasterise
from calibration.label.state import LabelState, ViewState, load_state, save_state
from surfclass.errors import InputError
from surfclass.schema import validate

label_images = arrays(np.uint8, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.integers(0, 3))
finite = st.floats(-20_000, 20_000)
shapes = st.builds(
    Shape,
    label=st.integers(0, 254),
    points=st.lists(st.tuples(finite, finite), min_size=3, max_size=9).map(tuple),
)


def empty(h, w):
    return np.zeros((h, w), np.uint8)


@given(label_images, st.integers(1, 3))
@settings(deadline=None)
def test_outlines_paint_their_label_image_again_to_the_pixel(label, enlarged):
    label = np.kron(label, np.ones((enlarged, enlarged), np.uint8))
    assert np.array_equal(rasterise(outlines(label), np.zeros_like(label)), label)


def test_a_ring_keeps_its_hole_and_what_is_in_it():
    label = empty(60, 80)
    label[5:50, 5:70] = 2
    label[15:40, 15:60] = 0
    label[20:30, 20:30] = 1
    found = outlines(label)
    assert [shape.label for shape in found] == [2, 0, 1]
    assert np.array_equal(rasterise(found, empty(60, 80)), label)


def test_smooth_outlines_have_fewer_corners_and_stay_near():
    label = empty(200, 200)
    cv2.circle(label, (100, 100), 70, 1, -1)
    exact, smooth = outlines(label)[0], outlines(label, tolerance_px=1.0)[0]
    assert len(smooth.points) < len(exact.points) / 2
    kernel = np.ones((3, 3), np.uint8)
    far = (rasterise([smooth], empty(200, 200)) != label) & (
        cv2.erode(label, kernel) == cv2.dilate(label, kernel)
    )
    assert far.sum() <= 4


def test_small_regions_and_small_holes_are_left_out():
    label = empty(50, 50)
    label[10:40, 10:40] = 1
    label[20:22, 20:22] = 0
    label[2:4, 2:4] = 2
    painted = rasterise(outlines(label, least_px=5, least_hole_px=5), empty(50, 50))
    assert set(np.unique(painted)) == {0, 1}
    assert (painted == 1).sum() == 900


def test_what_is_unlabelled_outside_of_everything_needs_no_shape():
    label = empty(50, 50)
    label[10:40, 20:25] = label[10:15, 20:45] = 1
    assert [shape.label for shape in outlines(label)] == [1]


def test_the_last_shape_is_on_top_and_zero_erases_what_lies_below():
    square = Shape(label=3, points=((2, 2), (8, 2), (8, 8), (2, 8)))
    hole = Shape(label=0, points=((4, 4), (6, 4), (6, 6), (4, 6)))
    below = np.full((12, 12), 7, np.uint8)
    painted = rasterise([square, hole], below)
    assert (painted[5, 5], painted[3, 3], painted[0, 0]) == (0, 3, 7)
    assert rasterise([hole, square], below)[5, 5] == 3
    assert (below == 7).all()


def test_pixel_zero_is_the_centre_of_the_first_pixel():
    painted = rasterise(
        [Shape(label=1, points=((-0.4, -0.4), (1.4, -0.4), (1.4, 0.4), (-0.4, 0.4)))], empty(4, 4)
    )
    assert painted[0].tolist() == [1, 1, 0, 0]
    assert painted.sum() == 2


@given(st.lists(shapes, max_size=4))
@settings(deadline=None)
def test_shapes_far_outside_the_image_paint_and_travel_as_any(drawn):
    painted = rasterise(drawn, empty(20, 30))
    assert set(np.unique(painted)) <= {0, *(shape.label for shape in drawn)}
    state = ViewState(shapes=tuple(drawn))
    assert validate(ViewState, json.loads(state.model_dump_json()), "x") == state


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["shapes", "label", "points", "role", "below", "revision", "x"]),
            inner,
            max_size=5,
        )
    ),
    max_leaves=15,
)


@given(st.dictionaries(st.sampled_from(["shapes", "role", "below", "revision", "y"]), json_values))
def test_any_other_object_is_a_drawing_or_refused_with_its_faults(data):
    with suppress(InputError):  # and no other error
        validate(ViewState, data, "drawing")


@pytest.mark.parametrize(
    ("shape", "fault"),
    [
        ({"label": 255, "points": [[0, 0]] * 3}, "label"),
        ({"label": 1.0, "points": [[0, 0]] * 3}, "label"),
        ({"label": True, "points": [[0, 0]] * 3}, "label"),
        ({"label": 1, "points": [[0, 0]] * 2}, "at least 3"),
        ({"label": 1, "points": [[0, 0, 0]] * 3}, "points"),
        ({"label": 1, "points": [[0, 1e9]] * 3}, "points"),
        ({"label": 1, "points": [["0", 0]] * 3}, "points"),
    ],
)
def test_a_shape_that_is_none_is_refused_by_its_path(shape, fault):
    with pytest.raises(InputError, match=fault):
        validate(ViewState, {"shapes": [shape]}, "drawing")


def drawn_on(recording="abc", classes=("a", "b")):
    square = Shape(label=1, points=((0, 0), (5, 0), (5, 5.25)))
    return LabelState(
        recording=recording, classes=classes, views={"v": ViewState(shapes=(square,), role="test")}
    )


def test_the_state_comes_back_as_it_was_saved(tmp_path):
    path = tmp_path / "state.json"
    assert load_state(path, "abc", ("a", "b")) == LabelState(recording="abc", classes=("a", "b"))
    save_state(path, drawn_on())
    assert load_state(path, "abc", ("a", "b")) == drawn_on()
    assert load_state(path, "abc", ("a", "b", "c")).classes == ("a", "b", "c")


def test_a_state_of_another_recording_or_other_classes_is_not_used(tmp_path):
    path = tmp_path / "state.json"
    save_state(path, drawn_on())
    with pytest.raises(InputError, match="another recording"):
        load_state(path, "abd", ("a", "b"))
    for classes in (("b", "a"), ("a",), ("x", "b")):
        with pytest.raises(InputError, match="classes may be added at the end only"):
            load_state(path, "abc", classes)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\xff", b"[" * 5000, b'{"schema": 2}', b'{"views": 3}'])
def test_a_damaged_state_is_refused_and_left_where_it_is(tmp_path, text):
    path = tmp_path / "state.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match=r"state\.json"):
        load_state(path, "abc", ("a", "b"))
    assert path.read_bytes() == text
