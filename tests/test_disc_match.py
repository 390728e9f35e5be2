"""Which disc is which: in any order, some missing, some false, on symmetric plates, with wrong positions."""

import numpy as np
import pytest
from disc_scenes import CAMERA, PLACES_M, RADIUS_M

from calibration.hand_eye import discs
from calibration.hand_eye.discs_match import arrangements
from calibration.hand_eye.discs_seen import Disc, Rejected, Sighting
from calibration.outcome import RefusedError
from calibration.rotations import difference, motion
from drivers.recordings.plate import Plate
from surfclass.errors import InputError
from surfclass.frames import Capture, DepthFrame, JointState
from surfclass.geometry import project
from surfclass.kinematics import forward_kinematics
from surfclass.rig import DepthRig
from surfclass.types import Transform

GRID = np.array([[0.1 * i, 0.1 * j, 0.0] for i in range(3) for j in range(3)]) - [0.1, 0.1, 0]
# Upright before the arm, as a plate stands.
BASE_T_PLATE = motion(np.array([0, np.pi / 2, 0, 1.2, 0.05, 0.6]), "base", "plate")
MOUNT = motion(np.array([0.02, 0.03, -1.5, 0.05, -0.02, 0.08]), "flange", "depth")
QUIET = DepthFrame(0, 0, None, np.zeros(CAMERA.shape, np.uint16), np.zeros(CAMERA.shape, np.uint16))


def scene(rng, places, missing=0, false=0, noise=0.0005):
    """Found centres in the camera's frame, which place each is (−1: none), and the truth."""
    pose = motion(np.concatenate([rng.normal(size=3), rng.normal(size=3)]), "depth", "base")
    order = rng.permutation(len(places))[: len(places) - missing]
    found = pose @ places[order] + rng.normal(0, noise, (len(order), 3))
    fake = found.mean(axis=0) + rng.uniform(-0.3, 0.3, (false, 3))
    mixed = rng.permutation(len(found) + false)
    return np.concatenate([found, fake])[mixed], np.concatenate([order, -np.ones(false, int)])[mixed], pose


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("missing", "false", "noise"), [(0, 0, 0.003), (3, 0, 0.001), (0, 5, 0.001), (3, 4, 0.001)]
)
def test_discs_find_their_positions_in_any_order(seed, missing, false, noise):
    found, which, pose = scene(np.random.default_rng(seed), PLACES_M, missing, false, noise)
    (way,) = arrangements(found, PLACES_M)
    assert which[way.found].tolist() == way.known.tolist()
    assert len(way.found) == 9 - missing
    assert np.abs(difference(way.base_T_depth, pose.inverse)[3:]).max() < 0.05


def test_a_wrong_position_is_not_matched_and_spoils_no_other():
    places = PLACES_M.copy()
    places[3] += [0.03, 0.02, 0]
    found, which, _ = scene(np.random.default_rng(1), PLACES_M)
    (way,) = arrangements(found, places)
    assert which[way.found].tolist() == way.known.tolist()
    assert 3 not in way.known
    assert len(way.found) == 8


@pytest.mark.parametrize(("places", "ways"), [(GRID, 8), (GRID[:6], 4), (GRID * [1, 1.3, 1], 4)])
def test_a_symmetric_layout_is_told_in_all_its_ways(places, ways):
    found, which, _ = scene(np.random.default_rng(2), places)
    several = arrangements(found, places)
    assert len(several) == ways
    assert any(which[way.found].tolist() == way.known.tolist() for way in several)


def test_what_lies_differently_or_is_too_little_matches_nothing():
    rng = np.random.default_rng(3)
    assert arrangements(rng.uniform(-0.3, 0.3, (9, 3)), PLACES_M) == []
    assert arrangements(PLACES_M[:3], PLACES_M) == []
    assert arrangements(np.zeros((0, 3)), PLACES_M) == []
    line = np.column_stack([np.arange(5) * 0.1, np.zeros(5), np.zeros(5)])
    assert arrangements(line, line) == []


def disc(camera_m):
    pixel = project(camera_m, CAMERA)
    small = np.eye(3) * 1e-8
    return Disc(
        pixel, np.eye(2) * 0.01, camera_m, small, np.array([0, 0, -1.0]), 0.0, 0.1, 1.0, 0.0, False, pixel
    )


