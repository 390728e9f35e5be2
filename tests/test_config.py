import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.config import Config, load_config
from surfclass.errors import ConfigurationError

EXAMPLE = Path(__file__).parents[1] / "systemd" / "surfclass.toml"
SMALL = """
rig = "rig.toml"
model = "models/m.npz"
[colour]
backend = "sim"
exposure_us = 8000
[depth]
backend = "sim"
"""


@pytest.fixture
def file(tmp_path):
    def write(text=SMALL):
        path = tmp_path / "surfclass.toml"
        path.write_text(text)
        return path

    return write


def test_example_is_valid_and_its_comments_are_the_defaults():
    load_config(EXAMPLE)
    text = EXAMPLE.read_text()
    # Every commented-out key, put into force, must change nothing.
    spelt_out = re.sub(r"^# (?=[a-z_]+ = )", "", text, flags=re.MULTILINE)
    lines = [line for line in spelt_out.splitlines() if not re.match(r"interval_s|viewpoints", line)]
    full, base = (tomllib.loads(toml) for toml in ("\n".join(lines), text))
    assert len(str(full)) > len(str(base)) + 300  # the pattern above did find them
    assert Config.model_validate(full) == Config.model_validate(base)


def test_byte_order_mark_changes_nothing(file):
    path = file()
    plain = load_config(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_config(path) == plain


def test_paths_start_at_the_file(file, tmp_path):
    config = load_config(file(SMALL.replace("[colour]", '[recording]\ndirectory = "rec"\n[colour]', 1)))
    assert config.rig == tmp_path / "rig.toml"
    assert config.model == tmp_path / "models" / "m.npz"
    assert config.recording.directory == tmp_path / "rec"
    absolute = load_config(file(), ["model=/x/m.npz"])
    assert absolute.model == Path("/x/m.npz")


def test_replay_starts_at_the_working_directory(file, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    config = load_config(None, ["model=m.npz"], replay=Path("a.mcap"))
    assert config.replay == tmp_path / "here" / "a.mcap"
    assert config.model == tmp_path / "here" / "m.npz"
    assert config.rig is None


def test_device_options_are_kept_for_the_driver(file):
    config = load_config(file(), ["colour.gain=2", "colour.port=/dev/x"])
    assert config.colour.options == {"exposure_us": 8000, "gain": 2, "port": "/dev/x"}
    assert config.simulated


def test_override_makes_tables_and_takes_toml_or_a_word(file):
    config = load_config(
        file(),
        ["trigger.interval_s=2.5", 'zenoh.listen=["tcp/0.0.0.0:1"]', "robot=left_arm", "capture.dark=true"],
    )
    assert config.trigger.interval_s == 2.5
    assert config.zenoh.listen == ("tcp/0.0.0.0:1",)
    assert config.robot == "left_arm"
    assert config.capture.dark is True


def test_all_faults_are_told_at_once_with_path_and_nearest_key(file):
    text = (
        SMALL
        + '[limits]\nwaiting_capture = 3\nrequest_s = -1\n[trigger]\ninterval_s = "5"\n[capture]\ndark = 1\n'
    )
    with pytest.raises(ConfigurationError) as caught:
        load_config(file(text))
    message = str(caught.value)
    assert "limits.waiting_capture: unknown key; did you mean 'waiting_captures'?" in message
    for path in ("limits.request_s", "trigger.interval_s", "capture.dark"):
        assert f"{path}: " in message


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("schema=2", "unknown schema"),
        ("robot=Left Arm", "robot"),
        ("trigger.rest={}", "needs an [arm]"),
        ("depth.backend=kinect", "share one world"),
        ("zenoh.mode=client", "needs a `connect`"),
        ("zenoh.listen=['nonsense']", "zenoh.listen"),
        ("limits.device_s=5", "taken for a hang"),
        ("model", "allowed is table.key=value"),
        ("robot.x=1", "not a table"),
        ("recording.part_mb=100", "recording.directory: missing"),
        ("capture.level=1.5", "capture.level"),
    ],
)
def test_what_cannot_work_is_refused(file, override, says):
    overrides = ["robot=r", override] if override == "robot.x=1" else [override]
    with pytest.raises(ConfigurationError, match=re.escape(says)):
        load_config(file(), overrides)


def test_interval_and_rest_exclude_each_other(file):
    text = SMALL + '[arm]\nbackend = "sim"\n[trigger]\ninterval_s = 1.0\n[trigger.rest]\n'
    with pytest.raises(ConfigurationError, match="exclude each other"):
        load_config(file(text))


@pytest.mark.parametrize(
    ("left_out", "says"),
    [("rig", "rig is missing"), ("model", "model: missing"), ("depth", r"no \[depth\] table")],
)
def test_what_is_missing_is_named(file, left_out, says):
    lines = SMALL.split("[depth]")[0] if left_out == "depth" else re.sub(f"(?m)^{left_out}.*$", "", SMALL)
    with pytest.raises(ConfigurationError, match=says):
        load_config(file(lines))


def test_file_that_is_none(tmp_path, file):
    with pytest.raises(ConfigurationError, match=r"absent\.toml: cannot be read"):
        load_config(tmp_path / "absent.toml")
    with pytest.raises(ConfigurationError, match=r"not a TOML file: .*line 1"):
        load_config(file("robot = = 1"))
    path = file()
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigurationError, match="not a TOML file"):
        load_config(path)


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=60))
def test_any_override_is_taken_or_refused_in_words(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "fuzz.toml"
    path.write_text(SMALL)
    try:
        load_config(path, [text])
    except ConfigurationError as error:
        assert str(error)  # noqa: PT017 - either outcome is right; anything but this error is not
