"""Which devices took a recording: what its metadata say of them."""

from __future__ import annotations

from collections.abc import Mapping

from calibration.source import SERIAL


def device_metadata(about: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Returns the keys of a recording's metadata that name the devices, such as "serial of colour".

    Args:
        about: By device, what it tells about itself (`SensorPackage.about`).
    """
    heads = {"serial": SERIAL, "model": "model of ", "firmware": "firmware of "}
    return {
        head + device: facts[fact]
        for device, facts in about.items()
        for fact, head in heads.items()
        if facts.get(fact)
    }
