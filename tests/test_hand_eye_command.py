"""`calibrate hand-eye` from end to end, its guide, and what the rig takes over."""

import json

import cv2
import numpy as np
import pytest
from hand_eye_world import CAMERA, FLANGE_T_CAMERA, arm_looks, board, observed, transform, with_poses

from calibration.gates import HandEyeGates
from calibration.hand_eye.boards_seen import in_one_order
from calibration.hand_eye.command import Options, calibrate
from calibration.hand_eye.guide import HandEyeGuide, edge_width_px
from calibration.hand_eye.observations import Observations, Pixels, View
from calibration.hand_eye.solution import solve
from calibration.outcome import RefusedError
from calibration.rotations import difference
from calibration.source import Source
from drivers.recordings.board import Board
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState
from surfclass.kinematics import depth_pose, flange_pose, forward_kinematics
from surfclass.rig import Arm, DepthRig, parse_depth_rig
from surfclass.types import Transform

RIG = """
schema = 1
name = "one"
voxel_size_m = 0.01
[depth]
size = [640, 480]
fx = 585.0
fy = 585.0
cx = 319.5
cy = 239.5
"""


def quiet(_):
    pass


def as_json(observations):
    camera = observations.intrinsics
    told = {"schema": 1, "mounting": observations.mounting, "poses": []}
    if observations.image_size:
        told["image_size"] = list(observations.image_size)
    if camera:
        keys = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
        told["intrinsics"] = {**keys, "distortion": list(camera.distortion)}
    for view in observations.views:
        points = {}
        for part, key, values in (
            (view.pixels, "pixel", view.pixels.pixel),
            (view.positions, "camera_m", view.positions.camera_m),
        ):
            for target, value in zip(part.target_m.tolist(), values.tolist(), strict=True):
                points.setdefault(tuple(target), {"target_m": target})[key] = value
        pose = {"base_T_flange": view.base_T_flange.matrix.tolist(), "points": list(points.values())}
        if view.q is not None:
            pose["q"] = view.q.tolist()
        told["poses"].append(pose)
    return told


def calibrated(observations, tmp_path, gates=None, **options):
    path = tmp_path / "obs.json"
    path.write_text(json.dumps(as_json(observations)))
    return calibrate(None, Options(observations=path, **options), gates or HandEyeGates(), quiet)


def test_observations_give_everything_that_is_promised(tmp_path):
    outcome = calibrated(observed(0, position_sd=3e-4), tmp_path)
    result = outcome.result
    assert outcome.verdict == "pass"
    assert list(result)[:3] == ["schema", "verdict", "reasons"]
    found = Transform("flange", "camera", np.array(result["flange_T_camera"]))
    off = difference(found, FLANGE_T_CAMERA)
    sd = np.array(result["jackknife_sd"]["rotation_rad"] + result["jackknife_sd"]["translation_m"])
    assert (np.abs(off) < 4 * sd).all()
    assert result["leave_one_out_px"] > result["rms_px"] > result["adjusted_rms_px"] > 0
    assert result["leave_one_out_m"] > result["rms_m"] > 0
    assert result["outlier_poses"] == []
    assert result["base_T_target"][3] == [0, 0, 0, 1]
    assert set(result["closed_forms"]) == {"tsai", "park", "horaud", "daniilidis", "andreff"}
    assert all(
        result["leave_one_out_px"] < form["leave_one_out_px"] for form in result["closed_forms"].values()
    )
    assert result["next_poses"][0]["gain"] > 0
    assert outcome.rig == {"transforms": {"flange_T_depth": result["flange_T_camera"]}}
    assert "14 poses" in outcome.sentence
    assert "leave-one-out" in outcome.sentence
    json.dumps(dict(result), allow_nan=False)
    DepthRig.with_values(parse_depth_rig(RIG, "rig"), outcome.rig)
    for table in outcome.figures:
        assert all(len(row) == len(table.columns) for row in table.rows)