@pytest.fixture
def world(monkeypatch):
    """A recording whose detector sees exact centres, with noise: `world(places, …)` returns its parts."""

    def made(places, q, known=None, hidden=(), noise=0.0003):
        rng = np.random.default_rng(9)
        base_m = BASE_T_PLATE @ places
        sightings, captures = {}, []
        for number, angles in enumerate(q):
            depth_T_base = (forward_kinematics(angles) @ MOUNT).inverse
            order = [i for i in rng.permutation(len(places)) if i not in hidden]
            seen = (depth_T_base @ base_m)[order] + rng.normal(0, noise, (len(order), 3))
            frame = DepthFrame(number, number, None, QUIET.depth_mm, QUIET.ir)
            sightings[number] = Sighting(tuple(disc(point) for point in seen), ())
            captures.append(Capture(f"v{number}", "hand_eye", frame, None, joints=JointState(0, 0, angles)))
        monkeypatch.setattr(
            discs, "look_for_discs", lambda frame, camera, radius, depth: sightings[frame.sequence]
        )
        rig = DepthRig.model_validate({"schema": 1, "name": "t", "voxel_size_m": 0.01, "depth": CAMERA})
        known = base_m if known is None else known
        plate = Plate(disc_radius_m=RADIUS_M, positions_base_m=tuple(map(tuple, known.tolist())))
        return captures, rig, plate, sightings

    return made


def mounts(observed):
    """What each view says of the camera's mounting."""
    from calibration.hand_eye.single_pose import align

    return [
        view.base_T_flange.inverse @ align(view.positions.camera_m, view.positions.target_m, "base", "depth")
        for view in observed.views
    ]


def looking(count):
    """Joint angles whose cameras face the plate: found by trying, so that depths are positive."""
    rng, chosen = np.random.default_rng(4), []
    while len(chosen) < count:
        q = np.array([0.0, 0.2, 1.5, 0.0, -0.2, 0.0]) + rng.uniform(-1, 1, 6) * [0.5, 0.6, 0.6, 1.0, 1.0, 2.0]
        depth_T_base: Transform = (forward_kinematics(q) @ MOUNT).inverse
        if (depth_T_base @ (BASE_T_PLATE @ GRID))[:, 2].min() > 0.3:
            chosen.append(q)
    return np.array(chosen)


def test_observations_carry_every_view_its_pixels_places_and_priors(world):
    captures, rig, plate, _ = world(PLACES_M, q=looking(5))
    notes = []
    seen = discs.observe(captures, rig, plate, notes.append)
    assert notes == []
    assert seen.mounting == "eye_in_hand"
    assert [view.name for view in seen.views] == ["v0", "v1", "v2", "v3", "v4"]
    assert all(view.count == 9 for view in seen.views)
    assert seen.intrinsics.fx == CAMERA.fx
    assert seen.image_size == CAMERA.size
    assert seen.probed.fixed_m == pytest.approx(seen.probed.target_m)
    assert seen.probed.sd_m == pytest.approx(0.0003)
    for view, mount in zip(seen.views, mounts(seen), strict=True):
        assert project(view.positions.camera_m, CAMERA) == pytest.approx(view.pixels.pixel)
        away = difference(mount, MOUNT)
        assert np.linalg.norm(away[:3]) < 0.01
        assert np.linalg.norm(away[3:]) < 0.01


def test_several_views_tell_a_symmetric_plate_apart_by_the_mounting_they_agree_on(world):
    captures, rig, plate, _ = world(GRID, q=looking(6))
    seen = discs.observe(captures, rig, plate, lambda _: None)
    assert len(seen.views) == 6
    for mount in mounts(seen):
        assert np.linalg.norm(difference(mount, MOUNT)[:3]) < 0.02
        assert np.linalg.norm(difference(mount, MOUNT)[3:]) < 0.02


@pytest.mark.parametrize("copies", [1, 5])
def test_a_symmetric_plate_from_one_place_is_refused(world, copies):
    captures, rig, plate, _ = world(GRID, q=np.repeat(looking(1), copies, axis=0))
    with pytest.raises(RefusedError, match="symmetric") as caught:
        discs.observe(captures, rig, plate, lambda _: None)
    assert "8 ways" in str(caught.value)


@pytest.mark.parametrize("off", [(0.0, 0.004, 0.0), (0.0, 0.03, -0.02), (0.0, 0.25, 0.1)])
def test_the_one_wrong_position_is_named_and_left_out(world, off):
    known = BASE_T_PLATE @ PLACES_M
    known[5] += off
    captures, rig, plate, _ = world(PLACES_M, known=known, q=looking(6))
    notes = []
    seen = discs.observe(captures, rig, plate, notes.append)
    assert len(notes) == 1
    assert "position 6" in notes[0]
    assert (
        f"{1e3 * np.linalg.norm(off):.0f}." in notes[0] or f"{1e3 * np.linalg.norm(off) - 1:.0f}." in notes[0]
    )
    assert all(view.count == 8 for view in seen.views)
    assert len(seen.probed.target_m) == 8


