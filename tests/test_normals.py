"""Normals against analytic planes, a plain PCA and Open3D; every validity test must bite."""

import cv2
import numpy as np
import pytest
from raycast import Plane, as_mm, cast, kinect, make_rig, tilted

from surfclass.errors import ConfigurationError, InputError
from surfclass.geometry import depth_to_points
from surfclass.normals import NormalSettings, estimate_normals
from surfclass.rig import parse_rig

CAMERA = make_rig().depth
DISTORTED = make_rig(depth_distortion=(0.1, -0.2, 1e-3, -1e-3, 0.05)).depth


def error_deg(result, truth):
    """Angle to the true normal, (h, w) or (3,) broadcast, at the valid pixels."""
    truth = np.broadcast_to(np.moveaxis(np.asarray(truth), -1, 0).reshape(3, -1), (3, result.valid.size))
    cosine = (result.normal.reshape(3, -1) * truth).sum(axis=0).reshape(result.valid.shape)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))[result.valid]


@pytest.mark.parametrize("distance_m", [0.6, 1.0, 1.5])
@pytest.mark.parametrize(("angle", "about"), [(0, "y"), (20, "x"), (-40, "y"), (60, "x")])
def test_noise_free_planes(angle, about, distance_m):
    plane = tilted(angle, distance_m, about)
    depth, _ = cast([plane], CAMERA)
    depth = np.where(depth < 4, depth, np.inf)
    exact = estimate_normals(as_mm(depth, quantised=False), CAMERA)
    assert np.median(error_deg(exact, plane.normal)) < 0.02
    assert error_deg(exact, plane.normal).max() < 0.1
    assert exact.valid[np.isfinite(depth)].mean() > 0.995
    # Steps of 1 mm are an error of their own: a tilted plane becomes a flight of stairs.
    stairs = estimate_normals(as_mm(depth), CAMERA)
    assert np.median(error_deg(stairs, plane.normal)) < (0.25 if distance_m < 0.8 else 0.1)
    assert stairs.valid[np.isfinite(depth)].mean() > 0.995


@pytest.mark.parametrize("angle", [0, 30, 60])
def test_kinect_noise_at_1_m(angle):
    plane = tilted(angle, 1.0)
    depth, _ = cast([plane], CAMERA)
    depth = np.where(depth < 2, depth, np.inf)
    result = estimate_normals(kinect(depth), CAMERA)
    assert np.median(error_deg(result, plane.normal)) < 1.2
    assert np.quantile(error_deg(result, plane.normal), 0.95) < 3
    assert result.valid[np.isfinite(depth)].mean() > 0.99


def test_thresholds_that_do_not_grow_with_distance_reject_a_far_wall():
    depth, _ = cast([tilted(0, 3.0)], CAMERA)
    image = kinect(depth)
    result = estimate_normals(image, CAMERA)
    assert result.valid.mean() > 0.97
    assert np.median(error_deg(result, (0, 0, -1))) < 2
    assert estimate_normals(image, CAMERA, NormalSettings(tau_kappa_growth=0.0)).valid.mean() < 0.1


def test_distortion_is_undone():
    plane = tilted(35, 0.9)
    depth, _ = cast([plane], DISTORTED)
    image = as_mm(depth, quantised=False)
    assert error_deg(estimate_normals(image, DISTORTED), plane.normal).max() < 0.1
    assert np.quantile(error_deg(estimate_normals(image, CAMERA), plane.normal), 0.9) > 0.5


def test_normals_are_unit_face_the_camera_and_are_zero_elsewhere():
    depth, _ = cast([tilted(60, 1.0), Plane((0.866, 0, -0.5), -0.5, (-9, -9), (-0.1, 9))], CAMERA)
    image = kinect(depth)
    image[100:140, 200:300] = 0
    result = estimate_normals(image, CAMERA)
    assert (result.normal.dtype, result.valid.dtype) == (np.float32, bool)
    assert result.normal.shape == (3, 480, 640)
    facing = (result.normal * depth_to_points(image, CAMERA)).sum(axis=0)
    assert (facing[result.valid] < 0).all()
    assert np.linalg.norm(result.normal, axis=0)[result.valid] == pytest.approx(1, abs=1e-5)
    assert not result.normal[:, ~result.valid].any()
    assert not result.valid[image == 0].any()


def test_no_normal_is_averaged_across_a_jump():
    near = Plane((0, 0, -1.0), -0.8, (-0.15, -0.1), (0.15, 0.1))
    depth, _ = cast([near, Plane((0, 0, -1.0), -0.95)], CAMERA)
    result = estimate_normals(kinect(depth), CAMERA)
    assert np.quantile(error_deg(result, (0, 0, -1)), 0.9999) < 8
    assert result.valid.mean() > 0.99