def test_a_fixed_camera_sets_no_hand_eye_of_the_rig(tmp_path):
    outcome = calibrated(observed(1, mounting="eye_to_hand"), tmp_path)
    assert outcome.rig == {}
    assert {"base_T_camera", "flange_T_target"} <= set(outcome.result)


def test_an_outlier_pose_fails_the_verdict_by_name_and_is_not_in_the_answer(tmp_path):
    observations = with_poses(
        observed(2),
        lambda k, m: m @ transform("flange", "flange", [0, 0, 0], [0, 0.008, 0]).matrix if k == 3 else m,
    )
    outcome = calibrated(observations, tmp_path)
    assert outcome.verdict == "fail"
    assert outcome.result["outlier_poses"] == [3]
    assert "pose 3 does not fit and is left out" in outcome.reasons[0]
    assert "left out: 3" in outcome.sentence
    assert [pose["used"] for pose in outcome.result["poses"]] == [k != 3 for k in range(14)]
    allowed = calibrated(observations, tmp_path, HandEyeGates(outlier_poses=1))
    assert allowed.verdict == "pass"
    assert allowed.result["flange_T_camera"] == outcome.result["flange_T_camera"]


@pytest.mark.parametrize(
    ("gate", "said"),
    [
        ({"translation_sd_m": 1e-6}, "translation known to ±"),
        ({"rotation_sd_rad": 1e-6}, "rotation known to ±"),
        ({"leave_one_out_px": 1e-3}, "px, allowed 0.001 px"),
        ({"leave_one_out_m": 1e-6}, "mm, allowed 0.001 mm"),
    ],
)
def test_every_limit_fails_the_verdict_with_the_figure_and_what_is_allowed(gate, said, tmp_path):
    outcome = calibrated(observed(3, poses=6, position_sd=3e-4), tmp_path, HandEyeGates(**gate))
    assert outcome.verdict == "fail"
    assert said in " ".join(outcome.reasons)


def test_three_poses_give_an_answer_that_nothing_checks(tmp_path):
    clean = observed(4, poses=3)
    outcome = calibrated(clean, tmp_path)
    assert outcome.verdict == "fail"
    assert "nothing to check" in " ".join(outcome.reasons)
    assert outcome.result["leave_one_out_px"] is None


def test_pictures_are_drawn(tmp_path):
    outcome = calibrated(observed(5, poses=6, position_sd=3e-4), tmp_path)
    for name, draw in outcome.pictures.items():
        draw(tmp_path / f"{name}.png")
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 5
    assert len(outcome.pictures) == 4


def test_joint_offsets_reach_the_rig_and_every_pose(tmp_path):
    offsets = np.radians([0, -0.2, 0.15, 0.3, -0.1, 0])
    outcome = calibrated(
        arm_looks(np.random.default_rng(0), 14, board(), offsets), tmp_path, joint_offsets=True
    )
    told = outcome.rig["arm"]["joint_offsets_rad"]
    assert told[0] == told[5] == 0
    assert told[1:5] == pytest.approx(offsets[1:5], abs=np.radians(0.05))
    rig = parse_depth_rig(RIG, "rig").with_values(outcome.rig)
    q = np.radians([10, 20, 80, 5, -20, 30])
    expected = forward_kinematics(q + told, 0.084)
    np.testing.assert_allclose(flange_pose(q, rig.arm).matrix, expected.matrix, atol=1e-12)
    frame = DepthFrame(0, 0, None, np.zeros((480, 640), np.uint16))
    capture = Capture("a", "map", frame, None, joints=JointState(0, 0, q))
    np.testing.assert_allclose(
        depth_pose(capture, rig).matrix, (expected @ rig.flange_T_depth).matrix, atol=1e-12
    )
    assert Arm().joint_offsets_rad == (0,) * 6


