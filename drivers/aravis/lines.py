"""The lines of a GenICam camera: what triggers an exposure, and which pulse an exposure gives."""

from __future__ import annotations

from drivers.aravis.features import Settings
from drivers.aravis.options import AravisOptions
from surfclass.errors import ConfigurationError


def set_strobe(settings: Settings, line: str, options: AravisOptions) -> str:
    """Makes a line give a pulse while a frame is exposed, and returns that in words.

    Raises:
        ConfigurationError, DeviceFaultError, GenicamError: As `aravis_settings.set_up`.
    """
    camera = settings.camera
    settings.need("strobe_lines", "LineSelector")
    settings.choice("strobe_lines", "LineSelector", line)
    camera.write("LineSelector", line)
    under = f"{line}: "
    if camera.has("LineMode"):
        settings.choice(f"strobe_lines: LineMode of {line}", "LineMode", "Output")
        settings.make("LineMode", "Output", under=under)
    settings.need("strobe_lines", "LineSource")
    settings.choice("strobe_source", "LineSource", options.strobe_source)
    settings.make("LineSource", options.strobe_source, under=under)
    if camera.has("LineInverter"):
        settings.make("LineInverter", options.strobe_inverted, under=under)
    elif options.strobe_inverted:
        raise ConfigurationError(f"{settings.device}: strobe_inverted: {line} of this camera cannot be")
    return f"strobe on {line}: {options.strobe_source}{', inverted' if options.strobe_inverted else ''}"


def set_trigger(settings: Settings, trigger: str) -> None:
    """Sets what begins an exposure.

    Raises:
        ConfigurationError, DeviceFaultError, GenicamError: As `aravis_settings.set_up`.
    """
    camera = settings.camera
    if trigger == "free":
        if camera.has("TriggerMode"):
            settings.make("TriggerMode", "Off")
        return
    settings.need("trigger", "TriggerMode")
    source = "Software" if trigger == "software" else trigger
    if camera.has("TriggerSelector"):
        settings.choice("trigger: selector", "TriggerSelector", "FrameStart")
        settings.make("TriggerSelector", "FrameStart")
    settings.need("trigger", "TriggerSource")
    settings.choice("trigger", "TriggerSource", source)
    settings.make("TriggerSource", source)
    if trigger != "software" and camera.has("TriggerActivation"):
        settings.make("TriggerActivation", "RisingEdge")
    settings.make("TriggerMode", "On")
