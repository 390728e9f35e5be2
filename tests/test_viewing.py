"""Distances and angles per colour pixel against ray-cast truth."""

import numpy as np
import pytest
from raycast import Plane, as_mm, cast, kinect, make_rig, pixel_rays, real_extrinsics, tilted

from surfclass.viewing import view_surface

LIGHT = (-0.084, 0.037, -0.006)
WITH_LIGHT = f"light = {{position_rgb_m = {list(LIGHT)}}}"


@pytest.mark.parametrize("sizes", [{}, {"rgb_size": (640, 480), "rgb_f": 812.367}])
@pytest.mark.parametrize(("angle", "distance_m"), [(0, 0.65), (45, 0.8), (-30, 1.3)])
def test_distances_and_cosines_are_the_analytic_ones(angle, distance_m, sizes):
    rig = make_rig(extra=WITH_LIGHT, **sizes)
    plane = tilted(angle, distance_m)  # in rgb
    depth, _ = cast([plane], rig.depth, real_extrinsics())
    view = view_surface(as_mm(depth, quantised=False), rig)
    points = pixel_rays(rig.rgb) * cast([plane], rig.rgb)[0][..., None]
    seen = view.has_normal
    assert seen.mean() > 0.9
    normal = np.array(plane.normal)
    for place, distance, cosine in (
        (np.zeros(3), view.viewing_distance_m, view.viewing_cosine),
        (np.array(LIGHT), view.light_distance_m, view.light_cosine),
    ):
        away = place - points
        truth = np.linalg.norm(away, axis=-1)
        assert np.abs(distance - truth)[seen].max() < 1e-4
        assert np.abs(cosine - away @ normal / truth)[seen].max() < 2e-3
    assert np.abs(np.moveaxis(view.point, 0, -1) - points)[seen].max() < 1e-4
    assert np.abs(np.moveaxis(view.normal, 0, -1) - normal)[seen].max() < 2e-3


def test_normals_are_in_the_colour_cameras_frame():
    """With cameras turned against each other by 25° the two frames' normals cannot be confused."""
    turned = real_extrinsics()
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    turned[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    rig = make_rig(pose=turned)
    plane = tilted(10, 0.9)
    view = view_surface(as_mm(cast([plane], rig.depth, turned)[0], quantised=False), rig)
    assert view.has_normal.sum() > 100_000
    normals = view.normal[:, view.has_normal]
    assert np.abs(normals - np.array(plane.normal)[:, None]).max() < 2e-3


def test_light_behind_the_surface_has_a_negative_cosine():
    rig = make_rig(extra="light = {position_rgb_m = [2.0, 0.0, 1.0]}")
    plane = tilted(50, 0.9)
    view = view_surface(as_mm(cast([plane], rig.depth, real_extrinsics())[0]), rig)
    assert (view.light_cosine[view.has_normal] < 0).mean() == pytest.approx(
        float(np.array(plane.normal) @ (2.0, 0.0, 1.0) < plane.offset)
    )
    assert (view.viewing_cosine[view.has_normal] > 0).all()


def test_what_is_not_seen_is_zero_and_nothing_is_nan():
    rig = make_rig(extra=WITH_LIGHT)
    board = Plane((0, 0, -1.0), -0.7, (-0.1, -0.1), (0.1, 0.1))
    image = kinect(cast([board, tilted(30, 1.0)], rig.depth, real_extrinsics())[0])
    image[:, 200:260] = 0
    image[np.random.default_rng(0).random(image.shape) < 0.03] = 0
    view = view_surface(image, rig)
    assert not (view.has_normal & ~view.has_point).any()
    assert view.has_normal[view.has_point].mean() > 0.9
    for field in (
        "point",
        "normal",
        "viewing_distance_m",
        "viewing_cosine",
        "light_distance_m",
        "light_cosine",
    ):
        array = getattr(view, field)
        assert array.dtype == np.float32
        assert np.isfinite(array).all()
        assert not array[..., ~view.has_point].any()
    assert not view.normal[:, ~view.has_normal].any()
    assert not view.light_cosine[~view.has_normal].any()
    assert np.linalg.norm(view.normal, axis=0)[view.has_normal] == pytest.approx(1, abs=1e-5)


def test_without_light_there_is_nothing_of_the_light():
    rig = make_rig()
    view = view_surface(as_mm(cast([tilted(0, 0.8)], rig.depth, real_extrinsics())[0]), rig)
    assert view.light_distance_m is None
    assert view.light_cosine is None


def test_sides_of_a_crease_are_not_averaged():
    rig = make_rig(pose=np.eye(4))
    c = np.sqrt(0.5)
    walls = [Plane((c, 0, -c), -c * 0.9), Plane((-c, 0, -c), -c * 0.9)]
    view = view_surface(as_mm(cast(walls, rig.depth)[0], quantised=False), rig)
    seen = view.normal[:, view.has_normal]
    best = np.max([np.array(wall.normal) @ seen for wall in walls], axis=0)
    assert best.min() > np.cos(np.radians(10))
    assert view.has_normal.mean() > 0.9
