"""The rig as the text of a `rig.toml`, for what is recorded with it."""

from __future__ import annotations

import tomli_w

from surfclass.rig import DepthRig


def rig_text(rig: DepthRig) -> str:
    """Returns the TOML text that `surfclass.rig.parse_depth_rig` reads as this rig."""
    told = rig.model_dump(by_alias=True, exclude_none=True, exclude_unset=True, mode="json")
    return tomli_w.dumps(told)
