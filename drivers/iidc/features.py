"""Sets shutter, gain and trigger of an IIDC camera, and everything automatic off; reads all of it back."""

from __future__ import annotations

from ctypes import byref, c_uint32
from dataclasses import dataclass, replace

from drivers.iidc.dc1394 import Camera
from drivers.iidc.dc1394_types import (
    MANUAL,
    TRIGGER_ACTIVE_HIGH,
    TRIGGER_ACTIVE_LOW,
    TRIGGER_MODE_0,
    TRIGGER_SOURCE_0,
    TRIGGER_SOURCE_SOFTWARE,
    Feature,
    FeatureInfo,
)
from drivers.iidc.options import IidcOptions, SetupError

# What works on the picture by itself: off, where it can be switched off.
_OFF = (
    Feature.EXPOSURE,  # "auto exposure": the brightness that automatic shutter and gain aim at
    Feature.SHARPNESS,
    Feature.WHITE_BALANCE,
    Feature.HUE,
    Feature.SATURATION,
    Feature.GAMMA,
    Feature.WHITE_SHADING,
    Feature.TRIGGER_DELAY,
)
_ON = (Feature.SHUTTER, Feature.GAIN, Feature.BRIGHTNESS, Feature.FRAME_RATE)
_MANUAL = (*_ON, *_OFF, Feature.IRIS, Feature.FOCUS, Feature.ZOOM)

_TRIGGER_MODE = 0x830
_SOFTWARE_SOURCE = 7  # in the register
_STROBE_INQ, _STROBE_CNT = 0x100, 0x200  # of line 0 in the strobe registers; 4 bytes a line
_ON_BIT, _HIGH_BIT, _STROBE_VALUE = 0x02000000, 0x01000000, 0x03FFFFFF
_TOLERANCE = 0.05  # of what was asked: shutters and gains have steps


@dataclass(frozen=True, slots=True)
class Exposure:
    """What the camera says that it does.

    Attributes:
        exposure_s: By its absolute shutter, or by the register and the options.
        gain_db: The same; None where neither tells.
        period_s: From one frame to the next; None where it is not known.
        shutter: The shutter for people.
        rest: All else for people.
    """

    exposure_s: float
    gain_db: float | None
    period_s: float | None
    shutter: str
    rest: str

    def __str__(self) -> str:
        return f"{self.shutter}, {self.rest}"


def set_exposure(camera: Camera, options: IidcOptions) -> Exposure:
    """Turns all automatic functions off, and sets frame rate, shutter, gain and black level.

    Raises:
        SetupError: If a value is outside what the camera can, or it does not keep one.
        Dc1394Error: If it does not answer.
    """
    infos = {feature: info for feature in _MANUAL if (info := _manual(camera, feature)) is not None}
    period_s = _set_frame_rate(camera, infos.get(Feature.FRAME_RATE), options)
    wanted_s = None if options.exposure_us is None else options.exposure_us / 1e6
    exposure_s, shutter = _set_shutter(
        camera, infos.get(Feature.SHUTTER), options, wanted_s, options.shutter_raw
    )
    gain_db, gain = _set_value(
        camera,
        infos.get(Feature.GAIN),
        _Wanted("gain_db", options.gain_db, "gain_raw", options.gain_raw, 1.0, 0.25),
        _Steps("gain_step_db", options.gain_step_db, options.gain_offset_db),
    )
    if options.brightness_raw is not None:
        _set_raw(camera, infos.get(Feature.BRIGHTNESS), "brightness_raw", options.brightness_raw)
    parts = [
        "gain " + (f"{gain_db:.2f} dB ({gain})" if gain_db is not None else gain),
        *([f"{1 / period_s:.3g} Hz"] if period_s is not None else []),
        *(
            f"{_name(feature)} {'cannot be switched off' if info.is_on else 'off'}"
            for feature, info in infos.items()
            if feature in _OFF
        ),
    ]
    return Exposure(exposure_s, gain_db, period_s, shutter, ", ".join(parts))


def exposure_range_s(camera: Camera, options: IidcOptions, now: Exposure) -> tuple[float, float]:
    """Returns the shortest and the longest exposure; both that of now where it cannot be changed.

    Raises:
        Dc1394Error: If it does not answer.
    """
    info = camera.feature(Feature.SHUTTER)
    if info.absolute_capable:
        return float(info.abs_min), float(info.abs_max)
    if options.shutter_step_us is None:
        return now.exposure_s, now.exposure_s
    step_us, offset_us = options.shutter_step_us, options.shutter_offset_us
    shortest_us, longest_us = (raw * step_us + offset_us for raw in (info.min, info.max))
    return max(shortest_us, step_us) / 1e6, longest_us / 1e6


