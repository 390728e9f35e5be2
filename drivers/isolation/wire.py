"""What the daemon and a device's own process say to each other: bounded JSON messages on a local socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from typing import Any

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from surfclass.errors import ConfigurationError, InputError

MESSAGE_LIMIT_BYTES = 65_536
_TEXT_LIMIT = 2_000  # characters of an error's message; JSON may need 6 bytes for each
_TRACEBACK_LIMIT = 6_000

_DRIVER_ERRORS: dict[str, type[DriverError]] = {
    kind.__name__: kind
    for kind in (
        DeviceNotFoundError,
        DeviceLostError,
        DeviceTimeoutError,
        DeviceFaultError,
        DriverUnavailableError,
    )
}
_INPUT_ERRORS: dict[str, type[InputError]] = {
    kind.__name__: kind for kind in (ConfigurationError, InputError)
}


class WireError(ValueError):
    """A message that is none, or is too long: whoever sent it cannot be trusted any more."""


def encode(message: Mapping[str, Any]) -> bytes:
    """Returns `message` as the bytes of one packet.

    Raises:
        WireError: If JSON cannot hold it, or it is longer than `MESSAGE_LIMIT_BYTES`.
    """
    try:
        data = json.dumps(message, allow_nan=False, ensure_ascii=False).encode("utf-8", "replace")
    except (TypeError, ValueError, RecursionError) as error:
        raise WireError(f"JSON cannot hold the message: {error}") from None
    if len(data) > MESSAGE_LIMIT_BYTES:
        raise WireError(f"a message of {len(data)} bytes, allowed are {MESSAGE_LIMIT_BYTES}")
    return data


def decode(data: bytes) -> dict[str, Any]:
    """Returns the message in one packet.

    Raises:
        WireError: If it is longer than `MESSAGE_LIMIT_BYTES` or no JSON object.
    """
    if len(data) > MESSAGE_LIMIT_BYTES:
        raise WireError(f"a message of more than {MESSAGE_LIMIT_BYTES} bytes")
    try:
        message = json.loads(data, parse_constant=_refuse)
    except (ValueError, RecursionError):
        raise WireError(f"no JSON: {data[:40]!r}") from None
    if not isinstance(message, dict):
        raise WireError(f"no JSON object: {data[:40]!r}")
    return message


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


def receive(channel: socket.socket) -> dict[str, Any] | None:
    """Returns the next message, or None where the other side has closed or died.

    The socket keeps the bounds of messages (SOCK_SEQPACKET), so that none is ever half read.

    Raises:
        WireError: As `decode`.
        BlockingIOError: If the socket does not block and no message is there.
    """
    try:
        data = channel.recv(MESSAGE_LIMIT_BYTES + 1)
    except ConnectionError:
        return None
    return decode(data) if data else None


def error_message(error: BaseException) -> dict[str, str] | None:
    """Returns how an error travels; None for one that may not leave a driver."""
    for kind in type(error).__mro__:
        if isinstance(error, DriverError) and kind.__name__ in _DRIVER_ERRORS:
            text = str(error).removeprefix(f"{error.device}: ")[:_TEXT_LIMIT]
            return {"error": kind.__name__, "device": error.device[:_TEXT_LIMIT], "text": text}
        if kind in _INPUT_ERRORS.values():
            return {"error": kind.__name__, "text": str(error)[:_TEXT_LIMIT]}
    return None


def raised(message: Mapping[str, Any], device: str) -> Exception:
    """Returns the error that travelled as `message`, of the class and with the text that it had.

    Args:
        message: What `error_message` made.
        device: The device's name, for a message without one.

    Raises:
        WireError: If there is no such error.
    """
    kind, text = message.get("error"), message.get("text")
    if isinstance(kind, str) and isinstance(text, str):
        if kind in _DRIVER_ERRORS:
            return _DRIVER_ERRORS[kind](str(message.get("device", device)), text)
        if kind in _INPUT_ERRORS:
            return _INPUT_ERRORS[kind](text)
    raise WireError(f"an error of class {kind!r:.80}")


def defect_message(error: BaseException, trace: str) -> dict[str, str]:
    """Returns how an error travels that may not leave a driver: a fault in the driver's own code."""
    return {
        "defect": f"{type(error).__name__}: {error}"[:_TEXT_LIMIT],
        "traceback": trace[-_TRACEBACK_LIMIT:],
    }
