"""The plate of reflector discs that hand-eye captures look at, from `plate.toml`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surfclass.schema import Positive, Table, Vector3, parse_toml


class Plate(Table):
    """What was measured on the plate.

    Attributes:
        disc_radius_m: Of every disc.
        positions_base_m: The discs' centres in `base`, touched with a pointer; their order says nothing.
    """

    disc_radius_m: Positive
    positions_base_m: Annotated[tuple[Vector3, ...], Field(min_length=3)]


def parse_plate(text: str | bytes, source: str) -> Plate:
    """Returns the plate that `plate.toml`'s text describes.

    Raises:
        ConfigurationError: Naming every fault by its path.
    """
    return parse_toml(Plate, text, source)
