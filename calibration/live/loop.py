"""The guided capture: takes a view where the arm comes to rest or the person asks, and keeps those of use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from calibration.guide import Guide
from calibration.live.exposures import exposure_series
from calibration.live.ui import Command, Doing, Judged, Situation, Ui, Verdict, thin
from drivers.capture_source import CaptureRequest, LiveSource, RequestTrigger, RestTrigger, Trigger
from drivers.errors import CaptureRejectedError, DeviceTimeoutError
from drivers.interfaces import Clock
from drivers.recordings import RecordingWriter
from drivers.sensor_package import SensorPackage
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture

Stopped = Callable[[], str | None]
Finish = Callable[[Capture], Capture]


class CaptureAbortedError(Exception):
    """The person, or a signal, ended the capture before there was enough."""


@dataclass(frozen=True, slots=True)
class GuidedSettings:
    """How a guided capture goes on.

    Attributes:
        title: What is captured, for the person.
        by_rest: Whether a view is taken wherever the arm comes to rest; else only on request.
        rest_s: So long the arm must have stood.
        moved_rad: A joint must be so far from where the last view was taken.
        idle_s: After so long without a view it ends as if the person had said that it is enough.
        poll_s: How often the person is listened to.
        rejected: As many captures in a row may be rejected by the sensors, for motion say.
        with_dark: Whether views get an unlit frame.
        exposures: How many exposures a guide of role "exposure" gets from one place.
        keep_aborted: Whether an aborted capture leaves a recording of what was accepted.
    """

    title: str = "capture"
    by_rest: bool = True
    rest_s: float = 0.5
    moved_rad: float = 0.01
    idle_s: float = 900.0
    poll_s: float = 0.1
    rejected: int = 25
    with_dark: bool = False
    exposures: int = 8
    keep_aborted: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not isinstance(value, bool) and not 0 < value < np.inf:
                raise ConfigurationError(f"guided capture: {field.name} {value}, allowed is above 0")


def guided(
    package: SensorPackage,
    guide: Guide,
    writer: RecordingWriter,
    settings: GuidedSettings,
    ui: Ui,
    clock: Clock,
    *,
    finish: Finish = lambda capture: capture,
    stopped: Stopped = lambda: None,
) -> int:
    """Captures until the guide has enough, finishes the recording, and returns how many captures it has.

    A view is taken where the arm comes to rest at a new place, or when the person asks for one. Those that
    the guide accepts are written. It also ends when the person says that it is enough, and when nothing was
    accepted or refused for `settings.idle_s`; the last situation then says what is still thin.

    Args:
        package: The open sensors.
        guide: Judges the views; its role decides: "exposure" gets a series of exposures from each place.
        writer: The recording, which this finishes, or deletes where nothing is kept.
        settings: How it goes on.
        ui: Shows and listens.
        clock: The sensors'.
        finish: What an accepted view becomes before it is written, such as a labelled one.
        stopped: Says that a signal came, and which.

    Raises:
        CaptureAbortedError: If the person or a signal ended it; the recording is deleted, unless
            `settings.keep_aborted` says otherwise.
        DriverError: As the devices do; what was accepted before is a finished recording.
        CaptureRejectedError: If too many in a row were rejected; likewise.
        InputError: If nothing was accepted, if views can only be asked for and nobody can, or as the
            exposure series does.
    """
    return guided_all(package, [(guide, finish)], writer, settings, ui, clock, stopped=stopped)


def guided_all(
    package: SensorPackage,
    guides: Sequence[tuple[Guide, Finish]],
    writer: RecordingWriter,
    settings: GuidedSettings,
    ui: Ui,
    clock: Clock,
    *,
    stopped: Stopped = lambda: None,
) -> int:
    """As `guided`, one guide after the other into one recording; between them the target is changed.

    From the second on the person has to ask for the first view: only they know that the target is there.
    """
    written = 0
    try:
        for number, (guide, finish) in enumerate(guides):
            run = _Run(package, guide, writer, settings, ui, clock, finish, stopped, written)
            run.until_enough(waits=number > 0)
            written = run.written
        if not written:
            raise InputError(f"{settings.title}: no view was accepted")
    except BaseException as error:
        aborted = isinstance(error, CaptureAbortedError | KeyboardInterrupt)
        if len(writer) and (settings.keep_aborted or not aborted):
            writer.close()
        else:
            writer.discard()
        raise
    writer.close()
    return written


class _Run:
    """One guide's captures."""

    def __init__(
        self,
        package: SensorPackage,
        guide: Guide,
        writer: RecordingWriter,
        settings: GuidedSettings,
        ui: Ui,
        clock: Clock,
        finish: Finish,
        stopped: Stopped,
        written: int,
    ) -> None:
        self._package, self._guide, self._writer, self._settings = package, guide, writer, settings
        self._ui, self._clock, self._finish, self._stopped = ui, clock, finish, stopped
        self.written = written
        self._source = self._watched()
        self._judged: list[Judged] = []
        self._picture: NDArray[np.uint8] | None = None
        self._rejected_in_a_row = 0
        self._active_ns = clock.now_ns()

    def until_enough(self, waits: bool) -> None:
        """Captures until the guide has enough or the person says so.

        Args:
            waits: Whether the person asks for the first view.
        """
        self._show("waiting")
        while not self._enough():
            command = self._command()
            if command == "done" or self._idle():
                self._end(command)
                return
            if waits and command != "capture":
                self._clock.sleep(self._settings.poll_s)
                continue
            waits = False
            views = self._views(asked=command == "capture")
            if views:
                self._judge(views)
                self._show("done" if self._enough() else "waiting")

    def _watched(self) -> LiveSource:
        """Returns the sensors with a trigger that has not seen any place yet."""
        settings = self._settings
        trigger: Trigger = RequestTrigger()
        if settings.by_rest and self._package.has_arm:
            trigger = RestTrigger(settings.rest_s, moved_rad=settings.moved_rad)
        return LiveSource(
            self._package, trigger, self._clock, role=self._guide.role, with_dark=settings.with_dark
        )

    def _command(self) -> Command | None:
        name = self._stopped()
        if name is not None:
            raise CaptureAbortedError(f"{self._settings.title}: stopped by {name}")
        command = self._ui.command()
        if command == "abort":
            raise CaptureAbortedError(f"{self._settings.title}: aborted")
        return command

    def _views(self, asked: bool) -> list[Capture]:
        """Returns what is due within a poll, if anything, and counts what the sensors reject."""
        request = CaptureRequest(None, self._guide.role, self._settings.with_dark) if asked else None
        if asked:
            self._show("capturing")
        try:
            view = self._take(request)
            if view is None:
                return []
            if self._guide.role == "exposure":
                return self._series()
        except CaptureRejectedError as error:
            self._reject(error)
            return []
        self._rejected_in_a_row = 0
        return [view]

    def _take(self, request: CaptureRequest | None) -> Capture | None:
        """Takes the next view; a device that only was silent once is asked again."""
        try:
            return self._source.next(self._settings.poll_s, request)
        except DeviceTimeoutError as error:
            self._show("waiting", f"{error}; trying once more")
            return self._source.next(self._settings.poll_s, request)

    def _series(self) -> list[Capture]:
        def note(sentence: str) -> None:
            self._show("capturing", sentence)

        try:
            views = exposure_series(self._package, self._settings.exposures, note)
        except CaptureRejectedError:
            self._source = self._watched()  # so that this place is tried again
            raise
        self._rejected_in_a_row = 0
        return views

    def _reject(self, error: CaptureRejectedError) -> None:
        self._note("", "rejected", (str(error),))
        self._rejected_in_a_row += 1
        if self._rejected_in_a_row > self._settings.rejected:
            raise error
        self._show("waiting")

    def _judge(self, views: Sequence[Capture]) -> None:
        for view in views:
            look = self._guide.look(view)
            self._picture = look.picture
            if not look.accepted:
                self._note("", "refused", look.reasons)
                continue
            name = f"{self._guide.role}_{self.written + 1:04d}"
            self._writer.write(self._finish(replace(view, name=name)))
            self.written += 1
            self._note(name, "accepted", look.reasons)
        self._writer.sync()
        self._active_ns = self._clock.now_ns()

    def _note(self, name: str, verdict: Verdict, reasons: tuple[str, ...]) -> None:
        self._judged.append(Judged(len(self._judged) + 1, name, verdict, reasons))

    def _enough(self) -> bool:
        taken, needed = self._guide.progress()
        return taken >= needed

    def _idle(self) -> bool:
        return (self._clock.now_ns() - self._active_ns) / 1e9 > self._settings.idle_s

    def _end(self, command: Command | None) -> None:
        taken, needed = self._guide.progress()
        told = [] if command else [f"nothing new for {self._settings.idle_s:g} s"]
        told.append(f"{taken} of {needed} views")
        told += [f"thin: {', '.join(lacking)}"] if (lacking := thin(self._guide.coverage())) else []
        self._show("ended", "; ".join([*told, f"it would go on: {self._guide.next_step()}"]))

    def _show(self, doing: Doing, notice: str = "") -> None:
        taken, needed = self._guide.progress()
        self._ui.show(
            Situation(
                title=self._settings.title,
                doing=doing,
                next_step="" if doing in ("done", "ended") else self._guide.next_step(),
                taken=taken,
                needed=needed,
                judged=tuple(self._judged),
                coverage=self._guide.coverage(),
                picture=self._picture,
                notice=notice,
            )
        )
