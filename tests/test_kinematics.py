"""The arm's forward kinematics against independent products, and a capture's pose."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surfclass.errors import InputError, MissingCalibrationError
from surfclass.frames import Capture, DepthFrame, JointState
from surfclass.kinematics import (
    JOINT_LIMITS_RAD,
    depth_pose,
    forward_kinematics,
    pose_difference,
)
from surfclass.rig import Rig, parse_depth_rig, parse_rig
from surfclass.types import Transform

# alpha°, a, d, theta offset° (Table 6.1)
DH = [
    (-90, 0.180, 0.475, 0),
    (0, 0.385, 0.0, -90),
    (90, -0.100, 0.0, 90),
    (-90, 0.0, 0.445, 0),
    (90, 0.0, 0.0, 0),
    (0, 0.0, 0.084, 0),
]
# The same arm as plain translations between joint axes: xyz, axis.
CHAIN = [
    ((0, 0, 0.475), "z"),
    ((0.18, 0, 0), "y"),
    ((0, 0, 0.385), "y"),
    ((-0.1, 0, 0), "z"),
    ((0, 0, 0.445), "y"),
    ((0, 0, 0), "z"),
]

angles = st.tuples(*[st.floats(low, high) for low, high in JOINT_LIMITS_RAD.tolist()])


def dh_product(q, rows=DH):
    pose = np.eye(4)
    for angle, (alpha, a, d, offset) in zip(q, rows, strict=True):
        ct, st_ = np.cos(angle + np.radians(offset)), np.sin(angle + np.radians(offset))
        ca, sa = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        pose = pose @ np.array(
            [
                [ct, -st_ * ca, st_ * sa, a * ct],
                [st_, ct * ca, -ct * sa, a * st_],
                [0, sa, ca, d],
                [0, 0, 0, 1],
            ]
        )
    return pose


def chain_product(q):
    pose = np.eye(4)
    for angle, (xyz, axis) in zip(q, CHAIN, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.eye(4)
        turn[:3, :3] = (
            [[c, -s, 0], [s, c, 0], [0, 0, 1]] if axis == "z" else [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        )
        turn[:3, 3] = xyz
        pose = pose @ turn
    pose = pose.copy()
    pose[:3, 3] += pose[:3, :3] @ [0, 0, 0.084]
    return pose


@settings(deadline=None, max_examples=50)
@given(angles)
def test_equals_plain_dh_product_and_chain_of_translations(q):
    pose = forward_kinematics(np.array(q)).matrix
    assert np.abs(pose - dh_product(q)).max() < 1e-12
    assert np.abs(pose - chain_product(q)).max() < 1e-12


@pytest.mark.parametrize(
    ("degrees", "position"),
    [
        ((0, 0, 0, 0, 0, 0), (0.080, 0, 1.389)),
        ((0, 0, 90, 0, 0, 0), (0.709, 0, 0.960)),
        ((0, 45, 90, 0, 45, 0), (0.8376, 0, 0.4193)),
        ((0, 90, 0, 0, 0, 0), (1.094, 0, 0.575)),
    ],
)
def test_known_flange_positions(degrees, position):
    assert forward_kinematics(np.radians(degrees)).translation == pytest.approx(position, abs=5e-5)


def test_known_orientations():
    upright = forward_kinematics(np.zeros(6))
    assert (upright.dst, upright.src) == ("base", "flange")
    assert upright.rotation == pytest.approx(np.eye(3), abs=1e-15)
    down = forward_kinematics(np.radians([0, 45, 90, 0, 45, 0]))
    assert down.rotation[:, 2] == pytest.approx([0, 0, -1], abs=1e-12)


def test_reach_to_the_wrist_centre_is_the_published_one():
    """With the elbow stretched the wrist centre is farthest from joint 1's axis."""
    stretched = np.arctan2(0.445, -0.100)  # direction of the forearm with its offset, from its own x
    q = np.array([0, np.pi / 2, stretched - np.pi / 2, 0, 0, 0])
    reach = [
        np.hypot(*forward_kinematics(q + delta * np.eye(6)[2], flange_offset_m=0.0).translation[:2])
        for delta in (-1e-3, 0.0, 1e-3)
    ]
    assert reach[1] == max(reach)
    assert reach[1] == pytest.approx(1.021, abs=5e-4)


def test_flange_offset_moves_the_flange_along_its_axis():
    q = np.radians([10, 20, 30, 40, 50, 60])
    near, far = forward_kinematics(q, 0.084), forward_kinematics(q, 0.090)
    assert far.translation - near.translation == pytest.approx(near.rotation[:, 2] * 0.006, abs=1e-12)


@pytest.mark.parametrize("q", [np.zeros(5), np.array([0, 0, np.nan, 0, 0, 0]), np.zeros((6, 1))])
def test_refuses_what_is_not_six_finite_angles(q):
    with pytest.raises(InputError, match="6 finite numbers"):
        forward_kinematics(q)


def test_hand_eye_order_of_a8():
    """`inv(base_T_flange) @ base_T_depth` recovers the hand-eye; the printed `oTs · oTe⁻¹` does not."""
    flange_T_depth = dh_product([0.1, 0.2, -0.3, 0.4, 0.5, 0.6])
    base_T_flange = forward_kinematics(np.radians([20, 30, 40, 50, 60, 70])).matrix
    base_T_depth = base_T_flange @ flange_T_depth
    corrected = np.linalg.inv(base_T_flange) @ base_T_depth
    printed = base_T_depth @ np.linalg.inv(base_T_flange)
    assert corrected == pytest.approx(flange_T_depth, abs=1e-12)
    assert np.abs(printed - flange_T_depth).max() > 0.1


