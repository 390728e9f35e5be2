"""What a b-CAP call ended with: HRESULTs by name (b-CAP guide; ORiN2)."""

from __future__ import annotations

from enum import IntEnum


class Result(IntEnum):
    """An HRESULT as 0…2³²−1; the upper half are failures."""

    S_OK = 0
    S_FALSE = 1
    S_EXECUTING = 0x00000900
    E_TIMEOUT = 0x80000900
    E_NOT_CONNECTED = 0x80000902
    E_MAX_OBJECT = 0x80000905
    E_TOO_MUCH_DATA = 0x80000909
    E_MAX_CONNECT = 0x8000090B
    E_NOTIMPL = 0x80004001
    E_ABORT = 0x80004004
    E_FAIL = 0x80004005
    E_UNEXPECTED = 0x8000FFFF
    E_INVALIDRCVPACKET = 0x80010001
    E_INVALIDSNDPACKET = 0x80010002
    E_INVALIDARGTYPE = 0x80010003
    E_ROBOTISBUSY = 0x80010004
    E_INVALIDCOMMAND = 0x80010005
    E_PACKETSIZEOVER = 0x80010011
    E_ARGSIZEOVER = 0x80010012
    E_ACCESSDENIED = 0x80070005
    E_HANDLE = 0x80070006
    E_OUTOFMEMORY = 0x8007000E
    E_INVALIDARG = 0x80070057
    E_BUSY_PROC = 0x809100AA


def unsigned(code: int) -> int:
    """Returns the code of a packet, which is signed, as 0…2³²−1."""
    return code & 0xFFFFFFFF


def signed(result: int) -> int:
    """Returns an HRESULT as a packet carries it."""
    return result - (1 << 32) if result >> 31 else result


def failed(result: int) -> bool:
    """Returns whether 0…2³²−1 is a failure."""
    return bool(result >> 31)


def describe(result: int) -> str:
    """Returns an HRESULT, 0…2³²−1, as people look it up."""
    names = {member.value: member.name for member in Result}
    return f"0x{result:08X}" + (f" ({names[result]})" if result in names else "")
