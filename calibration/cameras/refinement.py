"""Places the corners of a checkerboard to a small part of a pixel, through blur and through speckle."""

from __future__ import annotations

import cv2
import numpy as np

from surfclass.types import Float32, Float64

_REACH = 0.8  # of a square: how far from its corner the pattern is compared; beyond 1 the next edges come
_STEP_PX = 1.0  # between the places where the image is read, at most
_MOST_STEPS = 15  # from a corner to the end of its reach
_BLURS_PX = (0.5, 0.8, 1.2, 1.8, 2.7, 4.0, 6.0)  # widths of an edge that are tried
_ROUNDS = 8
_SETTLED_PX = 1e-4
_MOST_SHIFT = 0.45  # of a square: a corner that moves farther is not this corner


def refine(grey: Float32, rough: Float64, size: tuple[int, int]) -> Float64:
    """Returns the corners (n, 2) where a pattern of two crossing edges fits the image best.

    The pattern is an ideal corner seen through a blurred lens, `m + c · erf(s) · erf(t)`, over most of
    the four squares around: it averages over speckle, and since it is even about its centre, neither
    the camera's response nor the width of the edges moves that. The image is first brought to even noise
    (`_even_noise`), so that least squares weighs its pixels rightly. The shift is found by Gauss-Newton
    with the pattern's derivatives (inverse compositional: Baker and Matthews 2004), all corners at once.

    Args:
        grey: (h, w).
        rough: (rows · columns, 2) px, to about a third of a square.
        size: Columns and rows.
    """
    corners = _towards_plane(rough, size)
    along, down = _sides(corners, size)
    even = _even_noise(grey, corners.reshape(size[1], size[0], 2))
    widest = min(float(np.median(np.linalg.norm(side, axis=1))) for side in (along, down)) / 4
    blurs = [blur for blur in _BLURS_PX if blur <= max(widest, _BLURS_PX[0])]
    fits = []
    for blur in reversed(blurs):  # the widest pattern catches a corner from farthest away
        corners, misfit = _fit(even, corners, along, down, blur)
        fits.append((misfit, blur, corners))
    best = min(fits, key=lambda fit: fit[0])
    away = np.linalg.norm(best[2] - _towards_plane(rough, size), axis=1)
    side = np.minimum(np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1))
    return np.where((away < _MOST_SHIFT * side)[:, None], best[2], np.nan)


def _towards_plane(rough: Float64, size: tuple[int, int]) -> Float64:
    """The corners on the plane's image, where they are rougher than the lens bends that."""
    flat = _flat(size)
    matrix, _ = cv2.findHomography(flat, rough)
    ideal = cv2.perspectiveTransform(flat[None], matrix)[0]
    # What is left is the lens' distortion, smooth over the board, and the roughness, which is not.
    x, y = 2 * flat[:, 0] / (size[0] - 1) - 1, 2 * flat[:, 1] / (size[1] - 1) - 1
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    bend, *_ = np.linalg.lstsq(terms, rough - ideal, rcond=None)
    return np.asarray(ideal + terms @ bend, np.float64)


def _flat(size: tuple[int, int]) -> Float64:
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _sides(corners: Float64, size: tuple[int, int]) -> tuple[Float64, Float64]:
    """The image of one square's side along the rows and along the columns at each corner, (n, 2) each."""
    grid = corners.reshape(size[1], size[0], 2)
    along, down = (np.asarray(np.gradient(grid, axis=axis), np.float64) for axis in (1, 0))
    return along.reshape(-1, 2), down.reshape(-1, 2)


def _even_noise(grey: Float32, grid: Float64) -> Float32:
    """The image in a scale where its noise is as large on light squares as on dark ones.

    With a standard deviation `a + b I`, as speckle has it, that scale is `log(a + b I) / b`.
    """
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    half = (grid[1:, 1:] - grid[:-1, :-1]) / 2, (grid[:-1, 1:] - grid[1:, :-1]) / 2
    share = np.linspace(-0.5, 0.5, 9)
    places = middle[..., None, None, :] + (
        share[:, None, None] * half[0][..., None, None, :] + share[:, None] * half[1][..., None, None, :]
    )
    value = _read(grey, places.reshape(len(middle), -1, 2)).reshape(*middle.shape[:2], -1)
    level, noise = value.mean(axis=-1), value.std(axis=-1)
    dark = np.add.outer(np.arange(level.shape[0]), np.arange(level.shape[1])) % 2 == 0
    first, second = ((float(np.median(level[of])), float(np.median(noise[of]))) for of in (dark, ~dark))
    (low, noise_low), (high, noise_high) = sorted((first, second))
    slope = (noise_high - noise_low) / max(high - low, 1e-9)
    if slope * (high - low) <= 0.02 * (high - low):
        return grey
    start = noise_low - slope * low
    least = 0.3 * max(noise_low, 0.02 * noise_high)  # what is darker than the dark squares is no better known
    return np.asarray(np.log(np.maximum(start + slope * grey, least)) / slope, np.float32)


def _fit(
    image: Float32, corners: Float64, along: Float64, down: Float64, blur_px: float
) -> tuple[Float64, float]:
    """The corners that fit best with edges of one width, and the mean square that is left of the image."""
    lengths = np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1)
    steps = int(np.clip(np.ceil(_REACH * max(map(np.median, lengths)) / _STEP_PX), 4, _MOST_STEPS))
    t, s = (
        part.ravel()
        for part in np.meshgrid(*2 * [np.linspace(-_REACH, _REACH, 2 * steps + 1)], indexing="ij")
    )
    grid = s[:, None] * along[:, None] + t[:, None] * down[:, None]  # (n, k, 2) px
    edges = [_edge(place, length[:, None], blur_px) for place, length in zip((s, t), lengths, strict=True)]
    (es, ds), (et, dt) = edges
    # With slowly changing light: m + ms s + mt t beside the corner itself.
    plain = (np.broadcast_to(part, es.shape) for part in (np.ones_like(s), s, t))
    design = np.stack([*plain, es * et, ds * et, es * dt], axis=-1)
    solve = np.linalg.pinv(design)
    found = corners.copy()
    rest = np.zeros(len(corners))
    for _ in range(_ROUNDS):
        value = _read(image, found[:, None] + grid)
        x = np.einsum("nik,nk->ni", solve, value)
        rest = np.mean((value - np.einsum("nki,ni->nk", design, x)) ** 2, axis=1)
        contrast = np.where(np.abs(x[:, 3]) > 1e-9, x[:, 3], np.inf)
        # A corner that lies at +δ looks like the pattern minus δ times its derivative.
        shift = np.clip(-x[:, 4:6] / contrast[:, None], -0.2, 0.2)
        step = shift[:, :1] * along + shift[:, 1:] * down
        found = found + step
        if np.abs(step).max() < _SETTLED_PX:
            break
    return found, float(np.median(rest))


def _edge(place: Float64, length_px: Float64, blur_px: float) -> tuple[Float64, Float64]:
    """A blurred edge across `place` (in squares) of ±1, and its derivative."""
    z = place * length_px / blur_px
    # tanh(z · 2/√π) has the Gauss edge's slope and is within 3 % of it.
    value = np.tanh(z * 2 / np.sqrt(np.pi))
    return value, (1 - value**2) * (2 / np.sqrt(np.pi)) * length_px / blur_px


def _read(image: Float32, places: Float64) -> Float64:
    """The image at places (n, k, 2) px, between its pixels."""
    spot = places.astype(np.float32)
    value = cv2.remap(image, spot[..., 0], spot[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(value, np.float64)
