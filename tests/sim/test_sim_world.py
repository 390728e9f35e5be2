"""The simulated world as a whole: repeatable, driven by its robot program, honest about its truth."""

import threading
import tomllib

import numpy as np
import pytest

from drivers.sim import truth
from drivers.sim.clock import SimClock
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.scenes import SCENES
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import parse_classes, parse_rig

SCALE = 0.1


def run(seed=3, **options):
    """A small session: three stops of a robot program, everything that the devices delivered."""
    views = SimWorld("cell", scale=0.05).viewpoints
    world = SimWorld("cell", seed=seed, scale=0.06, program=views[:3], joint_noise_rad=1e-4, **options)
    delivered = []
    colour, depth, light, arm = (kind(world) for kind in (SimColourCamera, SimDepthCamera, SimLight, SimArm))
    with colour, depth, light, arm:
        for _ in range(12):
            lit = colour.grab(light.set_level(1.0), 1.0)
            deep = depth.grab(lit.t_ns, 1.0, with_ir=True)
            joints = arm.read_joints(0.1)
            dark = colour.grab(light.set_level(0.0), 1.0)
            delivered += [lit.rgb, deep.depth_mm, deep.ir, joints.q, dark.rgb]
            delivered.append(np.array([lit.t_ns, deep.t_ns, joints.t_ns, deep.sequence, dark.sequence]))
            world.clock.sleep(0.3)
    return world, b"".join(np.ascontiguousarray(one).tobytes() for one in delivered)


@pytest.fixture(scope="module")
def session():
    return run()


def test_a_run_repeats_byte_for_byte(session):
    assert run()[1] == session[1]


def test_another_seed_is_another_run(session):
    assert run(seed=4)[1] != session[1]


def test_images_do_not_depend_on_what_was_drawn_before():
    first, second = (SimWorld("cell", seed=1, scale=SCALE) for _ in range(2))
    a, b = (one.q for one in first.viewpoints[:2])
    early = first.render_colour(a, 1.0, 5), *first.render_depth(a, 5)
    for key in (9, 1):
        second.render_depth(b, key)
        second.render_colour(b, 0.5, key)
        second.render_colour(a, 0.2, key)
    late = *second.render_depth(a, 5), second.render_colour(a, 1.0, 5)
    assert (early[0] == late[2]).all()
    assert (early[1] == late[0]).all()
    assert (early[2] == late[1]).all()


def test_the_robot_program_goes_on_after_a_lit_exposure_at_rest_and_ends_at_its_last_view(session):
    world, _ = session
    assert world.program_done
    assert world.joints() == pytest.approx(world.program[-1].q)


def program_world(**options):
    views = SimWorld("cell", scale=0.05).viewpoints
    return SimWorld("cell", scale=0.05, program=views[1:3], **options)


def test_the_program_waits_for_the_handshake():
    world = program_world()
    world.clock.sleep(60)
    assert world.program_index == 0
    assert not world.program_done
    assert world.joints() == pytest.approx(world.program[0].q)


def test_an_unlit_exposure_is_no_handshake():
    world = program_world()
    with SimColourCamera(world) as camera:
        camera.grab(world.clock.now_ns(), 1.0)
    assert world.program_index == 0


def test_the_arm_dwells_before_it_leaves_and_counts_a_stop_once():
    world = program_world(dwell_s=0.5)
    with SimColourCamera(world) as camera, SimLight(world) as light:
        first = camera.grab(light.set_level(1.0), 1.0)
        camera.grab(world.clock.now_ns(), 1.0)
        assert world.program_index == 1
        assert not world.program_done
        end = first.t_ns + 5_000_000
        assert world.joints(end + 499_000_000) == pytest.approx(world.program[0].q, abs=0)
        assert np.abs(world.joints(end + 600_000_000) - world.program[0].q).max() > 1e-4
        world.clock.sleep(0.7)
        camera.grab(world.clock.now_ns(), 1.0)  # on the way: no handshake
        assert not world.program_done
        world.clock.sleep(30)
        camera.grab(world.clock.now_ns(), 1.0)
        assert world.program_done


def test_an_exposure_while_something_else_moves_the_arm_is_no_handshake():
    world = program_world()
    world.move_to(world.viewpoints[5].q)
    with SimColourCamera(world) as camera, SimLight(world) as light:
        camera.grab(light.set_level(1.0), 1.0)
    assert world.program_index == 0


def test_without_a_program_the_arm_stays():
    world = SimWorld("grey_card", scale=0.05)
    assert world.program_done
    with SimColourCamera(world) as camera, SimLight(world) as light:
        camera.grab(light.set_level(1.0), 1.0)
    world.clock.sleep(5)
    assert world.joints() == pytest.approx(world.viewpoints[0].q)


def test_an_exposure_in_motion_sees_the_middle_of_it():
    world = SimWorld("cell", scale=0.05)
    world.move_to(world.viewpoints[1].q)
    with SimColourCamera(world) as camera, SimLight(world) as light:
        world.clock.sleep(0.4)
        frame = camera.grab(light.set_level(1.0), 1.0)
    assert (frame.rgb == world.render_colour(world.joints(frame.t_ns), 1.0, frame.sequence)).all()
    assert (frame.rgb != world.render_colour(world.viewpoints[0].q, 1.0, frame.sequence)).mean() > 0.2


def test_a_level_that_changes_during_the_exposure_counts_by_its_time():
    world = SimWorld("grey_card", scale=0.05)
    world.set_light(1.0, world.began_ns + 4_000_000)
    world.set_light(0.5, world.began_ns + 8_000_000)
    assert world.light_level(world.began_ns, world.began_ns + 10_000_000) == pytest.approx(0.4 + 0.1)
    assert world.light_level(world.began_ns + 9_000_000, world.began_ns + 10_000_000) == pytest.approx(0.5)


