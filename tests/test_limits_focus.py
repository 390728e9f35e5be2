"""Depth of field: a lens is recovered from how blurred edges are at several depths."""

import cv2
import numpy as np
import pytest

from calibration.limits.focus import Blur, find_focus, measure
from calibration.limits.lens import LensData, depth_of_field
from calibration.outcome import RefusedError
from surfclass.errors import ConfigurationError
from surfclass.frames import Capture, ColourFrame, DepthFrame
from surfclass.quality import depth_of_field as planes
from surfclass.rig import TextureLimits, parse_rig

FX = 1600.0
RIG = parse_rig(
    f"""
schema = 1
name = "lens"
voxel_size_m = 0.01
[rgb]
size = [320, 240]
fx = {FX}
fy = {FX}
cx = 159.5
cy = 119.5
[depth]
size = [320, 240]
fx = {FX}
fy = {FX}
cx = 159.5
cy = 119.5
[transforms]
rgb_T_depth = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
""",
    "rig",
)
F, N, DISTANCE = 0.006, 2.0, 0.70
SPREAD = F / N * FX / 4


def capture(number, z, noise):
    """A checkerboard of 20 mm squares, turned a little, as a thin lens renders it."""
    col, row = np.meshgrid(np.arange(320 * 3), np.arange(240 * 3))
    x, y = (col / 3 - 159.5) * z / FX, (row / 3 - 119.5) * z / FX
    turned = 0.96 * x + 0.28 * y, -0.28 * x + 0.96 * y
    board = (np.floor(turned[0] / 0.02) + np.floor(turned[1] / 0.02)) % 2 * 120 + 60.0
    sigma = np.hypot(0.5, SPREAD * (1 / z - 1 / DISTANCE))
    image = cv2.resize(cv2.GaussianBlur(board, (0, 0), 3 * sigma), (320, 240), interpolation=cv2.INTER_AREA)
    image = np.clip(image + np.random.default_rng(number).normal(0, noise, image.shape), 0, 255).astype(
        np.uint8
    )
    depth = np.full((240, 320), round(1000 * z), np.uint16)
    colour = ColourFrame(number, number, 0.01, np.repeat(image[..., None], 3, axis=2))
    return Capture(f"at_{number}", "board", DepthFrame(number, number, None, depth), colour)


def series(noise=1.0, depths=(0.45, 0.5, 0.55, 0.62, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3)):
    return measure((capture(number, z, noise) for number, z in enumerate(depths)), RIG)


def test_plane_of_focus_and_aperture_are_recovered_from_a_focus_series():
    found = find_focus(series())
    assert found.distance_m == pytest.approx(DISTANCE, abs=0.03)
    assert found.aperture_m(FX) == pytest.approx(F / N, rel=0.12)
    assert (found.sd > 0).all()


def test_a_series_on_one_side_of_the_focus_is_refused():
    with pytest.raises(RefusedError, match="well before and well behind"):
        find_focus(series(depths=(0.9, 1.0, 1.1, 1.2, 1.3, 1.4)))


def test_too_few_depths_are_refused():
    one = Blur(np.array([0.7, 0.8]), np.ones(2), np.full(2, 500.0), np.arange(2))
    with pytest.raises(RefusedError, match="needed are 5 depths"):
        find_focus(one)


LIMITS = [TextureLimits(near_m=0.55, far_m=0.9), TextureLimits(near_m=0.6, far_m=1.0)]


def test_lens_data_alone_give_the_depth_of_field_of_5_1_and_5_2():
    found = depth_of_field(LensData(F, N, DISTANCE, 8e-6), None, FX, LIMITS)
    assert (found.near_m, found.far_m) == planes(F, N, 8e-6, DISTANCE)
    assert found.circle_from == "given"
    assert found.measured == ()


def test_without_a_circle_of_confusion_every_class_keeps_its_limits():
    found = depth_of_field(LensData(F, N, DISTANCE), None, FX, LIMITS)
    assert found.circle_from == "limits"
    assert found.near_m <= 0.55 + 1e-9
    assert found.far_m >= 1.0 - 1e-9
    tight = found.near_m == pytest.approx(0.55) or found.far_m == pytest.approx(1.0)
    assert tight


def test_a_focus_series_stands_in_for_what_is_not_written_on_the_lens():
    focus = find_focus(series())
    found = depth_of_field(LensData(focal_length_m=F), focus, FX, LIMITS)
    assert found.measured == ("focus_distance_m", "f_number")
    assert found.lens["f_number"] == pytest.approx(N, rel=0.12)
    assert depth_of_field(LensData(), focus, FX, LIMITS) is None
    assert depth_of_field(LensData(focal_length_m=F), None, FX, LIMITS) is None


def test_without_limits_around_the_focus_the_circle_has_to_be_given():
    beyond = [TextureLimits(near_m=0.8, far_m=0.9)]
    with pytest.raises(ConfigurationError, match="circle of confusion"):
        depth_of_field(LensData(F, N, 5.0), None, FX, [])
    assert depth_of_field(LensData(F, N, 0.95), None, FX, beyond).near_m == pytest.approx(0.8)
