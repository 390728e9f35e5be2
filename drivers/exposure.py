"""Whether an exposure time is one that a camera can be set to."""

from __future__ import annotations

from surfclass.errors import InputError


def check_exposure(device: str, exposure_s: float, range_s: tuple[float, float]) -> None:
    """Raises unless a camera whose exposure can be changed at all allows this one.

    Args:
        device: The camera's name.
        exposure_s: The wanted exposure time.
        range_s: As `drivers.interfaces.ExposureControl.exposure_range_s`.

    Raises:
        InputError: With what is allowed (a ValueError).
    """
    shortest_s, longest_s = range_s
    if shortest_s >= longest_s:
        raise InputError(f"{device}: its exposure cannot be changed")
    if not shortest_s <= exposure_s <= longest_s:
        raise InputError(
            f"{device}: exposure {exposure_s * 1e3:g} ms, the camera allows {shortest_s * 1e3:g} to "
            f"{longest_s * 1e3:g} ms"
        )
