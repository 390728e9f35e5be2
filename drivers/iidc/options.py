"""The options of the IIDC backend, and the error for what the camera at hand cannot do of them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from drivers.bayer import Pattern
from drivers.iidc.dc1394_types import FRAME_RATES
from surfclass.schema import Number, Positive, Table

Raw = Annotated[int, Field(ge=0, le=0xFFF)]  # the 12 bits of a feature's value
Line = Annotated[int, Field(ge=0, le=3)]
Pixels = Annotated[int, Field(ge=0, le=0xFFFF)]


class SetupError(Exception):
    """The camera cannot do what the options ask for, or does not keep it; the text says what it can."""


class IidcOptions(Table):
    """How the camera is set up. Exposure and gain have no defaults: the calibration was made with them.

    Attributes:
        guid: Hexadecimal, as `surfclass check` prints it; None: the only camera there is.
        mode: "1280x960_mono8" and the like are IIDC's fixed formats, with raw Bayer in them;
            "format7_0" … "format7_7" are the camera's own, with a region.
        coding: Of a Format_7 mode. mono8 and mono16 must carry raw Bayer too.
        region_px: Left, top, width, height in a Format_7 mode, each even; None: the whole sensor.
        bits: Of a 16-bit coding: how many low bits the values fill. Point Grey cameras shift their
            10 or 12 bits up, to 16.
        bayer: Colours of the first two pixels and of those below them; None: as the camera says.
        exposure_us: By the camera's absolute shutter, or by `shutter_step_us` where it has none.
        shutter_raw: Instead: the shutter register.
        shutter_step_us: Exposure is `shutter_raw` of these plus `shutter_offset_us`, from the
            camera's manual; needed only by a camera without an absolute shutter, and only used then.
        shutter_offset_us: See there.
        gain_db: By the camera's absolute gain, or by `gain_step_db`.
        gain_raw: Instead: the gain register.
        gain_step_db: Gain is `gain_raw` of these plus `gain_offset_db`; as for the shutter.
        gain_offset_db: See there.
        brightness_raw: The black level's register; None: as the camera has it.
        frame_rate_hz: In a fixed format one of IIDC's 1.875, 3.75 … 240.
        trigger: "software": an exposure begins when `grab` asks; "line": when an edge comes;
            "free": as the camera likes.
        trigger_line: IO0 … IO3.
        trigger_edge: Of that line.
        strobe_line: IO0 … IO3 is active while the sensor is exposed, where the pin is an output; None:
            strobes stay as they are.
        strobe_active: Its level then.
        registers: Command registers, by offset such as "0x11F8", that are written and read back before
            all else: for what has no option here, such as the direction of a pin.
        buffers: Frames in the library's ring. The kernel allows 16 MB for all USB cameras together.
        readout_min_s: The least time from an exposure's end until its frame is here.
        readout_max_s: The greatest; None: a frame period without a trigger by software, where the
            sending of the trigger bounds the exposure's begin already.
        late_s: A frame that is not here a frame period and so much after the camera was seen to be
            ready again does not come any more. Until then no other trigger is sent: the late frame
            would be taken for its.
    """

    guid: Annotated[str, Field(pattern=r"^(0[xX])?[0-9a-fA-F]{1,16}$")] | None = None
    mode: Annotated[str, Field(pattern=r"^(\d+x\d+_mono(8|16)|format7_[0-7])$")] = "1280x960_mono8"
    coding: Literal["raw8", "raw16", "mono8", "mono16"] = "raw8"
    region_px: tuple[Pixels, Pixels, Pixels, Pixels] | None = None
    bits: Literal[10, 12, 14, 16] = 16
    bayer: Pattern | None = None
    exposure_us: Positive | None = None
    shutter_raw: Raw | None = None
    shutter_step_us: Positive | None = None
    shutter_offset_us: Number = 0.0
    gain_db: Number | None = None
    gain_raw: Raw | None = None
    gain_step_db: Positive | None = None
    gain_offset_db: Number = 0.0
    brightness_raw: Raw | None = None
    frame_rate_hz: Positive = 15.0
    trigger: Literal["software", "line", "free"] = "software"
    trigger_line: Line = 0
    trigger_edge: Literal["rising", "falling"] = "rising"
    strobe_line: Line | None = None
    strobe_active: Literal["high", "low"] = "high"
    registers: dict[str, Annotated[int, Field(ge=0, le=0xFFFFFFFF)]] = Field(default_factory=dict)
    buffers: Annotated[int, Field(ge=2, le=32)] = 4
    readout_min_s: Annotated[Number, Field(ge=0)] = 0.0
    readout_max_s: Positive | None = None
    late_s: Positive = 0.5

    @field_validator("registers")
    @classmethod
    def _offsets(cls, registers: dict[str, int]) -> dict[str, int]:
        for offset in registers:
            try:
                allowed = 0 <= int(offset, 0) <= 0xFFFC and int(offset, 0) % 4 == 0
            except ValueError:
                allowed = False
            if not allowed:
                raise ValueError(f"offset {offset!r}, allowed is 0x0000 to 0xFFFC, a multiple of 4")
        return registers

    @model_validator(mode="after")
    def _fit(self) -> Self:
        for one, other in (("exposure_us", "shutter_raw"), ("gain_db", "gain_raw")):
            if (getattr(self, one) is None) == (getattr(self, other) is None):
                raise ValueError(f"one of {one} and {other} is needed")
        if self.format7 is None and self.region_px is not None:
            raise ValueError(f"region_px: mode {self.mode} has none, allowed in format7_0 … format7_7")
        if self.format7 is None and self.frame_rate_hz not in FRAME_RATES:
            rates = ", ".join(f"{rate:g}" for rate in FRAME_RATES)
            raise ValueError(f"frame_rate_hz {self.frame_rate_hz:g} in mode {self.mode}, allowed: {rates}")
        if self.region_px is not None and (any(n % 2 for n in self.region_px) or 0 in self.region_px[2:]):
            raise ValueError(f"region_px {list(self.region_px)}, allowed are even numbers and a size above 0")
        if self.readout_max_s is not None and self.readout_max_s < self.readout_min_s:
            raise ValueError(f"readout_max_s {self.readout_max_s:g} is below readout_min_s")
        return self

    @property
    def format7(self) -> int | None:
        """The number of the Format_7 mode, or None in a fixed format."""
        return int(self.mode[-1]) if self.mode.startswith("format7_") else None
