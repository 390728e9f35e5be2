"""Rays, points, projection and registration against ray-cast truth."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raycast import (
    ROTATION_VECTOR,
    TRANSLATION_MM,
    Plane,
    as_mm,
    cast,
    kinect,
    make_rig,
    pixel_rays,
    real_extrinsics,
    tilted,
)

from surfclass.errors import ConfigurationError, InputError
from surfclass.geometry import depth_to_points, fit_plane, project, rays, register
from surfclass.rig import parse_rig
from surfclass.types import Transform

DISTORTION = (-0.20, 0.15, 0.002, -0.001, -0.05)
SIZES = {
    "1280x960": {},
    "640x480": {"rgb_size": (640, 480), "rgb_f": 812.367},
    "wide colour": {"rgb_size": (640, 480), "rgb_f": 525.0},
    "distorted": {"depth_distortion": (0.1, -0.2, 1e-3, -1e-3, 0.05), "rgb_distortion": DISTORTION},
}
BOARD = Plane((0, 0, -1.0), -0.7, (-0.12, -0.09), (0.10, 0.11))  # in front of a tilted wall
WALL = tilted(30, 1.0)


def test_rays_agree_with_opencv_and_are_shared_read_only():
    camera = make_rig(depth_distortion=DISTORTION).depth
    assert np.abs(np.moveaxis(rays(camera), 0, -1) - pixel_rays(camera)[..., :2]).max() < 2e-7
    assert rays(camera) is rays(make_rig(depth_distortion=DISTORTION).depth)
    with pytest.raises(ValueError, match="read-only"):
        rays(camera)[0, 0, 0] = 1


def test_distortion_without_inverse_is_refused():
    camera = make_rig(depth_distortion=(-2.5, 0, 0, 0, 0)).depth
    with pytest.raises(ConfigurationError, match="no inverse"):
        rays(camera)


@settings(deadline=None, max_examples=30)
@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.35, 0.35), st.floats(0.3, 4)),
    st.tuples(*[st.floats(-s, s) for s in (0.2, 0.2, 5e-3, 5e-3, 0.1)]),
)
def test_project_is_opencvs_model(ray, distortion):
    camera = make_rig(rgb_distortion=distortion).rgb
    point = np.array([ray[0] * ray[2], ray[1] * ray[2], ray[2]])
    expected = cv2.projectPoints(
        point[None, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(distortion)
    )[0].reshape(2)
    assert project(point, camera) == pytest.approx(expected, abs=1e-8)
    assert project(point.astype(np.float32), camera).dtype == np.float32


def test_project_refuses_points_behind_the_camera():
    with pytest.raises(InputError, match="2 points"):
        project(np.array([[0, 0, 1.0], [0, 0, 0], [0, 0, -1]]), make_rig().rgb)


def test_points_project_back_to_their_pixels():
    camera = make_rig(depth_distortion=DISTORTION).depth
    depth_mm = np.random.default_rng(1).integers(400, 4000, camera.shape).astype(np.uint16)
    depth_mm[10:20] = 0
    points = depth_to_points(depth_mm, camera)
    assert points.dtype == np.float32
    assert (points[:, 10:20] == 0).all()
    back = project(np.moveaxis(points, 0, -1)[20:].astype(np.float64), camera)
    grid = np.stack(np.meshgrid(np.arange(640), np.arange(20, 480)), axis=-1)
    assert np.abs(back - grid).max() < 1e-3


def test_ignoring_distortion_would_move_points():
    """Eq. 3.3–3.5 hold only after undistortion: in the corner the difference is centimetres."""
    camera = make_rig(depth_distortion=DISTORTION).depth
    depth_mm = np.full(camera.shape, 1000, np.uint16)
    corner = depth_to_points(depth_mm, camera)[:, 0, 0]
    printed = np.array([(0 - camera.cx) / camera.fx, (0 - camera.cy) / camera.fy, 1.0])
    truth = pixel_rays(camera)[0, 0]
    assert corner == pytest.approx(truth, abs=1e-6)
    assert np.linalg.norm(printed - truth) > 0.02


def test_size_of_the_depth_image_is_checked():
    rig = make_rig()
    for call in (lambda d: depth_to_points(d, rig.depth), lambda d: register(d, rig)):
        with pytest.raises(InputError, match=r"\(480, 640\)"):
            call(np.zeros((640, 480), np.uint16))


def test_plane_through_noisy_points_faces_the_origin():
    rng = np.random.default_rng(0)
    normal = np.array([0.3, -0.2, -0.933])
    normal /= np.linalg.norm(normal)
    flat = rng.uniform(-0.2, 0.2, (500, 3)) + np.array([0, 0, 0.8])
    on_plane = flat - np.outer(flat @ normal + 0.7, normal) + rng.normal(0, 1e-4, (500, 1)) * normal
    found, offset = fit_plane(on_plane)
    assert found == pytest.approx(normal, abs=2e-4)
    assert offset == pytest.approx(-0.7, abs=1e-4)


@pytest.mark.parametrize(
    "points",
    [np.zeros((2, 3)), np.outer(np.arange(5.0), [1, 2, 3]), np.full((4, 3), np.nan), np.ones((4, 2))],
)
def test_plane_needs_three_points_off_a_line(points):
    with pytest.raises(InputError, match="plane"):
        fit_plane(points)


@pytest.mark.parametrize("name", SIZES)
def test_registration_against_ray_casting(name):
    """The board's own parallax shadow stays empty and hidden wall never shows through the board."""
    rig = make_rig(**SIZES[name])
    pose = real_extrinsics()
    depth, _ = cast([BOARD, WALL], rig.depth, pose)
    truth, surface = cast([BOARD, WALL], rig.rgb)
    result = register(as_mm(depth, quantised=False), rig)
    assert (result.point.dtype, result.u.dtype, result.has_point.dtype) == (np.float32, np.float32, bool)
    assert (result.point[:, ~result.has_point] == 0).all()

    error = np.abs(result.point[2] - truth)
    assert np.quantile(error[result.has_point], 0.999) < 1e-4
    # The board's outline is known to one depth pixel only; a pixel there may carry the wall's depth.
    outline = cv2.morphologyEx((surface == 0).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((7, 7)))
    assert error[result.has_point & (outline == 0)].max() < 1e-4

    # Where both cameras see the surface there is a point; where the depth camera cannot, none.
    seen_by_depth, inside = visible_in_depth(truth, depth, rig, pose)
    margin = cv2.dilate((~seen_by_depth & inside).astype(np.uint8), np.ones((9, 9))) > 0
    margin |= outline > 0
    assert result.has_point[seen_by_depth & inside & ~margin].mean() > 0.999
    shadow = cv2.erode((~seen_by_depth & inside).astype(np.uint8), np.ones((5, 5))) > 0
    assert shadow.sum() > 500
    assert result.has_point[shadow].sum() == 0

    # (u, v) is the place in the depth image, and the point lies on its pixel's ray.
    chosen = result.has_point & (outline == 0)
    in_depth = Transform("rgb", "depth", pose).inverse @ result.point[:, chosen].T.astype(np.float64)
    place = project(in_depth, rig.depth)
    shift = np.abs(place - np.stack([result.u[chosen], result.v[chosen]], axis=-1))
    assert np.quantile(shift, 0.99) < 0.01
    assert shift.max() < 0.51
    expected_ray = pixel_rays(rig.rgb)[chosen][:, :2]
    point = result.point[:, chosen]
    assert np.abs((point[:2] / point[2]).T - expected_ray).max() < 1e-6