def test_a_step_of_20_mm_costs_no_normals():
    """A block takes only a plane that it lies on itself, though the one beside it is as thin."""
    near = Plane((0, 0, -1.0), -0.8, (-0.15, -0.1), (0.15, 0.1))
    depth, _ = cast([near, Plane((0, 0, -1.0), -0.82)], CAMERA)
    assert estimate_normals(as_mm(depth), CAMERA).valid.all()


def test_normals_reach_up_to_a_crease():
    """A right-angled corner: eccentric windows serve the pixels that a centred window spoils."""
    c = np.sqrt(0.5)
    walls = [Plane((c, 0, -c), -c * 0.9), Plane((-c, 0, -c), -c * 0.9)]
    depth, surface = cast(walls, CAMERA)
    truth = np.array([wall.normal for wall in walls])[surface]
    result = estimate_normals(kinect(depth), CAMERA)
    crease = np.abs(np.arange(640) - 319.5)
    near = np.broadcast_to((crease > 6) & (crease < 24), (480, 640))
    assert result.valid[near].mean() > 0.98
    cosine = (result.normal * np.moveaxis(truth, -1, 0)).sum(axis=0)
    assert np.median(np.degrees(np.arccos(np.clip(cosine[near & result.valid], -1, 1)))) < 1.5
    assert (cosine[near & result.valid] > np.cos(np.radians(15))).mean() > 0.97


def test_surfaces_smaller_than_the_whole_window_have_normals_too():
    strip = Plane((0, 0, -1.0), -1.0, (-0.018, -1), (0.018, 1))  # 21 pixels wide, the window has 30
    depth, surface = cast([strip, Plane((0, 0, -1.0), -1.5)], CAMERA)
    result = estimate_normals(kinect(depth), CAMERA)
    core = cv2.erode((surface == 0).astype(np.uint8), np.ones((1, 5))) > 0
    assert result.valid[core].mean() > 0.95
    truth = np.degrees(np.arccos(np.clip(-result.normal[2][core & result.valid], -1, 1)))
    assert np.median(truth) < 3.5


def test_too_few_neighbours():
    patch = np.zeros((480, 640), np.uint16)
    patch[200, 300:303] = 1000
    fewest = NormalSettings(min_neighbours=4)
    assert not estimate_normals(patch, CAMERA, fewest).valid.any()
    patch[200:203, 300:303] = 1000
    assert estimate_normals(patch, CAMERA, fewest).valid.sum() == 9
    assert not estimate_normals(patch, CAMERA, NormalSettings(min_neighbours=10)).valid.any()


def test_readings_on_a_line_have_no_normal():
    line = np.zeros((480, 640), np.uint16)
    line[200] = 1000
    assert not estimate_normals(line, CAMERA, NormalSettings(min_neighbours=4)).valid.any()


def test_tau_alpha_rejects_what_is_as_thick_as_wide():
    image = np.random.default_rng(0).uniform(960, 1040, (480, 640)).astype(np.uint16)
    anything_near = {"tau_kappa_m": 1.0}
    assert not estimate_normals(image, CAMERA, NormalSettings(tau_alpha=4, **anything_near)).valid.any()
    assert estimate_normals(image, CAMERA, NormalSettings(tau_alpha=0.1, **anything_near)).valid.mean() > 0.9


def mixed(share, apart_mm):
    """A wall at 1 m with a share of its readings scattered behind it."""
    behind = np.random.default_rng(0).random((480, 640)) < share
    return (1000 + apart_mm * behind).astype(np.uint16)


def test_tau_kappa_wants_more_than_half_of_the_neighbours():
    def valid_share(image, tau_kappa_m):
        chosen = NormalSettings(tau_alpha=1, tau_kappa_m=tau_kappa_m, tau_kappa_growth=0.0)
        return estimate_normals(image, CAMERA, chosen).valid.mean()

    # Half and half, 20 mm apart: every reading is 10 mm from the plane between them.
    assert valid_share(mixed(0.5, 20), 0.005) == 0
    assert valid_share(mixed(0.5, 20), 0.016) > 0.99
    # 70 % lie 6 mm and 30 % 14 mm off: too thick to be sure without counting, and the count decides.
    assert valid_share(mixed(0.3, 20), 0.009) > 0.5
    assert valid_share(mixed(0.3, 20), 0.004) == 0


