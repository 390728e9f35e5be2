"""What a result was made with: a short digest of each part of the rig, by which stale results are known."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from surfclass.rig import DepthRig

PARTS: Mapping[str, tuple[str, ...]] = {
    "cameras": (
        *(f"{camera}.{key}" for camera in ("rgb", "depth") for key in ("size", "fx", "fy", "cx", "cy")),
        "rgb.distortion",
        "depth.distortion",
        "depth_correction",
        "transforms.rgb_T_depth",
    ),
    "hand-eye": ("transforms.flange_T_depth", "arm"),
    "response": ("response.inverse",),
    "light": ("light", "rgb.vignetting"),
    "limits": ("texture_limits", "class_texture_limits"),
}
"""The keys of `rig.toml` that each commissioning step finds."""
DEPENDS: Mapping[str, tuple[str, ...]] = {
    "cameras": (),
    "response": (),
    "hand-eye": ("cameras",),
    "light": ("cameras", "response"),
    "limits": ("cameras",),
    "model": ("cameras", "response", "light"),
    "map": ("cameras", "hand-eye", "response", "light", "limits"),
}
"""What each result rests on; it is stale when one of these has changed since."""
_DIGITS = 12


def fingerprints(rig: DepthRig) -> dict[str, str]:
    """Returns a digest of each part of the rig (`PARTS`); equal numbers give equal digests."""
    # Without defaults: a key that a later version adds must not make everything stale.
    told = rig.model_dump(by_alias=True, exclude_defaults=True, mode="json")
    return {part: _digest([_at(told, key) for key in keys]) for part, keys in PARTS.items()}


def changed(made_with: Mapping[str, str], now: Mapping[str, str], result: str) -> list[str]:
    """Returns the parts that `result` (of `DEPENDS`) rests on and that have changed since it was made.

    Args:
        made_with: The fingerprints that it carries; a part that one of the two does not have says
            nothing.
        now: Those of the rig in use.
        result: Such as "map".
    """
    known = [part for part in DEPENDS[result] if part in made_with and part in now]
    return [part for part in known if made_with[part] != now[part]]


def _at(table: Any, key: str) -> Any:
    for step in key.split("."):
        table = table.get(step) if isinstance(table, dict) else None
    return table


def _digest(values: list[Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:_DIGITS]
