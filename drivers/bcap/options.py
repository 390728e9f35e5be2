"""The keys of an arm's configuration with backend "bcap", and what they may be together."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, Strict, model_validator

from drivers.joint_limits import VM_6083_DEG
from surfclass.schema import Number, Table

_Range = tuple[Number, Number]


class ArmBcapOptions(Table):
    """Where the controller is, how a session with it begins, and what its arm can do.

    Attributes:
        transport: "tcp"; "udp", which an RC7 has since 3.0; or "serial", RS-232.
        host: The controller's name or address, for "tcp" and "udp".
        port: Its b-CAP server's.
        port_path: The serial port, such as /dev/serial/by-id/usb-…, for "serial".
        baud: Of the serial port.
        timeout_s: A controller that is silent for so long in a call is mute. Over "udp" and "serial" a
            call is sent `retries` times within it.
        retries: How often a call is sent there.
        patience_s: How long a call may take while the controller says that it is busy.
        service: Options of Service_Start. "WDT=400": the controller says every 400 ms that a long call
            still goes on; it refuses less than 80.
        controller: The name of the controller object.
        provider: "CaoProv.DENSO.VRC", or "CaoProv.DENSO.RC8" with `option` "@IfNotMember".
        machine: "localhost", or the controller's address.
        option: Of the provider.
        robot: The arm's name.
        rate_hz: How often the joints are read.
        use_controller_clock: Whether to believe the time stamps of HighCurJntEx. Without them, joint
            values that stand still in the controller cannot be told from an arm that rests.
        max_gap_s: Angles are interpolated between readings no further apart than this.
        limits_deg: Least and greatest angle of each joint; of the VM-6083 by default.
        limit_margin_deg: How far beyond them an arm may still be.
        max_speed_deg_s: Faster than this no joint turns.
    """

    transport: Literal["tcp", "udp", "serial"] = "tcp"
    host: str = ""
    port: Annotated[int, Strict(), Field(ge=1, le=65535)] = 5007
    port_path: str = ""
    baud: Annotated[int, Strict(), Field(ge=1200, le=921600)] = 38400
    timeout_s: Annotated[float, Strict(), Field(ge=0.05, le=10, allow_inf_nan=False)] = 0.5
    retries: Annotated[int, Strict(), Field(ge=1, le=7)] = 5
    patience_s: Annotated[float, Strict(), Field(ge=0.05, le=60, allow_inf_nan=False)] = 3.0
    service: str = "WDT=400"
    controller: str = "b-CAP"
    provider: str = "CaoProv.DENSO.VRC"
    machine: str = "localhost"
    option: str = ""
    robot: str = "Arm"
    rate_hz: Annotated[float, Strict(), Field(ge=1, le=500, allow_inf_nan=False)] = 125.0
    use_controller_clock: bool = True
    max_gap_s: Annotated[float, Strict(), Field(ge=0.01, le=2, allow_inf_nan=False)] = 0.1
    limits_deg: tuple[_Range, _Range, _Range, _Range, _Range, _Range] = VM_6083_DEG
    limit_margin_deg: Annotated[float, Strict(), Field(ge=0, le=30, allow_inf_nan=False)] = 3.0
    max_speed_deg_s: Annotated[float, Strict(), Field(gt=0, le=3600, allow_inf_nan=False)] = 720.0

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if self.transport == "serial" and not (self.port_path and not self.host):
            raise ValueError('transport "serial" needs port_path, and no host')
        if self.transport != "serial" and not (self.host and not self.port_path):
            raise ValueError(f'transport "{self.transport}" needs host, and no port_path')
        for number, (least, greatest) in enumerate(self.limits_deg, 1):
            if not least < greatest:
                raise ValueError(f"limits_deg of joint {number} are {least:g} to {greatest:g}")
        if self.max_gap_s < 2 / self.rate_hz:
            raise ValueError(f"max_gap_s {self.max_gap_s:g} is below two readings at {self.rate_hz:g} Hz")
        return self
