"""What guides the capture of a step: which view comes next, and whether the last one is of use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surfclass.frames import Capture


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What a view is worth.

    Attributes:
        accepted: Whether it is of use.
        reasons: Where it is not: why, and what to do instead, a sentence each.
        picture: (h, w, 3) uint8 RGB: the image with what was found in it drawn on top.
    """

    accepted: bool
    reasons: tuple[str, ...]
    picture: NDArray[np.uint8]


class Guide(Protocol):
    """One step's; it remembers the views that it has accepted."""

    role: str
    """Of the captures that the step needs."""

    def next_step(self) -> str:
        """What the engineer should do now, one sentence; where to move the camera, if that is known."""

    def look(self, capture: Capture) -> Look:
        """Judges a view; one that is accepted is remembered."""

    def progress(self) -> tuple[int, int]:
        """Returns how many views are there, and how many are needed."""

    def coverage(self) -> dict[str, Any]:
        """Returns what has been covered: names to shares of 1, or to grids of counts (lists of rows)."""
