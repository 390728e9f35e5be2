"""Appendix A as corrected, each beside its printed form."""

import numpy as np
import pytest

from calibration.hand_eye.single_pose import align, disc_centre, fit_circle, hand_eye_of_pose, plane_basis
from surfclass.errors import InputError
from surfclass.kinematics import forward_kinematics
from surfclass.types import Transform

RADIUS = 0.018


def turn(axis, angle):
    """Rodrigues' formula."""
    k = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def disc(tilt_deg=40, about=(1, 0.4, 0), centre=(0.05, -0.08, 0.8)):
    """Centre, normal, 400 points on the disc, and its outline (3D)."""
    rotation = turn(about, np.radians(tilt_deg))
    rng = np.random.default_rng(0)
    r, phi = RADIUS * np.sqrt(rng.random(400)), rng.uniform(0, 2 * np.pi, 400)
    flat = np.column_stack([r * np.cos(phi), r * np.sin(phi), 0 * r])
    phi = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rim = RADIUS * np.column_stack([np.cos(phi), np.sin(phi), 0 * phi])
    centre = np.array(centre)
    return centre, rotation[:, 2], flat @ rotation.T + centre, rim @ rotation.T + centre


def rays_of(points):
    return points[:, :2] / points[:, 2:]


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -2), (1, 0, 0), (0.3, -0.5, 0.6), (-1, -1, -1)])
def test_plane_basis_is_orthonormal_and_across_the_normal(normal):
    basis = plane_basis(np.array(normal))
    assert basis @ basis.T == pytest.approx(np.eye(2), abs=1e-15)
    assert basis @ normal == pytest.approx([0, 0], abs=1e-15)


def test_printed_a1_a2_angles_are_no_rotations():
    """Turning the disc by its angles to the x and y axes does not lay it flat; its own basis does."""
    centre, normal, points, _ = disc()
    beta, gamma = np.arccos(normal[0]), np.arccos(normal[1])  # A.1, A.2
    own = (points - centre) @ plane_basis(normal).T
    lengths = np.linalg.norm(points - centre, axis=1)
    assert np.linalg.norm(own, axis=1) == pytest.approx(lengths, abs=1e-12)
    about_n_cross_z = turn(np.cross(normal, [0, 0, 1]), np.arccos(normal[2]))
    assert about_n_cross_z @ normal == pytest.approx([0, 0, 1], abs=1e-12)
    for first, second in (((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (1, 0, 0))):
        for sign in (1, -1):
            for angles in ((beta, gamma), (gamma, beta)):
                printed = turn(second, sign * angles[1]) @ turn(first, sign * angles[0])
                assert abs((printed @ normal)[2]) < 0.9
                flat = ((points - centre) @ printed.T)[:, :2]
                assert np.abs(np.linalg.norm(flat, axis=1) - lengths).max() > 1e-3


def arc(degrees=200, centre=(0.3, -0.2), noise_m=0.0, seed=0):
    phi = np.radians(np.linspace(0, degrees, 80))
    points = np.array(centre) + RADIUS * np.column_stack([np.cos(phi), np.sin(phi)])
    return points + np.random.default_rng(seed).normal(0, noise_m, points.shape)


@pytest.mark.parametrize("degrees", [60, 200, 355])
def test_circle_of_known_radius(degrees):
    assert fit_circle(arc(degrees), RADIUS) == pytest.approx([0.3, -0.2], abs=1e-9)
    assert fit_circle(arc(degrees, noise_m=2e-4), RADIUS) == pytest.approx([0.3, -0.2], abs=3e-4)


def test_printed_a3_does_not_depend_on_the_radius():
    """Σ√… − r has its least value at one place whatever r is, and off the centre of a partial outline."""
    points = arc(200)

    def printed(centre, radius):
        return (np.linalg.norm(points - centre, axis=-1) - radius).sum()

    def corrected(centre, radius):
        return ((np.linalg.norm(points - centre, axis=-1) - radius) ** 2).sum()

    steps = np.linspace(-0.02, 0.02, 81)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + np.array([0.3, -0.2])

    def best(function, radius):
        return grid[np.argmin([function(centre, radius) for centre in grid])]

    assert (best(printed, RADIUS) == best(printed, RADIUS / 2)).all()
    assert np.linalg.norm(best(printed, RADIUS) - [0.3, -0.2]) > 2e-3
    assert best(corrected, RADIUS) == pytest.approx([0.3, -0.2], abs=1e-9)
    assert fit_circle(points, RADIUS) == pytest.approx([0.3, -0.2], abs=1e-9)
    assert (best(corrected, RADIUS) != best(corrected, RADIUS / 2)).any()


@pytest.mark.parametrize(
    ("points", "match"),
    [
        (np.zeros((2, 2)), "3 or more"),
        (np.outer(np.arange(6.0), [1, 2]), "on a line"),
        (arc() * 20, "miss it"),
        (np.zeros((5, 3)), "3 or more"),
    ],
)
def test_circle_refuses_what_does_not_determine_it(points, match):
    with pytest.raises(InputError, match=match):
        fit_circle(points, RADIUS)


@pytest.mark.parametrize("tilt", [0, 25, 55])
def test_disc_centre(tilt):
    centre, _, points, rim = disc(tilt)
    assert disc_centre(points, rays_of(rim), RADIUS) == pytest.approx(centre, abs=1e-9)
    half = rim[:50]  # an occluded outline
    assert disc_centre(points, rays_of(half), RADIUS) == pytest.approx(centre, abs=1e-9)


def test_centres_depth_comes_from_the_plane_not_from_single_readings():
    """A.4: with 3 mm of depth noise a single reading is ten times worse than the plane."""
    centre, _, points, rim = disc(30)
    rng = np.random.default_rng(1)
    from_plane, single = [], []
    for _ in range(40):
        noise = 1 + rng.normal(0, 0.003, (len(points), 1)) / points[:, 2:]
        noisy = points * noise  # along the ray
        from_plane.append(np.linalg.norm(disc_centre(noisy, rays_of(rim), RADIUS) - centre))
        nearest = np.linalg.norm(points - centre, axis=1).argmin()
        single.append(abs(noisy[nearest, 2] - points[nearest, 2]))
    assert np.median(from_plane) < 5e-4
    assert np.median(single) > 4 * np.median(from_plane)


def test_outline_that_misses_the_plane_is_refused():
    _, _, points, rim = disc(80, about=(1, 0, 0))
    rays = rays_of(rim)
    rays[0, 1] += 50
    rays[1, 1] -= 50
    with pytest.raises(InputError, match="does not meet"):
        disc_centre(points, rays, RADIUS)


def discs_on_a_plate():
    x, y = np.meshgrid([0, 0.13, 0.29], [0, 0.12, 0.25])
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(9)])


