"""A DBC file and a table say which bits are a joint; what does not fit is refused before a bus is opened."""

import math
import struct

import can_site
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canbus.layout import DbcOptions, ImpossibleAngleError, Layout
from drivers.emulators.can_bridge import JOINT_IDS, joint_frames
from surfclass.errors import ConfigurationError
from surfclass.schema import validate


def layout(text=None, folder=None, **more):
    options = can_site.bridge_options(**more)
    if text is not None:
        (folder / "joints.dbc").write_text(text)
        options["dbc_path"] = str(folder / "joints.dbc")
    return Layout("arm", validate(DbcOptions, options, "arm"))


def changed(old, new):
    text = can_site.DBC.read_text()
    assert old in text
    return text.replace(old, new)


def joints(**more):
    """The table of joints with another entry for j1."""
    table = can_site.joints()
    table["j1"] = {**table["j1"], **more}
    return table


EXAMPLE = layout()


def one(layout_, can_id, data):
    return layout_.read(can_id, False, data).angles


def test_the_example_dbc_says_what_the_emulated_bridge_sends():
    q = [0.1, -0.2, 1.5, -2.9, 0.0, 6.2]
    dbc = layout()
    read = {}
    for can_id, data in joint_frames(q, 300):
        frame = dbc.read(can_id, False, data)
        assert frame.counter == 300 % 256
        read |= frame.angles
    assert [read[joint] for joint in range(6)] == pytest.approx(q, abs=can_site.WORD_RAD)


def test_scale_offset_and_sign_are_the_tables():
    data = (10_000).to_bytes(3, "little") + bytes(5)  # 1°
    turned = layout(joints=joints(scale_rad=0.5, offset_rad=0.25, sign=-1))
    assert one(turned, JOINT_IDS[0], data)[0] == pytest.approx(-0.25)
    assert one(layout(), JOINT_IDS[0], data)[0] == pytest.approx(math.radians(1))


def test_units_of_the_dbc_give_the_scale(tmp_path):
    data = (10_000).to_bytes(3, "little") + bytes(5)
    for unit, rad in (("rad", 1.0), ("mrad", 1e-3), ("°", math.pi / 180)):
        text = changed('[-360|360] "deg" PC', f'[-360|360] "{unit}" PC')
        path = tmp_path / "joints.dbc"
        path.write_text(text, encoding="cp1252")
        options = can_site.bridge_options(dbc_path=str(path))
        read = Layout("arm", validate(DbcOptions, options, "arm"))
        assert one(read, JOINT_IDS[0], data)[0] == pytest.approx(rad)


def test_a_unit_that_is_no_angle_needs_a_scale(tmp_path):
    text = changed('[-360|360] "deg" PC', '[-360|360] "inc" PC')
    with pytest.raises(ConfigurationError, match=r"joints\.j1\.scale_rad: missing.*'inc'"):
        layout(text, tmp_path)


@pytest.mark.parametrize("size", [0, 3, 7])
def test_a_frame_of_another_length_says_nothing(size):
    assert layout().read(JOINT_IDS[1], False, bytes(size)) is None


@given(data=st.binary(max_size=64), can_id=st.sampled_from(JOINT_IDS))
def test_whatever_bytes_come_are_angles_or_none(data, can_id):
    try:
        frame = EXAMPLE.read(can_id, False, data)
    except ImpossibleAngleError:
        assert len(data) == 8
        return
    if len(data) != 8:
        assert frame is None
    else:
        assert all(abs(math.degrees(angle)) < 839 for angle in frame.angles.values())
        assert frame.counter == data[7]


def test_a_value_that_the_dbc_names_is_no_angle():
    data = (-(1 << 23)).to_bytes(3, "little", signed=True) + bytes(5)
    with pytest.raises(ImpossibleAngleError, match=r"j1: Joints12\.J1 says 'NotAvailable'"):
        layout().read(JOINT_IDS[0], False, data)


def test_a_floating_point_signal_that_is_no_number_is_no_angle(tmp_path):
    text = changed("SG_ J1 : 0|24@1- (0.0001,0)", "SG_ J1 : 0|32@1- (1,0)").replace(
        "J2 : 24|24", "J2 : 32|16"
    )
    text = text.replace('VAL_ 385 J1 -8388608 "NotAvailable" ;', "SIG_VALTYPE_ 385 J1 : 1;")
    read = layout(text, tmp_path)
    for value in (float("nan"), float("inf")):
        with pytest.raises(ImpossibleAngleError, match="j1"):
            read.read(JOINT_IDS[0], False, struct.pack("<f", value) + bytes(4))
    assert one(read, JOINT_IDS[0], struct.pack("<f", 90.0) + bytes(4))[0] == pytest.approx(math.pi / 2)


