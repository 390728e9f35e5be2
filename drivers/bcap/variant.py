"""The typed values of b-CAP, Denso's controller protocol, as bytes and as Python values (b-CAP guide).

    u16 type | u32 count | data, little endian

The count is 1 for what is no array, even where there is no data. A text is a u32 number of bytes and
UTF-16. An array is its type with 0x2000 and its items packed; one of VARIANT is whole values packed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

_MAX_DEPTH = 8  # of arrays of variants inside arrays of variants
_ARRAY = 0x2000
_HEAD = struct.Struct("<HI")
_LENGTH = struct.Struct("<I")


class PacketError(ValueError):
    """Bytes that are no packet, or a value that no packet can carry."""


class Type(IntEnum):
    """The type of a variant, as OLE automation numbers them."""

    EMPTY = 0
    NULL = 1
    I2 = 2
    I4 = 3
    R4 = 4
    R8 = 5
    CY = 6
    DATE = 7
    BSTR = 8
    ERROR = 10
    BOOL = 11
    VARIANT = 12
    UI1 = 17
    UI2 = 18
    UI4 = 19
    I8 = 20
    UI8 = 21


_FORMATS = {
    Type.I2: "h",
    Type.I4: "i",
    Type.R4: "f",
    Type.R8: "d",
    Type.CY: "q",
    Type.DATE: "d",
    Type.ERROR: "i",
    Type.BOOL: "h",
    Type.UI1: "B",
    Type.UI2: "H",
    Type.UI4: "I",
    Type.I8: "q",
    Type.UI8: "Q",
}
_NOTHING = (Type.EMPTY, Type.NULL)

Scalar: TypeAlias = "int | float | str | bool | None"


@dataclass(frozen=True, slots=True)
class Variant:
    """A typed value.

    Attributes:
        type: Of the value, or of each item of an array.
        value: None for EMPTY and NULL; an int (CY: in 1/10000), float (DATE: days since 1899-12-30),
            bool or str; for an array a tuple of these, for one of VARIANT a tuple of Variants.
    """

    type: Type
    value: Scalar | tuple[Scalar | Variant, ...] = None


EMPTY = Variant(Type.EMPTY)


def i4(value: int) -> Variant:
    """Returns a handle or another number of 32 bits."""
    return Variant(Type.I4, value)


def bstr(value: str) -> Variant:
    """Returns a text."""
    return Variant(Type.BSTR, value)


def r8_array(values: tuple[float, ...]) -> Variant:
    """Returns an array such as joint angles."""
    return Variant(Type.R8, values)


def to_bytes(variant: Variant, depth: int = 0) -> bytes:
    """Returns a value's bytes; `depth` is how many arrays it is inside of.

    Raises:
        PacketError: If the value is not of its type, or does not fit it.
    """
    if depth > _MAX_DEPTH:
        raise PacketError(f"arrays inside arrays more than {_MAX_DEPTH} deep")
    kind, value = variant.type, variant.value
    try:
        if isinstance(value, tuple):
            if kind in _NOTHING:
                raise PacketError(f"an array of {kind.name}")
            return _HEAD.pack(kind | _ARRAY, len(value)) + _items(kind, value, depth)
        if kind is Type.VARIANT:
            raise PacketError("a VARIANT that is no array")
        return _HEAD.pack(kind, 1) + _items(kind, (value,), depth)
    except (struct.error, OverflowError, UnicodeEncodeError) as error:
        raise PacketError(f"{value!r:.80} does not fit {kind.name}: {error}") from error


def from_bytes(data: bytes) -> Variant:
    """Returns the one value that `data` is; allocates no more than its bytes can hold.

    Raises:
        PacketError: If it is not exactly one well-formed value.
    """
    reader = _Reader(data)
    variant = reader.variant(0)
    if reader.left:
        raise PacketError(f"{reader.left} bytes after a value")
    return variant


def _items(kind: Type, values: tuple[Scalar | Variant, ...], depth: int) -> bytes:
    for value in values:
        if not _fits(kind, value):
            raise PacketError(f"{value!r:.80} is no {kind.name}")
    if kind in _NOTHING:
        return b""
    if kind in _FORMATS:
        numbers = [-1 if value is True else value for value in values]  # BOOL's; no other kind has a True
        return struct.pack(f"<{len(numbers)}{_FORMATS[kind]}", *numbers)
    return b"".join(
        to_bytes(value, depth + 1) if isinstance(value, Variant) else _text(str(value)) for value in values
    )


def _fits(kind: Type, value: Scalar | Variant) -> bool:
    if kind in _NOTHING:
        return value is None
    if kind is Type.VARIANT:
        return isinstance(value, Variant)
    if kind is Type.BSTR:
        return isinstance(value, str)
    if kind is Type.BOOL:
        return isinstance(value, bool)
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text(value: str) -> bytes:
    text = value.encode("utf-16-le")
    return _LENGTH.pack(len(text)) + text


class _Reader:
    """Takes values from bytes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def variant(self, depth: int) -> Variant:
        if depth > _MAX_DEPTH:
            raise PacketError(f"arrays inside arrays more than {_MAX_DEPTH} deep")
        number, count = _HEAD.unpack(self._take(_HEAD.size))
        try:
            kind = Type(number & ~_ARRAY)
        except ValueError:
            raise PacketError(f"a value of type 0x{number:04X}") from None
        if number & _ARRAY:
            if kind in _NOTHING:
                raise PacketError(f"an array of {kind.name}")
            if kind is Type.VARIANT:
                self._must_hold(count, _HEAD.size)
                return Variant(kind, tuple(self.variant(depth + 1) for _ in range(count)))
            return Variant(kind, self._scalars(kind, count))
        if count != 1 or kind is Type.VARIANT:
            raise PacketError(f"{count} × {kind.name} that is no array")
        return Variant(kind) if kind in _NOTHING else Variant(kind, self._scalars(kind, 1)[0])

    def _scalars(self, kind: Type, count: int) -> tuple[Scalar, ...]:
        if kind is Type.BSTR:
            self._must_hold(count, _LENGTH.size)
            return tuple(self._text() for _ in range(count))
        size = struct.calcsize("<" + _FORMATS[kind])
        self._must_hold(count, size)
        values = struct.unpack(f"<{count}{_FORMATS[kind]}", self._take(count * size))
        return tuple(value != 0 for value in values) if kind is Type.BOOL else values

    def _text(self) -> str:
        (size,) = _LENGTH.unpack(self._take(_LENGTH.size))
        try:
            return self._take(size).decode("utf-16-le")
        except UnicodeDecodeError as error:
            raise PacketError(f"a text that is no UTF-16: {error.reason}") from None

    def _must_hold(self, count: int, least: int) -> None:
        """A count is a claim: that many items must fit into the bytes that are there."""
        if count * least > self.left:
            raise PacketError(f"{count} items in {self.left} bytes")

    def _take(self, size: int) -> bytes:
        if size > self.left:
            raise PacketError(f"a value of {size} bytes, {self.left} are left")
        self._at += size
        return self._data[self._at - size : self._at]
