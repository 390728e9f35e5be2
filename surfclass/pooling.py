"""Eq. 3.10 and 3.11: log evidence becomes class distributions, and two routes become one."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from surfclass.errors import ConfigurationError
from surfclass.types import Bool, Float32

Pool = Literal["linear", "log-linear"]

# A distribution is read no steeper than e^-80 = 1.8e-35, which float32 still holds after every
# division here: whatever was seen, no class ever has probability 0.
_LOG_FLOOR = np.float32(-80.0)


def softmax(log: Float32) -> Float32:
    """Returns the class distributions of log evidence, (…, k) float32: normalised, and nowhere 0."""
    p: Float32 = np.exp(_bounded(log))
    p /= p.sum(axis=-1, keepdims=True)
    return p


def is_known(p: Float32) -> Bool:
    """Returns where distributions (…, k) say anything: a uniform one names no class.

    A voxel can have been seen and still be unknown: by pixels that no route could use, or by texture
    whose weight was 0.
    """
    known: Bool = p.max(axis=-1) > 1 / p.shape[-1] + 1e-6
    return known


def fuse(
    colour: Float32,
    texture: Float32,
    has_colour: Bool,
    has_texture: Bool,
    weight: Float32,
    pool: Pool,
    *,
    texture_is_weighted: bool = False,
) -> Float32:
    """Returns both routes' evidence as one class distribution each, (n, k) float32.

    "linear" is Eq. 3.11, `P_c + w P_t` normalised: as `w <= 1`, texture can never outvote a colour
    route that is sure. "log-linear" is `log P_c + w log P_t` normalised, in which it can. Where one
    route has seen something and the other has not, the result is that one's distribution; where
    neither has, it is uniform.

    Args:
        colour: (n, k) log evidence; zero rows where there is none.
        texture: (n, k) log evidence; zero rows where there is none.
        has_colour: (n,).
        has_texture: (n,).
        weight: (n,) in [0, 1], w.
        pool: As above.
        texture_is_weighted: The weight is in the texture evidence already, so that "log-linear" must
            not multiply by it again.

    Raises:
        ConfigurationError: If there is no such pool.
    """
    if pool not in get_args(Pool):
        raise ConfigurationError(f"pool: {pool!r}, known are {', '.join(get_args(Pool))}")
    p_colour, p_texture = softmax(colour), softmax(texture)
    w = weight[:, None]
    both: Float32
    if pool == "linear":
        both = np.divide(p_colour + w * p_texture, 1 + w, dtype=np.float32)
    else:
        # Bounded first, so that the sum is of log P_c and log P_t as each of them is read alone.
        both = softmax(_bounded(colour) + _bounded(texture) * (1 if texture_is_weighted else w))
    # By what was seen and not by the weight, which can be 0 where texture was seen.
    alone: Float32 = np.where(has_texture[:, None], p_texture, p_colour)
    fused: Float32 = np.where((has_colour & has_texture)[:, None], both, alone)
    return fused


def _bounded(log: Float32) -> Float32:
    """`log` shifted so that each row's largest is 0, and no lower than the floor."""
    bounded: Float32 = np.maximum(log - log.max(axis=-1, keepdims=True), _LOG_FLOOR)
    return bounded
