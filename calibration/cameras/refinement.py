"""Places the corners of a checkerboard to a small part of a pixel, through blur and through speckle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from surfclass.types import Float32, Float64

_REACH = 0.85  # of a square: how far from its corner the pattern is compared; beyond 1 the next edges come
_MOST_STEPS = 25  # from a corner to the end of its reach, a pixel each where that is enough
_FEW_STEPS = 8  # as many, while the width of the edges is looked for
_BLURS_PX = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)  # an edge's standard deviations that are tried
_ROUNDS = 8
_SETTLED_PX = 1e-3
_MOST_STEP = 0.2  # of a square, at once
_MOST_SHIFT = 0.45  # of a square: a corner that moves farther is not this corner
_LEAST_NOISE = 0.005  # of the contrast: what rounding and saturation hide is there still
_LEAST_CONTRAST = 0.6  # of the median corner's: at the board's outer edge it is about a third
_INSIDE = 0.35  # of half a square's diagonal: how far from its middle a square's noise is measured


def refine(grey: Float32, rough: Float64, size: tuple[int, int], *, quick: bool = False) -> Float64:
    """Returns the corners (n, 2) where a pattern of two crossing edges fits the image best; NaN where none.

    The pattern is an ideal corner seen through a blurred lens, `m + c · erf(s) · erf(t)`, over most of
    the four squares around: it averages over speckle. Since it is even about its centre, neither the
    camera's response nor a wrong width of the edges moves that. Each pixel is weighted by the noise that
    the image has at its brightness: speckle is strong on light squares and weak on dark ones, and equal
    weights would lose half of what the dark pixels say. The shift is found by Gauss-Newton with the
    pattern's derivatives (inverse compositional: Baker and Matthews 2004), all corners at once.

    Args:
        grey: (h, w).
        rough: (rows · columns, 2) px, to about a third of a square.
        size: Columns and rows.
        quick: Coarser, for a live view.
    """
    start = _towards_plane(rough, size)
    noise = _Noise.of(grey, start.reshape(size[1], size[0], 2))
    along, down = _sides(start, size)
    side = np.minimum(np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1))
    widest = max(float(np.median(side)) / 5, _BLURS_PX[0])
    corners, fits = start, []
    blurs = [blur for blur in _BLURS_PX[:: 3 if quick else 1] if blur <= widest]
    for blur in (blurs[-1], *blurs):  # the widest reaches farthest; from there on, the narrowest first
        fit = _fit(grey, corners, along, down, blur, noise, _FEW_STEPS)
        corners = fit[0]
        fits.append((fit[2], blur, fit))
        if len(fits) > 3 and fits[-1][0] > fits[-2][0]:
            break  # wider ones fit worse and worse
    _, blur, fit = min(fits[1:], key=lambda one: one[0])
    best, contrast, _ = fit if quick else _fit(grey, fit[0], along, down, blur, noise, _MOST_STEPS)
    crossing = contrast > _LEAST_CONTRAST * np.median(contrast)
    away = np.linalg.norm(best - start, axis=1)
    return np.where((crossing & (away < _MOST_SHIFT * side))[:, None], best, np.nan)


@dataclass(frozen=True, slots=True)
class _Noise:
    """A standard deviation that grows with the brightness: `dark + slope · (I - level)`.

    Attributes:
        level: The dark squares' brightness.
        dark: Standard deviation there.
        slope: Not negative.
    """

    level: float
    dark: float
    slope: float

    @classmethod
    def of(cls, grey: Float32, grid: Float64) -> _Noise:
        """Measures it inside of the squares between the corners `grid` (rows, columns, 2)."""
        middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
        first, second = (grid[1:, 1:] - grid[:-1, :-1]) / 2, (grid[:-1, 1:] - grid[1:, :-1]) / 2
        share = np.linspace(-_INSIDE, _INSIDE, 9)
        places = (
            middle[..., None, None, :]
            + share[:, None, None] * first[..., None, None, :]
            + share[:, None] * second[..., None, None, :]
        )
        value = _read(grey, places.reshape(len(middle), -1, 2)).reshape(*middle.shape[:2], -1)
        level, spread = value.mean(axis=-1), value.std(axis=-1)
        even = np.add.outer(np.arange(level.shape[0]), np.arange(level.shape[1])) % 2 == 0
        one, other = ((float(np.median(level[of])), float(np.median(spread[of]))) for of in (even, ~even))
        (low, dark), (high, light) = sorted((one, other))
        contrast = max(high - low, 1e-9)
        dark = max(dark, _LEAST_NOISE * contrast)
        return cls(low, dark, max(light - dark, 0.0) / contrast)

    def at(self, brightness: Float64) -> Float64:
        """Returns the standard deviation at a brightness."""
        return self.dark + self.slope * np.maximum(brightness - self.level, 0)


def _towards_plane(rough: Float64, size: tuple[int, int]) -> Float64:
    """The corners as a plane's image through a lens that bends it smoothly: most of their roughness goes."""
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    flat = np.stack([x, y], axis=-1).reshape(-1, 2)
    matrix, _ = cv2.findHomography(flat, rough)
    ideal = cv2.perspectiveTransform(flat[None], matrix)[0]
    x, y = 2 * flat[:, 0] / (size[0] - 1) - 1, 2 * flat[:, 1] / (size[1] - 1) - 1
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    if len(terms) < 2 * terms.shape[1]:
        return np.asarray(ideal, np.float64)
    bend, *_ = np.linalg.lstsq(terms, rough - ideal, rcond=None)
    return np.asarray(ideal + terms @ bend, np.float64)


