"""An open Aravis camera: how it is found, set up and started, and how it is let go."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

from drivers.aravis.control import ControlThread
from drivers.aravis.features import Settings
from drivers.aravis.library import Camera, GenicamError, Library, Stream
from drivers.aravis.lines import set_trigger
from drivers.aravis.options import AravisOptions
from drivers.aravis.settings import Setup, set_exposure, set_up
from drivers.aravis.timing import Arrivals, Exposures, FrameCount
from drivers.errors import DeviceNotFoundError
from drivers.interfaces import Clock

_BUFFERS = 4


@dataclass(slots=True)
class Session:
    """An open camera, streaming."""

    camera: Camera
    stream: Stream
    setup: Setup
    exposures: Exposures
    arrivals: Arrivals
    count: FrameCount
    facts: dict[str, str]
    trigger: str  # what begins an exposure, as `AravisOptions.trigger`
    fresh: bool = True  # no frame has come since the acquisition was started
    unanswered: bool = False  # a trigger was sent and its frame not seen
    frames: int = 0
    incomplete: int = 0


def connect(name: str, options: AravisOptions, clock: Clock, control: ControlThread) -> Session:
    """Opens a camera, sets it up and starts it; to be called in its control thread.

    Whatever becomes of it, `control` releases the camera when it ends.

    Raises:
        ConfigurationError, DeviceNotFoundError, DeviceFaultError, DriverUnavailableError: As
            `drivers.colour_aravis.AravisCamera.open`.
        GenicamError: If the camera stops answering meanwhile.
    """
    library = Library(name)
    where = options.address or _found(name, options.serial, library)
    try:
        camera = library.open(where)
    except GenicamError as error:
        raise DeviceNotFoundError(name, f"no camera answers at {where}: {error}") from error
    control.look_after(None, partial(_release, camera, None))
    if not camera.is_controlled:
        raise DeviceNotFoundError(name, "another application controls it (or did, until a few seconds ago)")
    camera.on_loss(partial(control.mark_lost, "it no longer heeds this application"))
    facts = _facts(camera, library.version, options.address)
    if options.serial is not None and facts.get("serial") != options.serial:
        raise DeviceNotFoundError(
            name,
            f"the camera at {options.address} has serial number {facts.get('serial')}, not {options.serial}",
        )
    with suppress(GenicamError):  # of an application that ended without it
        camera.execute("AcquisitionStop")
    if options.packet_bytes is not None:
        camera.set_packet_bytes(options.packet_bytes)
    setup = set_up(camera, options, name)
    stream = camera.stream(_BUFFERS)
    control.look_after(None, partial(_release, camera, stream))
    camera.execute("AcquisitionStart")
    width, height = setup.size
    facts |= {"format": f"{setup.format.name}, {width} × {height}"}
    exposures = Exposures(
        name, setup.exposure_s, options.stamp_at == "exposure_end", options.trigger_latency_s
    )
    session = Session(
        camera, stream, setup, exposures, Arrivals(clock.now_ns), FrameCount(), facts, setup.trigger
    )
    control.look_after(partial(_look, session), partial(_release, camera, stream))
    return session


def restart(session: Session) -> None:
    """Stops and starts the camera, so that no exposure of before is under way or on its way.

    Raises:
        GenicamError: If it does not answer.
    """
    session.camera.execute("AcquisitionStop")
    session.stream.drop_all()
    session.camera.execute("AcquisitionStart")
    session.count.restart()
    session.fresh, session.unanswered = True, False


def change_trigger(session: Session, name: str, trigger: str) -> None:
    """Has exposures begun by something else from now on.

    Raises:
        ConfigurationError, DeviceFaultError, GenicamError: As `aravis_settings.set_up`.
    """
    if trigger != session.trigger:
        session.camera.execute("AcquisitionStop")
        session.trigger = trigger
        set_trigger(Settings(session.camera, name), trigger)
        restart(session)


def exposure_range_us(session: Session) -> tuple[float, float]:
    """Returns the shortest and the longest exposure time.

    Raises:
        GenicamError: If it does not answer.
    """
    return session.camera.bounds(session.setup.exposure_feature)


def change_exposure(session: Session, name: str, exposure_us: float) -> None:
    """Has all exposures last so long from now on; the camera stands still for it.

    While it runs, an exposure with the old time may be under way or have its time set already.

    Raises:
        ConfigurationError, DeviceFaultError, GenicamError: As `aravis_settings.set_up`. The camera is
            left standing where it does not take the time.
    """
    setup, settings = session.setup, Settings(session.camera, name)
    settings.within("exposure_us", setup.exposure_feature, exposure_us)  # before it is stopped for nothing
    session.camera.execute("AcquisitionStop")
    session.camera.write(setup.exposure_feature, exposure_us)  # also a value that is close to the last
    took_us = set_exposure(settings, setup.exposure_feature, exposure_us)
    session.setup = replace(setup, exposure_value=took_us)
    session.exposures.last(session.setup.exposure_s)
    restart(session)


def _found(name: str, wanted: str | None, library: Library) -> str:
    """Searches for the camera, and returns its id."""
    found = library.search()
    fitting = [one for one in found if wanted is None or one.serial == wanted]
    if len(fitting) == 1:
        return fitting[0].id
    listed = ", ".join(f"{one.model} {one.serial} at {one.address}" for one in found) or "no camera"
    if not fitting:
        what = "no camera answers" if wanted is None else f"no camera with serial number {wanted} answers"
        raise DeviceNotFoundError(
            name,
            f"{what} (found: {listed}); is it powered and in this network, or, on USB, does a udev rule "
            "give access to it?",
        )
    raise DeviceNotFoundError(
        name, f"more than one camera answers: {listed}; say which by its serial number or address"
    )


def _facts(camera: Camera, version: str, address: str | None) -> dict[str, str]:
    """What the camera says about itself."""
    features = {
        "vendor": "DeviceVendorName",
        "model": "DeviceModelName",
        "serial": "DeviceSerialNumber",
        "firmware": "DeviceFirmwareVersion",
        "version": "DeviceVersion",
    }
    told = {key: str(camera.read(feature)) for key, feature in features.items() if camera.has(feature)}
    facts = {
        "library": version,
        "model": f"{told.get('vendor', '')} {told.get('model', '')}".strip(),
        "serial": told.get("serial", ""),
        "firmware": told.get("firmware") or told.get("version", ""),
        "address": f"{camera.transport} {address or ''}".strip(),
    }
    return {key: value for key, value in facts.items() if value}


def _look(session: Session) -> str:
    """Asks the camera for its exposure time; a camera that was reset has another."""
    feature, wanted = session.setup.exposure_feature, session.setup.exposure_value
    got = session.camera.read(feature)
    return "" if got == wanted else f"it was reset: {feature} reads {got}, was set to {wanted}"


def _release(camera: Camera, stream: Stream | None, answers: bool) -> None:
    """Stops a camera that still answers, and lets go of it."""
    if answers:
        with suppress(GenicamError):
            camera.execute("AcquisitionStop")
    if stream is not None:
        stream.close()
    camera.close()