def test_joint_noise_has_the_stated_size_and_moves_nothing():
    world = SimWorld("grey_card", scale=0.05, joint_noise_rad=2e-4)
    with SimArm(world) as arm:
        errors = np.array([arm.read_joints(0.1).q - world.viewpoints[0].q for _ in range(200)])
    assert errors.std() == pytest.approx(2e-4, rel=0.1)
    assert (world.joints() == world.viewpoints[0].q).all()


def test_a_real_time_world_does_not_move_while_it_renders():
    world = program_world(clock=SimClock(realtime=True), dwell_s=0.05)
    with SimColourCamera(world) as camera, SimLight(world) as light, SimArm(world) as arm:
        frame = camera.grab(light.set_level(1.0), 1.0)
        q = arm.read_joints(0.1).q
        assert q == pytest.approx(world.joints(frame.t_ns), abs=1e-9)


def test_two_threads_may_use_two_cameras():
    world = SimWorld("cell", scale=SCALE)
    alone = SimWorld("cell", scale=SCALE)
    found = {}
    with SimColourCamera(world) as colour, SimDepthCamera(world) as depth:
        now = world.clock.now_ns()
        threads = [
            threading.Thread(target=lambda: found.update(colour=colour.grab(now, 1.0))),
            threading.Thread(target=lambda: found.update(depth=depth.grab(now, 1.0))),
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    q = alone.viewpoints[0].q
    assert (found["colour"].rgb == alone.render_colour(q, 0.0, found["colour"].sequence)).all()
    assert (found["depth"].depth_mm == alone.render_depth(q, found["depth"].sequence)[0]).all()


@pytest.mark.parametrize("scene", SCENES)
def test_the_true_rig_is_whole_and_fits_the_images(scene):
    world = SimWorld(scene, scale=SCALE)
    rig = parse_rig(truth.rig(world), scene)
    assert rig.rgb.shape == world.render_colour(world.viewpoints[0].q, 1.0, 1).shape[:2]
    assert rig.depth.shape == world.render_depth(world.viewpoints[0].q, 1)[0].shape
    assert rig.rgb.vignetting is not None
    assert rig.light is not None
    assert rig.light.axis_rgb is not None
    assert rig.response is not None
    assert len(rig.response.inverse[0]) >= 64
    assert rig.flange_T_depth.matrix == pytest.approx(world.package.flange_T_depth.matrix)
    assert rig.rgb_T_depth.translation == pytest.approx([0.00349, 0.07742, 0.00142])


def test_the_true_poses_agree_with_the_rig():
    world = SimWorld("cell", scale=SCALE)
    q = world.viewpoints[4].q
    rig = parse_rig(truth.rig(world), "rig")
    by_rig = truth.base_T_rgb(world, q) @ rig.rgb_T_depth
    assert truth.base_T_depth(world, q).matrix == pytest.approx(by_rig.matrix, abs=1e-12)


def test_depth_and_colour_cameras_see_the_same_surfaces():
    world = SimWorld("board:timber", scale=SCALE)
    q = world.viewpoints[0].q
    for camera in ("rgb", "depth"):
        seen = truth.surface(world, q, camera)
        pose = truth.base_T_rgb(world, q) if camera == "rgb" else truth.base_T_depth(world, q)
        board = world.hits(q, camera).face == 0
        assert (pose @ seen.point[:, board].T)[:, 0] == pytest.approx(1.62, abs=1e-5)


def test_classes_and_labels_belong_together():
    classes = parse_classes(truth.classes_toml(), "classes")
    for index, name in enumerate(classes.names, start=1):
        world = SimWorld(f"board:{name}", scale=0.05)
        label = truth.label_image(world, world.viewpoints[0].q)
        assert label.dtype == np.uint8
        assert (label == index).all()


def test_the_plate_file_names_the_discs_where_the_depth_camera_sees_them():
    world = SimWorld("reflector_discs", scale=0.5)
    plate = tomllib.loads(truth.plate_toml(world))
    centres = np.array(plate["positions_base_m"])
    assert len(centres) == 9
    q = world.viewpoints[0].q
    _, ir = world.render_depth(q, 1)
    seen = truth.surface(world, q, "depth")
    at = truth.base_T_depth(world, q) @ seen.point.transpose(1, 2, 0)
    nearest = np.linalg.norm(at[:, :, None] - centres.astype(np.float32), axis=3).min(axis=2)
    assert ir[nearest < plate["disc_radius_m"] - 0.004].mean() > 500
    assert ir[(nearest > plate["disc_radius_m"] + 0.004) & (nearest < 0.06)].mean() < 120
    with pytest.raises(ConfigurationError, match="no reflector discs"):
        truth.plate_toml(SimWorld("cell", scale=0.05))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"scene": "kitchen"}, "allowed: cell, board:rusted"),
        ({"scale": 0.01}, "allowed is 0.05 to 1"),
        ({"dwell_s": -1.0}, "dwell_s is -1.0"),
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"ambient": float("nan")}, "ambient is nan"),
    ],
)
def test_a_wrong_world_is_refused_with_what_is_allowed(options, says):
    with pytest.raises(ConfigurationError, match=says):
        SimWorld(**options)


def test_a_goal_outside_the_joint_limits_is_refused():
    with pytest.raises(ConfigurationError, match="170"):
        SimWorld("cell", scale=0.05).move_to(np.full(6, 9.0))


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan")])
def test_an_impossible_timeout_is_refused(timeout):
    world = SimWorld("grey_card", scale=0.05)
    with SimColourCamera(world) as camera, pytest.raises(InputError, match="timeout"):
        camera.grab(0, timeout)
