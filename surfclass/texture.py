"""Texture features of square windows: local binary patterns and grey-level co-occurrence (appendix B)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from surfclass.errors import InputError
from surfclass.types import Float32, Float64

LBP_BINS = 59
GLCM_FEATURES = ("contrast", "correlation", "energy", "homogeneity")

_WINDOWS_AT_ONCE = 4096
# Neighbour p as (row, column) steps: from the right, counter-clockwise.
_NEIGHBOURS = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))


def grey_levels(rgb: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns the (h, w) luma, 0.299 R + 0.587 G + 0.114 B, of a (h, w, 3) uint8 or uint16 image.

    Raises:
        InputError: If the image has another shape or type.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype not in (np.uint8, np.uint16):
        raise InputError(f"image: {rgb.dtype} of shape {rgb.shape}, must be (h, w, 3) of uint8 or uint16")
    grey: NDArray[Any] = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    if grey.dtype == np.uint16:
        grey = ((grey.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return grey


def lbp_codes(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the bin, 0…58, of each pixel's local binary pattern (Eq. B.5, B.6 with weight 2ᵖ).

    Bit p is 1 where neighbour p of the 8 plain neighbours (no interpolation of the diagonals) is at
    least the centre. The 58 patterns with at most two changes around the circle have a bin each, in
    the order of their value; all others share bin 58. A turned texture has other bins: this mapping
    is not invariant to rotation. Beyond the border the nearest pixel is repeated.

    Args:
        grey: (h, w) uint8.

    Raises:
        InputError: If the image is not (h, w) of uint8.
    """
    _check_grey(grey)
    h, w = grey.shape
    padded = cv2.copyMakeBorder(grey, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    pattern = np.zeros((h, w), np.uint8)
    for p, (row, col) in enumerate(_NEIGHBOURS):
        neighbour = padded[1 + row : 1 + row + h, 1 + col : 1 + col + w]
        bit = (neighbour >= grey).view(np.uint8)
        bit <<= p
        pattern |= bit
    return np.asarray(cv2.LUT(pattern, uniform_bins()), np.uint8)


@lru_cache(maxsize=1)
def uniform_bins() -> NDArray[np.uint8]:
    """Returns (256,) uint8: the bin of each pattern of 8 neighbours at radius 1."""
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    uniform = (bits != np.roll(bits, 1, axis=1)).sum(axis=1) <= 2
    bins = np.where(uniform, np.cumsum(uniform) - 1, LBP_BINS - 1).astype(np.uint8)
    bins.flags.writeable = False
    return bins


def lbp_histograms(grey: NDArray[np.uint8], window: int = 20, stride: int | None = None) -> Float32:
    """Returns (rows, cols, 59) histograms of `lbp_codes` in square windows, each summing to 1.

    Codes are taken from the whole image, so a window's edge pixels see their true neighbours.

    Args:
        grey: (h, w) uint8.
        window: Side of a window, px; only whole windows are taken.
        stride: Step from window to window, px; None: `window`, so that they tile the image.

    Raises:
        InputError: If the image is not (h, w) of uint8 or smaller than a window.
    """
    stride = _checked_stride(grey, window, stride)
    codes = lbp_codes(grey)
    rows, cols = (grey.shape[0] - window) // stride + 1, (grey.shape[1] - window) // stride + 1
    if stride == window:
        cell = np.arange(rows * window * cols * window, dtype=np.int32)  # room for the keys
        cell = cell.reshape(rows, window, cols, window)
        first = np.arange(rows * cols, dtype=np.int32).reshape(rows, 1, cols, 1) * LBP_BINS
        np.add(codes[: rows * window, : cols * window].reshape(cell.shape), first, out=cell)
        count = np.bincount(cell.reshape(-1), minlength=rows * cols * LBP_BINS)
        return (count.reshape(rows, cols, LBP_BINS) / window**2).astype(np.float32)
    histogram = np.empty((rows, cols, LBP_BINS), np.float32)
    top, left = np.arange(rows)[:, None] * stride, np.arange(cols) * stride
    for code in range(LBP_BINS):
        total = cv2.integral((codes == code).view(np.uint8))
        inside = total[top + window, left + window] - total[top, left + window]
        inside += total[top, left] - total[top + window, left]
        histogram[..., code] = inside / window**2
    return histogram


def glcm_features(
    grey: NDArray[np.uint8],
    window: int = 20,
    levels: int = 8,
    offset: tuple[int, int] = (0, 1),
    stride: int | None = None,
) -> Float64:
    """Returns (rows, cols, 4): contrast, correlation, energy and homogeneity of square windows.

    Eq. B.1–B.4 on the symmetric, normalised co-occurrence matrix of pairs that lie inside the window.
    Energy is the sum of squares (scikit-image calls it ASM), homogeneity divides by 1 + |u − v|²
    (Matlab's by 1 + |u − v|), and the correlation of a constant window is defined as 1.

    Args:
        grey: (h, w) uint8; quantised to `levels` equal steps.
        window: Side of a window, px; only whole windows are taken.
        levels: Grey levels, 2 to 256.
        offset: (row, column) step from a pixel to its neighbour.
        stride: Step from window to window, px; None: `window`, so that they tile the image.

    Raises:
        InputError: If the image is not (h, w) of uint8 or smaller than a window, or a parameter is
            out of range.
    """
    stride = _checked_stride(grey, window, stride)
    if not 2 <= levels <= 256 or offset == (0, 0) or max(map(abs, offset)) >= window:
        raise InputError(
            f"GLCM: {levels} levels, offset {offset} in windows of {window} px; allowed are 2 to 256 "
            "levels and an offset other than (0, 0) that stays inside the window"
        )
    quantised = (grey.astype(np.int32) * levels) >> 8
    # Both pixels' levels of every pair of the image, at the place of the pair's upper left corner.
    reach = abs(offset[0]), abs(offset[1])
    height, width = grey.shape[0] - reach[0], grey.shape[1] - reach[1]
    from_row, from_col = max(0, -offset[0]), max(0, -offset[1])
    to_row, to_col = max(0, offset[0]), max(0, offset[1])
    pair = quantised[from_row : from_row + height, from_col : from_col + width] * levels
    pair += quantised[to_row : to_row + height, to_col : to_col + width]
    windows = sliding_window_view(pair, (window - reach[0], window - reach[1]))[::stride, ::stride]
    rows, cols = windows.shape[:2]
    features = np.empty((rows, cols, len(GLCM_FEATURES)))
    rows_at_once = max(1, _WINDOWS_AT_ONCE // cols)
    for start in range(0, rows, rows_at_once):
        part = windows[start : start + rows_at_once]
        features[start : start + rows_at_once] = _describe(part, levels).reshape(len(part), cols, -1)
    return features


def _describe(pair: NDArray[np.int32], levels: int) -> Float64:
    """(rows, cols, a, b) pairs to (rows · cols, 4) features."""
    n = pair.shape[0] * pair.shape[1]
    key = pair.reshape(n, -1) + np.arange(n, dtype=np.int32)[:, None] * (levels * levels)
    count = np.bincount(key.reshape(-1), minlength=n * levels * levels).reshape(n, levels, levels)
    D = (count + count.swapaxes(1, 2)) / (2 * pair.shape[2] * pair.shape[3])
    u = np.arange(levels, dtype=np.float64)
    step = (u[:, None] - u) ** 2
    share = D.sum(axis=2)
    deviation = u - (share @ u)[:, None]
    variance = (share * deviation**2).sum(axis=1)
    covariance = np.einsum("nuv,nu,nv->n", D, deviation, deviation)
    constant = (share > 0).sum(axis=1) == 1
    return np.stack(
        [
            np.einsum("nuv,uv->n", D, step),
            np.where(constant, 1.0, covariance / np.where(constant, 1.0, variance)),
            np.einsum("nuv,nuv->n", D, D),
            np.einsum("nuv,uv->n", D, 1 / (1 + step)),
        ],
        axis=1,
    )


def _check_grey(grey: NDArray[Any]) -> None:
    if grey.ndim != 2 or grey.dtype != np.uint8 or 0 in grey.shape:
        raise InputError(f"grey image: {grey.dtype} of shape {grey.shape}, must be (h, w) of uint8")


def _checked_stride(grey: NDArray[Any], window: int, stride: int | None) -> int:
    _check_grey(grey)
    stride = window if stride is None else stride
    if not 2 <= window <= min(grey.shape) or stride < 1:
        raise InputError(
            f"windows of {window} px every {stride} px in an image of {grey.shape[1]} × "
            f"{grey.shape[0]}: allowed are a window of at least 2 px that fits, and a stride of at least 1"
        )
    return stride
