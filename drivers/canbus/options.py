"""What a reader of joints on a CAN bus is told: which bus, how often, how close together, which limits."""

from __future__ import annotations

import difflib
from typing import Annotated

from pydantic import Field, Strict, field_validator, model_validator

from drivers.canbus.bus import interfaces
from drivers.joint_limits import VM_6083_DEG
from surfclass.schema import Number, Positive, Table

_OURS = {"interface", "channel", "bitrate", "receive_own_messages", "can_filters", "listen_only"}
_NOT_BELOW_0 = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]

Range = tuple[Number, Number]


class BusOptions(Table):
    """Which bus, in python-can's terms.

    Attributes:
        interface: python-can's name of the make: "socketcan", "slcan", "pcan", "kvaser", "virtual" …
        channel: "can0", a serial port's path, or what else the make calls its bus.
        bitrate: Bits in a second; not for socketcan, where `ip link set can0 type can bitrate …` sets it.
        listen_only: Whether an slcan adapter is opened so that it cannot even acknowledge; None: where
            nothing has to be sent. Somebody else has to acknowledge the sender's frames then.
        bus: More arguments of python-can's interface, such as {tty_baudrate = 1000000} for slcan.
    """

    interface: Annotated[str, Strict()]
    channel: Annotated[str, Strict(), Field(min_length=1)] | Annotated[int, Strict(), Field(ge=0)]
    bitrate: Annotated[int, Strict(), Field(ge=5_000, le=1_000_000)] | None = None
    listen_only: Annotated[bool, Strict()] | None = None
    bus: dict[str, bool | int | float | str] = Field(default_factory=dict)

    @field_validator("interface")
    @classmethod
    def _known(cls, value: str) -> str:
        if value == "udp_multicast":
            raise ValueError(
                "udp_multicast is not allowed: who sends there hears itself, and no controller is on it"
            )
        known = interfaces() - {"udp_multicast"}
        if value not in known:
            near = difflib.get_close_matches(value, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"not an interface of python-can{hint} (known: {', '.join(sorted(known))})")
        return value

    @model_validator(mode="after")
    def _fits(self) -> BusOptions:
        if self.interface == "socketcan":
            if self.bitrate is not None:
                raise ValueError(
                    f"bitrate: of {self.channel} it is set by `ip link set {self.channel} type can bitrate "
                    f"{self.bitrate}`; leave it out here"
                )
            if not isinstance(self.channel, str) or "/" in self.channel:
                raise ValueError("channel: a network interface, such as 'can0'")
        if self.interface != "slcan" and self.listen_only is not None:
            raise ValueError(
                "listen_only: for slcan alone; for socketcan there is `ip link set … type can listen-only on`"
            )
        if clash := sorted(_OURS & self.bus.keys()):
            raise ValueError(f"bus: {', '.join(clash)} cannot be given here; the driver sets it")
        return self


class ReaderOptions(BusOptions):
    """What all readers of joints are told.

    Attributes:
        period_ms: From one set of six angles to the next; what is silent for ten is said to be.
        window_ms: How far apart the frames of one set may arrive, or how long after their SYNC.
        latency_ms: How long the angles are old when their SYNC or their frames arrive: the bridge's
            cycle, the adapter's buffer.
        latency_sd_ms: How far that can be off.
        max_gap_s: Angles are interpolated between sets no further apart than this.
        open_timeout_s: How long open() waits for the first set.
        limits_deg: Least and greatest angle of j1 to j6; of the VM-6083 by default.
        limit_margin_deg: How far beyond them an arm may still be.
        max_speed_deg_s: Faster than this no joint turns.
    """

    period_ms: Annotated[Positive, Field(ge=1, le=1000)]
    window_ms: Positive
    latency_ms: _NOT_BELOW_0 = 0.0
    latency_sd_ms: _NOT_BELOW_0 = 0.0
    max_gap_s: Annotated[Positive, Field(le=2)] = 0.1
    open_timeout_s: Positive = 2.0
    limits_deg: tuple[Range, Range, Range, Range, Range, Range] = VM_6083_DEG
    limit_margin_deg: Annotated[float, Strict(), Field(ge=0, le=30, allow_inf_nan=False)] = 3.0
    max_speed_deg_s: Annotated[float, Strict(), Field(gt=0, le=3600, allow_inf_nan=False)] = 720.0

    @model_validator(mode="after")
    def _sets_are_neighbours(self) -> ReaderOptions:
        if self.max_gap_s < 2e-3 * self.period_ms:
            raise ValueError(
                f"max_gap_s: {self.max_gap_s:g}, allowed are two periods or more, {2e-3 * self.period_ms:g}"
            )
        return self

    @field_validator("limits_deg")
    @classmethod
    def _ordered(cls, value: tuple[Range, ...]) -> tuple[Range, ...]:
        for joint, (low, high) in enumerate(value, start=1):
            if low >= high:
                raise ValueError(f"j{joint}: lowest {low} and highest {high}, allowed is lowest first")
        return value
