"""Materials of the simulated scenes: fixed to their places, blurred with distance, and hard to tell apart."""

import cv2
import numpy as np
import pytest

from drivers.sim import truth
from drivers.sim.materials import CLASS_NAMES
from drivers.sim.relief import Patch
from drivers.sim.surfaces import Surface, bake
from drivers.sim.world import SimWorld

SCALE = 0.25


@pytest.fixture(scope="module")
def cell():
    return SimWorld("cell", scale=SCALE)


@pytest.fixture(scope="module")
def boards():
    """(n, 3) K_d and its local contrast of each class' training board."""
    found = {}
    for name in CLASS_NAMES:
        world = SimWorld(f"board:{name}", scale=SCALE)
        found[name] = truth.reflectance(world, world.viewpoints[0].q)
    return found


def places(world, q):
    """Base coordinates of every pixel's surface point."""
    return world.base_T_rgb(q) @ truth.surface(world, q).point.transpose(1, 2, 0).astype(np.float64)


def seen_again(world, first, second):
    """Pixel places in view `second` of what view `first` sees, and where both see it."""
    at = places(world, first)
    camera = world.package.rgb
    inside = world.base_T_rgb(second).inverse @ at
    pixel, _ = cv2.projectPoints(
        inside.reshape(-1, 3), np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )
    u, v = (pixel.reshape(*at.shape[:2], 2)[..., i].astype(np.float32) for i in (0, 1))
    depth = cv2.remap(truth.surface(world, second).point[2], u, v, cv2.INTER_NEAREST)
    return u, v, np.abs(depth - inside[..., 2]) < 0.003


@pytest.mark.parametrize(("first", "second"), [(0, 7), (9, 10), (1, 8), (12, 13)])
def test_two_views_of_a_place_agree_in_albedo_and_label(cell, first, second):
    one, two = cell.viewpoints[first].q, cell.viewpoints[second].q
    u, v, both = seen_again(cell, one, two)
    assert both.mean() > 0.15
    there = cv2.remap(truth.reflectance(cell, two).transpose(1, 2, 0), u, v, cv2.INTER_LINEAR)
    here = truth.reflectance(cell, one).transpose(1, 2, 0)
    # Each view averages over its own pixels: compare at a size that both resolve.
    smooth_here, smooth_there = (
        cv2.blur(np.where(both[..., None], image, 0), (5, 5)) for image in (here, there)
    )
    inner = cv2.erode(both.astype(np.uint8), np.ones((9, 9))) > 0
    ratio = smooth_there[inner] / smooth_here[inner]
    assert np.median(ratio) == pytest.approx(1, abs=0.01)
    assert np.percentile(np.abs(ratio - 1), 90) < 0.12
    for channel in range(3):
        pair = smooth_here[inner][:, channel], smooth_there[inner][:, channel]
        assert np.corrcoef(*pair)[0, 1] > 0.97
    label = cv2.remap(truth.label_image(cell, two), u, v, cv2.INTER_NEAREST)
    assert (label[inner] == truth.label_image(cell, one)[inner]).mean() > 0.98


def test_full_reflectance_model_recovers_the_same_k_d_in_two_views(cell):
    """The light taken out again, a matte place has one reflectance wherever it is seen from."""
    one, two = cell.viewpoints[1].q, cell.viewpoints[13].q
    u, v, both = seen_again(cell, one, two)

    def k_d(q):
        seen = truth.surface(cell, q)
        led = cell.package.led
        to_light = np.array(led.position_m)[:, None, None] - seen.point
        distance = np.maximum(np.linalg.norm(to_light, axis=0), 1e-6)
        cosine = (to_light * seen.normal).sum(axis=0) / distance
        emission = -(to_light * np.array(led.axis)[:, None, None]).sum(axis=0) / distance
        shade = cosine * emission**led.falloff_exponent * cell.package.vignetting
        return cell.irradiance(q) * (distance**2 / np.where(cosine > 0.3, shade, np.inf))[..., None]

    here, there = k_d(one), cv2.remap(k_d(two).astype(np.float32), u, v, cv2.INTER_LINEAR)
    timber = (truth.label_image(cell, one) == 4) & both
    inner = cv2.erode(timber.astype(np.uint8), np.ones((7, 7))) > 0
    inner &= (here.min(axis=2) > 0.01) & (there.min(axis=2) > 0.01)
    assert inner.sum() > 300
    ratio = cv2.blur(there, (7, 7))[inner] / cv2.blur(here, (7, 7))[inner]
    assert np.median(ratio) == pytest.approx(1, abs=0.04)


def test_the_cell_shows_all_five_classes_and_background(cell):
    seen = np.zeros(6)
    for one in cell.viewpoints:
        label = truth.label_image(cell, one.q)
        seen += np.bincount(label.ravel(), minlength=6) / label.size / len(cell.viewpoints)
    assert len(cell.viewpoints) >= 10
    assert (seen[1:] > 0.02).all(), seen
    assert seen[0] > 0.01


def test_viewpoints_cover_the_range_the_method_is_made_for(cell):
    distances = [one.distance_m for one in cell.viewpoints]
    angles = np.degrees([one.angle_rad for one in cell.viewpoints])
    assert min(distances) == pytest.approx(0.65, abs=0.03)
    assert max(distances) == pytest.approx(1.30, abs=0.01)
    assert angles.min() < 1
    assert 45 < angles.max() <= 50.5


def test_two_perpendicular_planes_are_seen_together(cell):
    q = next(one.q for one in cell.viewpoints if one.name == "corner_090")
    seen = truth.surface(cell, q)
    normals = seen.normal[:, seen.hit].T @ cell.base_T_rgb(q).rotation.T
    for direction in ([-1, 0, 0], [0, -1, 0]):
        assert ((normals @ direction) > 0.99).mean() > 0.05


