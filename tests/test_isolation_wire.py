"""Whatever a device's own process says: a message, a frame, or a WireError."""

import contextlib
import os
import socket

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceFaultError
from drivers.isolation.frame_memory import FRAME_LIMIT_BYTES, FrameMemory
from drivers.isolation.wire import (
    MESSAGE_LIMIT_BYTES,
    WireError,
    decode,
    defect_message,
    encode,
    error_message,
    raised,
    receive,
)
from surfclass.errors import InputError, MissingCalibrationError
from surfclass.frames import ColourFrame, DepthFrame

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=6,
)
PLACES = st.fixed_dictionaries(
    {
        "shape": st.lists(st.integers(-2, 2**70) | st.integers(0, 50), max_size=4) | JSON,
        "pixels": st.sampled_from(["uint8", "uint16", "float64", "object"]) | JSON,
        "at": st.integers(-64, 2**70) | st.sampled_from([0, 64, FRAME_LIMIT_BYTES]) | JSON,
    }
)
FRAMES = st.fixed_dictionaries(
    {
        "frame": st.sampled_from(["colour", "depth"]) | JSON,
        "t_ns": st.integers() | JSON,
        "t_sd_ns": st.integers() | JSON,
        "sequence": st.integers() | JSON,
        "exposure_s": st.none() | JSON,
        "gain_db": st.none() | JSON,
        "images": st.lists(PLACES, max_size=3) | JSON,
    }
)


@pytest.fixture(scope="module")
def memories():
    descriptor = FrameMemory.descriptor("test")
    writing, reading = FrameMemory(descriptor, writable=True), FrameMemory(descriptor, writable=False)
    os.close(descriptor)
    yield writing, reading
    writing.close()
    reading.close()


@given(st.dictionaries(st.text(), JSON))
def test_messages_come_through_as_they_are(message):
    assert decode(encode(message)) == message


@given(st.binary(max_size=200) | st.text().map(str.encode))
def test_bytes_that_are_no_message_are_refused(data):
    with contextlib.suppress(WireError):
        assert isinstance(decode(data), dict)


@pytest.mark.parametrize(
    "message", [{"a": float("nan")}, {"a": b"b"}, {"a": {1, 2}}, {"a": "x" * MESSAGE_LIMIT_BYTES}]
)
def test_what_is_no_message_is_not_sent(message):
    with pytest.raises(WireError, match=r"JSON cannot hold|allowed are 65536"):
        encode(message)


@pytest.mark.parametrize("data", [b'{"exposure_s": NaN}', b'{"a": [-Infinity]}'])
def test_numbers_that_are_none_are_refused(data):
    with pytest.raises(WireError, match="no JSON"):
        decode(data)


def test_deep_nesting_is_refused_and_not_followed():
    with pytest.raises(WireError, match="no JSON"):
        decode(b"[" * 60_000)
    nested = {}
    for _ in range(100_000):
        nested = {"a": nested}
    with pytest.raises(WireError):
        encode(nested)


def test_the_other_side_ends_and_talks_too_long():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.send(b"{" + b" " * MESSAGE_LIMIT_BYTES + b"}")
        theirs.send(b'{"id": 1}')
        theirs.close()
        with pytest.raises(WireError, match="more than 65536 bytes"):
            receive(ours)
        assert receive(ours) == {"id": 1}
        assert receive(ours) is None


@given(st.text(), st.text(min_size=1))
def test_errors_come_through_as_they_are_or_cut(text, device):
    error = raised(decode(encode(error_message(DeviceFaultError(device, text)))), "unknown")
    assert type(error) is DeviceFaultError
    assert error.device == device[:2000].encode("utf-8", "replace").decode()
    assert str(error) == f"{error.device}: " + text[:2000].encode("utf-8", "replace").decode()


def test_an_error_that_is_more_special_than_the_known_ones_travels_as_its_next_kin():
    class BusyError(DeviceFaultError):
        pass

    assert type(raised(error_message(BusyError("colour", "busy")), "colour")) is DeviceFaultError
    assert error_message(MissingCalibrationError("x")) == {"error": "ConfigurationError", "text": "x"}
    assert error_message(KeyError("x")) is None


@given(st.dictionaries(st.sampled_from(["error", "text", "device"]), JSON))
def test_what_is_no_error_is_refused(message):
    with pytest.raises(WireError, match="an error of class"):
        raised(message, "colour")


@given(st.text(), st.text())
def test_a_defect_always_fits_a_message(text, trace):
    encode(defect_message(ValueError(text * 1000), trace * 1000))


@given(about=FRAMES)
def test_a_frame_that_is_none_is_refused_and_nothing_outside_the_memory_read(memories, about):
    with contextlib.suppress(WireError):
        assert isinstance(memories[1].read(about), ColourFrame | DepthFrame)


@pytest.mark.parametrize("key", ["frame", "t_ns", "t_sd_ns", "sequence", "exposure_s", "gain_db", "images"])
def test_a_frame_of_which_something_is_not_said_is_refused(memories, key):
    about = memories[0].write(ColourFrame(1, 2, 0.1, np.zeros((2, 3, 3), np.uint8)))
    del about[key]
    with pytest.raises(WireError, match="no frame"):
        memories[1].read(about)


def test_images_lie_beside_each_other_and_need_not_be_contiguous(memories):
    rng = np.random.default_rng(1)
    depth = rng.integers(0, 2**16, (7, 26), np.uint16)[:, ::-2]
    ir = rng.integers(0, 2**8, (9, 5), np.uint8).T
    frame = memories[1].read(memories[0].write(DepthFrame(5, 6, 0.5, depth, ir, 7)))
    assert np.array_equal(frame.depth_mm, depth)
    assert np.array_equal(frame.ir, ir)
    assert (frame.t_ns, frame.sequence, frame.exposure_s, frame.t_sd_ns) == (5, 6, 0.5, 7)


def test_a_frame_beyond_the_limit_is_refused_and_writes_nothing(memories):
    writing, reading = memories
    about = writing.write(DepthFrame(1, 1, None, np.full((4, 4), 9, np.uint16)))
    big = np.zeros((4096, 4096), np.uint16)
    with pytest.raises(
        InputError, match=r"4096 × 4096 and 4097 × 4096 pixels has 64.0 MiB, allowed are 64 MiB"
    ):
        writing.write(DepthFrame(1, 1, None, big, np.zeros((4097, 4096), np.uint16)))
    assert (reading.read(about).depth_mm == 9).all()
    writing.write(DepthFrame(1, 1, None, big, big))  # exactly the limit


def test_the_size_of_the_memory_is_sealed_and_the_readers_map_cannot_write():
    descriptor = FrameMemory.descriptor("test")
    try:
        for size in (0, FRAME_LIMIT_BYTES * 2):
            with pytest.raises(PermissionError):
                os.ftruncate(descriptor, size)
        reading = FrameMemory(descriptor, writable=False)
        with pytest.raises(ValueError, match="read-only"):
            reading.write(DepthFrame(1, 1, None, np.zeros((4, 4), np.uint16)))
        reading.close()
    finally:
        os.close(descriptor)
