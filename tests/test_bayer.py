"""Bayer: patches of colour, round trips, linearity, borders, and every packing against a plain bit reader."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data

from drivers.bayer import BITS, PACKINGS, PATTERNS, demosaic, mosaic, packed_row_bytes, unpack
from surfclass.errors import InputError

_CV2 = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB,
    "GRBG": cv2.COLOR_BayerGRBG2RGB,
    "GBRG": cv2.COLOR_BayerGBRG2RGB,
    "BGGR": cv2.COLOR_BayerBGGR2RGB,
}


def full_scale(bits):
    return 2**bits - 1


def raw_type(bits):
    return np.uint8 if bits == 8 else np.uint16


def smooth(h, w, bits):
    """An image without detail near the pixel's size, from a fifth to four fifths of full scale."""
    y, x = np.mgrid[:h, :w]
    waves = [np.sin(x / 17 + n) * np.cos(y / 23 - 2 * n) for n in range(3)]
    return ((0.5 + 0.3 * np.stack(waves, axis=2)) * full_scale(bits)).round().astype(raw_type(bits))


def linear_light(picture):
    x = picture / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("bits", BITS)
def test_a_patch_of_one_colour_comes_back_as_that_colour_up_to_the_border(pattern, bits):
    full = full_scale(bits)
    for colour in (
        (full, 0, 0),
        (0, full, 0),
        (0, 0, full),
        (full, full, full),
        (full // 5, full // 3, full // 2),
    ):
        patch = np.full((9, 12, 3), colour, raw_type(bits))
        scale = 1 if bits == 8 else 65535 / full
        wanted = np.round(patch * scale)
        got = demosaic(mosaic(patch, pattern), pattern, bits)
        assert got.dtype == raw_type(bits)
        assert np.abs(got - wanted).max() <= (0 if bits in (8, 16) else 1)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("bits", BITS)
def test_a_smooth_image_comes_back_within_a_two_hundredth_of_full_scale(pattern, bits):
    image = smooth(61, 80, bits)
    got = demosaic(mosaic(image, pattern), pattern, bits)
    scale = 1 if bits == 8 else 65535 / full_scale(bits)
    error = np.abs(got.astype(float) - image * scale) / (full_scale(bits) * scale)
    assert error[2:-2, 2:-2].max() < 1 / 200 + 1 / full_scale(bits)
    assert error.max() < 1 / 30  # the mirror turns a slope round


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_part_of_the_mosaic_gives_that_part_of_the_image(pattern):
    raw = np.random.default_rng(3).integers(0, 65536, (301, 9)).astype(np.uint16)
    whole = demosaic(raw, pattern, 16)
    for first in (30, 60, 62, 64, 66, 126, 250):  # rows of the same pattern as row 0
        part = demosaic(raw[first : first + 9], pattern, 16)
        assert np.array_equal(part[2:-2], whole[first + 2 : first + 7])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pixel_keeps_its_own_raw_value_at_its_place(pattern):
    raw = np.random.default_rng(1).integers(0, 256, (10, 14)).astype(np.uint8)
    assert np.array_equal(mosaic(demosaic(raw, pattern, 8), pattern), raw)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_are_those_that_opencv_calls_by_the_same_names(pattern):
    image = smooth(40, 40, 8)
    ours = demosaic(mosaic(image, pattern), pattern, 8).astype(int)
    theirs = cv2.demosaicing(mosaic(image, pattern), _CV2[pattern]).astype(int)
    assert np.abs(ours - theirs)[2:-2, 2:-2].max() <= 2


def test_the_image_of_a_difference_is_the_difference_of_the_images():
    rng = np.random.default_rng(2)
    dark = rng.integers(20_000, 24_000, (30, 40)).astype(np.uint16)
    light = rng.integers(0, 4_000, (30, 40)).astype(np.uint16) + np.uint16(10_000)
    lit = demosaic(dark + light, "GRBG", 16).astype(int)
    apart = demosaic(dark, "GRBG", 16).astype(int) + demosaic(light, "GRBG", 16).astype(int)
    assert np.abs(lit - apart).max() <= 2


def test_doubling_the_light_doubles_the_image_to_the_end_of_the_scale():
    image = smooth(30, 40, 12) // 2
    once = demosaic(mosaic(image, "RGGB"), "RGGB", 12).astype(int)
    twice = demosaic(mosaic(2 * image, "RGGB"), "RGGB", 12).astype(int)
    assert np.abs(twice - 2 * once).max() <= 2


@pytest.mark.parametrize("name", ["coffee", "astronaut", "chelsea"])
def test_a_photograph_is_rebuilt_better_than_by_bilinear_interpolation(name):
    image = (linear_light(getattr(data, name)()) * 255).round().astype(np.uint8)
    image = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    raw = mosaic(image, "RGGB")

    def error(rgb):
        return np.mean((rgb.astype(float) - image)[2:-2, 2:-2] ** 2)

    bilinear = error(cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2RGB))
    assert error(demosaic(raw, "RGGB", 8)) < 0.6 * bilinear  # 2.2 dB at least


