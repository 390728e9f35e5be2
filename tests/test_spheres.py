"""Two spheres on a rod: centres from noisy caps, the fixed camera's pose, and what is refused."""

import csv

import cv2
import numpy as np
import pytest

from calibration.gates import HandEyeGates
from calibration.hand_eye.spheres import SpherePair, find_pair, fit_sphere, pinhole_of_cloud
from calibration.hand_eye.spheres_command import SpheresOptions, calibrate_spheres, read_frames
from calibration.hand_eye.spheres_fit import fit_spheres
from calibration.outcome import RefusedError
from calibration.rotations import difference, motion
from surfclass.errors import InputError
from surfclass.types import Transform

FOCAL, CX, CY = 700.0, 322.5, 198.25
SHAPE = (400, 640)
RADII = (0.012, 0.010)
APART = 0.050
ALONG = 0.068
BASE_T_CAMERA = motion(np.array([0.5, -0.4, 1.2, 0.06, 0.21, -0.01]), "base", "camera")


def tangents():
    y, x = np.indices(SHAPE).astype(float)
    return (x - CX) / FOCAL, (y - CY) / FOCAL


def drawn(centres, rng, noise=0.0001, extra=None):
    """IR (h, w) and the depth (h, w) m, 0 = none, of spheres at `centres` in front of nothing."""
    x, y = tangents()
    ray = np.stack([x, y, np.ones(SHAPE)])
    depth, ir = np.zeros(SHAPE), rng.normal(6, 2, SHAPE)
    for centre, radius in zip(centres, RADII, strict=True):
        a, b = (ray**2).sum(axis=0), np.tensordot(centre, ray, axes=1)
        root = b**2 - a * (centre @ centre - radius**2)
        z = (b - np.sqrt(np.maximum(root, 0))) / a
        depth = np.where(root > 0, z, depth)
        ir = np.where(root > 0, 140 * np.clip(np.sqrt(np.maximum(root, 0)) / radius, 0.2, 1) ** 0.3, ir)
    if extra is not None:
        ir, depth = extra(ir, depth)
    depth = np.where(depth > 0, depth + rng.normal(0, noise, SHAPE), 0)
    return np.clip(cv2.GaussianBlur(ir, (0, 0), 0.7), 0, 255).astype(np.uint8), depth


def cloud(depth):
    """Pixels (n, 2) and points (n, 3) of a depth image."""
    x, y = tangents()
    valid = depth > 0
    points = np.stack([x * depth, y * depth, depth], axis=-1)[valid]
    rows, columns = np.nonzero(valid)
    return np.column_stack([columns, rows]), points


def seen(centres, rng, **how):
    ir, depth = drawn(centres, rng, **how)
    pixels, points = cloud(depth)
    return find_pair(ir, pixels, points, RADII, APART)


def rod(direction, middle=(-0.05, 0.02, 0.27)):
    half = APART / 2 * np.asarray(direction) / np.linalg.norm(direction)
    return np.array([middle - half, middle + half])


def world(count=14, seed=0, spread=0.12, noise=0.0001, tool_noise=0.0003):
    """Exact rods, sightings with noise (as the detector's), and what the arm reads."""
    rng = np.random.default_rng(seed)
    pairs, tool = [], []
    for _ in range(count):
        direction = np.array([0.3, 0.7, 0.6]) + rng.normal(0, spread, 3)
        centres = rod(direction, rng.uniform([-0.08, -0.04, 0.23], [0.08, 0.04, 0.32]))
        axis = (centres[1] - centres[0]) / APART
        tool.append(BASE_T_CAMERA @ (centres.mean(axis=0) + ALONG * axis) + rng.normal(0, tool_noise, 3))
        first, second = (
            fit_like(centre + rng.normal(0, noise, 3), radius)
            for centre, radius in zip(centres, RADII, strict=True)
        )
        pairs.append(SpherePair(first, second))
    return pairs, np.array(tool)


def fit_like(centre, radius):
    from calibration.hand_eye.spheres import Sphere

    return Sphere(centre, radius, 0.0001, 500)


def test_centres_come_out_of_noisy_caps_without_bias():
    rng, errors, apart = np.random.default_rng(0), [], []
    for direction in ((0.3, 0.7, 0.6), (1, 0, 0), (0.5, -0.5, 0.6), (0.2, 0.9, -0.3)):
        centres = rod(direction)
        pair = seen(centres, rng)
        errors.append([pair.first.centre_m - centres[0], pair.second.centre_m - centres[1]])
        apart.append(pair.distance_m - APART)
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 5e-5
    assert np.abs(errors).max() < 2e-4
    assert np.abs(apart).max() < 1.5e-4


