"""`.oni` files: recorded from a virtual Kinect through the runtime's own recorder, and played back equal."""

import itertools
import time

import numpy as np
import pytest
from openni2_cells import Counting

from drivers import depth_openni2
from drivers.clock import SystemClock
from drivers.depth_openni2 import record_oni
from drivers.emulators.virtual_kinect import VirtualKinect
from drivers.errors import DeviceFaultError, DeviceNotFoundError, DriverError
from drivers.openni2 import build, plugins, record
from drivers.openni2.errors import PluginMissingError
from surfclass.errors import InputError

try:
    plugins.find("OniFile")
    build.build("virtual")
except PluginMissingError as missing:
    pytest.skip(str(missing), allow_module_level=True)

EXPOSURES = 12


def player(path, isolated=False):
    make = depth_openni2.depth if isolated else depth_openni2.in_process
    return make(name="depth", clock=SystemClock(), options={"file_path": str(path)}, shared={})


def played(path):
    """All frames of a file, and what the driver says at its end."""
    frames = []

    def play_on(opened):
        while True:
            frames.append(opened.grab(time.monotonic_ns(), 5.0, with_ir=True))

    with player(path) as opened:
        with pytest.raises(DeviceFaultError) as ended:
            play_on(opened)
        status = opened.about()["status"]
        with pytest.raises(DeviceFaultError, match="ended"):
            opened.grab(time.monotonic_ns(), 5.0)
    return frames, str(ended.value), status


@pytest.fixture(scope="module", params=["1mm", "100um"])
def recording(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    with VirtualKinect(Counting((160, 120)), folder / "kinect") as kinect:
        options = {"device": kinect.uri, "depth_unit": request.param}
        count = record_oni("depth", options, folder / "a.oni", EXPOSURES)
    assert [path.name for path in folder.iterdir()] == ["a.oni"]
    return folder / "a.oni", count


def test_what_was_recorded_plays_back_bit_by_bit_in_order_to_the_end(recording):
    path, count = recording
    frames, end, status = played(path)
    assert len(frames) == count >= EXPOSURES
    assert f"ended after {count} exposures" in end
    assert status == f"{count} of {count} exposures played"
    # The file numbers its frames from 1; which exposure it was, the image tells.
    numbers = [int(frame.ir[0, 0]) for frame in frames]
    assert np.all(np.diff(numbers) > 0)
    for number, frame in zip(numbers, frames, strict=True):
        depth, ir = Counting((160, 120)).depth(0, number)
        assert np.array_equal(frame.depth_mm, depth)
        assert np.array_equal(frame.ir, ir)


def test_a_recording_plays_the_same_each_time(recording):
    first, second = (played(recording[0])[0] for _ in range(2))
    assert [frame.sequence for frame in first] == list(range(1, len(first) + 1))
    assert [frame.sequence for frame in second] == list(range(1, len(second) + 1))
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one.depth_mm, other.depth_mm)
        assert np.array_equal(one.ir, other.ir)


def test_played_frames_are_of_the_time_that_was_asked_for(recording):
    with player(recording[0], isolated=True) as opened:
        for ahead_ns in (0, 50_000_000):
            asked_ns = time.monotonic_ns() + ahead_ns
            frame = opened.grab(asked_ns, 5.0)
            assert asked_ns <= frame.t_ns <= time.monotonic_ns()
        about = opened.about()
    assert "160 × 120 at 30 Hz" in about["format"]
    assert "58.12° × 45.25°" in about["format"]
    assert about["address"] == str(recording[0])


@pytest.mark.parametrize("content", [b"", b"not a recording", b"NI10" + b"\0" * 100])
def test_a_file_that_is_no_recording_is_refused(tmp_path, content):
    path = tmp_path / "bad.oni"
    path.write_bytes(content)
    for isolated in (False, True) if content[:4] != b"NI10" else (True,):  # the player may crash on it
        opened = player(path, isolated)
        with pytest.raises(DriverError):
            opened.open()
        assert not opened.is_open


def test_a_recording_that_was_cut_off_ends_in_an_error_of_the_driver(recording, tmp_path):
    whole = recording[0].read_bytes()
    path = tmp_path / "cut.oni"
    path.write_bytes(whole[: len(whole) // 3])
    opened = player(path, isolated=True)

    def play_all():
        with opened:
            for _ in range(recording[1] + 1):
                opened.grab(time.monotonic_ns(), 2.0, with_ir=True)

    with pytest.raises(DriverError):
        play_all()
    assert not opened.is_open


def test_a_missing_recording_is_not_found(tmp_path):
    with pytest.raises(DeviceNotFoundError):
        player(tmp_path / "none.oni").open()


def test_a_recording_that_is_not_as_seen_is_made_again_and_then_given_up(tmp_path, monkeypatch):
    original, attempts = record._read_back, []

    def shifted(*arguments):
        attempts.append(1)
        sums = original(*arguments)
        return [(depth, ir) for (depth, _), (_, ir) in itertools.pairwise(sums)]

    monkeypatch.setattr(record, "_read_back", shifted)
    path = tmp_path / "a.oni"
    path.write_bytes(b"the one before")
    with VirtualKinect(Counting(), tmp_path / "kinect") as kinect:
        with pytest.raises(DriverError, match="not as seen"):
            record_oni("depth", {"device": kinect.uri}, path, 3)
        assert len(attempts) == 3
        kinect.mute(True)
        with pytest.raises(DriverError, match="stay away"):
            record_oni("depth", {"device": kinect.uri}, path, 3, timeout_s=0.5)
    assert path.read_bytes() == b"the one before"
    assert [each.name for each in tmp_path.iterdir()] == ["a.oni"]


def test_what_cannot_be_recorded_is_refused(tmp_path):
    for exposures, timeout_s, options in ((0, 1.0, {}), (1, 0.0, {}), (1, 1.0, {"file_path": "a.oni"})):
        with pytest.raises(InputError):
            record_oni("depth", options, tmp_path / "a.oni", exposures, timeout_s)
    with pytest.raises(DeviceNotFoundError):
        record_oni("depth", {"device": f"virtual://{tmp_path}/none"}, tmp_path / "a.oni", 1)
