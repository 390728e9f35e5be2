"""Labels carried from view to view, against the simulated cell's truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.label.propagation import LabelVoxels, SeenPoints, seen_points, suggested_labels
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import DepthFrame
from surfclass.rig import parse_rig
from surfclass.types import Transform

SCALE = 0.3
VIEWS = (0, 3, 8, 11, 13, 14)  # near, from above, into a corner, 49°, and two of the whole


@pytest.fixture(scope="module")
def cell():
    """Rig, true labels and seen points of some views."""
    world = SimWorld("cell", seed=3, scale=SCALE)
    rig = parse_rig(truth.rig(world), "rig")
    labels, seen = [], []
    for index in VIEWS:
        q = world.viewpoints[index].q
        depth_mm, _ = world.render_depth(q, index)
        labels.append(truth.label_image(world, q))
        seen.append(seen_points(DepthFrame(0, index, None, depth_mm), truth.base_T_depth(world, q), rig))
    return rig, labels, seen


def test_a_view_whose_depth_is_corrected_sees_the_same_places(cell):
    rig, _, seen = cell
    world = SimWorld("cell", seed=3, scale=SCALE)
    q = world.viewpoints[0].q
    depth_mm, _ = world.render_depth(q, 0)
    wrong = np.rint(depth_mm / 0.95).astype(np.uint16)
    corrected = rig.with_values({"depth_correction": {"multiplier": [0.95]}})
    again = seen_points(DepthFrame(0, 0, None, wrong), truth.base_T_depth(world, q), corrected)
    both = again.has_point & seen[0].has_point
    assert both.mean() > 0.7
    assert np.abs(again.point_base - seen[0].point_base)[:, both].max() < 0.002


def away_from_edges(label, reach_px):
    kernel = np.ones((2 * reach_px + 1,) * 2, np.uint8)
    return cv2.dilate(label, kernel) == cv2.erode(label, kernel)


@pytest.mark.parametrize("source", range(len(VIEWS)))
def test_one_views_truth_is_the_truth_of_every_other_view(cell, source):
    rig, labels, seen = cell
    voxels = LabelVoxels(seen[source], labels[source], rig.voxel_size_m)
    for target in set(range(len(VIEWS))) - {source}:
        found = suggested_labels(seen[target], [voxels], labels[target].shape)
        says, right = found > 0, found == labels[target]
        assert right[says].mean() > 0.97  # edges and all
        assert right[says & away_from_edges(labels[target], 3)].mean() > 0.997


def test_a_view_of_the_whole_says_something_nearly_everywhere_it_looked(cell):
    rig, labels, seen = cell
    source, target = VIEWS.index(13), VIEWS.index(3)
    voxels = LabelVoxels(seen[source], labels[source], rig.voxel_size_m)
    found = suggested_labels(seen[target], [voxels], labels[target].shape)
    assert (found > 0).sum() > 0.7 * (labels[target] > 0).sum()


def flat(z, shape=(40, 50), pitch=0.002):
    """What a camera that moves with its image would see of a plane at depth z: pixels on a metric grid."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) * np.float32(pitch)
    point = np.stack([x, y, np.full(shape, z, np.float32)])
    return SeenPoints(point, np.full(shape, pitch, np.float32), np.ones(shape, bool), 1)


def test_what_stands_in_front_of_a_labelled_surface_gets_nothing_of_it():
    label = np.full((40, 50), 2, np.uint8)
    voxels = LabelVoxels(flat(1.0), label, 0.01)
    partly = flat(1.0)
    partly.point_base[2, :, 25:] = 0.9
    found = suggested_labels(partly, [voxels], label.shape)
    assert (found[:, :25] == 2).all()
    assert not found[:, 25:].any()


def test_unlabelled_surface_bounds_the_label_to_less_than_a_voxel():
    label = np.zeros((40, 50), np.uint8)
    label[:, :23] = 1
    found = suggested_labels(flat(1.0), [LabelVoxels(flat(1.0), label, 0.01)], label.shape)
    assert (found != label)[:, [*range(21), *range(25, 50)]].sum() == 0


def test_a_view_that_left_a_place_unlabelled_does_not_outvote_one_that_labelled_it():
    half, other = np.zeros((40, 50), np.uint8), np.zeros((40, 50), np.uint8)
    half[:, :20], other[:, 20:] = 1, 3
    sources = [LabelVoxels(flat(1.0), label, 0.01) for label in (half, other)]
    found = suggested_labels(flat(1.0), sources, half.shape)
    assert (found[:, :17] == 1).all()
    assert (found[:, 23:] == 3).all()


def test_views_that_contradict_each_other_leave_the_place_to_a_person():
    one, two = np.full((40, 50), 1, np.uint8), np.full((40, 50), 2, np.uint8)
    sources = [LabelVoxels(flat(1.0), label, 0.01) for label in (one, two)]
    assert not suggested_labels(flat(1.0), sources, one.shape).any()
    assert (suggested_labels(flat(1.0), [*sources, sources[0]], one.shape) != 2).all()


@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.floats(0, np.pi),
    st.lists(st.integers(0, 3), min_size=1, max_size=3),
)
@settings(max_examples=25, deadline=None)
def test_where_everything_stands_in_base_changes_nothing(shift, turn, stripes):
    label = np.kron(np.array([stripes], np.uint8), np.ones((40, 50 // len(stripes)), np.uint8))
    label = np.pad(label, ((0, 0), (0, 50 - label.shape[1])), mode="edge")
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    matrix[:3, 3] = shift
    view = flat(1.0)
    moved = SeenPoints(
        Transform("base", "x", matrix).move_planes(view.point_base), view.pitch_m, view.has_point, 1
    )
    found = suggested_labels(moved, [LabelVoxels(moved, label, 0.01)], label.shape)
    inner = away_from_edges(label, 4)
    assert np.array_equal(found[inner], label[inner])


@given(st.lists(st.integers(0, 5), min_size=1, max_size=4))
@settings(max_examples=20, deadline=None)
def test_the_order_of_the_sources_and_of_their_pixels_does_not_matter(values):
    labels = [np.full((40, 50), value, np.uint8) for value in values]
    for index, label in enumerate(labels):
        label[:, 10 * index : 10 * index + 5] = 0
    forward = [LabelVoxels(flat(1.0), label, 0.01) for label in labels]
    backward = [
        LabelVoxels(replace(flat(1.0), point_base=flat(1.0).point_base[:, ::-1]), label[::-1].copy(), 0.01)
        for label in reversed(labels)
    ]
    one, two = (suggested_labels(flat(1.0), said, (40, 50)) for said in (forward, backward))
    assert (one != two).mean() < 0.01  # ties of float32 sums


def test_nothing_seen_and_nothing_said_are_no_fault():
    blind = replace(flat(1.0), has_point=np.zeros((40, 50), bool))
    said = LabelVoxels(blind, np.ones((40, 50), np.uint8), 0.01)
    assert not suggested_labels(flat(1.0), [said], (40, 50)).any()
    assert not suggested_labels(
        blind, [LabelVoxels(flat(1.0), np.ones((40, 50), np.uint8), 0.01)], (40, 50)
    ).any()
    assert not suggested_labels(flat(1.0), [], (40, 50)).any()


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="label image"):
        LabelVoxels(flat(1.0), np.ones((39, 50), np.uint8), 0.01)
    with pytest.raises(ConfigurationError, match="voxel_size_m"):
        LabelVoxels(flat(1.0), np.ones((40, 50), np.uint8), 0.0)