def test_a_hidden_part_and_mixed_rim_readings_move_nothing():
    centres = rod((0.3, 0.7, 0.6))

    def spoil(ir, depth):
        ir, depth = ir.copy(), depth.copy()
        column = round(CX + FOCAL * centres[0][0] / centres[0][2])
        edge = (depth > 0) & (cv2.erode(depth, np.ones((5, 5))) == 0)
        depth[edge] += 0.01
        row = round(CY + FOCAL * centres[0][1] / centres[0][2])
        depth[row - 60 : row - 12, column - 12 : column + 12] = 0
        ir[row - 60 : row - 12, column - 12 : column + 12] = 5
        return ir, depth

    pair = seen(centres, np.random.default_rng(1), extra=spoil)
    assert np.linalg.norm(pair.first.centre_m - centres[0]) < 3e-4
    assert np.linalg.norm(pair.second.centre_m - centres[1]) < 3e-4


def test_another_bright_thing_is_no_sphere():
    centres = rod((1, 0.2, 0.1))

    def shine(ir, depth):
        ir, depth = ir.copy(), depth.copy()
        ir[300:380, 400:600], depth[300:380, 400:600] = 200, 0.3
        return ir, depth

    pair = seen(centres, np.random.default_rng(2), extra=shine)
    assert np.linalg.norm(pair.first.centre_m - centres[0]) < 2e-4


def test_what_is_not_the_pair_says_why():
    rng = np.random.default_rng(3)
    ir, depth = drawn(rod((1, 0, 0)), rng)
    pixels, points = cloud(depth)
    assert "apart" in find_pair(ir, pixels, points, RADII, 0.08)
    dark = np.zeros_like(ir)
    assert "bright regions" in find_pair(dark, pixels, points, RADII, APART)
    flat = points * [1, 1, 0] + [0, 0, 0.3]
    assert isinstance(find_pair(ir, pixels, flat, RADII, APART), str)
    assert fit_sphere(points[:20], RADII[0]) is None


def test_an_organised_cloud_tells_its_pinhole():
    _, depth = drawn(rod((0.3, 0.7, 0.6)), np.random.default_rng(4))
    pixels, points = cloud(depth)
    camera = pinhole_of_cloud(pixels, points)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((FOCAL, FOCAL, CX, CY), abs=1e-6)
    with pytest.raises(InputError, match="no pinhole"):
        pinhole_of_cloud(pixels, points + np.random.default_rng(0).normal(0, 0.001, points.shape))
    with pytest.raises(InputError, match="needed are 100"):
        pinhole_of_cloud(pixels[:50], points[:50])


def test_the_fixed_camera_and_the_tool_centre_are_found():
    pairs, tool = world(30)
    fit = fit_spheres(pairs, tool)
    away = difference(fit.base_T_camera, BASE_T_CAMERA)
    assert np.linalg.norm(away[:3]) < np.radians(0.6)
    assert np.linalg.norm(away[3:]) < 0.003
    assert fit.along_m == pytest.approx(ALONG, abs=0.002)
    assert fit.used.all()
    exact = fit_spheres(*world(12, noise=0.0, tool_noise=0.0))
    assert np.abs(difference(exact.base_T_camera, BASE_T_CAMERA)).max() < 1e-5
    assert exact.along_m == pytest.approx(ALONG, abs=1e-5)


def test_the_reported_spread_is_the_sampled_one():
    errors, reported = [], []
    for seed in range(14):
        fit = fit_spheres(*world(14, seed))
        away = difference(fit.base_T_camera, BASE_T_CAMERA)
        errors.append([*away[:3], *away[3:], fit.along_m - ALONG])
        reported.append([*fit.rotation_sd_rad, *fit.translation_sd_m, fit.along_sd_m])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(reported), axis=0))
    assert ratio.min() > 0.5
    assert ratio.max() < 1.6
    bias = np.mean(errors, axis=0) / (np.std(errors, axis=0) / np.sqrt(14))
    assert np.abs(bias).max() < 3.5


def test_the_order_of_the_poses_changes_nothing():
    pairs, tool = world(10)
    turned = np.random.default_rng(0).permutation(10)
    one, other = fit_spheres(pairs, tool), fit_spheres([pairs[i] for i in turned], tool[turned])
    assert one.base_T_camera.matrix == pytest.approx(other.base_T_camera.matrix, abs=1e-6)
    assert one.left_out_m[turned] == pytest.approx(other.left_out_m, abs=1e-6)


def test_a_pose_that_was_read_wrong_is_named_and_spoils_nothing():
    pairs, tool = world(14, 5)
    tool[6] += [0.01, -0.006, 0.004]
    fit = fit_spheres(pairs, tool)
    assert np.flatnonzero(~fit.used).tolist() == [6]
    assert fit.left_out_m[6] > 0.008
    assert np.linalg.norm(difference(fit.base_T_camera, BASE_T_CAMERA)[:3]) < np.radians(1)


