"""The packets of b-CAP, Denso's controller protocol, as bytes and as values (b-CAP guide).

off size field, little endian
0   1    0x01
1   4    length of the whole packet
5   2    serial number, 1…65535
7   2    reserved: 0 on TCP; else the serial number of the first attempt of this call
9   4    request: function; reply: HRESULT
13  2    number of arguments
15       each: u32 length of the value | value (drivers.bcap.variant)
end      on RS-232 a u16 CRC, then 0x04
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum

from drivers.bcap import variant as bcap_variant
from drivers.bcap.variant import PacketError, Variant

MAX_PACKET = 1 << 20  # bytes; no reply to a joint reader comes near it
MAX_DATAGRAM = 488  # bytes, on UDP and RS-232
_SOH, _EOT = 0x01, 0x04
_HEADER = struct.Struct("<BIHHiH")
_LENGTH = struct.Struct("<I")
_CRC = struct.Struct("<H")


class Function(IntEnum):
    """The calls of a joint reader: all that this project ever sends."""

    SERVICE_START = 1
    SERVICE_STOP = 2
    CONTROLLER_CONNECT = 3
    CONTROLLER_DISCONNECT = 4
    CONTROLLER_GET_ROBOT = 7
    CONTROLLER_EXECUTE = 17
    ROBOT_GET_VARIABLE = 62
    ROBOT_EXECUTE = 64
    ROBOT_RELEASE = 84
    VARIABLE_GET_VALUE = 101
    VARIABLE_RELEASE = 111


@dataclass(frozen=True, slots=True)
class Packet:
    """A request or a reply.

    Attributes:
        serial: 1…65535; a reply has its request's (the guide's first example numbers it 0).
        reserved: 0 on TCP; on UDP and RS-232 the serial number of the first attempt of this call.
        code: Function of a request, HRESULT of a reply; signed 32 bits.
        args: Of a request; of a reply its result, or nothing.
    """

    serial: int
    reserved: int
    code: int
    args: tuple[Variant, ...] = ()


def encode(packet: Packet, crc: bool = False) -> bytes:
    """Returns the bytes of a packet, with `crc` as on RS-232.

    Raises:
        PacketError: If a value does not fit, or the packet would be longer than MAX_PACKET.
    """
    parts = []
    for variant in packet.args:
        value = bcap_variant.to_bytes(variant)
        parts += [_LENGTH.pack(len(value)), value]
    length = _least(crc) + sum(map(len, parts))
    if length > MAX_PACKET:
        raise PacketError(f"a packet of {length} bytes, allowed are {MAX_PACKET}")
    try:
        head = _HEADER.pack(_SOH, length, packet.serial, packet.reserved, packet.code, len(packet.args))
    except struct.error as error:
        raise PacketError(f"{packet!r:.120} fits no packet: {error}") from error
    data = b"".join((head, *parts))
    if crc:
        data += _CRC.pack(binascii.crc_hqx(data[1:], 0xFFFF))
    return data + bytes([_EOT])


def decode(data: bytes, crc: bool = False) -> Packet:
    """Returns the one packet that `data` is, on RS-232 after checking its CRC.

    Raises:
        PacketError: If it is not exactly one well-formed packet.
    """
    if not _least(crc) <= len(data) <= MAX_PACKET:
        raise PacketError(f"{len(data)} bytes, allowed are {_least(crc)} to {MAX_PACKET}")
    start, length, serial, reserved, code, argc = _HEADER.unpack_from(data)
    if start != _SOH or data[-1] != _EOT:
        raise PacketError(f"begins with 0x{start:02X} and ends with 0x{data[-1]:02X}, not 0x01 and 0x04")
    if length != len(data):
        raise PacketError(f"says that it has {length} bytes, and has {len(data)}")
    end = len(data) - 1
    if crc:
        end -= _CRC.size
        (found,) = _CRC.unpack_from(data, end)
        if found != binascii.crc_hqx(data[1:end], 0xFFFF):
            raise PacketError("its CRC is wrong")
    return Packet(serial, reserved, code, _arguments(data[_HEADER.size : end], argc))


def expected_length(head: bytes | bytearray) -> int | None:
    """Returns how long the packet is that begins with `head`, None while fewer than 5 bytes are there.

    Raises:
        PacketError: If no packet begins so.
    """
    if head and head[0] != _SOH:
        raise PacketError(f"begins with 0x{head[0]:02X}, not 0x01")
    if len(head) < 1 + _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack_from(head, 1)
    if not _least(False) <= length <= MAX_PACKET:
        raise PacketError(f"says that it has {length} bytes, allowed are {_least(False)} to {MAX_PACKET}")
    return int(length)


def next_serial(serial: int) -> int:
    """Returns the serial number after this one: 1…65535, never 0."""
    return serial % 0xFFFF + 1


def _least(crc: bool) -> int:
    return _HEADER.size + (_CRC.size if crc else 0) + 1


def _arguments(data: bytes, argc: int) -> tuple[Variant, ...]:
    found: list[Variant] = []
    at = 0
    for _ in range(argc):  # ends with an error at the first argument that is not there
        if at + _LENGTH.size > len(data):
            raise PacketError(f"{argc} arguments, {len(found)} are there")
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if length > len(data) - at:
            raise PacketError(f"an argument of {length} bytes, {len(data) - at} are left")
        found.append(bcap_variant.from_bytes(data[at : at + length]))
        at += length
    if at != len(data):
        raise PacketError(f"{len(data) - at} bytes after the last argument")
    return tuple(found)