def change_exposure(camera: Camera, options: IidcOptions, now: Exposure, exposure_s: float) -> Exposure:
    """Sets the shutter alone, and returns what the camera does then.

    Raises:
        SetupError: If the camera does not keep it.
        Dc1394Error: If it does not answer.
    """
    info = camera.feature(Feature.SHUTTER)
    took_s, shutter = _set_shutter(camera, info, options, exposure_s, None)
    return replace(now, exposure_s=took_s, shutter=shutter)


def _set_shutter(
    camera: Camera, info: FeatureInfo | None, options: IidcOptions, exposure_s: float | None, raw: int | None
) -> tuple[float, str]:
    """Sets the exposure time or the register; returns the time, and the shutter for people."""
    step_s = None if options.shutter_step_us is None else options.shutter_step_us / 1e6
    took_s, register = _set_value(
        camera,
        info,
        _Wanted("exposure_us", exposure_s, "shutter_raw", raw, 1e6, 50e-6),
        _Steps("shutter_step_us", step_s, options.shutter_offset_us / 1e6),
    )
    if took_s is None:
        raise SetupError("the camera has no absolute shutter; give shutter_step_us from its manual")
    if took_s <= 0:
        raise SetupError(f"exposure {took_s} s by {register} and shutter_step_us, allowed is above 0")
    return took_s, f"shutter {took_s * 1e3:.3f} ms ({register})"


def set_trigger(camera: Camera, options: IidcOptions) -> None:
    """Sets what starts an exposure.

    Raises:
        SetupError: If the camera has no such trigger, or does not keep it.
        Dc1394Error: If it does not answer.
    """
    info = camera.feature(Feature.TRIGGER)
    if options.trigger == "free":
        if info.available:
            camera.call("external_trigger_set_power", 0)
            if camera.read(_TRIGGER_MODE) & _ON_BIT:
                raise SetupError("trigger free: the camera's trigger stays on")
        return
    software = options.trigger == "software"
    source = TRIGGER_SOURCE_SOFTWARE if software else TRIGGER_SOURCE_0 + options.trigger_line
    what = "trigger software" if software else f"trigger line, trigger_line {options.trigger_line}"
    has = list(info.trigger_sources.sources[: info.trigger_sources.num]) if info.available else []
    if source not in has:
        lines = ", ".join(str(n - TRIGGER_SOURCE_0) for n in has if n != TRIGGER_SOURCE_SOFTWARE)
        also = " and software" if TRIGGER_SOURCE_SOFTWARE in has else ""
        raise SetupError(f"{what}: the camera has {f'the lines {lines}' if lines else 'no lines'}{also}")
    high = options.trigger_edge == "rising"
    camera.call("external_trigger_set_mode", TRIGGER_MODE_0)
    camera.call("external_trigger_set_source", source)
    if not software and info.polarity_capable:
        camera.call("external_trigger_set_polarity", TRIGGER_ACTIVE_HIGH if high else TRIGGER_ACTIVE_LOW)
    camera.call("external_trigger_set_power", 1)
    kept = camera.read(_TRIGGER_MODE)
    on, mode, number = kept & _ON_BIT, kept >> 16 & 0xF, kept >> 21 & 0x7
    if not on or mode != 0 or number != (_SOFTWARE_SOURCE if software else options.trigger_line):
        raise SetupError(f"{what}: the camera kept {kept:#010x} in register {_TRIGGER_MODE:#x}")
    if not software and bool(kept & _HIGH_BIT) != high:
        raise SetupError(f"{what}: the camera's edge is not {options.trigger_edge}")


def set_strobe(camera: Camera, options: IidcOptions) -> None:
    """Has a line be active during exposures, without delay (IIDC 1.31, strobe control registers).

    Raises:
        SetupError: If the camera has no such strobe, or does not keep it.
        Dc1394Error: If it does not answer.
    """
    line = options.strobe_line
    if line is None:
        return
    value = c_uint32()
    if camera.strobe_offset:
        camera.call("get_strobe_register", _STROBE_INQ + 4 * line, byref(value))
    if not value.value >> 31:
        raise SetupError(f"strobe_line {line}: the camera has no strobe on it")
    wanted = _ON_BIT | (_HIGH_BIT if options.strobe_active == "high" else 0)  # delay and duration 0
    camera.call("set_strobe_register", _STROBE_CNT + 4 * line, 0x80000000 | wanted)
    camera.call("get_strobe_register", _STROBE_CNT + 4 * line, byref(value))
    if value.value & _STROBE_VALUE != wanted:
        raise SetupError(f"strobe_line {line}: the camera kept {value.value:#010x}, not {wanted:#010x}")


def set_registers(camera: Camera, options: IidcOptions) -> None:
    """Writes the registers that the operator asks for.

    Raises:
        SetupError: If the camera does not keep one.
        Dc1394Error: If it does not answer.
    """
    for offset, value in options.registers.items():
        camera.write(int(offset, 0), value)
        if (kept := camera.read(int(offset, 0))) != value:
            raise SetupError(f"registers.{offset}: the camera kept {kept:#010x}, not {value:#010x}")


