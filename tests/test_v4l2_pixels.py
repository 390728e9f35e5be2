"""V4L2's pixel formats: their codes, beside the kernel's own names for them, and how they become RGB."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.bayer import demosaic, packed_row_bytes
from drivers.v4l2.pixels import LAYOUTS, decode, layout, needed_bytes
from surfclass.errors import InputError

BAYER = [code for code, each in LAYOUTS.items() if each.pattern]
W, H = 8, 4


def raw_image(bits, seed=0):
    dtype = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(seed).integers(0, 2**bits, (H, W)).astype(dtype)


def packed(raw, bits):
    """MIPI's packing, written down pixel by pixel: the high 8 bits each, then the low bits of all."""
    per_group, low = (4, 2) if bits == 10 else (2, 4)
    out = bytearray()
    for row in raw.tolist():
        for start in range(0, W, per_group):
            group = row[start : start + per_group]
            out += bytes(value >> low for value in group)
            out.append(sum((value & (1 << low) - 1) << low * n for n, value in enumerate(group)))
    return bytes(out)


@pytest.mark.parametrize("code", BAYER)
def test_a_bayer_code_is_what_the_kernel_calls_it(code):
    device = pytest.importorskip("linuxpy.video.device", reason="linuxpy is not installed")
    name = next(each.name for each in device.PixelFormat if each.human_str() == code)
    pattern, bits, how = re.fullmatch(r"S([RGB]{4})(\d+)(P?)", name).groups()
    of = layout(code)
    assert (of.pattern, of.bits, of.packing) == (pattern, int(bits), f"mipi{bits}" if how else None)


@pytest.mark.parametrize("code", BAYER)
@pytest.mark.parametrize("padding", [0, 5])
def test_a_bayer_image_is_demosaiced_whatever_its_rows_end_with(code, padding):
    of = layout(code)
    raw = raw_image(of.bits)
    flat = packed(raw, of.bits) if of.packing else raw.astype("<u2" if of.bits > 8 else "u1").tobytes()
    used = of.row_bytes(W)
    rows = [flat[n * used : (n + 1) * used] + b"\xff" * padding for n in range(H)]
    data = b"".join(rows)[: needed_bytes(of, W, H, used + padding)]
    np.testing.assert_array_equal(decode(data, of, W, H, used + padding), demosaic(raw, of.pattern, of.bits))


@pytest.mark.parametrize(("code", "first"), [("RGB3", [1, 2, 3]), ("BGR3", [3, 2, 1])])
def test_three_bytes_a_pixel_are_taken_in_the_formats_order(code, first):
    data = bytes([1, 2, 3] + [0] * (W * H * 3 - 3))
    rgb = decode(data, layout(code), W, H, W * 3)
    assert rgb[0, 0].tolist() == first
    assert rgb.shape == (H, W, 3)


@given(st.sampled_from(sorted(LAYOUTS)), st.binary(max_size=200), st.integers(1, 40))
def test_any_bytes_are_an_image_or_an_input_error(code, data, row_bytes):
    try:
        rgb = decode(data, layout(code), W, H, row_bytes)
    except InputError:
        return
    assert rgb.shape == (H, W, 3)
    assert len(data) >= needed_bytes(layout(code), W, H, row_bytes)


def test_rows_of_a_packed_format_are_whole_groups():
    assert layout("pRAA").row_bytes(W) == packed_row_bytes(W, "mipi10")
    with pytest.raises(InputError, match="multiple of 4"):
        layout("pRAA").row_bytes(6)