def visible_in_depth(truth, depth, rig, pose):
    """Whether the depth camera measured the surface that each colour pixel sees, by reprojection."""
    points = pixel_rays(rig.rgb) * truth[..., None]
    points = points @ pose[:3, :3] - pose[:3, 3] @ pose[:3, :3]
    u, v = np.moveaxis(project(points, rig.depth), -1, 0)
    h, w = depth.shape
    inside = (u > 1) & (u < w - 2) & (v > 1) & (v < h - 2)
    measured = cv2.remap(
        depth.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_NEAREST
    )
    return np.abs(measured - points[..., 2]) < 0.02, inside


def test_nearest_surface_wins_even_where_the_far_one_is_found_first():
    """A thin post: beside it the depth camera sees the wall that the colour camera sees the post before."""
    rig = make_rig(pose=Transform("rgb", "depth", np.eye(4)).matrix + np.eye(4, k=3) * 0.08)
    post = Plane((0, 0, -1.0), -0.6, (-0.01, -1), (0.01, 1))
    wall = Plane((0, 0, -1.0), -1.2)
    depth, _ = cast([post, wall], rig.depth, np.array(rig.transforms.rgb_T_depth))
    truth, surface = cast([post, wall], rig.rgb)
    result = register(as_mm(depth), rig)
    core = cv2.erode((surface == 0).astype(np.uint8), np.ones((7, 7))) > 0
    assert result.has_point[core].mean() > 0.99
    assert np.abs(result.point[2] - truth)[core & result.has_point].max() < 2e-3


