"""What a configuration may say of a V4L2 camera."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, Strict

from surfclass.schema import Number, Positive, Table

Whole = Annotated[int, Strict()]


class V4l2Options(Table):
    """The `[colour]` table of the backend "v4l2".

    Attributes:
        device_path: Such as "/dev/v4l/by-id/…-video-index0", which stays the same whatever else is plugged
            in, or "/dev/video0".
        width: Of the image, pixels; the camera must have exactly this size.
        height: The same.
        pixel_format: V4L2's four characters. Raw Bayer formats ("RGGB", "RG10", "RG12", "RG16" …) are linear;
            "RGB3" and "BGR3" are what the camera's own processing makes of it. Compressed and YUV formats
            are refused.
        rate_hz: Frames per second; left out: as the camera has it. Must be given where the kernel's driver
            does not tell.
        exposure_us: A multiple of 100, as V4L2 has it; left out: as the camera has it. Automatic exposure is
            always off.
        gain: In the camera's own unit; left out: as the camera has it. Automatic gain is always off.
        gain_unit_db: What one step of `gain` is worth; left out: the gain in dB is not known.
        controls: Other controls by the names that `v4l2-ctl --list-ctrls` shows, such as { gamma = 100 }.
        buffers: How many frames the kernel may hold.
    """

    device_path: Annotated[str, Field(min_length=1)]
    width: Annotated[int, Strict(), Field(ge=2, le=16384)]
    height: Annotated[int, Strict(), Field(ge=2, le=16384)]
    pixel_format: Annotated[str, Field(min_length=4, max_length=4)]
    rate_hz: Positive | None = None
    exposure_us: Annotated[Positive, Field(multiple_of=100)] | None = None
    gain: Whole | None = None
    gain_unit_db: Number | None = None
    controls: dict[str, Whole | bool] = Field(default_factory=dict)
    buffers: Annotated[int, Strict(), Field(ge=2, le=32)] = 4
