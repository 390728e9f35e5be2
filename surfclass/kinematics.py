"""Where the depth camera was: the arm's forward kinematics and the pose of a capture."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.rig import Arm, DepthRig
from surfclass.types import Float64, Transform, freeze

# Standard D-H rows of the VM-6083 (Table 6.1): alpha, a, d, theta at zero. The last d is the flange offset.
_ALPHA = np.array([-np.pi / 2, 0, np.pi / 2, -np.pi / 2, np.pi / 2, 0])
_A_M = np.array([0.180, 0.385, -0.100, 0, 0, 0])
_D_M = np.array([0.475, 0, 0, 0.445, 0])
_THETA_ZERO = np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])

JOINT_LIMITS_RAD: Float64 = freeze(
    np.radians([[-170, 170], [-90, 135], [-80, 165], [-185, 185], [-120, 120], [-360, 360]])
)
"""(6, 2) rad, least and greatest angle of each joint (Table 6.1)."""

POSE_TOLERANCE_M = 1e-3
POSE_TOLERANCE_RAD = np.radians(0.1)


def forward_kinematics(q: Float64, flange_offset_m: float = 0.084) -> Transform:
    """Returns the flange's pose in the arm's base (Eq. 3.1, A.7).

    Computed by Pinocchio from a model that is generated from the D-H table, once for each offset.

    Args:
        q: (6,) joint angles, rad. Angles beyond `JOINT_LIMITS_RAD` are computed too: a controller's
            own limits may be set wider.
        flange_offset_m: The last D-H length, constant after joint 6; public tables disagree on it.

    Raises:
        InputError: If `q` is not six finite numbers, or the offset is not finite.
    """
    import pinocchio

    angles = np.asarray(q, dtype=np.float64)
    if angles.shape != (6,) or not np.isfinite(angles).all():
        raise InputError(f"joint angles: {angles!r:.80}, allowed are 6 finite numbers in rad")
    if not np.isfinite(flange_offset_m):
        raise InputError(f"flange offset: {flange_offset_m} m, allowed is a finite length")
    model, flange = _model(float(flange_offset_m))
    data = model.createData()  # per call: a Data is written to, and callers may be threads
    pinocchio.framesForwardKinematics(model, data, angles)
    return Transform("base", "flange", data.oMf[flange].homogeneous)


def flange_pose(q: Float64, arm: Arm) -> Transform:
    """Returns the flange's pose in the base of one arm from its joints' read-out `q` (6,), rad.

    Raises:
        InputError: As `forward_kinematics`.
    """
    return forward_kinematics(corrected(q, arm), arm.flange_offset_m)


def corrected(q: Float64, arm: Arm) -> Float64:
    """Returns the joint angles (6,), rad, that a read-out stands for."""
    angles: Float64 = np.asarray(q, np.float64) + np.array(arm.joint_offsets_rad)
    return angles


def flange_jacobian(q: Float64, flange_offset_m: float = 0.084) -> Float64:
    """Returns how the flange moves with each joint: (6, 6), a column for each joint.

    Rows 0–2 are the turn (rad per rad), rows 3–5 the shift (m per rad), both in the flange's own frame.

    Args:
        q: (6,) joint angles, rad.
        flange_offset_m: The last D-H length.
    """
    import pinocchio

    model, flange = _model(float(flange_offset_m))
    data = model.createData()
    local = pinocchio.ReferenceFrame.LOCAL
    shift_first = pinocchio.computeFrameJacobian(model, data, np.asarray(q, np.float64), flange, local)
    return np.concatenate([shift_first[3:], shift_first[:3]])


@lru_cache(maxsize=16)
def _model(flange_offset_m: float) -> tuple[Any, int]:
    """Pinocchio turns about z first, so a joint's placement is what follows the joint before it."""
    import pinocchio

    model = pinocchio.Model()
    parent = 0
    after_previous = pinocchio.SE3.Identity()
    for i, d in enumerate([*_D_M, flange_offset_m]):
        at_zero = pinocchio.SE3(_rotation_z(_THETA_ZERO[i]), np.zeros(3))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), after_previous * at_zero, f"joint{i + 1}")
        after_previous = pinocchio.SE3(_rotation_x(_ALPHA[i]), np.array([_A_M[i], 0, d]))
    frame = pinocchio.Frame("flange", parent, 0, after_previous, pinocchio.FrameType.OP_FRAME)
    return model, model.addFrame(frame)


def _rotation_x(angle: float) -> Float64:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _rotation_z(angle: float) -> Float64:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def pose_difference(first: Transform, second: Transform) -> tuple[float, float]:
    """Returns how far two poses of one frame are apart: metres, and radians of the turn between them."""
    distance = float(np.linalg.norm(first.translation - second.translation))
    chord = float(np.linalg.norm(first.rotation - second.rotation))
    return distance, 2 * float(np.arcsin(min(1.0, chord / np.sqrt(8))))


def depth_pose(capture: Capture, rig: DepthRig) -> Transform:
    """Returns the depth camera's pose in `base` for one capture (Eq. 3.2, A.9).

    The recorded pose is taken where there is one, else it follows from the joint angles and the
    hand-eye transform.

    Raises:
        InputError: If the capture has neither a pose nor joint angles, or has both and the rig's
            hand-eye transform makes them differ by more than 1 mm or 0.1°.
        MissingCalibrationError: If only joint angles are given and the rig has no hand-eye transform.
    """
    recorded, joints = capture.base_T_depth, capture.joints
    if joints is None:
        if recorded is None:
            raise InputError(
                f"capture {capture.name}: neither joint angles nor base_T_depth, one of them is needed"
            )
        return recorded
    if recorded is not None and rig.transforms.flange_T_depth is None:
        return recorded
    computed = flange_pose(joints.q, rig.arm) @ rig.flange_T_depth
    if recorded is None:
        return computed
    distance, angle = pose_difference(recorded, computed)
    if distance > POSE_TOLERANCE_M or angle > POSE_TOLERANCE_RAD:
        raise InputError(
            f"capture {capture.name}: base_T_depth and the joint angles differ by {distance * 1e3:.2f} mm "
            f"and {np.degrees(angle):.3f}°, allowed are 1 mm and 0.1°; the hand-eye transform, "
            "the arm's table, the angles or the pose are wrong"
        )
    return recorded
