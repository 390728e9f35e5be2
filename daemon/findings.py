"""What `surfclass check` found: one finding for each thing looked at, with what to do about it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from surfclass.errors import InputError

_ADVICE: dict[type[DriverError], str] = {
    DeviceNotFoundError: "check power, cable, address and access rights (`systemd/60-surfclass.rules`)",
    DeviceLostError: "check the cable and the power supply; look for USB resets in `journalctl -k`",
    DeviceTimeoutError: "it is there but silent: is another program using it, or its trigger not wired?",
    DeviceFaultError: "read the fault at the device itself, mend it and switch the device off and on",
    DriverUnavailableError: "install the package that the message names into the service's environment",
}


class Verdict(StrEnum):
    """How a finding counts."""

    OK = "ok"
    WARNING = "warning"
    CONFIGURATION = "configuration"
    DEVICE = "device"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        subject: What, such as "colour" or "model".
        verdict: Whether it can work, and if not, whose fault that is.
        message: What was found.
        advice: What to do; empty where nothing is to be done.
        facts: What a device tells about itself, by name, as `drivers.interfaces.Device.about` has them.
    """

    subject: str
    verdict: Verdict
    message: str
    advice: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Returns the finding for `--json`."""
        return asdict(self)


def exit_code(findings: list[Finding]) -> int:
    """Returns 0, 78 where something is configured wrongly, else 69 where a device does not work."""
    verdicts = {finding.verdict for finding in findings}
    if Verdict.CONFIGURATION in verdicts:
        return os.EX_CONFIG
    return os.EX_UNAVAILABLE if Verdict.DEVICE in verdicts else os.EX_OK


class Notes:
    """Collects findings."""

    def __init__(self, findings: list[Finding]) -> None:
        self._findings = findings

    def ok(self, subject: str, message: str, facts: Mapping[str, str] | None = None) -> None:
        """It works."""
        self._findings.append(Finding(subject, Verdict.OK, message, facts=facts or {}))

    def warn(self, subject: str, message: str, advice: str) -> None:
        """It works, but somebody should look."""
        self._findings.append(Finding(subject, Verdict.WARNING, message, advice))

    def wrong(self, subject: str, message: str, advice: str) -> None:
        """It is configured or installed wrongly."""
        self._findings.append(Finding(subject, Verdict.CONFIGURATION, message, advice))

    @contextmanager
    def faults_of(self, subject: str, advice: str) -> Iterator[None]:
        """Turns what goes wrong inside into a finding."""
        try:
            yield
        except DriverUnavailableError as error:
            self.wrong(subject, str(error), _ADVICE[DriverUnavailableError])
        except DriverError as error:
            told = next((_ADVICE[kind] for kind in type(error).__mro__ if kind in _ADVICE), advice)
            self._findings.append(Finding(subject, Verdict.DEVICE, str(error), told))
        except (InputError, OSError) as error:
            self.wrong(subject, str(error), advice)