def pose(seed=0):
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = turn(rng.normal(size=3), rng.uniform(0.3, 2.5))
    matrix[:3, 3] = rng.uniform(-1, 1, 3)
    return Transform("base", "depth", matrix)


def test_coplanar_discs_come_out_reflected_without_the_guard():
    """A.5: noise on coplanar points flips plain `V·Uᵀ` into a mirror every now and then."""
    mirrored = 0
    for seed in range(20):
        truth = pose(seed)
        rng = np.random.default_rng(100 + seed)
        source = discs_on_a_plate() + rng.normal(0, 5e-4, (9, 3))
        target = truth @ discs_on_a_plate() + rng.normal(0, 5e-4, (9, 3))
        u, _, vt = np.linalg.svd((source - source.mean(0)).T @ (target - target.mean(0)))
        printed = vt.T @ u.T
        mirrored += np.linalg.det(printed) < 0
        found = align(source, target, "base", "depth")
        assert (found.dst, found.src) == ("base", "depth")
        assert np.linalg.det(found.rotation) == pytest.approx(1)
        assert np.abs(found.rotation - truth.rotation).max() < 0.02
        if np.linalg.det(printed) < 0:
            assert np.abs(printed - truth.rotation).max() > 0.1
    assert mirrored >= 3


def test_alignment_of_exact_points():
    truth = pose(3)
    cloud = np.random.default_rng(0).normal(size=(10, 3))
    found = align(cloud, truth @ cloud, "base", "depth")
    assert found.matrix == pytest.approx(truth.matrix, abs=1e-12)


@pytest.mark.parametrize(
    ("source", "match"),
    [
        (np.zeros((2, 3)), "3 or more"),
        (np.outer(np.arange(4.0), [1, 2, 3]), "on a line"),
        (np.full((4, 3), np.nan), "not finite"),
    ],
)
def test_alignment_refuses_what_does_not_determine_it(source, match):
    with pytest.raises(InputError, match=match):
        align(source, source, "base", "depth")


def test_hand_eye_order():
    """A.8: `oTs · oTe⁻¹`, as printed, is the motion in `base`, not the camera on the flange."""
    base_T_flange = forward_kinematics(np.radians([20, 30, 40, 50, 60, 70]))
    flange_T_depth = Transform("flange", "depth", pose(5).matrix)
    base_T_depth = base_T_flange @ flange_T_depth
    found = hand_eye_of_pose(base_T_flange, base_T_depth)
    assert (found.dst, found.src) == ("flange", "depth")
    assert found.matrix == pytest.approx(flange_T_depth.matrix, abs=1e-12)
    printed = base_T_depth.matrix @ base_T_flange.inverse.matrix
    assert np.abs(printed - flange_T_depth.matrix).max() > 0.1
    with pytest.raises(ValueError, match="inner frames"):
        base_T_depth @ base_T_flange.inverse  # the frames' names catch the printed order


def test_registering_rows_needs_the_transpose():
    """A.10: `[P 1] · T` as printed moves rows by the wrong rotation and by no translation at all."""
    truth = pose(7)
    cloud = np.random.default_rng(0).normal(size=(30, 3))
    expected = np.array([truth.rotation @ point + truth.translation for point in cloud])
    assert truth @ cloud == pytest.approx(expected, abs=1e-12)
    printed = (np.column_stack([cloud, np.ones(30)]) @ truth.matrix)[:, :3]
    assert np.abs(printed - expected).max() > 0.1