def rig(hand_eye: bool = True) -> Rig:
    text = """
        schema = 1
        name = "test"
        voxel_size_m = 0.01
        rgb = {size = [4, 3], fx = 4.0, fy = 4.0, cx = 1.5, cy = 1.0}
        depth = {size = [4, 3], fx = 4.0, fy = 4.0, cx = 1.5, cy = 1.0}
        [transforms]
        rgb_T_depth = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    """
    if hand_eye:
        text += "flange_T_depth = [[0, -1, 0, 0.05], [1, 0, 0, 0.02], [0, 0, 1, 0.08], [0, 0, 0, 1]]\n"
    return parse_rig(text, "rig.toml")


def capture(q=None, pose=None) -> Capture:
    depth = DepthFrame(0, 0, None, np.ones((3, 4), np.uint16))
    joints = None if q is None else JointState(0, 0, np.array(q))
    recorded = None if pose is None else Transform("base", "depth", pose)
    return Capture("view", "map", depth, None, joints=joints, base_T_depth=recorded)


Q = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def test_pose_from_joints_and_hand_eye():
    expected = dh_product(Q) @ np.array(rig().transforms.flange_T_depth)
    pose = depth_pose(capture(q=Q), rig())
    assert (pose.dst, pose.src) == ("base", "depth")
    assert pose.matrix == pytest.approx(expected, abs=1e-12)
    assert depth_pose(capture(q=Q, pose=expected), rig()).matrix == pytest.approx(expected, abs=0)


@pytest.mark.parametrize("shift_m", [[0.0011, 0, 0], [0, 0, -0.0011]])
def test_joints_and_pose_must_agree_in_place(shift_m):
    pose = dh_product(Q) @ np.array(rig().transforms.flange_T_depth)
    pose[:3, 3] += np.array(shift_m) * 0.8
    depth_pose(capture(q=Q, pose=pose), rig())
    pose[:3, 3] += np.array(shift_m) * 0.2
    with pytest.raises(InputError, match=r"capture view: .* 1\.10 mm"):
        depth_pose(capture(q=Q, pose=pose), rig())


def test_joints_and_pose_must_agree_in_direction():
    pose = dh_product(Q) @ np.array(rig().transforms.flange_T_depth)
    turned = pose @ dh_product([np.radians(0.12), 0, 0, 0, 0, 0], [(0, 0, 0, 0)] * 6)
    with pytest.raises(InputError, match=r"0\.120°"):
        depth_pose(capture(q=Q, pose=turned), rig())


def test_pose_without_hand_eye():
    pose = dh_product(Q)
    assert depth_pose(capture(q=Q, pose=pose), rig(hand_eye=False)).matrix == pytest.approx(pose, abs=0)
    with pytest.raises(MissingCalibrationError, match=r"flange_T_depth is missing.*; add it to rig\.toml"):
        depth_pose(capture(q=Q), rig(hand_eye=False))
    with pytest.raises(InputError, match="capture view: neither"):
        depth_pose(capture(), rig())


def test_only_what_needs_the_colour_camera_refuses_where_it_is_unknown():
    text = """
        schema = 1
        name = "test"
        voxel_size_m = 0.01
        depth = {size = [4, 3], fx = 4.0, fy = 4.0, cx = 1.5, cy = 1.0}
    """
    known = parse_depth_rig(text, "rig.toml")
    assert depth_pose(capture(pose=dh_product(Q)), known).matrix == pytest.approx(dh_product(Q), abs=0)
    with pytest.raises(MissingCalibrationError, match=r"rgb_T_depth is missing.*; add it to rig\.toml"):
        _ = known.rgb_T_depth
    with pytest.raises(MissingCalibrationError, match=r"\[rgb\] and transforms\.rgb_T_depth are missing"):
        parse_rig(text, "rig.toml")
    complete = known.model_copy(update={"rgb": rig().rgb, "transforms": rig().transforms})
    assert complete.whole() == rig()


def test_pose_difference_of_half_a_turn():
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    identity = Transform("base", "depth", np.eye(4))
    assert pose_difference(identity, Transform("base", "depth", turn))[1] == pytest.approx(np.pi)


def test_rendered_joints_agree_with_rendered_poses(shared: Path):
    """The data set's joint angles, its poses and its hand-eye come from elsewhere and close the loop."""
    folder = shared / "data" / "rendered"
    known = parse_rig((folder / "rig.toml").read_bytes(), "rig.toml")
    checked = 0
    with (folder / "captures.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if not row["q1"]:
                continue
            pose = np.eye(4)
            pose[:3] = [[float(row[f"p{i}{j}"]) for j in range(4)] for i in range(3)]
            q = [float(row[f"q{i}"]) for i in range(1, 7)]
            computed = depth_pose(capture(q=q), known)
            distance, angle = pose_difference(computed, Transform("base", "depth", pose))
            assert distance < 1e-6
            assert angle < 1e-6
            checked += 1
    assert checked >= 10