def _sides(corners: Float64, size: tuple[int, int]) -> tuple[Float64, Float64]:
    """The image of one square's side along the rows and along the columns at each corner, (n, 2) each."""
    grid = corners.reshape(size[1], size[0], 2)
    along, down = (np.asarray(np.gradient(grid, axis=axis), np.float64) for axis in (1, 0))
    return along.reshape(-1, 2), down.reshape(-1, 2)


def _fit(
    image: Float32,
    corners: Float64,
    along: Float64,
    down: Float64,
    blur_px: float,
    noise: _Noise,
    most_steps: int,
) -> tuple[Float64, Float64, float]:
    """The corners that fit best with edges of one width.

    Returns:
        (n, 2) px; (n,) the contrast over the brightness; and minus twice the log-likelihood of a pixel.
    """
    lengths = np.linalg.norm(along, axis=1), np.linalg.norm(down, axis=1)
    steps = int(np.clip(np.ceil(_REACH * max(map(np.median, lengths))), 4, most_steps))
    t, s = _REACH * (np.mgrid[: 2 * steps + 1, : 2 * steps + 1].reshape(2, -1) / steps - 1)
    grid = s[:, None] * along[:, None] + t[:, None] * down[:, None]  # (n, k, 2) px
    (es, ds), (et, dt) = (_edge(p, length, blur_px) for p, length in zip((s, t), lengths, strict=True))
    # With slowly changing light beside the corner itself, and how that looks when it lies elsewhere.
    plain = (np.broadcast_to(part, es.shape) for part in (np.ones_like(s), s, t))
    design = np.stack([*plain, es * et, ds * et, es * dt], axis=-1)
    found, weight = corners, np.ones_like(es)
    misfit = np.inf
    for _ in range(_ROUNDS):
        value = _read(image, found[:, None] + grid)
        weighted = design * weight[..., None]
        normal = np.swapaxes(weighted, 1, 2) @ design
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        x = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ value[..., None])[..., 0]
        shift = np.clip(-x[:, 4:] / np.where(x[:, 3:4] == 0, np.inf, x[:, 3:4]), -_MOST_STEP, _MOST_STEP)
        step = shift[:, :1] * along + shift[:, 1:] * down
        found = found + step
        model = np.einsum("nki,ni->nk", design[..., :4], x[:, :4])
        spread = noise.at(model)
        weight = 1 / spread**2
        misfit = float(np.median(np.mean((value - model) ** 2 * weight + 2 * np.log(spread), axis=1)))
        if np.abs(step).max() < _SETTLED_PX:
            break
    return found, np.abs(x[:, 3]) / np.maximum(x[:, 0], 1e-9), misfit


def _edge(place: Float64, length_px: Float64, blur_px: float) -> tuple[Float64, Float64]:
    """An edge of ±1 across `place` (k,) in squares, blurred by a Gaussian, and its derivative, (n, k)."""
    from scipy.special import erf  # late: scipy takes its time

    z = place * length_px[:, None] / blur_px
    slope = np.sqrt(2 / np.pi) * np.exp(-z * z / 2) * length_px[:, None] / blur_px
    return erf(z / np.sqrt(2)), slope


def _read(image: Float32, places: Float64) -> Float64:
    """The image at places (n, k, 2) px, between its pixels."""
    spot = places.astype(np.float32)
    value = cv2.remap(image, spot[..., 0], spot[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(value, np.float64)
