"""Seeded random streams: the same keys give the same numbers, whatever was drawn before."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *keys: int | str) -> np.random.Generator:
    """Returns a generator that depends on `seed` and `keys` alone."""
    words = [key if isinstance(key, int) else zlib.crc32(key.encode()) for key in keys]
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, *words])))
