"""b-CAP packets as bytes: the vendor's own, everything that can be said, and everything that cannot."""

from __future__ import annotations

import math
import struct
import tracemalloc

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.bcap import packet as bcap
from drivers.bcap.packet import Function, Packet, decode, encode
from drivers.bcap.result import Result, describe, failed, signed, unsigned
from drivers.bcap.variant import EMPTY, PacketError, Type, Variant, bstr, i4, r8_array

ANGLES = struct.unpack(
    "<8d",
    bytes.fromhex(
        "C1 0B B2 0D EB 4B D8 BC F0 D1 25 37 00 80 46 40 0D 97 E5 F5 FF 7F 56 40 26 BC 9E 96 1A 58 06 3D"
        "F6 FF 0E DD FF 7F 46 40 96 B0 06 42 EC 4B D8 BC 0F 00 00 00 89 11 40 00 FE FF FF FF 10 00 00 00"
    ),
)

# As the vendor's documents and programs have them: bytes, and what they say. The first is numbered 0.
GOLDEN = {
    "Service_Start": (
        "01 10 00 00 00 00 00 00 00 01 00 00 00 00 00 04",
        Packet(0, 0, Function.SERVICE_START),
    ),
    "Controller_GetRobot": (
        """
        01 40 00 00 00 02 00 00 00 07 00 00 00 03 00 0A 00 00 00 03 00 01 00 00 00 02 00 00 00 10 00 00 00
        08 00 01 00 00 00 06 00 00 00 41 00 72 00 6D 00 0A 00 00 00 08 00 01 00 00 00 00 00 00 00 04
        """,
        Packet(2, 0, Function.CONTROLLER_GET_ROBOT, (i4(2), bstr("Arm"), bstr(""))),
    ),
    "a handle": (
        "01 1E 00 00 00 01 00 00 00 00 00 00 00 01 00 0A 00 00 00 03 00 01 00 00 00 02 00 00 00 04",
        Packet(1, 0, Result.S_OK, (i4(2),)),
    ),
    "Variable_GetValue": (
        "01 1E 00 00 00 04 00 00 00 65 00 00 00 01 00 0A 00 00 00 03 00 01 00 00 00 03 00 00 00 04",
        Packet(4, 0, Function.VARIABLE_GET_VALUE, (i4(3),)),
    ),
    "joint angles": (
        """
        01 5A 00 00 00 09 00 00 00 00 00 00 00 01 00 46 00 00 00 05 20 08 00 00 00 C1 0B B2 0D EB 4B D8 BC
        F0 D1 25 37 00 80 46 40 0D 97 E5 F5 FF 7F 56 40 26 BC 9E 96 1A 58 06 3D F6 FF 0E DD FF 7F 46 40
        96 B0 06 42 EC 4B D8 BC 0F 00 00 00 89 11 40 00 FE FF FF FF 10 00 00 00 04
        """,
        Packet(9, 0, Result.S_OK, (r8_array(ANGLES),)),
    ),
    "Service_Start with options": (
        """
        01 2C 00 00 00 01 00 00 00 01 00 00 00 01 00 18 00 00 00 08 00 01 00 00 00 0E 00 00 00
        57 00 44 00 54 00 3D 00 34 00 30 00 30 00 04
        """,
        Packet(1, 0, Function.SERVICE_START, (bstr("WDT=400"),)),
    ),
    "E_HANDLE": (
        "01 10 00 00 00 05 00 00 00 06 00 07 80 00 00 04",
        Packet(5, 0, signed(Result.E_HANDLE)),
    ),
    "S_EXECUTING": (
        "01 10 00 00 00 05 00 00 00 00 09 00 00 00 00 04",
        Packet(5, 0, Result.S_EXECUTING),
    ),
    "a false of VT_BOOL": (
        "01 1C 00 00 00 04 00 00 00 00 00 00 00 01 00 08 00 00 00 0B 00 01 00 00 00 00 00 04",
        Packet(4, 0, Result.S_OK, (Variant(Type.BOOL, False),)),
    ),
    "a true of VT_BOOL": (
        """
        01 2A 00 00 00 05 00 00 00 66 00 00 00 02 00 0A 00 00 00 03 00 01 00 00 00 03 00 00 00
        08 00 00 00 0B 00 01 00 00 00 FF FF 04
        """,
        Packet(5, 0, 102, (i4(3), Variant(Type.BOOL, True))),
    ),
    "Controller_Connect": (
        """
        01 8A 00 00 00 01 00 00 00 03 00 00 00 04 00 14 00 00 00 08 00 01 00 00 00 0A 00 00 00
        62 00 2D 00 43 00 41 00 50 00 2C 00 00 00 08 00 01 00 00 00 22 00 00 00 43 00 61 00 6F 00 50 00
        72 00 6F 00 76 00 2E 00 44 00 45 00 4E 00 53 00 4F 00 2E 00 56 00 52 00 43 00 20 00 00 00 08 00
        01 00 00 00 16 00 00 00 31 00 39 00 32 00 2E 00 31 00 36 00 38 00 2E 00 30 00 2E 00 31 00
        0A 00 00 00 08 00 01 00 00 00 00 00 00 00 04
        """,
        Packet(
            1,
            0,
            Function.CONTROLLER_CONNECT,
            (bstr("b-CAP"), bstr("CaoProv.DENSO.VRC"), bstr("192.168.0.1"), bstr("")),
        ),
    ),
}

