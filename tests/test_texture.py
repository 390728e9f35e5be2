"""Texture features against scikit-image, against literal loops, and against the forms as printed."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data
from skimage.feature import graycomatrix, graycoprops

from surfclass import texture
from surfclass.errors import InputError

AROUND = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
CONTRAST, CORRELATION, ENERGY, HOMOGENEITY = range(4)


def scene(seed: int, h: int = 47, w: int = 66) -> np.ndarray:
    """Smooth noise with a constant patch: a textured and an untextured part."""
    noise = np.random.default_rng(seed).integers(0, 256, (h, w)).astype(np.uint8)
    noise = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1), None, 0, 255, cv2.NORM_MINMAX)
    noise[:20, :20] = 77
    return noise


def angle_of(offset: tuple[int, int]) -> tuple[float, float]:
    """scikit-image's distance and angle of a (row, column) offset."""
    return float(np.hypot(*offset)), float(np.arctan2(offset[0], offset[1]))


@given(
    st.integers(0, 999),
    st.sampled_from([2, 8, 16]),
    st.sampled_from([(0, 1), (1, 0), (1, 1), (-1, 1), (0, 2)]),
    st.sampled_from([5, 20, 13]),
)
@settings(deadline=None, max_examples=10)
def test_glcm_is_scikit_images(seed: int, levels: int, offset: tuple[int, int], stride: int) -> None:
    grey = scene(seed)
    ours = texture.glcm_features(grey, 20, levels, offset, stride)
    assert ours.shape == ((47 - 20) // stride + 1, (66 - 20) // stride + 1, 4)
    quantised = (grey.astype(int) * levels // 256).astype(np.uint8)
    distance, angle = angle_of(offset)
    if offset in ((1, 1), (-1, 1)):
        distance = 1  # its angles are rounded to the pixel
    for row, col in np.ndindex(ours.shape[:2]):
        window = quantised[row * stride : row * stride + 20, col * stride : col * stride + 20]
        matrix = graycomatrix(window, [distance], [angle], levels, symmetric=True, normed=True)
        theirs = [
            graycoprops(matrix, name)[0, 0] for name in ("contrast", "correlation", "ASM", "homogeneity")
        ]
        assert np.abs(ours[row, col] - theirs).max() < 1e-12


def matrix_of(window: np.ndarray, levels: int = 8) -> np.ndarray:
    """Co-occurrences of horizontal neighbours, counted one by one."""
    D = np.zeros((levels, levels))
    for row in window.astype(int) * levels // 256:
        for a, b in pairwise(row):
            D[a, b] += 1
            D[b, a] += 1
    return D / D.sum()


def test_energy_is_the_sum_of_squares_not_its_root() -> None:
    window = scene(3)[20:40, 20:40]
    D = matrix_of(window)
    ours = texture.glcm_features(window)[0, 0]
    assert ours[ENERGY] == pytest.approx((D**2).sum(), abs=1e-12)
    assert abs(ours[ENERGY] - np.sqrt((D**2).sum())) > 0.05


def test_homogeneity_divides_by_the_squared_difference_not_matlabs() -> None:
    window = scene(3)[20:40, 20:40]
    D = matrix_of(window)
    u, v = np.indices(D.shape)
    ours = texture.glcm_features(window)[0, 0]
    assert ours[HOMOGENEITY] == pytest.approx((D / (1 + (u - v) ** 2)).sum(), abs=1e-12)
    assert abs(ours[HOMOGENEITY] - (D / (1 + abs(u - v))).sum()) > 0.01


def test_a_constant_window_correlates_perfectly() -> None:
    for level in (0, 128, 255):
        window = np.full((20, 20), level, np.uint8)
        assert texture.glcm_features(window)[0, 0].tolist() == [0, 1, 1, 1]


def test_a_checkerboard_has_the_extreme_contrast() -> None:
    board = (np.indices((20, 20)).sum(axis=0) % 2 * 255).astype(np.uint8)
    assert texture.glcm_features(board)[0, 0] == pytest.approx([49, -1, 0.5, 1 / 50])
    assert texture.glcm_features(board, offset=(1, 1))[0, 0] == pytest.approx(
        [0, 1, 0.5, 1], abs=1e-5
    )  # 19² pairs


def literal_pattern(grey: np.ndarray, row: int, col: int) -> int:
    h, w = grey.shape
    total = 0
    for p, (down, right) in enumerate(AROUND):
        neighbour = grey[min(max(row + down, 0), h - 1), min(max(col + right, 0), w - 1)]
        total += 2**p if neighbour >= grey[row, col] else 0
    return total


def literal_bin(pattern: int) -> int:
    def changes(code: int) -> int:
        bits = [code >> p & 1 for p in range(8)]
        return sum(bits[p] != bits[p - 1] for p in range(8))

    return sum(changes(code) <= 2 for code in range(pattern)) if changes(pattern) <= 2 else 58


@given(st.integers(0, 999), st.integers(3, 25), st.integers(3, 25))
@settings(deadline=None, max_examples=10)
def test_lbp_is_the_literal_double_loop(seed: int, h: int, w: int) -> None:
    grey = np.random.default_rng(seed).integers(0, 6, (h, w)).astype(np.uint8)  # many equal neighbours
    literal = [[literal_bin(literal_pattern(grey, row, col)) for col in range(w)] for row in range(h)]
    assert texture.lbp_codes(grey).tolist() == literal


def test_there_are_58_uniform_patterns_and_one_bin_for_the_rest() -> None:
    bins = texture.uniform_bins()
    assert np.bincount(bins).tolist() == [1] * 58 + [198]


def test_weight_is_two_to_the_p_as_the_printed_one_cannot_tell_patterns_apart() -> None:
    """With the printed 2^P every set bit weighs 256: nine values are left, their count alone."""
    grey = scene(1)
    patterns = [literal_pattern(grey, row, col) for row in range(1, 46) for col in range(1, 65)]
    printed = {256 * code.bit_count() for code in patterns}
    assert len(printed) <= 9
    assert len(np.unique(texture.lbp_codes(grey))) > 50


def test_a_bit_is_set_where_the_neighbour_is_at_least_the_centre() -> None:
    """The text's rule, one where the centre is greater, gives a constant surface the other pattern."""
    flat = np.full((20, 20), 9, np.uint8)
    all_ones, all_zeros = texture.uniform_bins()[255], texture.uniform_bins()[0]
    assert (texture.lbp_codes(flat) == all_ones).all()
    peak = np.zeros((3, 3), np.uint8)
    peak[1, 1] = 1
    assert texture.lbp_codes(peak)[1, 1] == all_zeros


def test_lbp_does_not_change_with_monotonic_illumination_but_does_with_rotation() -> None:
    grey = data.brick()[:200, :200]
    assert grey.max() < 225
    plain = texture.lbp_histograms(grey, 200)[0, 0]
    brighter = (grey + 30).astype(np.uint8)
    assert np.array_equal(texture.lbp_histograms(brighter, 200)[0, 0], plain)
    turned = texture.lbp_histograms(np.ascontiguousarray(np.rot90(grey)), 200)[0, 0]
    assert np.abs(turned - plain).sum() > 0.2


@pytest.mark.parametrize(("window", "stride"), [(20, 20), (20, 10), (8, 5), (11, 11)])
def test_histograms_count_the_codes_of_whole_windows(window: int, stride: int) -> None:
    grey = scene(5)
    codes, ours = texture.lbp_codes(grey), texture.lbp_histograms(grey, window, stride)
    assert ours.dtype == np.float32
    assert ours.shape == ((47 - window) // stride + 1, (66 - window) // stride + 1, 59)
    for row, col in np.ndindex(ours.shape[:2]):
        inside = codes[row * stride : row * stride + window, col * stride : col * stride + window]
        expected = np.bincount(inside.reshape(-1), minlength=59) / window**2
        assert ours[row, col] == pytest.approx(expected, abs=1e-6)


def test_histograms_tell_real_textures_apart() -> None:
    photographs = [data.brick(), data.grass(), data.gravel()]
    upper = [texture.lbp_histograms(one[:256], 64).reshape(-1, 59) for one in photographs]
    lower = [texture.lbp_histograms(one[256:], 64).reshape(-1, 59) for one in photographs]
    means = np.stack([one.mean(axis=0) for one in upper])
    for k, one in enumerate(lower):
        nearest = ((one[:, None] - means) ** 2).sum(axis=2).argmin(axis=1)
        assert (nearest == k).mean() > 0.8


def test_grey_is_the_luma_for_both_depths() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (12, 10, 3)).astype(np.uint8)
    luma = rgb @ np.array([0.299, 0.587, 0.114])
    assert np.abs(texture.grey_levels(rgb) - luma).max() <= 0.51
    assert np.abs(texture.grey_levels(rgb.astype(np.uint16) * 257) - luma).max() <= 0.51
    assert np.array_equal(texture.grey_levels(rgb[:, ::-1]), texture.grey_levels(rgb)[:, ::-1])


def test_what_has_no_whole_window_or_another_type_is_refused() -> None:
    grey = scene(0)
    for call, said in [
        (lambda: texture.lbp_histograms(grey, 48), "66 × 47"),
        (lambda: texture.lbp_histograms(grey, 20, 0), "stride of at least 1"),
        (lambda: texture.lbp_codes(grey.astype(np.float32)), "float32"),
        (lambda: texture.glcm_features(grey, levels=1), "1 levels"),
        (lambda: texture.glcm_features(grey, offset=(0, 0)), "offset"),
        (lambda: texture.glcm_features(grey, 20, offset=(20, 0)), "stays inside"),
        (lambda: texture.grey_levels(grey), r"must be \(h, w, 3\)"),
    ]:
        with pytest.raises(InputError, match=said):
            call()
