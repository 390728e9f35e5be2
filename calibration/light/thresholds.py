"""Where a board's highlight and diffuse region end, from the image itself: τ_s, τ_d of Eq. 4.5, 4.7."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.light.highlight import LightSearch
from surfclass.errors import InputError
from surfclass.types import Bool, Float32, Float64

_ROUNDS = 8
_STEP = 4  # of the pixels that the background is fitted to
_LEAST_EXCESS = 0.10  # a highlight outshines the diffuse background by so much of it
_BAND = (0.5, 3.0)  # allowed widths of the guard band, radii of the highlight


def thresholds(intensity: Float32, usable: Bool) -> LightSearch:
    """Returns thresholds and guard band for one board.

    The diffuse background is a smooth surface below most of the image. τ_d is as bright as it gets; the
    highlight's core is what reaches half way from there to the peak; the guard band ends where nothing
    stands out of the background any more.

    Args:
        intensity: (h, w) grey fractions of full scale.
        usable: (h, w) whether a pixel shows the board.

    Raises:
        InputError: If nothing on the board stands out of its background.
    """
    background = diffuse_background(intensity, usable)
    excess = np.where(usable, intensity / np.maximum(background, 1e-3) - 1, 0.0).astype(np.float32)
    smooth = cv2.GaussianBlur(excess, (0, 0), max(1.0, intensity.shape[1] / 300))
    peak = float(smooth[usable].max(initial=0.0))
    if peak < _LEAST_EXCESS:
        raise InputError(
            f"light: nothing on the board is brighter than its surroundings by more than {peak:.0%}, so "
            "there is no highlight; the board must be semi-gloss, and turned so that it mirrors the light "
            "into the camera"
        )
    noise = 1.4826 * float(np.median(np.abs(smooth[usable & (smooth < _LEAST_EXCESS)])))
    shines = usable & (smooth > max(0.02, 4 * noise))
    tau_d = float(np.quantile(background[usable], 0.995)) * (1 + 3 * noise)
    top = float(intensity[usable].max())
    tau_s = min(max((tau_d + top) / 2, tau_d), 0.975)
    core = np.sqrt(max(1.0, float((usable & (intensity > tau_s)).sum())) / np.pi)
    guard = np.sqrt(float(shines.sum()) / np.pi) / core - 1
    return LightSearch(
        specular_above=tau_s, diffuse_below=min(tau_d, tau_s), guard=float(np.clip(guard, *_BAND))
    )


def diffuse_background(intensity: Float32, usable: Bool) -> Float64:
    """Returns (h, w): a smooth surface through what is not brighter than it, by repeated least squares.

    Its logarithm is of second order, with r⁴ for the lens.
    """
    h, w = intensity.shape
    y, x = np.mgrid[:h, :w].astype(np.float64)
    x, y = 2 * x / w - 1, 2 * y / h - 1
    r2 = x * x + y * y
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, r2 * r2], axis=-1)
    part = np.s_[::_STEP, ::_STEP]
    rows, seen = terms[part].reshape(-1, terms.shape[-1]), usable[part].ravel()
    values = np.log(np.maximum(intensity[part].ravel().astype(np.float64), 1e-3))
    kept = seen & (values <= np.quantile(values[seen], 0.85)) if seen.any() else seen
    if kept.sum() < 20:
        raise InputError("light: the board covers too little of the image")
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(rows[kept], values[kept], rcond=None)[0]
        away = values - rows @ found
        spread = 1.4826 * float(np.median(np.abs(away[kept]))) + 1e-3
        kept = seen & (away < 3 * spread)
    return np.asarray(np.exp(terms @ found))