def packed(values, packing):
    """The standards' own bit order, a bit at a time."""
    bits = int("".join(c for c in packing if c.isdigit()))
    if packing.endswith("p"):
        stream = [int(v) >> n & 1 for v in values for n in range(bits)]
        return bytes(sum(stream[i + n] << n for n in range(8)) for i in range(0, len(stream), 8))
    low = bits - 8
    out = bytearray()
    group = 4 if packing == "mipi10" else 2
    for i in range(0, len(values), group):
        some = [int(v) for v in values[i : i + group]]
        high = [v >> low for v in some]
        step = 4 if packing.endswith("Packed") else low
        rest = sum((v & ((1 << low) - 1)) << (step * n) for n, v in enumerate(some))
        out += bytes([high[0], rest, high[1]]) if packing.endswith("Packed") else bytes([*high, rest])
    return bytes(out)


@pytest.mark.parametrize("packing", PACKINGS)
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_packed_values_come_out_as_they_went_in(packing, data):
    bits = int("".join(c for c in packing if c.isdigit()))
    height, width = data.draw(st.integers(1, 3)), 4 * data.draw(st.integers(1, 4))
    values = np.array(
        data.draw(st.lists(st.integers(0, 2**bits - 1), min_size=height * width, max_size=height * width)),
        np.uint16,
    ).reshape(height, width)
    gap = data.draw(st.integers(0, 5))
    rows = [packed(row, packing) for row in values]
    assert packed_row_bytes(width, packing) == len(rows[0])
    stream = b"".join(row + b"\xff" * gap for row in rows)
    assert np.array_equal(unpack(stream, width, height, packing, len(rows[0]) + gap), values)
    assert np.array_equal(unpack(b"".join(rows), width, height, packing), values)


def test_known_bytes_of_each_packing():
    pixels = np.array([[0x123, 0xABC]], np.uint16)
    assert np.array_equal(unpack(bytes([0x23, 0xC1, 0xAB]), 2, 1, "12p"), pixels)
    assert np.array_equal(unpack(bytes([0x12, 0xC3, 0xAB]), 2, 1, "12Packed"), pixels)
    assert np.array_equal(unpack(bytes([0x12, 0xAB, 0xC3]), 2, 1, "mipi12"), pixels)
    four = np.array([[0x3FF, 0, 0x155, 0x2AA]], np.uint16)
    assert np.array_equal(unpack(bytes([0xFF, 0x03, 0x50, 0x95, 0xAA]), 4, 1, "10p"), four)
    assert np.array_equal(unpack(bytes([0xFF, 0x00, 0x55, 0xAA, 0x93]), 4, 1, "mipi10"), four)


@pytest.mark.parametrize(
    ("raw", "pattern", "bits", "message"),
    [
        (np.zeros((4, 4), np.uint8), "RGBG", 8, "pattern 'RGBG', allowed: RGGB"),
        (np.zeros((4, 4), np.uint8), "RGGB", 9, "9 bits, allowed: 8, 10"),
        (np.zeros((4, 4), np.uint8), "RGGB", 12, "12 bits need .* uint16"),
        (np.zeros((4, 4), np.uint16), "RGGB", 8, "8 bits need .* uint8"),
        (np.zeros((4, 4, 3), np.uint8), "RGGB", 8, r"shape \(4, 4, 3\)"),
        (np.zeros((1, 4), np.uint8), "RGGB", 8, "at least 2"),
        (np.full((4, 4), 4096, np.uint16), "RGGB", 12, "value 4096, 12 bits allow up to 4095"),
    ],
)
def test_what_is_no_mosaic_is_refused(raw, pattern, bits, message):
    with pytest.raises(InputError, match=message):
        demosaic(raw, pattern, bits)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((b"\0" * 6, 4, 1, "11p"), "packing '11p', allowed: 10p"),
        ((b"\0" * 6, 3, 1, "12p"), "width 3 .* multiple of 2"),
        ((b"\0" * 5, 4, 1, "12p"), "5 bytes .* 1 rows of 6"),
        ((b"\0" * 6, 4, 0, "12p"), "0 rows"),
        ((b"\0" * 6, 4, 1, "12p", 5), "at least 1 row of 6"),
    ],
)
def test_what_cannot_be_unpacked_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        unpack(*arguments)
