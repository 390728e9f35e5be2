"""Recordings: lossless, byte-repeatable, streamed, and clear about what is wrong with a file."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from capture_values import (
    CLASSES_TOML,
    DEPTH_HEIGHT,
    DEPTH_ONLY_TOML,
    DEPTH_WIDTH,
    HEIGHT,
    PLATE_TOML,
    RIG_TOML,
    WIDTH,
    assert_same,
    capture,
    write_folder,
)
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from drivers.recordings import Recording, RecordingWriter, unix_offset_ns
from drivers.recordings.folder import read_folder
from drivers.recordings.format import METADATA, capture_images
from surfclass.errors import ConfigurationError, InputError, MissingCalibrationError
from surfclass.frames import ROLES, Capture, ColourFrame, DepthFrame

UPDATE = b"\x0a\x03abc"


def write(path: Path, captures: list[Capture], **options: Any) -> Path:
    with RecordingWriter(path, RIG_TOML, CLASSES_TOML, {"robot": "r1"}, **options) as writer:
        for one in captures:
            writer.write(one)
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write(tmp_path / "a.mcap", [capture(seed) for seed in range(3)])


def messages(path: Path) -> list[Any]:
    """All messages, read as any other MCAP program would."""
    with path.open("rb") as file:
        return list(make_reader(file).iter_messages())


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image if image.ndim == 2 else image[:, :, ::-1])[1].tobytes()


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    """A capture with any of its optional parts missing, and any numbers that a field allows."""
    seed = draw(st.integers(0, 999))
    whole = capture(
        seed, role=draw(st.sampled_from(ROLES)), name=f"{seed}" + draw(st.text("aé .-_", max_size=9))
    )
    changes: dict[str, Any] = {
        key: None
        for key in ("dark", "joints", "base_T_depth", "label", "light_level", "joint_motion_rad")
        if draw(st.booleans())
    }
    if draw(st.booleans()):
        deep = np.random.default_rng(seed).integers(0, 65536, (HEIGHT, WIDTH, 3)).astype(np.uint16)
        exposure = draw(st.none() | st.floats(1e-300, 1e300))
        changes["colour"] = ColourFrame(
            draw(st.integers(0, 2**61)), draw(st.integers(0, 2**63)), exposure, deep
        )
    elif draw(st.booleans()):
        changes |= {"colour": None, "dark": None, "label": None}
    changes["skew_ns"] = draw(st.integers(-(2**62), 2**62))
    return capture(seed, **{"name": whole.name, "role": whole.role, **changes})


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(captures(), max_size=3, unique_by=lambda one: one.name), st.randoms(use_true_random=False))
def test_what_is_written_is_read(tmp_path: Path, written: list[Capture], random: Any) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, RIG_TOML, CLASSES_TOML) as writer:
        for one in written:
            images = {kind: png(image) for kind, image in capture_images(one).items()}
            writer.write(one, {kind: data for kind, data in images.items() if random.random() < 0.5})
    found = Recording.open(path)
    assert len(found) == len(written)
    for one, other in zip(found.captures(), written, strict=True):
        assert_same(one, other)


def test_texts_and_metadata_travel_with_it(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [capture()], plate_text=PLATE_TOML, unix_offset_ns=123)
    found = Recording.open(path)
    assert (found.rig_text, found.classes_text, found.plate_text) == (RIG_TOML, CLASSES_TOML, PLATE_TOML)
    assert found.rig.name == "bench"
    assert found.classes is not None
    assert found.classes.names == ("rusted", "blasted")
    assert found.plate is not None
    assert found.plate.disc_radius_m == 0.018
    assert (found.metadata, found.unix_offset_ns) == ({"robot": "r1"}, 123)


def test_a_set_without_colour(tmp_path: Path) -> None:
    one = capture(0, role="hand_eye", colour=None, dark=None, label=None)
    with RecordingWriter(tmp_path / "a.mcap", DEPTH_ONLY_TOML, None, plate_text=PLATE_TOML) as writer:
        writer.write(one)
    found = Recording.open(tmp_path / "a.mcap")
    assert_same(next(found.captures()), one)
    with pytest.raises(MissingCalibrationError, match=r"\[rgb\] and transforms\.rgb_T_depth are missing"):
        _ = found.rig


@pytest.mark.parametrize("rig", [DEPTH_ONLY_TOML, RIG_TOML.split("[transforms]")[0]])
def test_a_set_to_calibrate_the_colour_camera_from(tmp_path: Path, rig: str) -> None:
    some = [capture(seed, role="board") for seed in range(2)]
    with RecordingWriter(tmp_path / "a.mcap", rig, CLASSES_TOML) as writer:
        for one in some:
            writer.write(one)
    found = Recording.open(tmp_path / "a.mcap")
    for one, other in zip(found.captures(), some, strict=True):
        assert_same(one, other)
    with pytest.raises(MissingCalibrationError, match=r"transforms\.rgb_T_depth"):
        _ = found.rig


def test_a_capture_of_an_unknown_colour_camera_has_one_size(tmp_path: Path) -> None:
    one = capture(0, dark=ColourFrame(0, 0, None, np.zeros((WIDTH, HEIGHT, 3), np.uint8)))
    with (
        RecordingWriter(tmp_path / "a.mcap", DEPTH_ONLY_TOML, CLASSES_TOML) as writer,
        pytest.raises(InputError, match="c000: dark image is 6 × 8, its colour image is 8 × 6"),
    ):
        writer.write(one)


def test_texts_with_a_byte_order_mark_travel_as_they_stand(tmp_path: Path) -> None:
    texts = ["\ufeff" + text for text in (RIG_TOML, CLASSES_TOML, PLATE_TOML)]
    with RecordingWriter(tmp_path / "a.mcap", texts[0], texts[1], plate_text=texts[2]) as writer:
        writer.write(capture(0))
    found = Recording.open(tmp_path / "a.mcap")
    assert [found.rig_text, found.classes_text, found.plate_text] == texts
    assert found.rig.name == "bench"


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_imported_bytes_are_kept_verbatim(tmp_path: Path, suffix: str) -> None:
    folder = read_folder(write_folder(tmp_path / "set", [capture(0), capture(1)], suffix))
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, folder.rig_text, folder.classes_text) as writer:
        for one, encoded in folder.captures():
            writer.write(one, encoded)
    stored = [message.data for _, _, message in messages(path)]
    for file in sorted((tmp_path / "set").glob(f"*/*{suffix}")):
        assert any(file.read_bytes() in message for message in stored), file
    for one, (other, _) in zip(Recording.open(path).captures(), folder.captures(), strict=True):
        assert_same(one, other)


def test_the_same_captures_give_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = [capture(seed) for seed in range(4)]
    first = write(tmp_path / "a.mcap", some).read_bytes()
    monkeypatch.setattr("drivers.recordings.file.SYNC_S", 0.0)  # another rhythm of the disk
    assert write(tmp_path / "b.mcap", some).read_bytes() == first
    assert write(tmp_path / "c.mcap", some[:3]).read_bytes() != first


def test_captures_are_read_one_at_a_time(tmp_path: Path) -> None:
    count, shape = 12, (400, 500)
    rig = RIG_TOML.replace(f"[{DEPTH_WIDTH}, {DEPTH_HEIGHT}]", str([shape[1], shape[0]]))
    noise = np.random.default_rng(0).integers(0, 65536, (count, *shape)).astype(np.uint16)
    with RecordingWriter(tmp_path / "a.mcap", rig, CLASSES_TOML) as writer:
        for seed in range(count):
            writer.write(capture(seed, depth=DepthFrame(seed, seed, None, noise[seed])))
    found = Recording.open(tmp_path / "a.mcap")
    tracemalloc.start()
    try:
        assert sum(1 for _ in found.captures()) == count
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # Packed chunk, unpacked chunk, message, image, and the capture before.
    assert peak < 6.5 * noise[0].nbytes < noise.nbytes


def test_roles_are_picked(tmp_path: Path) -> None:
    roles = ["train", "map", "test", "map"]
    path = write(tmp_path / "a.mcap", [capture(seed, role=role) for seed, role in enumerate(roles)])
    found = Recording.open(path)
    assert [one.name for one in found.captures("map")] == ["c001", "c003"]
    assert [one.name for one in found.captures({"map", "train"})] == ["c000", "c001", "c003"]
    with pytest.raises(InputError, match="role 'tset', allowed: train, test"):
        found.captures("tset")


def test_times_are_unix_times_and_captures_keep_the_monotonic_ones(tmp_path: Path) -> None:
    offset = unix_offset_ns()
    path = write(tmp_path / "a.mcap", [capture(0)], unix_offset_ns=offset)
    times = {channel.topic: message.log_time for _, channel, message in messages(path)}
    one = next(Recording.open(path).captures())
    assert times["/colour"] == times["/capture"] == one.t_ns + offset
    assert times["/depth"] == one.depth.t_ns + offset
    assert 1_700_000_000e9 < times["/colour"] < 5_000_000_000e9


def test_offset_is_between_the_two_clocks() -> None:
    assert abs(time.monotonic_ns() + unix_offset_ns() - time.time_ns()) < 50_000_000


def test_map_updates_travel_beside_the_captures(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, RIG_TOML, CLASSES_TOML, map_schema=b"") as writer:
        for seed in range(2):
            writer.write(capture(seed))
            writer.write_update(UPDATE + bytes([seed]), 5)
    found = Recording.open(path)
    assert list(found.updates()) == [UPDATE + b"\0", UPDATE + b"\1"]
    assert [one.name for one in found.captures()] == ["c000", "c001"]
    with (
        RecordingWriter(tmp_path / "b.mcap", RIG_TOML, CLASSES_TOML) as writer,
        pytest.raises(ConfigurationError, match="map_schema"),
    ):
        writer.write_update(UPDATE, 5)


def test_other_tools_find_standard_messages(recording: Path) -> None:
    schemas = {channel.topic: schema.name for schema, channel, _ in messages(recording) if schema}
    assert schemas == {
        **{f"/{kind}": "foxglove.RawImage" for kind in ("depth", "ir", "colour", "dark", "label")},
        "/joints": "foxglove.JointStates",
        "/capture": "surfclass.Capture",
    }


REFUSED: dict[str, tuple[Callable[[RecordingWriter], None], str]] = {
    "size": (
        lambda w: w.write(
            capture(9, colour=ColourFrame(0, 0, None, np.zeros((9, 9, 3), np.uint8)), dark=None, label=None)
        ),
        r"capture c009: colour image is 9 × 9, rig bench says 8 × 6",
    ),
    "name": (lambda w: w.write(capture(0)), "capture c000: .* has one of that name"),
    "label": (
        lambda w: w.write(capture(9, label=np.full((6, 8), 3, np.uint8))),
        "label 3, allowed are 0 to 2",
    ),
    "other pixels": (
        lambda w: w.write(capture(9), {"depth": png(capture(8).depth.depth_mm)}),
        "capture c009, depth image: the encoded image has other pixels",
    ),
    "unknown image": (
        lambda w: w.write(capture(9, ir=None) if False else capture(9), {"iir": b""}),
        "encoded 'iir'",
    ),
    "not an image": (lambda w: w.write(capture(9), {"depth": b"x"}), "not an image that is understood"),
    "time": (
        lambda w: w.write(capture(9, colour=ColourFrame(-5, 0, None, np.zeros((6, 8, 3), np.uint8)))),
        "capture c009, colour image: at -5 ns of Unix time",
    ),
}


@pytest.mark.parametrize(("fault", "message"), REFUSED.values(), ids=REFUSED)
def test_a_refused_capture_leaves_nothing_and_stops_nothing(
    tmp_path: Path, fault: Callable[[RecordingWriter], None], message: str
) -> None:
    with RecordingWriter(tmp_path / "a.mcap", RIG_TOML, CLASSES_TOML) as writer:
        writer.write(capture(0))
        with pytest.raises(InputError, match=message):
            fault(writer)
        writer.write(capture(1))
    plain = tmp_path / "b.mcap"
    with RecordingWriter(plain, RIG_TOML, CLASSES_TOML) as writer:
        writer.write(capture(0))
        writer.write(capture(1))
    assert (tmp_path / "a.mcap").read_bytes() == plain.read_bytes()


def test_a_writer_needs_valid_texts(tmp_path: Path) -> None:
    for rig, classes, options in (
        ("schema = 3", CLASSES_TOML, {}),
        (RIG_TOML, "names = 1", {}),
        (RIG_TOML, CLASSES_TOML, {"plate_text": "x = 1"}),
        (RIG_TOML, CLASSES_TOML, {"metadata": {"schema": "2"}}),
    ):
        with pytest.raises(ConfigurationError, match=r"a\.mcap"):
            RecordingWriter(tmp_path / "a.mcap", rig, classes, **options)
    with pytest.raises(InputError, match="there is no folder"):
        RecordingWriter(tmp_path / "none" / "a.mcap", RIG_TOML, CLASSES_TOML)
    assert list(tmp_path.iterdir()) == []


def test_a_discarded_recording_leaves_the_old_one(recording: Path) -> None:
    before = recording.read_bytes()
    writer = RecordingWriter(recording, RIG_TOML, CLASSES_TOML)
    writer.write(capture(7))
    writer.discard()
    writer.close()
    assert recording.read_bytes() == before
    assert list(recording.parent.iterdir()) == [recording]


def test_an_exception_keeps_what_was_recorded(tmp_path: Path) -> None:
    def record() -> None:
        with RecordingWriter(tmp_path / "a.mcap", RIG_TOML, CLASSES_TOML) as writer:
            writer.write(capture(0))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        record()
    assert len(Recording.open(tmp_path / "a.mcap")) == 1


def other_mcap(metadata: dict[str, str] | None) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start("ros2")
            schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
            channel = writer.register_channel("/camera", "cdr", schema)
            if metadata is not None:
                writer.add_metadata(METADATA, metadata)
            writer.add_message(channel, 1, b"abc", 1)
            finish: Callable[[], None] = writer.finish
            finish()

    return make


def changed(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(change(path.read_bytes())) and None


NOT_A_RECORDING: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: path.unlink(), "no such file$"),
    "unfinished": (
        lambda path: path.rename(f"{path}.active"),
        r"did not finish: run `surfclass recover .*a\.mcap\.active`",
    ),
    "empty": (lambda path: path.write_bytes(b""), "an empty file; there is nothing to recover"),
    "garbage": (lambda path: path.write_bytes(bytes(range(256)) * 50), "not an MCAP file"),
    "cut": (changed(lambda data: data[: len(data) // 2]), "unfinished: .*run `surfclass recover"),
    "cut by a byte": (changed(lambda data: data[:-1]), "unfinished"),
    "only magic": (changed(lambda data: data[:8]), "damaged|unfinished"),
    "magic twice": (changed(lambda data: data[:8] * 2), "damaged"),
    "rig": (
        changed(lambda data: data.replace(b"voxel_size_m", b"voxel_size_n", 1)),
        r"its rig\.toml is not what was written",
    ),
    "other program": (
        other_mcap(None),
        r"not a surfclass recording: no metadata 'surfclass\.recording', topics /camera",
    ),
    "other schema": (other_mcap({"schema": "9"}), "recording schema '9', allowed is '1'"),
    "no rig": (other_mcap({"schema": "1"}), r"its rig\.toml is missing"),
}


@pytest.mark.parametrize(("spoil", "message"), NOT_A_RECORDING.values(), ids=NOT_A_RECORDING)
def test_what_is_no_recording_is_said_to_be_none(
    recording: Path, spoil: Callable[[Path], object], message: str
) -> None:
    spoil(recording)
    with pytest.raises(InputError, match=message) as caught:
        Recording.open(recording)
    assert str(recording) in str(caught.value)


def test_a_folder_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a folder; .*surfclass import"):
        Recording.open(tmp_path)


@settings(deadline=None, max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
@example(where=0.9465791330929775, flip=3)  # in the index: one chunk seemed to hold no capture
def test_a_flipped_byte_is_noticed_or_harmless(recording: Path, where: float, flip: int) -> None:
    data = bytearray(recording.read_bytes())
    data[int(where * len(data))] ^= flip
    damaged = recording.with_name("damaged.mcap")
    damaged.write_bytes(data)
    try:
        found = list(Recording.open(damaged).captures())
    except InputError:
        return
    for one, seed in zip(found, range(3), strict=True):
        assert_same(one, capture(seed))


def test_real_sets_survive(shared: Path, tmp_path: Path) -> None:
    for name in ("kitchen", "hand_eye_discs"):
        folder = read_folder(shared / "data" / name)
        path = tmp_path / f"{name}.mcap"
        with RecordingWriter(
            path, folder.rig_text, folder.classes_text, plate_text=folder.plate_text
        ) as writer:
            for one, encoded in folder.captures():
                writer.write(one, encoded)
        for one, (other, _) in zip(Recording.open(path).captures(), folder.captures(), strict=True):
            assert_same(one, other)