GOLDEN_SERIAL = bytes.fromhex("01 12 00 00 00 01 00 01 00 01 00 00 00 00 00 69 F4 04")


@pytest.mark.parametrize("name", GOLDEN)
def test_the_vendors_packets_are_written_and_read_byte_for_byte(name):
    text, packet = GOLDEN[name]
    assert encode(packet) == bytes.fromhex(text)
    assert decode(bytes.fromhex(text)) == packet


def test_the_vendors_packet_of_rs_232_is_written_and_read_byte_for_byte():
    packet = Packet(1, 1, Function.SERVICE_START)
    assert encode(packet, crc=True) == GOLDEN_SERIAL
    assert decode(GOLDEN_SERIAL, crc=True) == packet


def test_six_angles_stand_before_two_numbers_that_mean_nothing():
    value = decode(bytes.fromhex(GOLDEN["joint angles"][0])).args[0].value
    assert value[:6] == pytest.approx([0, 45, 90, 0, 45, 0], abs=1e-5)


FIXED = {
    Type.I2: st.integers(-(2**15), 2**15 - 1),
    Type.I4: st.integers(-(2**31), 2**31 - 1),
    Type.R4: st.floats(width=32, allow_nan=False),
    Type.R8: st.floats(allow_nan=False),
    Type.CY: st.integers(-(2**63), 2**63 - 1),
    Type.DATE: st.floats(allow_nan=False),
    Type.ERROR: st.integers(-(2**31), 2**31 - 1),
    Type.BOOL: st.booleans(),
    Type.UI1: st.integers(0, 2**8 - 1),
    Type.UI2: st.integers(0, 2**16 - 1),
    Type.UI4: st.integers(0, 2**32 - 1),
    Type.I8: st.integers(-(2**63), 2**63 - 1),
    Type.UI8: st.integers(0, 2**64 - 1),
    Type.BSTR: st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
}
PLAIN = st.one_of(
    st.sampled_from([EMPTY, Variant(Type.NULL)]),
    *[st.builds(Variant, st.just(kind), values) for kind, values in FIXED.items()],
    *[
        st.builds(Variant, st.just(kind), st.lists(values, max_size=6).map(tuple))
        for kind, values in FIXED.items()
    ],
)
VARIANTS = st.recursive(
    PLAIN,
    lambda inner: st.builds(Variant, st.just(Type.VARIANT), st.lists(inner, max_size=4).map(tuple)),
    max_leaves=8,
)
PACKETS = st.builds(
    Packet,
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF),
    st.integers(-(2**31), 2**31 - 1),
    st.lists(VARIANTS, max_size=5).map(tuple),
)


@given(PACKETS, st.booleans())
@settings(max_examples=60)
def test_what_is_written_is_read(packet, crc):
    data = encode(packet, crc)
    assert decode(data, crc) == packet
    assert bcap.expected_length(data) == len(data)


@given(st.binary(max_size=200), st.booleans())
@example(b"\x01\xff\xff\xff\xff" + bytes(11), False)
def test_garbage_is_refused_and_nothing_else(data, crc):
    with pytest.raises(PacketError):
        decode(data, crc)


def packet_of(arguments, argc):
    """A well-framed packet around any bytes."""
    length = 16 + len(arguments)
    return struct.pack("<BIHHiH", 1, length, 1, 0, 0, argc) + arguments + b"\x04"


@given(st.binary(max_size=120), st.integers(0, 0xFFFF))
def test_garbage_inside_a_good_frame_is_a_packet_or_refused(arguments, argc):
    try:
        packet = decode(packet_of(arguments, argc))
    except PacketError:
        return
    assert len(packet.args) == argc