def test_neither_captures_nor_observations_is_an_error():
    with pytest.raises(InputError, match="either a recording"):
        calibrate(None, Options(), HandEyeGates(), quiet)


def folder(tmp_path, rows, role="hand_eye", plate=None):
    """A data folder with black images."""
    for kind in ("depth", "ir", "colour"):
        (tmp_path / kind).mkdir()
    (tmp_path / "rig.toml").write_text(RIG)
    if plate:
        (tmp_path / "plate.toml").write_text(plate)
    names = ["name", "role", "t_ns", "exposure_s", *(f"q{k}" for k in range(1, 7))]
    names += [f"p{row}{column}" for row in range(3) for column in range(4)]
    lines = [",".join(names)]
    for number, (q, pose) in enumerate(rows):
        black = np.zeros((480, 640), np.uint16)
        assert cv2.imwrite(str(tmp_path / "depth" / f"{number}.png"), black)
        assert cv2.imwrite(str(tmp_path / "ir" / f"{number}.png"), black)
        if role != "hand_eye":
            grey = np.zeros((480, 640, 3), np.uint8)
            assert cv2.imwrite(str(tmp_path / "colour" / f"{number}.png"), grey)
        cells = [f"{number}", role, f"{number}", "", *(q or [""] * 6), *(pose or [""] * 12)]
        lines.append(",".join(map(str, cells)))
    (tmp_path / "captures.csv").write_text("\n".join(lines) + "\n")
    return Source.open(tmp_path)


PLATE = "disc_radius_m = 0.018\npositions_base_m = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]\n"


def test_poses_that_were_computed_with_a_hand_eye_cannot_tell_a_new_one(tmp_path):
    source = folder(tmp_path, [(None, np.eye(4)[:3].ravel().tolist())] * 3, plate=PLATE)
    with pytest.raises(RefusedError, match="cannot tell a new one"):
        calibrate(source, Options(), HandEyeGates(), quiet)


def test_captures_without_the_target_that_was_asked_for_say_what_is_missing(tmp_path):
    source = folder(tmp_path, [([0.0] * 6, None)], role="exposure")
    with pytest.raises(RefusedError, match=r"without plate\.toml"):
        calibrate(source, Options(), HandEyeGates(), quiet)
    told = Options(target="checkerboard", board=Board(columns=9, rows=6, square_m=0.025))
    with pytest.raises(RefusedError, match="no capture has the role 'board'"):
        calibrate(source, told, HandEyeGates(), quiet)


def test_a_board_has_to_be_told_and_of_the_kind_that_is_asked_for(tmp_path):
    source = folder(tmp_path, [([0.0] * 6, None)], role="board")
    with pytest.raises(RefusedError, match="which checkerboard"):
        calibrate(source, Options(target="checkerboard"), HandEyeGates(), quiet)
    told = Board(columns=9, rows=6, square_m=0.025)
    with pytest.raises(InputError, match="the board is a checkerboard"):
        calibrate(source, Options(target="charuco", board=told), HandEyeGates(), quiet)
    with pytest.raises(RefusedError, match="no view shows the checkerboard"):
        calibrate(source, Options(target="checkerboard", board=told), HandEyeGates(), quiet)
    with pytest.raises(ConfigurationError, match="rgb"):
        calibrate(source, Options(target="checkerboard", board=told, eye="rgb"), HandEyeGates(), quiet)


