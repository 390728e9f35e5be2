"""Depth of field, ranges and the probability map, each correction beside the form as printed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surfclass import quality
from surfclass.errors import ConfigurationError, InputError
from surfclass.rig import TextureLimits
from surfclass.types import SurfaceView

F, N, D = 0.006, 1.4, 0.65  # the thesis' lens, focused at its training distance


def printed_depth_of_field(c: float) -> tuple[float, float]:
    return F * D**2 / (F**2 + N * c * (D - F)), F * D**2 / (F**2 - N * c * (D - F))


def blur_on_sensor(z: float, focused: float) -> float:
    """Diameter of the disc that a point at z makes where the sensor is focused on a plane (thin lens)."""
    sensor = 1 / (1 / F - 1 / focused)
    image = 1 / (1 / F - 1 / z)
    return F / N * abs(sensor - image) / image


def test_without_blur_only_the_plane_of_focus_is_sharp() -> None:
    assert quality.depth_of_field(F, N, 1e-12, D) == pytest.approx((0.65, 0.65), rel=1e-6)
    # as printed both limits go to d² / F
    assert printed_depth_of_field(1e-12) == pytest.approx((D**2 / F, D**2 / F), rel=1e-6)
    assert round(D**2 / F, 1) == 70.4


@given(st.floats(1e-7, 1e-5), st.floats(0.1, 3.0))
@settings(deadline=None, max_examples=30)
def test_the_limits_are_where_a_thin_lens_blurs_by_the_circle_of_confusion(c: float, d: float) -> None:
    near, far = quality.depth_of_field(F, N, c, d)
    assert near < d < far
    assert blur_on_sensor(near, d) == pytest.approx(c, rel=1e-6)
    if math.isfinite(far):
        assert blur_on_sensor(far, d) == pytest.approx(c, rel=1e-6)
    else:
        assert blur_on_sensor(1e12, d) <= c * (1 + 1e-6)


def test_beyond_the_hyperfocal_distance_everything_far_is_sharp() -> None:
    c = 1e-5
    hyperfocal = F + F**2 / (N * c)
    assert quality.depth_of_field(F, N, c, hyperfocal * 1.01)[1] == math.inf
    assert math.isfinite(quality.depth_of_field(F, N, c, hyperfocal * 0.99)[1])


def test_circle_of_confusion_undoes_the_far_limit_and_the_printed_one_does_not() -> None:
    far = 0.8
    c = quality.circle_of_confusion(F, N, D, far)
    assert quality.depth_of_field(F, N, c, D)[1] == pytest.approx(far, rel=1e-12)
    assert blur_on_sensor(far, D) == pytest.approx(c, rel=1e-9)
    printed = (F * D**2 - far * F**2) / (far * N * (D - F))
    assert printed > 100 * c
    assert quality.depth_of_field(F, N, printed, D)[1] == math.inf
    assert quality.circle_of_confusion(F, N, D, math.inf) == pytest.approx(F**2 / (N * (D - F)))


def test_focus_is_a_plane_not_a_distance() -> None:
    """A wall parallel to the sensor, in focus everywhere; its corners are farther away."""
    near, far = quality.depth_of_field(F, N, quality.circle_of_confusion(F, N, D, 0.7), D)
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7))
    wall = np.stack([x, y, np.full_like(x, 0.68)])
    assert quality.in_focus(wall[2], near, far).all()
    distance = np.sqrt((wall**2).sum(axis=0))
    assert not quality.in_focus(distance, near, far).all()


def test_pixels_for_an_area_fall_with_the_distance_squared_and_with_tilt() -> None:
    d, cosine = np.array([1.0, 2.0, 2.0]), np.array([1.0, 1.0, 0.5])
    assert quality.pixels_per_area(d, cosine).tolist() == [1, 1 / 4, 1 / 8]


@pytest.mark.parametrize(
    "lens",
    [(0, 1.4, 1e-6, 0.65), (F, -1, 1e-6, D), (F, N, 0, D), (F, N, 1e-6, 0.005), (F, N, 1e-6, math.nan)],
)
def test_an_impossible_lens_is_refused(lens: tuple[float, float, float, float]) -> None:
    with pytest.raises(ConfigurationError, match="lens"):
        quality.depth_of_field(*lens)


def test_a_far_limit_before_the_focus_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="beyond the focus distance"):
        quality.circle_of_confusion(F, N, D, 0.6)


def test_a_range_is_what_both_allow_and_an_empty_one_names_its_class() -> None:
    assert quality.range_of(0.5, 0.9, 0.6, 0.8, "timber") == (0.6, 0.8)
    assert quality.range_of(0.65, math.inf, 0.6, 0.8, "timber") == (0.65, 0.8)
    for near_2, far_2 in ((0.9, 1.2), (0.95, 1.0)):
        with pytest.raises(ConfigurationError, match="class timber"):
            quality.range_of(0.5, 0.9, near_2, far_2, "timber")


def literal(distance_mm: float, angle_deg: float, limits: TextureLimits) -> float:
    """Eq. 5.17–5.19 as printed, in the thesis' units: millimetres, degrees, slopes of 1."""
    near, far, tau = limits.near_m * 1000, limits.far_m * 1000, math.degrees(limits.angle_rad)
    p_d = 1 / (1 + math.exp(near - distance_mm)) - 1 / (1 + math.exp(far - distance_mm))
    return p_d * (1 - 1 / (1 + math.exp(tau - angle_deg)))


