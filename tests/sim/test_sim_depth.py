"""The simulated depth camera against the noise model that it states."""

import cv2
import numpy as np
import pytest

from drivers.sim import depth_camera, truth
from drivers.sim.arm import joints_of
from drivers.sim.scenes import DISC_PLACES_M as DISCS
from drivers.sim.world import SimWorld
from surfclass.types import Transform

SCALE = 0.5


@pytest.fixture(scope="module")
def card():
    return SimWorld("grey_card", scale=SCALE)


@pytest.fixture(scope="module")
def cell():
    return SimWorld("cell", scale=0.25)


@pytest.fixture(scope="module")
def discs():
    return SimWorld("reflector_discs", scale=SCALE)


def view(world, name):
    return next(one.q for one in world.viewpoints if one.name == name)


def readings(world, q, frames):
    images = [world.render_depth(q, key)[0] for key in range(frames)]
    return np.array(images, dtype=np.float64) / 1000


@pytest.mark.parametrize("name", ["at_0650", "at_1000", "at_1300"])
def test_the_axial_noise_is_the_stated_one(card, name):
    q = view(card, name)
    true = truth.depth(card, q).astype(np.float64)
    depth = readings(card, q, 6)
    on_card = cv2.erode((card.hits(q, "depth").face == 0).astype(np.uint8), np.ones((5, 5))) > 0
    error = np.where((depth > 0) & on_card, depth - true, np.nan)[:, 40:-40, 40:-40]
    step = depth_camera.DISPARITY_STEP_PX
    disparity_sd = np.sqrt(depth_camera.DISPARITY_SD_PX**2 + step**2 / 12)
    per_metre = card.package.depth.fx * card.package.projector_baseline_m
    wanted = np.nanmedian(true) ** 2 / per_metre * disparity_sd
    assert np.nanstd(error) == pytest.approx(wanted, rel=0.12)
    assert abs(np.nanmean(error)) < 0.1 * wanted + 0.0001


def test_noise_grows_with_the_square_of_the_distance(card):
    spread = []
    for name in ("at_0650", "at_1300"):
        q = view(card, name)
        depth = readings(card, q, 4)[:, 60:-60, 80:-80]
        true = truth.depth(card, q)[60:-60, 80:-80]
        spread.append(np.nanstd(np.where(depth > 0, depth - true, np.nan)))
    assert spread[1] / spread[0] == pytest.approx(4, rel=0.15)


def test_depth_comes_in_steps_of_an_eighth_of_a_pixel_of_disparity(card):
    depth = readings(card, view(card, "at_1000"), 1)[0]
    levels = np.unique(depth[depth > 0])
    disparity = depth_camera.disparity_per_metre(card.package) / levels
    # Millimetre rounding moves a level by up to half a millimetre.
    slack = 0.00051 * disparity / levels * 8
    off = np.abs(8 * disparity - np.round(8 * disparity))
    assert (off <= slack + 1e-6).all()
    assert np.median(np.diff(np.round(8 * disparity))) == -1


def test_neighbours_share_their_noise(card):
    q = view(card, "at_1000")
    error = readings(card, q, 1)[0] - truth.depth(card, q)
    error[np.abs(error) > 0.1] = 0
    middle = error[60:-60, 80:-80]
    near = np.corrcoef(middle[:, :-1].ravel(), middle[:, 1:].ravel())[0, 1]
    far = np.corrcoef(middle[:, :-20].ravel(), middle[:, 20:].ravel())[0, 1]
    assert near > 0.3
    assert abs(far) < 0.15


def test_frames_differ_and_a_frame_repeats(card):
    q = view(card, "at_0800")
    first, again, other = (card.render_depth(q, key)[0] for key in (5, 5, 6))
    assert (first == again).all()
    assert (first != other).mean() > 0.3


