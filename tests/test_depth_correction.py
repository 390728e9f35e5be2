import cv2
import numpy as np
import pytest

from calibration.cameras.boards import Board
from calibration.cameras.depth import DepthReadings, corrected_error, fit_depth, read_plane
from surfclass.errors import ConfigurationError
from surfclass.geometry import corrected_depth, register
from surfclass.rig import Camera, DepthCorrection, parse_rig

RIG = """\
schema = 1
name = "bench"
voxel_size_m = 0.01
[depth]
size = [160, 120]
fx = 146.0
fy = 146.0
cx = 80.0
cy = 60.0
[rgb]
size = [160, 120]
fx = 200.0
fy = 200.0
cx = 80.0
cy = 60.0
[transforms]
rgb_T_depth = [[1, 0, 0, 0.0], [0, 1, 0, 0.02], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
CORRECTION = DepthCorrection(multiplier=(0.98, 0.01, -0.004, 0.003, 0.002, -0.005), inverse_offset_per_m=0.01)
BOARD = Board(columns=9, rows=6, square_m=0.025)


def rig(correction=None):
    values = {} if correction is None else {"depth_correction": correction.model_dump(mode="json")}
    return parse_rig(RIG, "rig.toml").with_values(values)


def test_without_a_correction_the_depth_image_is_the_very_same_object():
    depth = np.full((120, 160), 800, np.uint16)
    assert corrected_depth(depth, rig()) is depth


def test_the_correction_is_the_documented_formula_and_keeps_no_return():
    rng = np.random.default_rng(0)
    depth = rng.integers(500, 3000, (120, 160)).astype(np.uint16)
    depth[3, 5] = 0
    found = corrected_depth(depth, rig(CORRECTION))
    for row, column in ((0, 0), (3, 5), (60, 80), (119, 159), (119, 0)):
        x, y = 2 * column / 159 - 1, 2 * row / 119 - 1
        m = 0.98 + 0.01 * x - 0.004 * y + 0.003 * x * x + 0.002 * x * y - 0.005 * y * y
        z = depth[row, column] / 1000
        true = 0.0 if z == 0 else 1000 / (1 / (m * z) + 0.01)
        assert found[row, column] == pytest.approx(true, rel=1e-5)


def test_colour_pixels_get_corrected_points():
    depth = np.full((120, 160), 1000, np.uint16)
    scaled = rig(DepthCorrection(multiplier=(0.98,)))
    point = register(depth, scaled).point
    assert np.median(point[2][point[2] > 0]) == pytest.approx(0.98, abs=1e-4)


@pytest.mark.parametrize("count", [0, 2, 4, 5, 7, 11])
def test_a_multiplier_has_as_many_coefficients_as_an_order_has(count):
    with pytest.raises(ConfigurationError, match=r"depth_correction\.multiplier"):
        rig().with_values({"depth_correction": {"multiplier": [1.0, *[0.0] * (count - 1)][:count]}})


def readings(seed, correction, views=12, noise=2e-3):
    """Planes all over the image at 0.5–1.2 m, read by a sensor that needs the correction."""
    rng = np.random.default_rng(seed)
    made = []
    for index in range(views):
        centre = rng.uniform(-0.6, 0.6, 2)
        place = np.clip(centre + rng.uniform(-0.5, 0.5, (150, 2)), -1, 1)
        slope = rng.uniform(-0.3, 0.3, 2)
        plane = 1 / (1 / rng.uniform(0.5, 1.2) + place @ slope)
        x, y = place.T
        terms = np.array([np.ones_like(x), x, y, x * x, x * y, y * y])[: len(correction.multiplier)]
        m = np.array(correction.multiplier) @ terms
        # The view's own error, such as that of its pose, and each reading's.
        inverse = (1 / plane - correction.inverse_offset_per_m) * (1 + rng.normal(0, 2e-4)) + rng.normal(
            0, noise, len(x)
        )
        read = 1 / (m * inverse)
        read[:3] *= 1.2
        made.append(DepthReadings(f"v{index}", place, 80 * place + 80, read, plane))
    return made


def test_a_sensor_that_needs_none_gets_no_correction():
    fit = fit_depth(readings(0, DepthCorrection()))
    assert not fit.needed
    assert fit.scale == pytest.approx(1, abs=1e-3)


def test_scale_and_distortion_are_recovered_whatever_some_readings_say():
    fit = fit_depth(readings(1, CORRECTION))
    assert fit.needed
    assert fit.held_out_rms < 0.3 * fit.before_rms
    clean = readings(2, CORRECTION, noise=0.0)
    left = np.concatenate([corrected_error(one, fit.correction)[3:] for one in clean])
    assert np.sqrt(np.mean(left**2)) < 1e-3


def test_the_order_of_the_views_does_not_matter():
    made = readings(3, CORRECTION)
    one, other = fit_depth(made), fit_depth(made[::-1])
    assert np.allclose(one.correction.multiplier, other.correction.multiplier, atol=1e-9)


def test_the_spread_over_seeds_is_the_reported_one():
    truth = DepthCorrection(multiplier=(0.985, 0.008, -0.006))
    fits = [fit_depth(readings(seed, truth)) for seed in range(16)]
    same = [fit for fit in fits if len(fit.correction.multiplier) == 3 and len(fit.sd) == 3]
    assert len(same) >= 12
    errors = np.array([np.subtract(fit.correction.multiplier, truth.multiplier) for fit in same])
    reported = np.mean([fit.sd for fit in same], axis=0)
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / reported
    assert (ratio < 1.5).all()
    assert (ratio > 0.5).all()


def test_readings_inside_of_the_board_are_told_from_those_around_it():
    camera = Camera(size=(320, 240), fx=292.0, fy=292.0, cx=160.0, cy=120.0)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0]
    pose[:3, 3] = (-0.1, -0.06, 0.6)
    x, y = (np.mgrid[:240, :320][::-1] - np.array([160.0, 120.0])[:, None, None]) / 292.0
    normal = pose[:3, 2]
    plane = normal @ pose[:3, 3] / (normal[0] * x + normal[1] * y + normal[2])
    depth = np.round(1010 * plane).astype(np.uint16)
    s = (np.stack([x * plane, y * plane, plane]).T - pose[:3, 3]) @ pose[:3, 0]
    depth[(s.T < -0.024) | (s.T > 0.224)] = 2000
    depth[::5, ::7] = 0
    found = read_plane("v", depth, pose, BOARD, camera)
    assert found is not None
    assert len(found.read) > 50
    assert np.abs(found.read / found.plane - 1.01).max() < 2e-3
    assert read_plane("v", np.zeros_like(depth), pose, BOARD, camera) is None
