"""What goes wrong on purpose does go wrong, when and as long as it should, and nothing else."""

import numpy as np
import pytest

from drivers.errors import DeviceFaultError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.faults import Fault, Faults
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError


def world_with(*faults, **options):
    return SimWorld("grey_card", faults=Faults(faults), scale=0.05, **options)


def test_a_lost_device_comes_back_when_its_fault_ends():
    world = world_with(Fault("colour", "absent", from_s=1.0, to_s=3.0))
    camera = SimColourCamera(world)
    camera.open()
    camera.grab(world.clock.now_ns(), 1.0)
    world.clock.sleep(1.5)
    with pytest.raises(DeviceLostError):
        camera.grab(world.clock.now_ns(), 1.0)
    camera.close()
    with pytest.raises(DeviceNotFoundError):
        camera.open()
    world.clock.sleep(2.0)
    camera.open()
    assert camera.grab(world.clock.now_ns(), 1.0).sequence == 2


def test_a_device_that_goes_away_during_the_wait_is_lost():
    world = world_with(Fault("depth", "absent", from_s=0.5))
    camera = SimDepthCamera(world)
    camera.open()
    with pytest.raises(DeviceLostError):
        camera.grab(world.clock.now_ns() + 600_000_000, 1.0)


@pytest.mark.parametrize("camera_type", [SimColourCamera, SimDepthCamera])
def test_dropped_frames_are_missing_from_the_sequence_but_a_later_one_comes(camera_type):
    world = world_with(Fault(camera_type.kind, "drop", every=3))
    with camera_type(world) as camera:
        numbers = [camera.grab(world.clock.now_ns(), 1.0).sequence for _ in range(8)]
    assert all(number % 3 for number in numbers)
    assert max(np.diff(numbers)) > 1


@pytest.mark.parametrize("camera_type", [SimColourCamera, SimDepthCamera])
def test_when_every_frame_is_dropped_the_grab_times_out(camera_type):
    world = world_with(Fault(camera_type.kind, "drop", every=1))
    with camera_type(world) as camera:
        before = world.clock.now_ns()
        with pytest.raises(DeviceTimeoutError):
            camera.grab(before, 0.7)
        assert world.clock.now_ns() - before == pytest.approx(0.7e9, abs=1e6)


@pytest.mark.parametrize("camera_type", [SimColourCamera, SimDepthCamera])
def test_late_frames_keep_the_time_of_their_exposure(camera_type):
    on_time, late = (world_with(*fault) for fault in ((), (Fault(camera_type.kind, "late", delay_s=0.4),)))
    frames, arrivals = [], []
    for world in (on_time, late):
        with camera_type(world) as camera:
            frames.append(camera.grab(world.clock.now_ns(), 1.0))
            arrivals.append(world.clock.now_ns())
    assert frames[0].t_ns == frames[1].t_ns
    assert arrivals[1] - arrivals[0] == 400_000_000
    with camera_type(late) as camera, pytest.raises(DeviceTimeoutError):
        camera.grab(late.clock.now_ns(), 0.3)


def test_a_frozen_arm_stands_still_and_reads_so():
    world = world_with(Fault("arm", "frozen", from_s=0.3))
    goal = world.viewpoints[3].q
    there = world.move_to(goal)
    world.clock.sleep_until(there)
    with SimArm(world) as arm:
        q = arm.read_joints(0.1).q
        world.clock.sleep(1.0)
        assert (arm.read_joints(0.1).q == q).all()
    assert np.abs(q - goal).max() > 0.01
    assert world.joints() == pytest.approx(q)


def test_a_stale_read_out_hides_that_the_arm_moves():
    world = world_with(Fault("arm", "stale", from_s=0.0))
    start = world.joints()
    world.clock.sleep_until(world.move_to(world.viewpoints[3].q))
    with SimArm(world) as arm:
        assert arm.read_joints(0.1).q == pytest.approx(start)
    assert np.abs(world.joints() - start).max() > 0.05


def test_a_dark_light_takes_the_command_and_stays_off():
    world = world_with(Fault("light", "dark", from_s=1.0))
    with SimLight(world) as light, SimColourCamera(world) as camera:
        lit = camera.grab(light.set_level(1.0), 1.0).rgb.mean()
        world.clock.sleep(1.0)
        dark = camera.grab(light.set_level(1.0), 1.0).rgb.mean()
    assert lit > 20 * max(dark, 1)


def test_faults_touch_their_own_device_only():
    world = world_with(Fault("colour", "broken"), Fault("light", "silent"))
    with SimDepthCamera(world) as depth, SimArm(world) as arm:
        depth.grab(world.clock.now_ns(), 1.0)
        arm.read_joints(0.1)
    with pytest.raises(DeviceFaultError):
        SimColourCamera(world).open()
    with SimLight(world) as light, pytest.raises(DeviceTimeoutError):
        light.set_level(1.0)


def test_a_fault_can_be_injected_while_the_world_runs():
    world = world_with()
    with SimArm(world) as arm:
        arm.read_joints(0.1)
        world.inject(Fault("arm", "broken"))
        with pytest.raises(DeviceFaultError):
            arm.read_joints(0.1)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("camera", "absent"), "allowed: colour, depth, light, arm"),
        (("light", "drop"), "allowed: absent, silent, broken, dark"),
        (("arm", "frozen", 2.0, 1.0), "from < to"),
        (("colour", "drop", 0.0, 1.0, 0), "every 0"),
        (("colour", "late", 0.0, 1.0, 1, -1.0), "delay -1"),
    ],
)
def test_impossible_faults_are_refused_with_what_is_allowed(arguments, says):
    with pytest.raises(ConfigurationError, match=says):
        Fault(*arguments)