def _manual(camera: Camera, feature: Feature) -> FeatureInfo | None:
    """Takes a feature out of its automatic mode, and switches it on or off; None if there is none."""
    info = camera.feature(feature)
    if not info.available:
        return None
    if MANUAL in info.modes.modes[: info.modes.num]:
        camera.call("feature_set_mode", feature, MANUAL)
    switched = bool(info.on_off_capable) and feature in (*_ON, *_OFF)
    if switched:
        camera.call("feature_set_power", feature, int(feature in _ON))
    info = camera.feature(feature)
    off, automatic = switched and not info.is_on, info.current_mode != MANUAL
    if (automatic and not off) or (switched and off == (feature in _ON)):
        state = "automatic" if automatic and not off else "off" if off else "on"
        raise SetupError(f"{_name(feature)}: it stays {state}, though it was told otherwise")
    return info


def _name(feature: Feature) -> str:
    return feature.name.lower().replace("_", " ")


def _set_frame_rate(camera: Camera, info: FeatureInfo | None, options: IidcOptions) -> float | None:
    """Sets the rate where that is a feature of its own, and returns the period."""
    if info is None or not info.absolute_capable:
        return None if options.format7 is not None else 1 / options.frame_rate_hz
    wanted = _Wanted("frame_rate_hz", options.frame_rate_hz, "", None, 1.0, 0.01)
    return 1 / float(_set_absolute(camera, info, wanted).abs_value)


@dataclass(frozen=True, slots=True)
class _Wanted:
    """A value by either of two options.

    Attributes:
        option: The one in the feature's own unit, s or dB or Hz.
        value: Its value, or None.
        raw_option: The one for the register.
        raw: Its value, or None.
        shown: What the option's unit is smaller by than the feature's.
        slack: How far the camera may be off whatever the value.
    """

    option: str
    value: float | None
    raw_option: str
    raw: int | None
    shown: float
    slack: float


@dataclass(frozen=True, slots=True)
class _Steps:
    """What the manual says of a register: its unit in s or dB, and what 0 is."""

    option: str
    step: float | None
    offset: float


def _set_value(
    camera: Camera, info: FeatureInfo | None, wanted: _Wanted, steps: _Steps
) -> tuple[float | None, str]:
    """Sets shutter or gain by whichever way there is; returns it in s or dB, and the register as text."""
    if info is None:
        raise SetupError(f"{wanted.option}: the camera has no such feature that can be set")
    if wanted.value is not None and info.absolute_capable:
        info = _set_absolute(camera, info, wanted)
    else:
        raw = wanted.raw
        if raw is None:
            if steps.step is None or wanted.value is None:
                raise SetupError(
                    f"{wanted.option}: the camera has no absolute {_name(Feature(info.id))}; "
                    f"give {wanted.raw_option}, or {steps.option} from its manual"
                )
            raw = round((wanted.value - steps.offset) / steps.step)
        if info.absolute_capable:
            camera.call("feature_set_absolute_control", info.id, 0)
        info = _set_raw(camera, info, wanted.raw_option, raw)
    if info.absolute_capable:
        return float(info.abs_value), f"raw {info.value}"
    return None if steps.step is None else info.value * steps.step + steps.offset, f"raw {info.value}"


def _set_absolute(camera: Camera, info: FeatureInfo, wanted: _Wanted) -> FeatureInfo:
    value, shown = wanted.value, wanted.shown
    assert value is not None
    least, most = float(info.abs_min), float(info.abs_max)
    rounding = 1e-6 * max(abs(least), abs(most))  # the register's numbers are of 32 bits
    if not least - rounding <= value <= most + rounding:
        raise SetupError(
            f"{wanted.option} {value * shown:g}, the camera allows {least * shown:g} to {most * shown:g}"
        )
    camera.call("feature_set_absolute_control", info.id, 1)
    camera.call("feature_set_absolute_value", info.id, value)
    info = camera.feature(Feature(info.id))
    kept = float(info.abs_value)
    if not info.abs_control or abs(kept - value) > max(wanted.slack, _TOLERANCE * abs(value)):
        raise SetupError(f"{wanted.option} {value * shown:g}: the camera kept {kept * shown:g}")
    return info


def _set_raw(camera: Camera, info: FeatureInfo | None, option: str, raw: int) -> FeatureInfo:
    if info is None or not info.min <= raw <= info.max:
        allowed = "has no such feature" if info is None else f"allows {info.min} to {info.max}"
        raise SetupError(f"{option} {raw}, the camera {allowed}")
    camera.call("feature_set_value", info.id, raw)
    info = camera.feature(Feature(info.id))
    if info.value != raw:
        raise SetupError(f"{option} {raw}: the camera kept {info.value}")
    return info
