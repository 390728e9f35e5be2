"""Hand-eye in the simulated cell: discs from the default poses, and does it know how good it is?"""

from dataclasses import replace

import numpy as np
import pytest

from calibration.hand_eye.discs import observe
from calibration.hand_eye.observations import Probed
from calibration.hand_eye.solution import solve
from calibration.rotations import difference
from drivers.recordings.plate import parse_plate
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.frames import Capture, DepthFrame, JointState
from surfclass.kinematics import flange_pose
from surfclass.rig import parse_depth_rig
from surfclass.types import Transform

WORLDS, DRAWS = 4, 25
JOINT_SD = np.radians(0.01)
PROBED_SD_M = 0.0003


def seen_in(world, rig):
    plate = parse_plate(truth.plate_toml(world), "plate.toml")
    captures = []
    for number, viewpoint in enumerate(world.viewpoints):
        depth_mm, ir = world.render_depth(viewpoint.q, 100 * world.seed + number)
        frame = DepthFrame(number, number, None, depth_mm, ir)
        joints = JointState(number, 0, viewpoint.q)
        captures.append(Capture(f"{number}", "hand_eye", frame, None, joints=joints))
    return observe(captures, rig, plate, lambda _: None)


def shaken(observations, arm, rng):
    """The same with noisy joint read-outs, and a plate that was touched with a noisy pointer."""
    exact = observations.probed.target_m
    touched = exact + rng.normal(0, PROBED_SD_M, exact.shape)
    name = {tuple(place): found for place, found in zip(exact, touched, strict=True)}

    def renamed(part):
        return replace(part, target_m=np.array([name[tuple(point)] for point in part.target_m]))

    views = []
    for view in observations.views:
        q = view.q + rng.normal(0, JOINT_SD, 6)
        pixels, positions = renamed(view.pixels), renamed(view.positions)
        views.append(
            replace(view, q=q, base_T_flange=flange_pose(q, arm), pixels=pixels, positions=positions)
        )
    probed = Probed(touched, touched, np.full(len(touched), PROBED_SD_M))
    return replace(observations, views=tuple(views), probed=probed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_default_poses_give_the_hand_eye_and_how_well_it_is_known():
    errors, sd = [], []
    for seed in range(WORLDS):
        world = SimWorld("reflector_discs", seed)
        rig = parse_depth_rig(truth.rig(world), "rig")
        observations = seen_in(world, rig)
        true = Transform("flange", "camera", rig.flange_T_depth.matrix)
        for draw in range(DRAWS):
            noisy = shaken(observations, rig.arm, np.random.default_rng((seed, draw)))
            found = solve(noisy, rig.arm.flange_offset_m, lambda _: None)
            assert found.fit.keep.all()
            errors.append(difference(Transform("flange", "camera", found.fit.state.x), true))
            sd.append(found.sd)
    errors, sd = np.array(errors), np.array(sd)
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.0005
    assert np.linalg.norm(errors[:, :3], axis=1).max() < np.radians(0.05)
    assert (np.abs(errors) < 3 * sd).all(axis=1).mean() >= 0.95
    ratio = np.sqrt((sd**2).mean(axis=0) / (errors**2).mean(axis=0))
    assert (ratio < 2).all()  # the images' own noise was drawn only once for each world
    assert (ratio > 1 / 1.5).all()
