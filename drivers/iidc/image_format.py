"""Sets the format of an IIDC camera's images, and finds out how the colours lie in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.bayer import PATTERNS, Pattern, demosaic
from drivers.iidc.dc1394 import Camera, Dc1394Error
from drivers.iidc.dc1394_types import (
    COLOUR_FILTERS,
    FRAME_RATES,
    FUNCTION_NOT_SUPPORTED,
    USE_MAX_AVAILABLE,
    Coding,
    ColourCodings,
    FrameRates,
    VideoMode,
    VideoModes,
)
from drivers.iidc.options import IidcOptions, SetupError
from surfclass.errors import InputError

POINT_GREY = 0x00B09D  # its OUI, the vendor id of its cameras

# Command registers of IIDC 1.31, and two that only Point Grey's cameras have.
V_FORMAT_INQ = 0x100
BAYER_TILE_MAPPING = 0x1040  # four letters, such as "RGGB"
BAYER_MONO_CTRL = 0x1050  # whether the fixed mono formats carry raw Bayer or luminance


@dataclass(frozen=True, slots=True)
class Format:
    """What an image's bytes are.

    Attributes:
        width: Pixels.
        height: Pixels.
        bits: Of a value: 8, or the low bits of big-endian 16.
        pattern: Colours of pixels (0, 0), (0, 1), (1, 0), (1, 1).
        name: For people.
    """

    width: int
    height: int
    bits: int
    pattern: Pattern
    name: str

    @property
    def size_bytes(self) -> int:
        """Of an image."""
        return self.width * self.height * (1 if self.bits == 8 else 2)

    def decoded(self, image: bytes) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Returns the (h, w, 3) image that these bytes are.

        Raises:
            InputError: If there are too few or too many, or values fill other bits than they should.
        """
        if len(image) != self.size_bytes:
            raise InputError(f"an image of {len(image)} bytes came, {self.size_bytes} are in {self.name}")
        raw: NDArray[np.uint8] | NDArray[np.uint16] = np.frombuffer(image, np.uint8)
        if self.bits > 8:
            raw = raw.view(">u2").astype(np.uint16)
        try:
            return demosaic(raw.reshape(self.height, self.width), self.pattern, self.bits)
        except InputError as error:
            raise InputError(f"{error}; see the option bits") from error


def set_format(camera: Camera, options: IidcOptions) -> Format:
    """Sets mode, region and frame rate of a camera that does not transmit.

    Raises:
        SetupError: If the camera has no such format, or does not keep it.
        Dc1394Error: If it does not answer.
    """
    number = options.format7
    if number is not None:
        mode = VideoMode[f"FORMAT7_{number}"]
    else:
        size, coding = options.mode.upper().split("_")
        named = f"{coding}_{size}"
        if named not in VideoMode.__members__:
            fixed = ", ".join(_option(known) for known in VideoMode if not _is_format7(known))
            raise SetupError(f"mode {options.mode}: IIDC has no such format, but {fixed}")
        mode = VideoMode[named]
    has = camera.listed("video_get_supported_modes", into=VideoModes())
    if mode not in has:
        usable = ", ".join(_option(known) for known in VideoMode if known in has)
        raise SetupError(f"mode {options.mode}: the camera does not have it, but {usable or 'no raw one'}")
    camera.call("video_set_mode", mode)
    if (kept := camera.number("video_get_mode")) != mode:
        raise SetupError(f"mode {options.mode}: the camera kept mode {kept} of libdc1394")
    if number is None:
        return _set_fixed(camera, options, mode)
    return _set_format7(camera, options, mode)


def optional_register(camera: Camera, offset: int) -> int:
    """Returns a command register, or 0 where the camera answers but has no such register.

    Raises:
        Dc1394Error: If the camera does not answer.
    """
    try:
        return camera.read(offset)
    except Dc1394Error:
        camera.read(V_FORMAT_INQ)  # every camera has this one
        return 0