def test_a_multiplexed_message_carries_one_joint_at_a_time(tmp_path):
    signals = "".join(
        f' SG_ J{joint} m{joint} : 8|32@1- (0.0001,0) [0|0] "deg" PC\n' for joint in range(1, 7)
    )
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: PLC PC\nBO_ 256 Joints: 6 PLC\n'
        ' SG_ Selector M : 0|8@1+ (1,0) [0|0] "" PC\n'
        f'{signals} SG_ Counter : 40|8@1+ (1,0) [0|0] "" PC\n'
    )
    table = {f"j{joint}": {"message": "Joints", "signal": f"J{joint}"} for joint in range(1, 7)}
    read = layout(text, tmp_path, joints=table)
    frame = read.read(256, False, bytes([3]) + (900_000).to_bytes(4, "little") + bytes([7]))
    assert frame.angles == {2: pytest.approx(math.pi / 2)}
    assert frame.counter == 7
    assert read.read(256, False, bytes([9, 0, 0, 0, 0, 0])) is None, "a selector that it does not know"


def test_extended_ids_are_other_frames_than_standard_ones(tmp_path):
    read = layout(changed("BO_ 386 ", f"BO_ {386 | 1 << 31} "), tmp_path)
    assert read.wanted == {(385, False), (386, True), (387, False)}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"joints": joints(message="Joint12")}, "'Joint12' is no message; did you mean 'Joints12'"),
        ({"joints": joints(signal="j1")}, r"j1\.signal: 'j1' is no signal of Joints12; did you mean 'J1'"),
        ({"joints": joints(signal="J2")}, r"joints\.j2: Joints12\.J2 is j1 already"),
        ({"counter": "Count"}, r"counter: 'Count' is no signal of Joints12; did you mean 'Counter'"),
        ({"counter": "J1"}, r"counter: Joints12\.J1 is no plain unsigned number"),
        ({"counter": {"Joints12": "Counter"}}, "a table for Joints12, the joints are in Joints12, "),
        ({"sync": "Synch"}, r"sync: 'Synch' is no message; did you mean 'Sync'"),
        ({"sync": 0x181}, r"sync: 0x181 is a joint's message, Joints12"),
        ({"sync": 0x80, "counter": "Counter"}, "exactly one of the two"),
        ({"counter": None}, "exactly one of the two"),
        ({"sync": 0x80, "window_ms": 21.0}, "a set could hold frames of two SYNCs"),
        ({"window_ms": 20.0 * 128}, "to be mistaken"),
        ({"dbc_path": "/nowhere/joints.dbc"}, "No such file"),
        ({"joints": {**can_site.joints(), "j7": can_site.joints()["j1"]}}, r"joints\.j7: unknown key"),
        ({"joints": {"j1": can_site.joints()["j1"]}}, r"joints\.j2: missing"),
        ({"limits_deg": ((10.0, -10.0),) * 6}, "lowest first"),
        ({"interface": "udp_multicast"}, "hears itself"),
        ({"interface": "socketscan"}, "did you mean 'socketcan'"),
        ({"interface": "socketcan", "channel": "can0", "bitrate": 500_000}, "can0 type can bitrate 500000"),
        ({"interface": "socketcan", "channel": 0}, "network interface"),
        ({"listen_only": True}, "for slcan alone"),
        ({"bus": {"can_filters": 1}}, "bus: can_filters cannot be given here"),
        ({"windw_ms": 5}, "did you mean 'window_ms'"),
        ({"period_ms": 0}, "period_ms"),
        ({"max_gap_s": 0.015}, "two periods or more, 0.02"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_with_what_is_allowed(more, message):
    with pytest.raises(ConfigurationError, match=message):
        layout(**more)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a DBC file that can be read"),
        ("this is not one", "not a DBC file that can be read"),
        (changed("SG_ J2 : 24|24", "SG_ J2 : 20|24"), "overlapping"),
        (changed("BO_ 386 Joints34", "BO_ 385 Joints34"), "the same id 0x181"),
        (changed('56|8@1+ (1,0) [0|255] "" PC\n\nBO_ 387', '56|4@1+ (1,0) [0|15] "" PC\n\nBO_ 387'), "range"),
    ],
)
def test_a_dbc_file_that_does_not_fit_is_refused(text, message, tmp_path):
    with pytest.raises(ConfigurationError, match=message):
        layout(text, tmp_path)