def test_poses_that_cannot_tell_are_refused():
    pairs, tool = world(8)
    with pytest.raises(RefusedError, match="5 poses, needed are 6"):
        fit_spheres(pairs[:5], tool[:5])
    with pytest.raises(RefusedError, match="points the same way"):
        fit_spheres(*world(10, spread=0.002))
    with pytest.raises(InputError, match="tool centres"):
        fit_spheres(pairs, tool[:5])
    with pytest.raises(RefusedError, match="line"):
        fit_spheres(pairs, np.outer(np.arange(8), [0.01, 0, 0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("spheres")
    (root / "ir").mkdir()
    rng, clouds, rows = np.random.default_rng(7), {}, []
    for number in range(8):
        direction = np.array([0.3, 0.7, 0.6]) + rng.normal(0, 0.3, 3)
        centres = rod(direction, rng.uniform([-0.06, -0.03, 0.25], [0.06, 0.03, 0.31]))
        ir, depth = drawn(centres, rng)
        pixels, points = cloud(depth)
        cv2.imwrite(str(root / "ir" / f"{number:02d}.png"), ir)
        clouds[f"index_{number:02d}"] = (pixels[:, 1] * SHAPE[1] + pixels[:, 0]).astype(np.int32)
        clouds[f"xyz_mm_{number:02d}"] = (1e3 * points).astype(np.float32)
        axis = (centres[1] - centres[0]) / APART
        rows.append(BASE_T_CAMERA @ (centres.mean(axis=0) + ALONG * axis) + rng.normal(0, 0.0002, 3))
    np.savez(root / "clouds.npz", **clouds)
    with (root / "marker_base_m.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["x", "y", "z"], *[row.tolist() for row in rows]])
    return root


def test_a_folder_gives_an_outcome_with_its_figures(folder):
    notes = []
    outcome = calibrate_spheres(folder, SpheresOptions(RADII, APART), HandEyeGates(), notes.append)
    assert notes == []
    found = Transform("base", "camera", np.array(outcome.result["base_T_camera"]))
    sd = outcome.result["jackknife_sd"]
    away = difference(found, BASE_T_CAMERA)
    assert np.all(np.abs(away[:3]) < 5 * np.array(sd["rotation_rad"]))
    assert np.all(np.abs(away[3:]) < 5 * np.array(sd["translation_m"]))
    assert outcome.result["intrinsics"]["fx"] == pytest.approx(FOCAL, abs=0.01)
    assert outcome.result["leave_one_out_m"] < 0.001
    assert "leave-one-out" in outcome.sentence
    assert len(outcome.figures[0].rows) == 8
    strict = HandEyeGates(leave_one_out_m=1e-6, translation_sd_m=1e-6, rotation_sd_rad=1e-6)
    failed = calibrate_spheres(folder, SpheresOptions(RADII, APART), strict, notes.append)
    assert failed.verdict == "fail"
    assert len(failed.reasons) == 3


def test_the_wrong_rod_is_refused_and_every_pose_says_why(folder):
    notes = []
    with pytest.raises(RefusedError, match="no pose shows both"):
        calibrate_spheres(folder, SpheresOptions(RADII, 0.09), HandEyeGates(), notes.append)
    assert len(notes) == 8
    assert all("apart" in note for note in notes)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("marker_base_m.csv", "x,y\n1,2\n", "columns x,y,z"),
        ("marker_base_m.csv", "x,y,z\n1,2,3\n", "1 rows, there are 8 images"),
        ("marker_base_m.csv", "x,y,z\n1,2,nan\n" * 4, "columns x,y,z"),
        ("marker_base_m.csv", "x,y,z\n" + "1,2,nan\n" * 8, "not finite"),
        ("clouds.npz", "no archive", "clouds.npz"),
        ("ir/03.png", "no image", "no grey image"),
    ],
)
def test_broken_files_are_named(folder, tmp_path, name, content, why):
    copy = tmp_path / "set"
    copy.mkdir()
    (copy / "ir").mkdir()
    for path in folder.rglob("*.*"):
        (copy / path.relative_to(folder)).write_bytes(path.read_bytes())
    (copy / name).write_text(content)
    with pytest.raises(InputError, match=why):
        read_frames(copy)


def test_a_folder_without_images_is_no_set(tmp_path):
    with pytest.raises(InputError, match="no images"):
        read_frames(tmp_path)


def test_the_published_frames_are_predicted_within_0_62_mm_by_the_others(shared):
    notes = []
    outcome = calibrate_spheres(shared / "data/hand_eye_ir", SpheresOptions(), HandEyeGates(), notes.append)
    assert notes == []
    assert outcome.result["outlier_poses"] == []
    assert len(outcome.result["poses"]) == 20
    assert outcome.result["leave_one_out_m"] < 0.00062
    apart = np.array([pose["distance_m"] for pose in outcome.result["poses"]])
    assert apart.mean() == pytest.approx(0.05026, abs=0.0001)
    assert apart.std() < 0.0001