@given(PACKETS, st.data())
@settings(max_examples=80)
def test_a_changed_byte_is_never_more_than_a_refusal(packet, data):
    wire = bytearray(encode(packet))
    wire[data.draw(st.integers(0, len(wire) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        decode(bytes(wire))
    except PacketError:
        return


@given(PACKETS, st.data())
@settings(max_examples=50)
def test_the_crc_finds_every_changed_byte(packet, data):
    wire = bytearray(encode(packet, crc=True))
    wire[data.draw(st.integers(0, len(wire) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(PacketError):
        decode(bytes(wire), crc=True)


@given(PACKETS, st.data())
@settings(max_examples=50)
def test_a_part_of_a_packet_is_no_packet(packet, data):
    wire = encode(packet)
    with pytest.raises(PacketError):
        decode(wire[: data.draw(st.integers(0, len(wire) - 1))])


CLAIMS = {
    "R8": struct.pack("<HI", 0x2005, 2**31),
    "UI1": struct.pack("<HI", 0x2011, 2**32 - 1),
    "BSTR": struct.pack("<HI", 0x2008, 2**32 - 1),
    "text": struct.pack("<HII", 0x0008, 1, 2**32 - 1),
    "VARIANT": struct.pack("<HI", 0x200C, 2**32 - 1),
    "EMPTY": struct.pack("<HI", 0x2000, 2**32 - 1),
    "EMPTY, no array": struct.pack("<HI", 0x0000, 2**32 - 1),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_a_claim_of_billions_takes_no_memory(claim):
    body = CLAIMS[claim]
    tracemalloc.start()
    try:
        with pytest.raises(PacketError):
            decode(packet_of(struct.pack("<I", len(body)) + body, 1))
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_arrays_inside_arrays_have_an_end():
    deep = EMPTY
    for _ in range(8):
        deep = Variant(Type.VARIANT, (deep,))
    assert decode(encode(Packet(1, 0, 0, (deep,)))).args[0] == deep
    with pytest.raises(PacketError, match="deep"):
        encode(Packet(1, 0, 0, (Variant(Type.VARIANT, (deep,)),)))
    body = struct.pack("<HI", 0x200C, 1) * 100_000
    with pytest.raises(PacketError, match="deep"):
        decode(packet_of(struct.pack("<I", len(body)) + body, 1))


BAD_VALUES = [
    Variant(Type.I2, 40_000),
    Variant(Type.UI1, -1),
    Variant(Type.I4, 1.5),
    Variant(Type.I4, "1"),
    Variant(Type.I4, True),
    Variant(Type.BOOL, 1),
    Variant(Type.R4, 1e300),
    Variant(Type.BSTR, "\ud800"),
    Variant(Type.BSTR, None),
    Variant(Type.EMPTY, 1),
    Variant(Type.EMPTY, (None,)),
    Variant(Type.VARIANT, 1),
    Variant(Type.VARIANT, (1,)),
    Variant(Type.R8, (i4(1),)),
]


@pytest.mark.parametrize("value", BAD_VALUES, ids=str)
def test_a_value_that_is_not_of_its_type_is_not_sent(value):
    with pytest.raises(PacketError):
        encode(Packet(1, 0, 0, (value,)))


@pytest.mark.parametrize(
    "packet", [Packet(-1, 0, 0), Packet(1, 70_000, 0), Packet(1, 0, 0x80000000)], ids=str
)
def test_a_number_that_fits_no_packet_is_not_sent(packet):
    with pytest.raises(PacketError):
        encode(packet)


def test_a_packet_is_at_most_a_mebibyte():
    with pytest.raises(PacketError, match="1048576"):
        encode(Packet(1, 0, 0, (bstr("x" * (1 << 19)),)))
    with pytest.raises(PacketError, match="1048576"):
        bcap.expected_length(struct.pack("<BI", 1, (1 << 20) + 1))


def test_nan_arrives_as_nan():
    value = decode(encode(Packet(1, 0, 0, (r8_array((math.nan, math.inf)),)))).args[0].value
    assert math.isnan(value[0])
    assert value[1] == math.inf


def test_the_length_is_known_from_five_bytes_on():
    data = bytes.fromhex(GOLDEN["a handle"][0])
    assert [bcap.expected_length(data[:n]) for n in range(7)] == [None] * 5 + [30, 30]
    for wrong in (b"\x02", b"\x01\x0f\x00\x00\x00", b"\x01\xff\xff\xff\xff"):
        with pytest.raises(PacketError):
            bcap.expected_length(wrong)


def test_serial_numbers_go_from_1_to_65535_and_never_0():
    assert bcap.next_serial(0) == 1
    assert bcap.next_serial(1) == 2
    assert bcap.next_serial(0xFFFE) == 0xFFFF
    assert bcap.next_serial(0xFFFF) == 1


def test_results_are_shown_as_people_look_them_up():
    assert describe(unsigned(-2147024890)) == "0x80070006 (E_HANDLE)"
    assert describe(0x83500001) == "0x83500001"
    assert signed(0x80070006) == -2147024890
    assert failed(0x80000900)
    assert not failed(Result.S_EXECUTING)