def test_a_board_is_another_piece_of_the_same_material():
    def piece(name):
        corner, s, t = np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
        surface = Surface(name, corner, s, t, (0.3, 0.2), ("timber",))
        return bake(surface, seed=0, texel_m=0.001).albedo[0][..., 1].astype(float)

    board, cell = piece("board.timber"), piece("plank")
    assert np.abs(np.corrcoef(board.ravel(), cell.ravel())[0, 1]) < 0.5
    assert np.median(board) == pytest.approx(np.median(cell), rel=0.15)
    assert (piece("plank") == cell).all()


def test_another_seed_is_another_texture():
    first, second = (SimWorld("board:rusted", seed=seed, scale=0.1) for seed in (0, 1))
    q = first.viewpoints[0].q
    a, b = truth.reflectance(first, q), truth.reflectance(second, q)
    assert abs(np.corrcoef(a[0].ravel(), b[0].ravel())[0, 1]) < 0.4
    assert np.median(a) == pytest.approx(np.median(b), rel=0.5)


def test_noise_is_a_function_of_the_place_not_of_the_texel_size():
    fine = Patch((0.2, 0.1), 0.0005, 3, "x").noise("n", 0.02)
    coarse = Patch((0.2, 0.1), 0.001, 3, "x").noise("n", 0.02)
    averaged = cv2.resize(fine, coarse.shape[::-1], interpolation=cv2.INTER_AREA)
    assert averaged == pytest.approx(coarse, abs=0.02)
    assert 0.5 < fine.std() < 1.5


def test_noise_finer_than_the_texel_fades_as_an_average_would():
    coarse = Patch((0.4, 0.4), 0.008, 3, "x").noise("n", 0.002)
    assert coarse.std() < 0.35 * Patch((0.1, 0.1), 0.0005, 3, "x").noise("n", 0.002).std()


def test_far_views_average_what_near_views_resolve():
    world = SimWorld("board:blasted", scale=SCALE)
    texture = world.texture(0)
    s, t = np.meshgrid(
        np.linspace(0.1, 0.5, 200, dtype=np.float32), np.linspace(0.1, 0.4, 150, dtype=np.float32)
    )
    near, far = (
        texture.sample(s, t, np.full_like(s, texture.texel_m * factor))[0][..., 1] for factor in (1, 8)
    )
    near_grain, far_grain = (image - cv2.blur(image, (9, 9)) for image in (near, far))
    assert far_grain.std() < 0.3 * near_grain.std()
    assert far.mean() == pytest.approx(near.mean(), rel=0.02)


def test_coarse_copies_lie_over_the_fine_ones():
    """A shift between the levels would make a place look different from afar."""
    world = SimWorld("board:rusted", scale=SCALE)
    texture = world.texture(0)
    s, t = np.meshgrid(
        np.linspace(0.1, 0.5, 300, dtype=np.float32), np.linspace(0.1, 0.4, 200, dtype=np.float32)
    )
    fine, coarse = (
        cv2.GaussianBlur(
            texture.sample(s, t, np.full_like(s, texture.texel_m * factor))[0][..., 0], (0, 0), 6
        )
        for factor in (1, 8)
    )
    window = cv2.createHanningWindow(fine.shape[::-1], cv2.CV_64F)
    pair = [(image - image.mean()).astype(np.float64) for image in (fine, coarse)]
    shift, response = cv2.phaseCorrelate(*pair, window)
    assert np.hypot(*shift) < 0.15
    assert response > 0.5


def test_no_constant_tells_rust_from_the_rest(boards):
    """The best single threshold on any channel or channel ratio leaves errors on both sides."""
    rust = boards["rusted"].reshape(3, -1)[:, ::7]
    rest = np.concatenate([boards[name].reshape(3, -1)[:, ::7] for name in CLASS_NAMES[1:]], axis=1)
    for feature in (lambda k: k[0], lambda k: k[2], lambda k: k[0] / k[1], lambda k: k[0] / k[2]):
        a, b = feature(rust), feature(rest)
        thresholds = np.quantile(np.concatenate([a, b]), np.linspace(0.01, 0.99, 99))
        errors = [((a > c).mean() + (b <= c).mean()) / 2 for c in thresholds]
        assert min(min(errors), 1 - max(errors)) > 0.005


def test_classes_overlap_yet_differ_in_colour(boards):
    """A Gaussian for each class tells most pixels, and not all, of all pairs that are alike."""
    samples = {name: np.log(boards[name].reshape(3, -1)[:, ::11]).T for name in CLASS_NAMES}
    score = []
    for values in samples.values():
        mean, covariance = values.mean(axis=0), np.cov(values.T)
        inverse, size = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]
        score.append(
            [-0.5 * (np.einsum("ni,ij,nj->n", x - mean, inverse, x - mean) + size) for x in samples.values()]
        )
    right = np.array(
        [np.mean(np.argmax([score[k][true] for k in range(5)], axis=0) == true) for true in range(5)]
    )
    assert 0.80 < right.mean() < 0.985, right
    assert right.min() > 0.5, right


def test_timber_has_grain_and_blasted_steel_has_none():
    def direction(name):
        world = SimWorld(f"board:{name}", scale=0.5)
        grey = world.irradiance(world.viewpoints[0].q).mean(axis=2)
        middle = grey[100:380, 150:490]
        return np.abs(np.diff(middle, axis=0)).mean() / np.abs(np.diff(middle, axis=1)).mean()

    assert direction("timber") > 1.5
    assert 0.8 < direction("blasted") < 1.25
