"""How a GenICam camera is set up for measuring: everything automatic off, and every setting read back."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.aravis import formats as aravis_formats
from drivers.aravis.features import Settings
from drivers.aravis.formats import Format
from drivers.aravis.library import Camera, Value
from drivers.aravis.lines import set_strobe, set_trigger
from drivers.aravis.options import AravisOptions
from surfclass.errors import ConfigurationError

# What changes the image by itself, bends its light, or moves its pixels; those that a camera has are
# brought to this value. The names are SFNC's, and FLIR's and Basler's where they have others.
_OFF: tuple[tuple[str, Value], ...] = (
    *(("ExposureMode", "Timed"), ("ExposureAuto", "Off"), ("GainAuto", "Off"), ("BalanceWhiteAuto", "Off")),
    *(("BlackLevelAuto", "Off"), ("GammaEnable", False), ("GammaEnabled", False)),
    *(("SharpnessAuto", "Off"), ("SharpnessEnable", False), ("SharpnessEnabled", False)),
    *(("SharpeningAuto", False), ("SharpeningEnable", False), ("SaturationAuto", "Off")),
    *(("SaturationEnable", False), ("SaturationEnabled", False), ("HueAuto", "Off"), ("HueEnable", False)),
    *(("HueEnabled", False), ("ColorTransformationEnable", False), ("RgbTransformEnable", False)),
    *(
        ("LUTEnable", False),
        ("pgrExposureCompensationAuto", "Off"),
        ("AutoExposureEVCompensationAuto", "Off"),
    ),
    *(("TestPattern", "Off"), ("TestImageSelector", "Off"), ("ReverseX", False), ("ReverseY", False)),
    *(("BinningHorizontal", 1), ("BinningVertical", 1)),
    *(("DecimationHorizontal", 1), ("DecimationVertical", 1)),
)
_EXPOSURES = ("ExposureTime", "ExposureTimeAbs")
_RATES = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_RATE_SWITCHES = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")

# A camera takes the nearest value that it can make: a row's time of exposure, a step of gain.
_EXPOSURE_TOLERANCE = (0.02, 20.0)  # relative, µs
_GAIN_TOLERANCE_DB = 0.25
_RATIO_TOLERANCE = 0.02


@dataclass(frozen=True, slots=True)
class Setup:
    """How the camera is set up, as read back.

    Attributes:
        format: Of the pixels.
        size: Width and height.
        exposure_feature: Where the exposure time was read, and its `exposure_value` there, µs.
        gain_db: None where the camera does not tell it in dB.
        facts: The settings in words, but for trigger and exposure.
        trigger: What begins an exposure now: the camera's software trigger wherever it has one.
    """

    format: Format
    size: tuple[int, int]
    exposure_feature: str
    exposure_value: float
    gain_db: float | None
    facts: str
    trigger: str

    @property
    def exposure_s(self) -> float:
        """Exposure time."""
        return self.exposure_value / 1e6


def set_up(camera: Camera, options: AravisOptions, device: str) -> Setup:
    """Sets up a camera that is not streaming, and returns what came of it.

    Raises:
        ConfigurationError: If the camera cannot do what the options ask for; says what it can.
        DeviceFaultError: If a feature does not take its value; names it, the value and what it reads.
        GenicamError: If it does not answer.
    """
    settings = Settings(camera, device)
    has = camera.has
    if has("AcquisitionMode"):
        settings.make("AcquisitionMode", "Continuous")
    if has("TriggerMode"):
        camera.write("TriggerMode", "Off")  # some cameras lock what follows while it is on
    pixel_format = _choose_format(settings, options.pixel_format)
    for feature, off in _OFF:
        if has(feature):
            settings.make(feature, _off(camera.kind(feature), off))
    if has("Gamma") and not (has("GammaEnable") or has("GammaEnabled")):
        settings.make("Gamma", 1.0, 0.01)
    size = _set_region(settings, options.region, pixel_format)
    facts = [_set_rate(settings, options.rate_hz if options.trigger == "free" else None)]
    exposure_feature = settings.need("exposure_us", *_EXPOSURES)
    exposure_us = set_exposure(settings, exposure_feature, options.exposure_us)
    gain_db = _set_gain(settings, options.gain_db)
    facts += [_set_white_balance(settings, options), _black_level(camera)]
    facts += [set_strobe(settings, line, options) for line in options.strobe_lines]
    first = options.trigger
    if camera.has("TriggerSource") and "Software" in camera.choices("TriggerSource"):
        first = "software"
    set_trigger(settings, first)
    settings.look_again()
    gain = "gain in the camera's own steps" if gain_db is None else f"gain {gain_db:.2f} dB"
    described = "; ".join(fact for fact in [gain, *facts] if fact)
    return Setup(pixel_format, size, exposure_feature, exposure_us, gain_db, described, first)


def set_exposure(settings: Settings, feature: str, exposure_us: float) -> float:
    """Sets the exposure time and returns what the camera made of it, µs.

    Raises:
        ConfigurationError, DeviceFaultError, GenicamError: As `set_up`.
    """
    settings.within("exposure_us", feature, exposure_us)
    relative, absolute = _EXPOSURE_TOLERANCE
    return float(settings.make(feature, exposure_us, max(relative * exposure_us, absolute)))


def _choose_format(settings: Settings, name: str | None) -> Format:
    has = settings.camera.choices("PixelFormat")
    if name is None:
        chosen = aravis_formats.best(has)
        if chosen is None:
            raise ConfigurationError(
                f"{settings.device}: this camera has no colour format that is read here, but "
                f"{', '.join(has) or 'none'}"
            )
    else:
        settings.choice("pixel_format", "PixelFormat", name)
        chosen = aravis_formats.parse(name)
        if chosen is None:
            usable = [one for one in has if aravis_formats.parse(one) is not None]
            raise ConfigurationError(
                f"{settings.device}: pixel_format {name!r} is no colour format that is read here; "
                f"of this camera's these are: {', '.join(usable) or 'none'}"
            )
    settings.make("PixelFormat", chosen.name)
    return chosen


def _set_region(
    settings: Settings, region: tuple[int, int, int, int] | None, pixel_format: Format
) -> tuple[int, int]:
    camera = settings.camera
    offsets = [feature for feature in ("OffsetX", "OffsetY") if camera.has(feature)]
    for feature in offsets:
        camera.write(feature, 0)  # so that width and height have their whole range
    whole = [int(camera.bounds(feature)[1]) for feature in ("Width", "Height")]
    x, y, width, height = (0, 0, *whole) if region is None else region
    if x + width > whole[0] or y + height > whole[1]:
        raise ConfigurationError(
            f"{settings.device}: region {x}, {y}, {width}, {height} leaves the {whole[0]} × {whole[1]} "
            "pixels of this camera"
        )
    wanted = {"Width": width, "Height": height, "OffsetX": x, "OffsetY": y}
    for feature, value in wanted.items():
        if feature in offsets or feature in ("Width", "Height"):
            settings.within(f"region: {feature}", feature, value)
            step = camera.step(feature)
            if value % step:
                raise ConfigurationError(
                    f"{settings.device}: region: {feature} {value}, this camera takes multiples of {step}"
                )
            if feature in offsets and pixel_format.pattern is not None and value % 2:
                raise ConfigurationError(
                    f"{settings.device}: region: {feature} {value}, must be even, or the Bayer pattern shifts"
                )
            settings.make(feature, value)
        elif value:
            raise ConfigurationError(f"{settings.device}: region: this camera has no {feature}")
    try:
        pixel_format.frame_bytes(width, height)
    except ValueError as error:
        raise ConfigurationError(f"{settings.device}: region: {error}") from None
    return width, height


def _set_rate(settings: Settings, rate_hz: float | None) -> str:
    switch = next((feature for feature in _RATE_SWITCHES if settings.camera.has(feature)), None)
    if switch is not None:
        settings.make(switch, rate_hz is not None)  # left on, it would limit the exposure time
    if rate_hz is None:
        return ""
    feature = settings.need("rate_hz", *_RATES)
    settings.within("rate_hz", feature, rate_hz)
    return f"{float(settings.make(feature, rate_hz, 0.02 * rate_hz)):.2f} Hz"


def _set_gain(settings: Settings, gain_db: float) -> float | None:
    camera = settings.camera
    if camera.has("Gain") and camera.kind("Gain") == "float":
        settings.within("gain_db", "Gain", gain_db)
        return float(settings.make("Gain", gain_db, _GAIN_TOLERANCE_DB))
    if gain_db:
        raise ConfigurationError(
            f"{settings.device}: gain_db {gain_db:g}: this camera does not know its gain in dB; allowed is 0"
        )
    if camera.has("GainRaw"):
        settings.make("GainRaw", int(camera.bounds("GainRaw")[0]))
    return None


def _set_white_balance(settings: Settings, options: AravisOptions) -> str:
    camera = settings.camera
    selector = "BalanceRatioSelector"
    feature = next((name for name in ("BalanceRatio", "BalanceRatioAbs") if camera.has(name)), None)
    wanted = {"Red": options.balance_red, "Green": 1.0, "Blue": options.balance_blue}
    if feature is None or not camera.has(selector):
        if set(wanted.values()) != {1.0}:
            raise ConfigurationError(f"{settings.device}: balance: this camera's white balance is fixed")
        return ""
    told = []
    for colour, ratio in wanted.items():
        if colour in camera.choices(selector):
            camera.write(selector, colour)
            settings.within(f"balance of {colour}", feature, ratio)
            got = float(settings.make(feature, ratio, _RATIO_TOLERANCE * ratio, f"{colour}: "))
            told.append(f"{colour.lower()} {got:.3f}")
    return f"white balance {', '.join(told)}" if told else ""


def _black_level(camera: Camera) -> str:
    feature = next((name for name in ("BlackLevel", "BlackLevelRaw") if camera.has(name)), None)
    return "" if feature is None else f"black level {camera.read(feature)}"


def _off(kind: str | None, off: Value) -> Value:
    """Some makers have a switch where others have a choice."""
    if kind == "boolean":
        return False
    return "Off" if kind == "text" and not isinstance(off, str) else off
