"""What a kill, a full disk or a cut leaves of a recording can be made a whole recording again."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from capture_values import CLASSES_TOML, RIG_TOML, assert_same, capture
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from drivers.recordings import Recording, RecordingWriter, recover
from surfclass.errors import InputError

HERE = Path(__file__).parent

KILLED = """
import sys
from capture_values import CLASSES_TOML, RIG_TOML, capture
from drivers.recordings import RecordingWriter
writer = RecordingWriter(sys.argv[1], RIG_TOML, CLASSES_TOML, {"robot": "r1"}, map_schema=b"")
for seed in range(100_000):
    writer.write(capture(seed))
    writer.write_update(bytes([seed % 256]), seed)
    print(seed, flush=True)
"""

FULL_DISK = """
import resource, signal, sys
from capture_values import CLASSES_TOML, RIG_TOML, capture
from drivers.recordings import RecordingWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
with RecordingWriter(sys.argv[1], RIG_TOML, CLASSES_TOML) as writer:
    for seed in range(100_000):
        writer.write(capture(seed))
        print(seed, flush=True)
"""


def start(program: str, path: Path) -> subprocess.Popen[str]:
    search = os.pathsep.join([str(HERE), str(HERE.parent)])
    return subprocess.Popen(
        [sys.executable, "-c", program, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": search},
    )


def write(path: Path, count: int, updates: bool = False) -> Path:
    with RecordingWriter(path, RIG_TOML, CLASSES_TOML, {"robot": "r1"}, map_schema=b"") as writer:
        for seed in range(count):
            writer.write(capture(seed))
            if updates:
                writer.write_update(bytes([seed % 256]), seed)
    return path


@pytest.fixture
def killed(tmp_path: Path) -> tuple[Path, int]:
    """A recording whose writer was killed at full speed, and how many captures it had reported."""
    path = tmp_path / "a.mcap"
    with start(KILLED, path) as process:
        assert process.stdout is not None
        for _ in range(25):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
        process.communicate()
    return path, 25 + len(rest)


def test_a_kill_loses_nothing_that_was_reported(killed: tuple[Path, int], tmp_path: Path) -> None:
    path, reported = killed
    assert not path.exists()
    active = path.with_name("a.mcap.active")
    with pytest.raises(InputError, match=r"unfinished: .*surfclass recover .*a\.mcap\.active"):
        Recording.open(active)
    assert recover(active) == path
    assert not active.exists()
    found = Recording.open(path)
    assert reported <= len(found) <= reported + 1
    for seed, one in enumerate(found.captures()):
        assert_same(one, capture(seed))
    updates = list(found.updates())
    assert reported <= len(updates) <= len(found)
    # It is the very file that an orderly end would have left.
    if len(updates) == len(found):
        assert path.read_bytes() == write(tmp_path / "b.mcap", len(found), updates=True).read_bytes()


def test_a_full_disk_surfaces_and_keeps_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with start(FULL_DISK, path) as process:
        out, err = process.communicate()
    assert process.returncode == 1
    assert "OSError: [Errno 27] recording stopped (File too large)" in err
    assert err.count("\nOSError:") == 2  # the cause and what it became; closing adds no third
    assert not path.exists()
    reported = len(out.split())
    assert reported > 2
    saved = len(Recording.open(recover(path.with_name("a.mcap.active"))))
    assert saved in (reported, reported + 1)  # the last one may lack its index only


def test_after_a_disk_error_nothing_more_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    writer = RecordingWriter(tmp_path / "a.mcap", RIG_TOML, CLASSES_TOML)
    writer.write(capture(0))
    monkeypatch.setattr("drivers.recordings.file.os.fsync", refuse)
    with pytest.raises(OSError, match=r"recording stopped.*a\.mcap\.active"):
        writer.sync()
    with pytest.raises(ValueError, match="the recording is closed"):
        writer.write(capture(1))
    writer.close()
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap.active"]


WHOLE = 4


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write(tmp_path_factory.mktemp("whole") / "a.mcap", WHOLE).read_bytes()


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(part=st.floats(0, 1))
@example(part=0.0)
@example(part=1.0)
def test_wherever_it_is_cut_the_whole_captures_before_are_saved(
    tmp_path: Path, whole: bytes, part: float
) -> None:
    keep = int(part * len(whole))
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:keep])
    target = tmp_path / "cut.recovered.mcap"
    head = whole.index(b"lz4") - 40  # before the first chunk lie the rig and the classes
    if keep < head:
        with pytest.raises(InputError):
            recover(path)
        assert list(tmp_path.iterdir()) == [path]
        return
    assert recover(path) == target
    assert path.read_bytes() == whole[:keep]
    found = list(Recording.open(target).captures())
    target.unlink()
    for seed, one in enumerate(found):
        assert_same(one, capture(seed))
    # Only the capture that was cut is missing: the next one's chunk follows, or the summary.
    starts = [place.start() for place in re.finditer(b"lz4", whole)][:WHOLE]
    assert len(found) >= sum(start + 3 < keep for start in starts) - 1
    assert len(found) == WHOLE or keep < len(whole)


def test_a_damaged_chunk_costs_its_capture_only(tmp_path: Path, whole: bytes) -> None:
    place = -1
    for _ in range(3):
        place = whole.index(b"lz4", place + 1)
    data = bytearray(whole)
    data[place + 200] ^= 0xFF
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"damaged .*surfclass recover"):
        list(Recording.open(path).captures())
    names = [one.name for one in Recording.open(recover(path)).captures()]
    assert names == ["c000", "c001", "c003"]


def test_a_recording_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", RIG_TOML, CLASSES_TOML)
    writer.write(capture(0))
    active = tmp_path / "a.mcap.active"
    with pytest.raises(InputError, match="is being written"):
        recover(active)
    with pytest.raises(InputError, match="already there: it is being written, or a crash left it"):
        RecordingWriter(tmp_path / "a.mcap", RIG_TOML, CLASSES_TOML)
    writer.close()
    assert len(Recording.open(tmp_path / "a.mcap")) == 1


def test_a_crash_that_was_not_recovered_is_never_overwritten(killed: tuple[Path, int]) -> None:
    path, _ = killed
    active = path.with_name("a.mcap.active")
    before = active.read_bytes()
    with pytest.raises(InputError, match=r"run `surfclass recover .*a\.mcap\.active`, or delete it"):
        RecordingWriter(path, RIG_TOML, CLASSES_TOML)
    assert active.read_bytes() == before
    path.write_bytes(b"another recording")
    with pytest.raises(InputError, match=r"a\.mcap: already there; move it away"):
        recover(active)
    assert active.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "an empty file"), (b"nonsense" * 9, "not an MCAP file"), (None, "no such file")],
)
def test_nothing_to_recover(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "a.mcap.active"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        recover(path)
    assert not (tmp_path / "a.mcap").exists()
