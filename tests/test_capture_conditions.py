"""The thesis' experiments on a checkerboard (§5.2): what blur, scale and shear do to texture features."""

import itertools

import cv2
import numpy as np
import pytest

from surfclass import texture

SIDE, SQUARE, WINDOW = 400, 20, 50
CONTRAST, HOMOGENEITY = texture.GLCM_FEATURES.index("contrast"), texture.GLCM_FEATURES.index("homogeneity")
SHEARS = np.arange(0.1, 0.5 + 1e-9, 0.05)


def checkerboard():
    row, col = np.indices((SIDE, SIDE)) // SQUARE
    return np.where((row + col) % 2, 255, 0).astype(np.uint8)


def features(image):
    return texture.glcm_features(image, WINDOW).reshape(-1, 4).mean(axis=0)


def sheared(k, u_of=lambda u, v, k: u + k * v):
    """Eq. 5.14 and 5.15: each pixel (u, v) goes to (u + k v, k u + v); nearest neighbour."""
    forward = np.array([[u_of(1, 0, k), u_of(0, 1, k), 0], [k, 1, 0]], np.float64)
    return cv2.warpAffine(
        checkerboard(), forward, (SIDE, SIDE), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT
    )


def test_there_are_nine_shears_not_ten():
    assert len(SHEARS) == 9


def test_shear_moves_u_by_v():
    """5.14 prints a y that is nowhere defined; with u for it, u would only be stretched."""
    k = 0.25
    corner = 2 * SQUARE  # where four squares meet
    image = sheared(k)
    u, v = corner + k * corner, k * corner + corner
    near = image[int(v) - 3 : int(v) + 4, int(u) - 3 : int(u) + 4]
    assert 0.3 < (near == 255).mean() < 0.7
    assert not np.array_equal(image, sheared(k, lambda u, v, k: u + k * u))


@pytest.mark.parametrize(
    "changed",
    [
        [cv2.GaussianBlur(checkerboard(), (0, 0), beta) for beta in (1, 2, 4, 8)],
        [cv2.resize(checkerboard(), None, fx=b, fy=b, interpolation=cv2.INTER_NEAREST) for b in (2, 3, 4)],
    ],
    ids=["blur (5.5, 5.6)", "enlargement (5.11, 5.12)"],
)
def test_what_smooths_lowers_contrast(changed):
    contrasts = [features(image)[CONTRAST] for image in (checkerboard(), *changed)]
    assert all(later < earlier for earlier, later in itertools.pairwise(contrasts))


def test_shear_changes_the_features_the_more_the_stronger_it_is():
    flat = features(checkerboard())
    change = [np.abs(features(sheared(k)) - flat)[CONTRAST] for k in SHEARS]
    assert change[-1] > change[0] > 0
    assert features(sheared(0.0)) == pytest.approx(flat)
    assert features(sheared(0.5))[HOMOGENEITY] != pytest.approx(flat[HOMOGENEITY], abs=1e-3)
