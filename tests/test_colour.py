"""a*, b* against scikit-image and against the printed equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surfclass.colour import WHITE, a_b, as_fraction, rgb_to_xyz, xyz_to_ab
from surfclass.errors import InputError

fractions = st.tuples(*[st.floats(0, 1)] * 3)


def reference_ab(rgb):
    """Eq. 4.15–4.22 pixel by pixel with math.pow, in float64."""
    matrix = np.array(
        [
            [0.4124564, 0.3575761, 0.1804375],
            [0.2126729, 0.7151522, 0.072175],
            [0.0193339, 0.119192, 0.9503041],
        ]
    )
    linear = [((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in rgb]
    relative = matrix @ linear / matrix.sum(axis=1)
    f = [t ** (1 / 3) if t > 0.008856 else 7.787 * t + 16 / 116 for t in relative]
    return 500 * (f[0] - f[1]), 200 * (f[1] - f[2])


@settings(deadline=None, max_examples=200)
@given(fractions)
def test_fast_path_equals_the_formulas(rgb):
    image = np.array(rgb, np.float32).reshape(3, 1, 1)
    assert a_b(image).ravel() == pytest.approx(reference_ab(image.ravel().astype(float)), abs=1e-3)
    exact = xyz_to_ab(rgb_to_xyz(np.array(rgb).reshape(3, 1, 1)))
    assert exact.ravel() == pytest.approx(reference_ab(rgb), abs=1e-9)


def test_every_8_bit_grey_is_colourless_and_dark_ones_are_finite():
    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)
    ab = a_b(as_fraction(grey))
    assert ab.dtype == np.float32
    assert np.abs(ab).max() < 1e-3


def test_agrees_with_scikit_image():
    from skimage.color import rgb2lab

    image = np.random.default_rng(0).integers(0, 256, (70, 90, 3)).astype(np.uint8)
    expected = np.moveaxis(rgb2lab(image)[..., 1:], -1, 0)
    assert np.abs(a_b(as_fraction(image)) - expected).max() < 0.02


def test_printed_a_b_lack_f_on_the_second_term():
    """Eq. 4.20, 4.21: as printed even a grey is colourful; corrected they are CIE's."""

    def printed(rgb):
        x, y, z = rgb_to_xyz(np.array(rgb).reshape(3, 1)).ravel() / WHITE
        f = np.cbrt
        return 500 * (f(x) - y), 200 * (f(y) - z)

    grey, colourful = (0.5, 0.5, 0.5), (0.404, 0.792, 0.796)
    assert np.abs(a_b(np.array(grey, np.float32).reshape(3, 1, 1))).max() < 1e-3
    assert min(np.abs(printed(grey))) > 50
    from skimage.color import rgb2lab

    truth = rgb2lab(np.array(colourful).reshape(1, 1, 3)).ravel()[1:]
    corrected = xyz_to_ab(rgb_to_xyz(np.array(colourful).reshape(3, 1, 1))).ravel()
    assert corrected == pytest.approx(truth, abs=0.02)
    assert np.abs(printed(colourful) - truth).min() > 20


def test_luminance_of_white_is_one():
    assert rgb_to_xyz(np.ones((3, 1)))[1, 0] == pytest.approx(1.0, abs=1e-6)
    assert np.abs(WHITE - [0.95047, 1.0, 1.08883]).max() < 1e-4


def test_fractions_of_both_depths():
    byte = np.array([[[0, 51, 255]]], np.uint8)
    word = np.array([[[0, 13107, 65535]]], np.uint16)
    for image in (byte, word):
        assert as_fraction(image).shape == (3, 1, 1)
        assert as_fraction(image).ravel() == pytest.approx([0, 0.2, 1], abs=1e-7)


def test_strips_join_without_seams():
    image = np.random.default_rng(1).random((3, 501, 400)).astype(np.float32)
    whole = a_b(image)
    assert np.array_equal(whole[:, 300:310], a_b(image[:, 300:310]))


@pytest.mark.parametrize("image", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3), np.float32)])
def test_refuses_other_images(image):
    with pytest.raises(InputError, match="h × w × 3"):
        as_fraction(image)
    with pytest.raises(InputError, match="3 × h × w"):
        a_b(image.astype(np.float32))