def test_nothing_nearer_than_half_a_metre_is_measured():
    world = SimWorld("checkerboard", scale=SCALE)
    first = world.viewpoints[0]
    for step_m, kept in ((0.0, 0.95), (0.16, 0.0)):
        pose = first.base_T_rgb.matrix.copy()
        pose[:3, 3] += step_m * pose[:3, 2]
        flange = Transform("base", "rgb", pose) @ world.package.flange_T_rgb.inverse
        q = joints_of(flange, first.q)
        on_board = cv2.erode((world.hits(q, "depth").face == 0).astype(np.uint8), np.ones((5, 5))) > 0
        depth, _ = world.render_depth(q, 1)
        assert on_board.sum() > 1000
        assert abs((depth[on_board] > 0).mean() - kept) < 0.05


def test_grazing_places_are_lost_and_facing_ones_kept(cell):
    lost, cosine = [], []
    for one in cell.viewpoints[:12]:
        seen = truth.surface(cell, one.q, "depth")
        away = -seen.point / np.maximum(np.linalg.norm(seen.point, axis=0), 1e-6)
        cosine.append((seen.normal * away).sum(axis=0)[seen.hit])
        lost.append(cell.render_depth(one.q, 1)[0][seen.hit] == 0)
    lost, cosine = np.concatenate(lost), np.concatenate(cosine)
    assert lost[cosine < 0.15].mean() > 0.9
    assert lost[cosine > 0.9].mean() < 0.15
    assert 0.15 < lost[(cosine > 0.22) & (cosine < 0.36)].mean() < 0.95


def test_the_projector_throws_a_shadow_on_one_side_only(discs):
    """Beside the plate the wall behind is hidden from the projector but not from the camera."""
    q = discs.viewpoints[0].q
    hits = discs.hits(q, "depth")
    plate = hits.face == 0
    depth = discs.render_depth(q, 1)[0]
    rows = slice(plate.shape[0] // 2 - 20, plate.shape[0] // 2 + 20)
    columns = np.flatnonzero(plate[rows].all(axis=0))
    left, right = columns[0], columns[-1]
    z, wall = hits.z[rows][:, columns].mean(), hits.z[rows, :5].mean()
    width = discs.package.depth.fx * discs.package.projector_baseline_m * (1 / z - 1 / wall)
    inner = round(0.2 * width), round(0.8 * width)
    assert (depth[rows, left - inner[1] : left - inner[0]] == 0).mean() > 0.9
    assert (depth[rows, right + inner[0] + 3 : right + inner[1] + 3] == 0).mean() < 0.3


def test_a_flat_facing_card_is_nearly_whole(card):
    q = view(card, "at_0800")
    depth = card.render_depth(q, 3)[0][20:-20, 20:-20]
    assert 0.002 < (depth == 0).mean() < 0.05


def test_reflector_discs_stand_out_in_the_infrared(discs):
    q = discs.viewpoints[0].q
    _, ir = discs.render_depth(q, 1)
    hits = discs.hits(q, "depth")
    at = (
        hits.s[..., None] - np.array([[s for s, _ in DISCS]]),
        hits.t[..., None] - np.array([[t for _, t in DISCS]]),
    )
    distance = np.hypot(*at).min(axis=-1)
    on_plate = hits.face == 0
    assert ir.max() <= 1023
    assert ir[on_plate & (distance < 0.025)].mean() > 6 * ir[on_plate & (distance > 0.04)].mean()


def test_the_speckle_belongs_to_the_projector_not_to_the_frame(card):
    q = view(card, "at_0800")
    first, second = (card.render_depth(q, key)[1].astype(float) for key in (1, 2))
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.8
    assert first[100:140, 140:180].std() > 0.25 * first[100:140, 140:180].mean()


def test_truth_is_flat_where_the_surface_is(card):
    q = view(card, "turned_20")
    normals = truth.normal(card, q)
    on_card = card.hits(q, "depth").face == 0
    assert np.ptp(normals[:, on_card], axis=1).max() < 1e-6
    assert (np.einsum("kij,kij->ij", normals, truth.surface(card, q, "depth").point)[on_card] < 0).all()
    plane = np.einsum("kij,kij->ij", normals, truth.surface(card, q, "depth").point)[on_card]
    assert np.ptp(plane) < 1e-5
