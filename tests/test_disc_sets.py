"""Reflector discs on independent images: the simulated cell's plate and the ray-cast reference set."""

import json
import tomllib

import cv2
import numpy as np
import pytest
from disc_scenes import find_discs

from calibration.gates import HandEyeGates
from calibration.hand_eye.command import Options, calibrate
from calibration.rotations import difference
from calibration.source import Source
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.frames import DepthFrame
from surfclass.geometry import project
from surfclass.rig import parse_depth_rig
from surfclass.types import Transform


def measured(seed, views, edit=None):
    """Every disc's error in the image (px) and in the camera's frame (m), each over its reported sd."""
    world = SimWorld("reflector_discs", seed)
    rig = parse_depth_rig(truth.rig(world), "rig")
    plate = tomllib.loads(truth.plate_toml(world))
    pixel, place, pixel_share, place_share = [], [], [], []
    for number in views:
        q = world.viewpoints[number].q
        depth_mm, ir = world.render_depth(q, 100 * seed + number)
        centres = truth.base_T_depth(world, q).inverse @ np.array(plate["positions_base_m"])
        shown = project(centres, rig.depth)
        if edit is not None:
            depth_mm, ir = edit(depth_mm, ir, shown)
        discs = find_discs(DepthFrame(0, 0, None, depth_mm, ir), rig.depth, plate["disc_radius_m"])
        assert len(discs) == 9
        for disc in discs:
            nearest = np.linalg.norm(shown - disc.pixel, axis=1).argmin()
            pixel.append(disc.pixel - shown[nearest])
            place.append(disc.camera_m - centres[nearest])
            pixel_share.append(pixel[-1] / np.sqrt(np.diag(disc.pixel_covariance)))
            place_share.append(place[-1] / np.sqrt(np.diag(disc.camera_covariance)))
    return tuple(np.array(part) for part in (pixel, place, pixel_share, place_share))


def check(pixel, place, pixel_share, place_share):
    assert np.abs(pixel.mean(axis=0)).max() < 0.05
    assert np.linalg.norm(pixel, axis=1).max() < 0.5
    assert np.abs(place.mean(axis=0)).max() < 0.0001
    assert np.sqrt(np.mean(np.sum(place**2, axis=1))) < 0.0005
    for share in (pixel_share, place_share):
        assert 0.7 < np.sqrt(np.mean(share**2)) < 1.5


def test_the_simulated_plate_is_measured_without_bias_and_as_well_as_is_reported():
    check(*measured(0, (0, 6, 9)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 4))
def test_the_simulated_plate_is_measured_from_everywhere(seed):
    check(*measured(seed, range(14)))


@pytest.mark.slow
def test_dim_and_overexposed_simulated_plates_are_measured_alike():
    def dim(depth_mm, ir, _):
        return depth_mm, (ir // 30).astype(np.uint16)

    def overexposed(depth_mm, ir, shown):
        depth_mm = depth_mm.copy()
        for x, y in shown:
            cv2.circle(depth_mm, (round(x), round(y)), 15, 0, -1)
        return depth_mm, np.minimum(ir * 6, 1023).astype(np.uint16)

    for edit in (dim, overexposed):
        pixel, place, _, _ = measured(0, (2, 10), edit)
        assert np.linalg.norm(pixel, axis=1).max() < 0.5
        assert np.sqrt(np.mean(np.sum(place**2, axis=1))) < 0.0006


def test_the_reference_set_gives_its_hand_eye(shared):
    folder = shared / "data/hand_eye_discs"
    notes = []
    outcome = calibrate(Source.open(folder), Options(), HandEyeGates(), notes.append)
    assert not any("left out," in note for note in notes)
    assert outcome.verdict == "pass"
    true = Transform(
        "flange", "depth", np.array(json.loads((folder / "truth.json").read_text())["flange_T_depth"])
    )
    away = difference(Transform("flange", "depth", np.array(outcome.result["flange_T_camera"])), true)
    assert np.linalg.norm(away[3:]) < 0.0006
    assert np.linalg.norm(away[:3]) < np.radians(0.08)
    sd = outcome.result["jackknife_sd"]
    assert np.abs(away[3:] / np.array(sd["translation_m"])).max() < 2.5
    assert np.abs(away[:3] / np.array(sd["rotation_rad"])).max() < 2.5
