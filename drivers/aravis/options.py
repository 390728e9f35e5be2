"""What a configuration says about an Aravis camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from surfclass.schema import Positive, Table

Count = Annotated[int, Strict(), Field(ge=0)]
NotNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]


class AravisOptions(Table):
    """Which camera, and how it is set up.

    Attributes:
        serial: The camera's serial number; None: the only camera there is, or the one at `address`.
        address: Network address of a GigE camera; spares the search, which takes 1 s.
        exposure_us: Exposure time.
        gain_db: Gain. A camera that knows its gain only in steps of its own takes 0 alone.
        region: x, y, width, height on the sensor; None: all of it.
        pixel_format: Such as "BayerRG12p"; None: the best that the camera has (raw before RGB, twelve
            bits before others).
        trigger: "software" triggers inside `grab`; "Line0" and so on waits there for a frame that the
            line has triggered; "free" runs by itself.
        trigger_latency_s: A software-triggered exposure begins within this of the camera's accepting the
            trigger; bounds how uncertain a frame's time is.
        rate_hz: Of frames that run freely; None: as the camera is.
        strobe_lines: Lines that give a pulse while a frame is exposed, such as ["Line2"].
        strobe_source: What the camera calls that pulse.
        strobe_inverted: Whether the pulse is low.
        balance_red: White balance, a factor on red; `balance_blue` likewise. 1 leaves raw values alone.
        stamp_at: Which moment the camera's time stamps mean.
        packet_bytes: Of a GigE camera's image packets; None: Aravis tries what the network carries.
        silence_s: A camera that leaves a command unanswered for so long is lost.
    """

    serial: str | None = None
    address: str | None = None
    exposure_us: Positive = 10_000.0
    gain_db: NotNegative = 0.0
    region: tuple[Count, Count, Count, Count] | None = None
    pixel_format: str | None = None
    trigger: Annotated[str, Field(pattern=r"^(software|free|Line\d+)$")] = "software"
    trigger_latency_s: Positive = 0.02
    rate_hz: Positive | None = None
    strobe_lines: tuple[str, ...] = ()
    strobe_source: str = "ExposureActive"
    strobe_inverted: bool = False
    balance_red: Positive = 1.0
    balance_blue: Positive = 1.0
    stamp_at: Literal["exposure_start", "exposure_end"] = "exposure_start"
    packet_bytes: Annotated[int, Strict(), Field(ge=576, le=65_000)] | None = None
    silence_s: Annotated[float, Strict(), Field(ge=0.5, le=10)] = 1.0