@given(st.floats(0.45, 0.85), st.floats(0, 0.9))
@settings(deadline=None, max_examples=50)
def test_the_thesis_slopes_of_1_per_mm_and_degree_are_the_defaults(distance: float, angle: float) -> None:
    limits = TextureLimits()
    ours = quality.viewing_probability(np.array(distance), np.array(angle), limits)
    assert ours == pytest.approx(literal(distance * 1000, math.degrees(angle), limits), abs=1e-6)


def test_copied_slopes_would_make_the_sigmoids_flat() -> None:
    """1 per metre instead of 1 per millimetre: the middle of the range would hardly be trusted."""
    middle, straight = np.array(0.65), np.array(0.0)
    assert quality.viewing_probability(middle, straight, TextureLimits()) > 0.999
    copied = TextureLimits(slope_per_m=1.0, slope_per_rad=1.0)
    assert quality.viewing_probability(middle, straight, copied) < 0.1


def test_nothing_overflows_far_from_the_range() -> None:
    limits = TextureLimits()
    distance, angle = np.array([0.0, 0.65, 1e6, 0.65]), np.array([0.0, 0.0, 0.0, 1.57])
    with np.errstate(all="raise"):
        ours = quality.viewing_probability(distance, angle, limits)
    assert ours == pytest.approx([0, 1, 0, 0], abs=1e-9)
    with pytest.raises(OverflowError):
        literal(-1000.0, 0.0, limits)


def view_of(distance: np.ndarray, cosine: np.ndarray, z: np.ndarray | None = None) -> SurfaceView:
    distance, cosine = distance.astype(np.float32), cosine.astype(np.float32)
    point = np.zeros((3, *distance.shape), np.float32)
    point[2] = distance if z is None else z
    has_normal = cosine > 0
    return SurfaceView(point, np.zeros_like(point), distance, cosine, None, None, distance > 0, has_normal)


def test_the_map_is_each_pixels_probability_for_its_own_class() -> None:
    random = np.random.default_rng(0)
    distance, angle = random.uniform(0.3, 1.2, (70, 30)), random.uniform(0, 1.4, (70, 30))
    label = random.integers(0, 3, (70, 30)).astype(np.uint8)
    limits = [TextureLimits(), TextureLimits(near_m=0.6, far_m=1.0, angle_rad=0.9, slope_per_m=50.0)]
    ours = quality.probability_map(view_of(distance, np.cos(angle)), limits, label)
    assert ours.dtype == np.float32
    for k in (1, 2):
        expected = quality.viewing_probability(distance, angle, limits[k - 1])
        assert np.abs(ours - expected)[label == k].max() < 1e-3  # single precision, in a steep sigmoid
    assert (ours[label == 0] == 0).all()
    alike = quality.probability_map(view_of(distance, np.cos(angle)), [limits[0]] * 2, label)
    assert np.array_equal(alike[label == 1], ours[label == 1])


def test_pixels_without_a_normal_have_no_probability() -> None:
    distance, cosine = np.full((2, 2), 0.65), np.array([[1, 0], [1, 1]])
    any_angle = [TextureLimits(angle_rad=1.5, slope_per_rad=1.0)]
    ours = quality.probability_map(view_of(distance, cosine), any_angle, np.ones((2, 2), np.uint8))
    assert ours[0, 1] == 0
    assert (ours > 0.5).sum() == 3


def test_the_map_can_ask_for_focus_by_the_plane() -> None:
    distance = np.full((1, 3), 0.7)
    view = view_of(distance, np.ones((1, 3)), z=np.array([[0.55, 0.65, 0.7]]))
    label = np.ones((1, 3), np.uint8)
    assert quality.probability_map(view, [TextureLimits()], label, (0.6, 0.68))[0] == pytest.approx(
        [0, 1, 0], abs=1e-6
    )
    assert quality.probability_map(view, [TextureLimits()], label, (0.6, math.inf))[0] == pytest.approx(
        [0, 1, 1]
    )


def test_labels_that_do_not_fit_are_refused() -> None:
    view = view_of(np.full((2, 2), 0.65), np.ones((2, 2)))
    with pytest.raises(InputError, match=r"the view has \(2, 2\)"):
        quality.probability_map(view, [TextureLimits()], np.ones((2, 3), np.uint8))
    with pytest.raises(InputError, match="label 2, there are 1"):
        quality.probability_map(view, [TextureLimits()], np.full((2, 2), 2, np.uint8))