def test_a_stray_reading_gets_no_normal_from_the_plane_that_it_is_off():
    image = np.full((480, 640), 1000, np.uint16)
    image[240, 320] = 1030
    valid = estimate_normals(image, CAMERA).valid
    assert not valid[240, 320]
    assert valid[240, 325]


def test_agrees_with_plain_pca():
    """Eq. 3.6 literally, at a sample of pixels: smallest eigenvector of the neighbours' covariance."""
    plane = tilted(35, 0.8)
    depth, _ = cast([plane], CAMERA)
    image = kinect(depth)
    points = depth_to_points(image, CAMERA).reshape(3, -1).T.astype(np.float64)
    result = estimate_normals(image, CAMERA)
    rng = np.random.default_rng(0)
    ours, pca = [], []
    for pixel in rng.integers(0, [400, 560], (60, 2)) + 40:
        centre = points[pixel[0] * 640 + pixel[1]]
        near = points[np.linalg.norm(points - centre, axis=1) < 0.024]
        normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
        pca.append(np.degrees(np.arccos(min(1, abs(normal @ plane.normal)))))
        ours.append(np.degrees(np.arccos(min(1, result.normal[:, *pixel] @ plane.normal))))
    assert np.median(ours) < np.median(pca) * 1.1


@pytest.mark.slow
def test_no_worse_than_open3d():
    open3d = pytest.importorskip("open3d", exc_type=ImportError)

    depth, _ = cast([tilted(30, 1.0)], CAMERA)
    image = kinect(depth)
    crop = np.s_[160:320, 220:420]
    points = depth_to_points(image, CAMERA)[:, *crop].reshape(3, -1).T.astype(np.float64)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamRadius(0.026))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    truth = np.array(tilted(30, 1.0).normal)
    theirs = np.degrees(np.arccos(np.clip(np.asarray(cloud.normals) @ truth, -1, 1)))
    result = estimate_normals(image, CAMERA)
    mine = np.degrees(np.arccos(np.clip(np.tensordot(truth, result.normal[:, *crop], 1), -1, 1)))
    assert np.median(mine) < np.median(theirs)
    assert np.quantile(mine, 0.95) < np.quantile(theirs, 0.95)


def test_flat_parts_of_a_real_room_have_normals(shared):
    """Table and wall of real Kinect frames, 0.8 to 2.9 m; one set of fixed thresholds loses them."""
    folder = shared / "data" / "kitchen"
    camera = parse_rig((folder / "rig.toml").read_bytes(), "rig.toml").depth
    shares, fixed_shares = [], []
    fixed = NormalSettings(tau_alpha=20, tau_kappa_m=0.004, tau_kappa_growth=0)
    for name, part in (("000240", np.s_[330:470, 300:620]), ("000400", np.s_[90:150, 400:560])):
        image = cv2.imread(str(folder / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        image[image > 6000] = 0
        seen = image[part] > 0
        shares.append(estimate_normals(image, camera).valid[part][seen].mean())
        fixed_shares.append(estimate_normals(image, camera, fixed).valid[part][seen].mean())
    assert min(shares) > 0.98
    assert min(fixed_shares) < 0.6


def test_same_input_gives_the_same_bytes():
    image = kinect(cast([tilted(40, 1.2)], CAMERA)[0])
    first, second = estimate_normals(image, CAMERA), estimate_normals(image, CAMERA)
    assert first.normal.tobytes() == second.normal.tobytes()
    assert first.valid.tobytes() == second.valid.tobytes()


def test_sizes_that_are_no_multiple_of_a_block():
    camera = make_rig(depth_size=(131, 99), depth_f=300.0).depth
    plane = tilted(30, 2.0)
    depth, _ = cast([plane], camera)
    result = estimate_normals(as_mm(depth, quantised=False), camera)
    assert result.valid.shape == (99, 131)
    assert result.valid.mean() > 0.99
    assert error_deg(result, plane.normal).max() < 0.1


def test_nothing_seen_and_wrong_sizes():
    assert not estimate_normals(np.zeros((480, 640), np.uint16), CAMERA).valid.any()
    with pytest.raises(InputError, match=r"\(480, 640\)"):
        estimate_normals(np.zeros((240, 320), np.uint16), CAMERA)


@pytest.mark.parametrize(
    "wrong", [{"min_neighbours": 3}, {"radius_m": 0.0}, {"tau_alpha": np.nan}, {"tau_kappa_growth": -1.0}]
)
def test_settings_are_checked(wrong):
    with pytest.raises(ConfigurationError):
        NormalSettings(**wrong)
