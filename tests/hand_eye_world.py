"""Made-up arms that look at made-up targets, and what they would have seen."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.hand_eye.observations import Intrinsics, Observations, Pixels, Positions, Probed, View
from surfclass.kinematics import forward_kinematics
from surfclass.types import Transform

CAMERA = Intrinsics(900.0, 905.0, 640.0, 480.0, (0.05, -0.1, 0.001, -0.0005, 0.0))
IMAGE = (1280, 960)


def transform(dst, src, vector, shift):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    matrix[:3, 3] = shift
    return Transform(dst, src, matrix)


FLANGE_T_CAMERA = transform("flange", "camera", [0.1, -0.05, 1.5], [0.05, 0.08, 0.06])
BASE_T_TARGET = transform("base", "target", [1.1, 1.2, -1.2], [0.9, 0.1, 0.4])


def board(columns=3, rows=3, square_m=0.09):
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return square_m * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)


def pixels_of(points, camera=CAMERA):
    """The pinhole camera with OpenCV's distortion, written out."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=1)


def looks(rng, count, target, turns=(0.6, 0.6, 1.2)):
    """`camera_T_target` of cameras that look at the target's middle from about its front."""
    middle = target.mean(axis=0)
    for _ in range(count):
        rotation = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * turns).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = [*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.45, 0.8)] - rotation @ middle
        yield Transform("camera", "target", matrix)


def observed(
    seed,
    poses=14,
    pixel_sd=0.15,
    position_sd=None,
    turn_sd=1e-4,
    shift_sd=1e-4,
    mounting="eye_in_hand",
    target=None,
    turns=(0.6, 0.6, 1.2),
    stated_scale=1.0,
):
    """What an arm saw whose read-out is noisy: pixels, positions or both."""
    rng = np.random.default_rng(seed)
    target = board() if target is None else target
    views = []
    for number, camera_T_target in enumerate(looks(rng, poses, target, turns)):
        if mounting == "eye_in_hand":
            matrix = (BASE_T_TARGET @ camera_T_target.inverse @ FLANGE_T_CAMERA.inverse).matrix
        else:  # the same two transforms, now base_T_camera and flange_T_target
            matrix = FLANGE_T_CAMERA.matrix @ camera_T_target.matrix @ BASE_T_TARGET.inverse.matrix
        noise = transform("flange", "flange", rng.normal(0, turn_sd, 3), rng.normal(0, shift_sd, 3))
        seen = camera_T_target @ target
        kinds = {}
        if pixel_sd is not None:
            pixel = pixels_of(seen)
            kinds["pixels"] = Pixels(target * stated_scale, pixel + rng.normal(0, pixel_sd, pixel.shape))
        if position_sd is not None:
            noisy = seen + rng.normal(0, position_sd, seen.shape)
            kinds["positions"] = Positions(target * stated_scale, noisy)
        views.append(View(f"pose_{number}", Transform("base", "flange", matrix) @ noise, **kinds))
    return Observations(mounting, tuple(views), CAMERA, IMAGE)


def with_poses(observations, change):
    """The same with each view's pose (4, 4) changed by `change(number, matrix)`."""
    views = [
        replace(view, base_T_flange=Transform("base", "flange", change(number, view.base_T_flange.matrix)))
        for number, view in enumerate(observations.views)
    ]
    return replace(observations, views=tuple(views))


def arm_looks(rng, count, target, offsets=None, joint_sd=0.0, probed_sd=None, still=()):
    """What the VM-6083 saw of a target in front of it, in space: its joints read with offsets and noise.

    The joints (0…5) that are `still` do not move.
    """
    offsets = np.zeros(6) if offsets is None else np.asarray(offsets)
    middle = np.radians([0.0, 20.0, 90.0, 0.0, -20.0, 0.0])
    base_T_camera = forward_kinematics(middle) @ FLANGE_T_CAMERA
    place = transform("camera", "target", [0.2, -0.1, 0.3], [0, 0, 0.6])
    base_T_target = base_T_camera @ place
    views = []
    for number in range(count):
        moves = np.where(np.isin(np.arange(6), still), 0, np.radians([15, 12, 12, 40, 25, 60]))
        q = middle + rng.uniform(-1, 1, 6) * moves
        camera_T_target = (forward_kinematics(q) @ FLANGE_T_CAMERA).inverse @ base_T_target
        seen = camera_T_target @ target
        read = q - offsets + rng.normal(0, joint_sd, 6) if joint_sd else q - offsets
        positions = Positions(target, seen + rng.normal(0, 2e-4, seen.shape))
        views.append(View(f"pose_{number}", forward_kinematics(read), positions=positions, q=read))
    probed = None
    if probed_sd is not None:
        touched = base_T_target @ target + rng.normal(0, probed_sd, target.shape)
        probed = Probed(target, touched, np.full(len(target), probed_sd))
    return Observations("eye_in_hand", tuple(views), probed=probed)