def test_little_shows_through_at_the_outlines_of_clutter():
    """Random small boards: without the z-buffer's test three times as many outline pixels see behind."""
    rng = np.random.default_rng(1)
    boards = [tilted(20, 1.5)]
    for _ in range(25):
        centre, half = rng.uniform([-0.5, -0.4, 0.5], [0.5, 0.4, 1.4]), rng.uniform(0.005, 0.1, 2)
        normal = np.array([*rng.normal(size=2), -1.0])
        normal /= np.linalg.norm(normal)
        boards.append(
            Plane(tuple(normal), normal @ centre, tuple(centre[:2] - half), tuple(centre[:2] + half))
        )
    rig = make_rig(**SIZES["640x480"])
    truth, surface = cast(boards, rig.rgb)
    result = register(as_mm(cast(boards, rig.depth, real_extrinsics())[0]), rig)
    outline = cv2.morphologyEx(surface.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0
    behind = result.point[2] > 1.03 * truth
    assert (behind & outline).sum() < 0.02 * outline.sum()


def test_no_depth_is_invented_in_holes_or_across_jumps():
    rig = make_rig()
    depth, _ = cast([BOARD, WALL], rig.depth, real_extrinsics())
    image = kinect(depth)
    image[200:230, 300:340] = 0
    image[:, 100] = 0
    result = register(image, rig)
    i, j = np.floor(result.v).astype(int), np.floor(result.u).astype(int)
    i, j = i[result.has_point], j[result.has_point]
    corners = np.stack([image[i + a, j + b] for a in (0, 1) for b in (0, 1)]).astype(float)
    assert corners.min() > 0
    assert (corners.max(axis=0) < 1.04 * corners.min(axis=0)).all()
    between = result.point[2][result.has_point]
    assert (np.abs(between * 1e3 - corners.mean(axis=0)) < 60).all()


def test_empty_depth_gives_no_points():
    result = register(np.zeros((480, 640), np.uint16), make_rig())
    assert not result.has_point.any()
    assert not result.point.any()


def test_same_input_gives_the_same_bytes():
    rig = make_rig(**SIZES["640x480"])
    image = kinect(cast([BOARD, WALL], rig.depth, real_extrinsics())[0])
    first, second = register(image, rig), register(image, rig)
    for name in ("point", "u", "v", "has_point"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_depth_points_need_rgb_T_depth_not_its_inverse():
    """After Eq. 3.5 the text applies `sTc`; by its own notation depth points need the other direction."""
    rig = make_rig()
    board = Plane((0, 0, -1.0), -0.65, (-0.05, -0.05), (0.05, 0.05))  # in rgb
    depth, _ = cast([board], rig.depth, real_extrinsics())
    points = np.moveaxis(depth_to_points(as_mm(depth), rig.depth), 0, -1)[np.isfinite(depth)]
    corrected = rig.rgb_T_depth @ points
    printed = rig.rgb_T_depth.inverse @ points
    assert np.abs(corrected[:, :2]).max() < 0.051
    assert np.abs(corrected[:, 2] - 0.65).max() < 1e-3
    assert np.abs(printed[:, :2]).max() > 0.15
    assert np.median(np.abs(printed[:, 2] - 0.65)) > 5e-3
    assert register(as_mm(depth), rig).has_point.sum() == pytest.approx((1624.73 * 0.1 / 0.65) ** 2, rel=0.05)


def test_registering_a_cloud_of_rows_needs_the_transpose():
    """A.10 prints `[P 1] · T`; rows need `P · Rᵀ + t`, which is `[P 1] · Tᵀ`."""
    pose = Transform("rgb", "depth", real_extrinsics())
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    truth = np.array([pose.rotation @ p + pose.translation for p in cloud])
    printed = (np.column_stack([cloud, np.ones(50)]) @ pose.matrix)[:, :3]
    assert np.abs(pose @ cloud - truth).max() < 1e-12
    assert np.abs(printed - truth).max() > 0.05


def test_translation_of_table_6_2_is_in_millimetres(shared):
    """The row is headed as radians: read so, or as metres, the two cameras would share no view."""
    known = parse_rig((shared / "data" / "rendered" / "rig.toml").read_bytes(), "rig.toml")
    assert known.rgb_T_depth.translation == pytest.approx(np.array(TRANSLATION_MM) * 1e-3, abs=1e-7)
    assert cv2.Rodrigues(known.rgb_T_depth.rotation)[0].ravel() == pytest.approx(ROTATION_VECTOR, abs=1e-4)
    image = cv2.imread(str(shared / "data" / "rendered" / "depth" / "train_timber.png"), cv2.IMREAD_UNCHANGED)
    metres = real_extrinsics()
    metres[:3, 3] = TRANSLATION_MM
    printed = known.model_copy(
        update={"transforms": known.transforms.model_copy(update={"rgb_T_depth": tuple(map(tuple, metres))})}
    )
    assert register(image, known).has_point.mean() > 0.8
    assert not register(image, printed).has_point.any()
