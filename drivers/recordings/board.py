"""The calibration board that `board` captures look at, from `board.toml`."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from surfclass.schema import Positive, Table, parse_toml
from surfclass.types import Float64

Side = Annotated[int, Field(ge=3, le=100)]


class Board(Table):
    """A flat board whose corners are known.

    Attributes:
        kind: A plain checkerboard, which has to be seen whole, or a ChArUco board, which need not.
        columns: Inner corners in a row: one fewer than there are squares.
        rows: Inner corners in a column, likewise.
        square_m: Side of a square.
        dictionary: Of a ChArUco board's markers, such as "DICT_5X5_100".
        marker_m: Side of a ChArUco board's marker.
    """

    kind: Literal["checkerboard", "charuco"] = "checkerboard"
    columns: Side
    rows: Side
    square_m: Positive
    dictionary: Annotated[str, Field(pattern=r"^DICT_\w+$")] | None = None
    marker_m: Positive | None = None

    @model_validator(mode="after")
    def _markers_go_with_charuco(self) -> Board:
        told = (self.dictionary is not None, self.marker_m is not None)
        if self.kind == "charuco" and not all(told):
            raise ValueError("a charuco board needs dictionary and marker_m")
        if self.kind == "checkerboard" and any(told):
            raise ValueError('dictionary and marker_m belong to kind = "charuco"')
        if self.marker_m is not None and self.marker_m >= self.square_m:
            raise ValueError(f"marker_m {self.marker_m} is not below square_m {self.square_m}")
        return self

    @property
    def points_m(self) -> Float64:
        """(rows · columns, 3) the corners in the board's frame, row by row; z is 0.

        The first corner is the origin, x goes along the rows and y along the columns, so that z points
        into the board where it is seen from its front.
        """
        y, x = np.mgrid[: self.rows, : self.columns].astype(np.float64)
        points: Float64 = self.square_m * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        return points

    def __str__(self) -> str:
        """Such as "checkerboard of 9 × 6 inner corners, squares of 25 mm"."""
        return (
            f"{self.kind} of {self.columns} × {self.rows} inner corners, "
            f"squares of {1000 * self.square_m:g} mm"
        )


def parse_board(text: str | bytes, source: str) -> Board:
    """Returns the board that `board.toml`'s text describes.

    Raises:
        ConfigurationError: Naming every fault by its path.
    """
    return parse_toml(Board, text, source)