def _set_fixed(camera: Camera, options: IidcOptions, mode: VideoMode) -> Format:
    code = FRAME_RATES[options.frame_rate_hz]
    has = camera.listed("video_get_supported_framerates", mode, into=FrameRates())
    if code not in has:
        rates = ", ".join(f"{rate:g}" for rate, known in FRAME_RATES.items() if known in has)
        wanted = f"frame_rate_hz {options.frame_rate_hz:g} in mode {options.mode}"
        raise SetupError(f"{wanted}: the camera has {rates or 'none'}")
    camera.call("video_set_framerate", code)
    if camera.number("video_get_framerate") != code:
        raise SetupError(f"frame_rate_hz {options.frame_rate_hz:g}: the camera did not keep it")
    if camera.vendor_id == POINT_GREY and optional_register(camera, BAYER_MONO_CTRL) >> 31:
        camera.write(BAYER_MONO_CTRL, 0x80000001)
        if not camera.read(BAYER_MONO_CTRL) & 1:
            raise SetupError(f"mode {options.mode}: the camera would not put raw Bayer into it")
    elif options.bayer is None:
        raise SetupError(
            f"mode {options.mode}: the camera does not tell whether it puts raw Bayer into it; "
            "say so by the option bayer, or use a format7 mode with coding raw8"
        )
    coding, size = mode.name.split("_")
    width, height = (int(side) for side in size.split("X"))
    bits = 8 if coding == "MONO8" else options.bits
    pattern = _pattern(camera, options, None)
    return Format(width, height, bits, pattern, f"{size.lower()} {coding}, {bits} bits of raw {pattern}")


def _set_format7(camera: Camera, options: IidcOptions, mode: VideoMode) -> Format:
    coding = Coding[options.coding.upper()]
    has = camera.listed("format7_get_color_codings", mode, into=ColourCodings())
    if coding not in has:
        usable = ", ".join(known.name.lower() for known in Coding if known in has)
        raise SetupError(
            f"coding {options.coding} in {options.mode}: the camera has {usable or 'no raw one'}"
        )
    sensor = camera.pair("format7_get_max_image_size", mode)
    steps = camera.pair("format7_get_unit_position", mode) + camera.pair("format7_get_unit_size", mode)
    region = options.region_px or (0, 0, *sensor)
    if any(n % step for n, step in zip(region, steps, strict=True) if step) or not all(
        0 <= start <= start + length <= side
        for start, length, side in zip(region[:2], region[2:], sensor, strict=True)
    ):
        raise SetupError(
            f"region_px {list(region)} in {options.mode}: the camera has {sensor[0]} × {sensor[1]} pixels, "
            f"in steps of {list(steps)}"
        )
    camera.call("format7_set_roi", mode, coding, USE_MAX_AVAILABLE, *region)
    bits = 16 if options.coding.endswith("16") else 8
    packet = _packet_bytes(camera, mode, region[2] * region[3] * bits // 8)
    camera.call("format7_set_roi", mode, coding, packet, *region)
    kept = camera.region(mode)
    if kept != (coding, packet, *region):
        raise SetupError(f"region_px {list(region)} in packets of {packet} bytes: the camera kept {kept}")
    pattern = _pattern(camera, options, mode)
    bits = 8 if bits == 8 else options.bits
    name = (
        f"{options.mode} {options.coding}, {region[2]} × {region[3]} at ({region[0]}, {region[1]}), "
        f"{bits} bits of raw {pattern}"
    )
    return Format(region[2], region[3], bits, pattern, name)


def _packet_bytes(camera: Camera, mode: VideoMode, image_bytes: int) -> int:
    """The largest packet of which whole ones make an image: no padding, which cameras treat differently."""
    unit, most = camera.pair("format7_get_packet_parameters", mode)
    if not 0 < unit <= most:
        raise SetupError(f"the camera's packet sizes are of {unit} to {most} bytes, which makes no sense")
    for packet in range(most - most % unit, 0, -unit):
        if image_bytes % packet == 0:
            return packet
    return most - most % unit


def _pattern(camera: Camera, options: IidcOptions, format7: VideoMode | None) -> Pattern:
    """How the colours lie: as the operator says, as Point Grey's register does, or as Format_7's."""
    if options.bayer is not None:
        return options.bayer
    told = ""
    if camera.vendor_id == POINT_GREY:
        tile = optional_register(camera, BAYER_TILE_MAPPING).to_bytes(4, "big")
        told = tile.decode("ascii", "replace").strip("\0")
        if told == "YYYY":
            raise SetupError("it is a monochrome camera; this needs a colour one")
    if not told and format7 is not None:
        try:
            told = COLOUR_FILTERS.get(camera.number("format7_get_color_filter", format7), "")
        except Dc1394Error as error:
            if error.code != FUNCTION_NOT_SUPPORTED:  # before IIDC 1.31 there was no such register
                raise
    if told not in PATTERNS:
        raise SetupError(
            f"the camera tells {told!r} of its Bayer pattern; set bayer to one of {', '.join(PATTERNS)}"
        )
    return told


def _is_format7(mode: VideoMode) -> bool:
    return mode.name.startswith("FORMAT7")


def _option(mode: VideoMode) -> str:
    """What the option `mode` calls it."""
    name = mode.name.lower()
    return name if _is_format7(mode) else "_".join(reversed(name.split("_")))
