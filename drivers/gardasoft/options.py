"""The keys of a light's configuration with backend "gardasoft", and what they may be together."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, Strict, model_validator

from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.protocol import GardasoftError
from surfclass.schema import Positive, Table

_Port = Annotated[int, Strict(), Field(ge=1, le=65535)]
_Input = Annotated[int, Strict(), Field(ge=1, le=8)]


def _ipv4(text: str) -> str:
    try:
        return str(ipaddress.IPv4Address(text))
    except ValueError as error:
        raise ValueError("allowed is an IPv4 address such as 192.168.1.21") from error


class LightOptions(Table):
    """Where the controller is, what the light stands, and how it is used.

    Attributes:
        port_path: The serial port, such as /dev/serial/by-id/usb-…; this or `host`.
        host: The IPv4 address of a controller on Ethernet; no name, since looking one up can take long.
        host_port: Where it listens.
        local_port: UDP from and back to this port of ours (30312 by default of the maker); without it
            TCP.
        channel: Of the controller, 1…8.
        rating_v: The light's, V; 0 for a light that is rated by its current.
        rating_a: The light's, A; 0 for a light that is rated by its voltage.
        max_percent: The brightness that level 1 stands for, in percent of the rating. Above 100 only in
            "strobe" mode, and then within the maker's limits of pulse width and duty cycle.
        max_on_s: The light is put out when it was on (or armed) for so long.
        mode: "continuous": a level shines until the next one. "strobe": the camera's strobe output makes
            each flash.
        trigger_input: Which input the camera is wired to; that with the channel's number by default.
        pulse_width_ms: How long a flash lasts.
        pulse_delay_ms: From the trigger to the flash.
        retrigger_ms: Triggers that come sooner than this after another are ignored; by default as short
            as the brightness allows.
        settle_ms: From the controller's answer until the light is taken to be steady.
        reply_timeout_s: For each answer.
    """

    port_path: str | None = None
    host: Annotated[str, AfterValidator(_ipv4)] | None = None
    host_port: _Port = 30313
    local_port: _Port | None = None
    channel: _Input = 1
    rating_v: Annotated[float, Strict(), Field(ge=0, le=48, allow_inf_nan=False)] = 0.0
    rating_a: Annotated[float, Strict(), Field(ge=0, le=20, allow_inf_nan=False)] = 0.0
    max_percent: Annotated[float, Strict(), Field(ge=1, le=999, allow_inf_nan=False)] = 100.0
    max_on_s: Annotated[float, Strict(), Field(ge=0.05, le=600, allow_inf_nan=False)] = 10.0
    mode: Literal["continuous", "strobe"] = "continuous"
    trigger_input: _Input | None = None
    pulse_width_ms: Annotated[float, Strict(), Field(ge=0.02, le=999, allow_inf_nan=False)] = 20.0
    pulse_delay_ms: Annotated[float, Strict(), Field(ge=0.01, le=999, allow_inf_nan=False)] = 0.01
    retrigger_ms: Positive | None = None
    settle_ms: Annotated[float, Strict(), Field(ge=0, le=1000, allow_inf_nan=False)] = 5.0
    reply_timeout_s: Annotated[float, Strict(), Field(ge=0.02, le=1, allow_inf_nan=False)] = 0.3

    @property
    def rating(self) -> str:
        """For people, such as "0.7 A"."""
        told = ((self.rating_v, "V"), (self.rating_a, "A"))
        return " and ".join(f"{value:g} {unit}" for value, unit in told if value)

    @property
    def allowed_retrigger_ms(self) -> float:
        """The configured retrigger time, or the shortest that the brightness allows."""
        return self._shortest_retrigger_ms() if self.retrigger_ms is None else self.retrigger_ms

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if (self.port_path is None) == (self.host is None):
            raise ValueError("one of port_path and host must be given, and not both")
        if not (self.rating_v or self.rating_a):
            raise ValueError(
                "rating_v or rating_a must be given: what the light's data sheet allows for ever"
            )
        if self.mode == "continuous":
            if self.max_percent > 100:
                raise ValueError(f'max_percent {self.max_percent:g} needs mode "strobe", allowed is to 100')
            strobe_only = {"trigger_input", "pulse_width_ms", "pulse_delay_ms", "retrigger_ms"}
            if given := sorted(strobe_only & self.model_fields_set):
                raise ValueError(f'{", ".join(given)}: only for mode "strobe"')
            return self
        try:
            longest_s, duty = gardasoft.overdrive_limit(self.max_percent)
        except GardasoftError as error:
            raise ValueError(str(error)) from error
        if self.pulse_width_ms > longest_s * 1e3:
            raise ValueError(
                f"pulse_width_ms {self.pulse_width_ms:g} at max_percent {self.max_percent:g}, allowed is to "
                f"{longest_s * 1e3:g}"
            )
        shortest_ms = self._shortest_retrigger_ms()
        if self.retrigger_ms is not None and self.retrigger_ms < shortest_ms:
            raise ValueError(
                f"retrigger_ms {self.retrigger_ms:g}, allowed is from {shortest_ms:g}: a light at "
                f"{self.max_percent:g} % may shine for {duty:.0%} of the time"
            )
        return self

    def _shortest_retrigger_ms(self) -> float:
        return self.pulse_width_ms / gardasoft.overdrive_limit(self.max_percent)[1]