def test_a_disc_that_is_never_seen_is_no_wrong_position(world):
    captures, rig, plate, _ = world(PLACES_M, hidden=(2, 7), q=looking(5))
    notes = []
    seen = discs.observe(captures, rig, plate, notes.append)
    assert notes == []
    assert all(view.count == 7 for view in seen.views)


def test_a_pose_that_was_read_wrong_stays_for_the_adjustment_to_find(world):
    captures, rig, plate, _ = world(PLACES_M, q=looking(6))
    wrong = Capture(
        "v2", "hand_eye", captures[2].depth, None, joints=JointState(0, 0, captures[2].joints.q + 0.05)
    )
    captures[2] = wrong
    seen = discs.observe(captures, rig, plate, lambda _: None)
    assert [view.name for view in seen.views] == [f"v{n}" for n in range(6)]


def test_views_without_enough_are_left_out_with_the_reason(world):
    captures, rig, plate, sightings = world(PLACES_M, q=looking(5))
    blob = Rejected(np.array([5.0, 5.0]), "cut off by the image's border", np.zeros((3, 2)))
    sightings[1] = Sighting(sightings[1].discs[:3], (blob,))
    sightings[2] = Sighting(
        tuple(disc(point) for point in np.random.default_rng(0).uniform(0.4, 0.8, (6, 3))), ()
    )
    captures[3] = Capture(
        "v3", "hand_eye", captures[3].depth, None, base_T_depth=Transform("base", "depth", np.eye(4))
    )
    dark = DepthFrame(4, 4, None, QUIET.depth_mm)
    captures[4] = Capture("v4", "hand_eye", dark, None, joints=captures[4].joints)
    notes = []
    seen = discs.observe(captures, rig, plate, notes.append)
    assert [view.name for view in seen.views] == ["v0"]
    assert [note.split(":")[0] for note in notes] == ["capture v1", "capture v2", "capture v3", "capture v4"]
    for note, why in zip(
        notes, ("3 discs found", "do not lie", "no joint angles", "no IR image"), strict=True
    ):
        assert why in note
    assert "border" in notes[0]


def test_the_rigs_own_corrections_of_arm_and_depth_are_applied(world, monkeypatch):
    captures, rig, plate, sightings = world(PLACES_M, q=looking(2))
    offsets = (0.0, 0.01, 0.0, 0.0, -0.02, 0.0)
    correction = {"multiplier": [1.02]}
    rig = rig.with_values({"arm": {"joint_offsets_rad": offsets}, "depth_correction": correction})
    bright = np.full(CAMERA.shape, 1000, np.uint16)
    moved = [
        Capture(
            one.name, "hand_eye", DepthFrame(0, n, None, bright, QUIET.ir), None, joints=JointState(0, 0, q)
        )
        for n, (one, q) in enumerate((one, one.joints.q - offsets) for one in captures)
    ]
    readings = []

    def look(frame, camera, radius, depth_mm):
        readings.append(float(depth_mm.mean()))
        return sightings[frame.sequence]

    monkeypatch.setattr(discs, "look_for_discs", look)
    seen = discs.observe(moved, rig, plate, lambda _: None)
    assert readings == pytest.approx([1020.0, 1020.0], abs=0.01)
    for view, capture in zip(seen.views, captures, strict=True):
        assert view.q == pytest.approx(capture.joints.q)
        assert view.base_T_flange.matrix == pytest.approx(forward_kinematics(capture.joints.q).matrix)


def test_nothing_seen_at_all_is_refused_and_a_wrong_image_size_is_an_error(world):
    captures, rig, plate, sightings = world(PLACES_M, q=looking(2))
    sightings.update({number: Sighting((), ()) for number in sightings})
    with pytest.raises(RefusedError, match=r"no view shows 4 or more discs of 25\.0 mm radius"):
        discs.observe(captures, rig, plate, lambda _: None)
    small = DepthFrame(0, 0, None, QUIET.depth_mm[:100], QUIET.ir[:100])
    with pytest.raises(InputError, match="640"):
        discs.observe(
            [Capture("s", "hand_eye", small, None, joints=captures[0].joints)], rig, plate, lambda _: None
        )