def test_ends_of_a_symmetric_board_that_were_taken_for_each_other_are_told_apart():
    flat = Board(columns=5, rows=5, square_m=0.04)
    clean = observed(6, target=flat.points_m, poses=10)
    flip = np.arange(25)[::-1]
    views = []
    for number, view in enumerate(clean.views):
        target = flat.points_m[flip] if number in (2, 5, 6) else flat.points_m
        views.append(View(view.name, view.base_T_flange, Pixels(target, view.pixels.pixel)))
    mixed = Observations("eye_in_hand", tuple(views), CAMERA, clean.image_size)
    orders = [np.arange(25), flip]
    whole = in_one_order(mixed, flat.points_m, orders, 0.084)
    found, expected = (solve(one, 0.084, quiet).fit.state.x for one in (whole, clean))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def capture_of(image, q, motion=None):
    depth = DepthFrame(0, 0, None, np.zeros((480, 640), np.uint16))
    rgb = np.repeat(image[..., None], 3, axis=2)
    return Capture(
        "a", "board", depth, ColourFrame(0, 0, None, rgb), joints=JointState(0, 0, q), joint_motion_rad=motion
    )


def checkerboard(size=(480, 640), square=40, corners=(9, 6), blur=0.8):
    image = np.full(size, 200, np.uint8)
    for row in range(corners[1] + 1):
        for column in range(corners[0] + 1):
            if (row + column) % 2 == 0:
                y, x = 80 + row * square, 100 + column * square
                image[y : y + square, x : x + square] = 30
    return cv2.GaussianBlur(image, (0, 0), blur)


def test_the_guide_takes_new_sharp_whole_views_and_says_what_is_wrong_with_others():
    guide = HandEyeGuide(
        parse_depth_rig(RIG, "rig"), Board(columns=9, rows=6, square_m=0.025), eye="rgb", views=3
    )
    assert guide.role == "board"
    assert "middle of the image" in guide.next_step()
    q = np.radians([0, 20, 80, 0, -20, 0])
    sharp = checkerboard()
    first = guide.look(capture_of(sharp, q))
    assert first.accepted
    assert first.picture.shape == (480, 640, 3)
    assert (first.picture[..., 1].astype(int) - first.picture[..., 0] > 60).any()  # what was found, in green
    alike = guide.look(capture_of(sharp, q + np.radians(2)))
    assert "too like view 1" in alike.reasons[0]
    moved = guide.look(capture_of(sharp, q + np.radians([0, 0, 0, 0, 0, 40]), motion=0.01))
    assert "arm moved" in moved.reasons[0]
    blank = guide.look(capture_of(np.full((480, 640), 90, np.uint8), q + np.radians([0, 0, 0, 0, 0, 40])))
    assert "is not found" in blank.reasons[0]
    assert guide.progress() == (1, 3)
    for turn in (40, 80):
        assert guide.look(capture_of(sharp, q + np.radians([0, 0, 0, 0, 0, turn]))).accepted
    assert guide.progress() == (3, 3)
    assert "enough" in guide.next_step()
    covered = guide.coverage()
    assert np.sum(covered["image"]) > 0
    assert covered["turns about the first axis"] == pytest.approx(1.0)
    assert covered["about the second"] == pytest.approx(0.0, abs=1e-6)


def test_the_guide_names_the_turn_that_is_missing():
    guide = HandEyeGuide(parse_depth_rig(RIG, "rig"), Board(columns=9, rows=6, square_m=0.025), eye="rgb")
    q = np.radians([0, 20, 80, 0, -20, 0])
    for turn in (0, 30, 60, 90):
        assert guide.look(capture_of(checkerboard(), q + np.radians([0, 0, 0, 0, 0, turn]))).accepted
    assert "insufficient rotation" in guide.next_step()


def test_the_guide_finds_all_discs_of_real_looking_frames(shared):
    source = Source.open(shared / "data/hand_eye_discs")
    guide = HandEyeGuide(source.rig, source.plate)
    looks = [guide.look(capture) for _, capture in zip(range(3), source.captures("hand_eye"), strict=False)]
    assert guide.role == "hand_eye"
    assert [look.accepted for look in looks] == [True] * 3


def test_blurred_edges_are_wide():
    middle = np.array([[100.0, 100], [400, 300]])
    assert edge_width_px(checkerboard(), middle) < 4
    assert edge_width_px(checkerboard(blur=5), middle) > 8
