"""The commands around the service, run for real on the simulated cell: check, capture, run, watch, replay."""

import json
import re
import time

import numpy as np
import pytest
from cli_site import (
    CLASSES,
    ended,
    endpoint_in,
    running,
    state_of,
    surfclass,
    terminated,
)

from daemon.console import MapClient
from daemon.transport import RefusedError, TransportError, ask, open_session
from drivers.recordings import Recording
from surfclass.map_file import from_npz_bytes


def connected(endpoint, service, log):
    """A session with the service, as soon as it listens."""
    until = time.monotonic() + 60
    while True:
        try:
            return open_session("client", connect=[endpoint])
        except TransportError:
            assert service.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.1)


@pytest.fixture(scope="module")
def served(commissioned, tmp_path_factory):
    """What a service leaves that mapped three viewpoints and two requests, and then was told to stop."""
    folder = tmp_path_factory.mktemp("served")
    configuration = commissioned.configuration(folder)
    endpoint, log, watched = endpoint_in(folder), folder / "run.log", folder / "watch.log"
    watch = ("--connect", endpoint, "--robot", "cell", "--map", "console.npz", "--json", "console.json")
    with (
        running(log, "run", "--config", configuration, cwd=folder) as service,
        running(watched, "watch", *watch, "--captures", 5, "--timeout-s", 90, cwd=folder) as console,
    ):
        with connected(endpoint, service, log) as session, MapClient(session, "cell") as client:
            client.wait_until(sequence=3, timeout_s=60)  # the arm has visited its viewpoints, and stays
            answers = [
                ask(session, "cell", "capture", {"name": "asked", "dark": True}),
                ask(session, "cell", "capture"),
            ]
            with pytest.raises(RefusedError, match="there is a capture asked already"):
                ask(session, "cell", "capture", {"name": "asked"})
        ended(console, watched)
        terminated(service, log)
    (recording,) = (folder / "recordings").iterdir()
    return folder, recording, answers


class TestRun:
    def test_a_request_is_answered_with_what_became_of_it(self, served):
        _, _, (asked, numbered) = served
        assert (asked["name"], asked["sequence"], asked["recorded"]) == ("asked", 4, True)
        assert (numbered["name"], numbered["sequence"]) == ("000004", 5)
        assert asked["voxels"] <= numbered["voxels"]
        assert 0 < asked["touched"] < asked["voxels"]
        assert {"capture", "record", "process", "publish"} <= set(asked["stage_ms"])

    def test_sigterm_leaves_a_whole_recording(self, served):
        folder, path, _ = served
        assert re.fullmatch(r"cell-\d{8}T\d{6}Z-001\.mcap", path.name)
        recording = Recording.open(path)
        captures = {capture.name: capture for capture in recording.captures()}
        assert list(captures) == ["000001", "000002", "000003", "asked", "000004"]
        assert [name for name, capture in captures.items() if capture.dark is not None] == ["asked"]
        assert all(capture.joints is not None for capture in captures.values())
        assert recording.classes.names == CLASSES
        assert not list(folder.rglob("*.active"))
        assert not list(folder.rglob("*.part"))

    def test_replaying_the_recording_gives_the_services_map(self, served, commissioned, tmp_path):
        folder, recording, (_, last) = served
        arguments = ("--model", commissioned.model, "--map", tmp_path / "replayed.npz")
        surfclass("replay", recording, *arguments, cwd=tmp_path)
        daemon = (folder / "daemon.npz").read_bytes()
        assert (tmp_path / "replayed.npz").read_bytes() == daemon
        found = from_npz_bytes(daemon, "daemon.npz")
        assert len(found.layers.index) == last["voxels"] > 1000
        assert found.classes == CLASSES
        assert (found.layers.p.argmax(axis=1) > 0).any()

    def test_the_console_had_the_services_map(self, served):
        folder, *_ = served
        assert (folder / "console.npz").read_bytes() == (folder / "daemon.npz").read_bytes()
        told = json.loads((folder / "console.json").read_text())
        assert (told["state"], told["sequence"], told["gaps"]) == ("live", 5, 0)
        assert told["status"]["counts"]["recorded"] == 5

    def test_the_service_on_its_own_recording_makes_the_same_map(self, served, commissioned, tmp_path):
        folder, recording, _ = served
        configuration, log = commissioned.configuration(tmp_path), tmp_path / "run.log"
        run = ("run", "--config", configuration, "--from", recording, "--exit-when-done")
        with running(log, *run, cwd=tmp_path) as service:
            ended(service, log)
        assert (tmp_path / "daemon.npz").read_bytes() == (folder / "daemon.npz").read_bytes()
        assert not (tmp_path / "recordings").exists()

    def test_other_evidence_gives_another_map(self, served, commissioned, tmp_path):
        """Or the comparisons above would say nothing about the settings."""
        folder, recording, _ = served
        arguments = ("--model", commissioned.model, "--map", "other.npz", "--pool", "linear")
        surfclass("replay", recording, *arguments, cwd=tmp_path)
        assert (tmp_path / "other.npz").read_bytes() != (folder / "daemon.npz").read_bytes()

    def test_a_wrong_file_ends_it_with_78_before_anything_is_written(self, commissioned, tmp_path):
        configuration = commissioned.configuration(tmp_path)
        before = state_of(tmp_path)
        for setting, said in (
            ("model=absent.npz", "absent.npz: cannot read the model: No such file or directory"),
            (f"model={configuration}", "surfclass.toml: not a surfclass model"),
            ("map=absent/map.npz", "map: there is no folder"),
            ("recording.directory=surfclass.toml", "recording.directory"),
        ):
            done = surfclass("run", "-c", configuration, "--set", setting, cwd=tmp_path, code=78)
            assert said in done.stderr
            assert done.stderr.startswith("surfclass: ")
            assert done.stderr.count("\n") == 1
        assert state_of(tmp_path) == before

    def test_an_address_in_use_ends_it_with_69(self, commissioned, tmp_path):
        configuration = commissioned.configuration(tmp_path)
        before = state_of(tmp_path)
        with open_session("router", listen=[endpoint_in(tmp_path)]):
            done = surfclass("run", "-c", configuration, cwd=tmp_path, code=69)
        assert "no way to the consoles" in done.stderr
        assert {path: data for path, data in state_of(tmp_path).items() if path.name != "z"} == before


class TestWatch:
    def test_nobody_to_watch_is_69(self, tmp_path):
        arguments = ("--connect", endpoint_in(tmp_path), "--timeout-s", "0.2", "--map", "map.npz")
        done = surfclass("watch", *arguments, cwd=tmp_path, code=69)
        assert done.stderr.startswith("surfclass: nothing answers at unixsock-stream/")
        assert state_of(tmp_path) == {}


class TestCheck:
    def test_what_to_do_is_told_word_for_word(self, commissioned, tmp_path):
        text = commissioned.configuration(tmp_path).read_text()
        configuration = tmp_path / "silent.toml"
        table = text[text.index("[recording]") : text.index("[zenoh]")]
        configuration.write_text(text.replace(table, ""))
        done = surfclass("check", "-c", configuration, cwd=tmp_path)
        assert "add a [recording] table to keep them" in done.stderr

    def test_everything_works(self, commissioned, tmp_path):
        configuration = commissioned.configuration(tmp_path)
        (tmp_path / "recordings").mkdir()
        before = state_of(tmp_path)
        done = surfclass("check", "-c", configuration, "--json", "-", cwd=tmp_path)
        findings = json.loads(done.stdout)
        assert {finding["verdict"] for finding in findings} == {"ok"}
        subjects = {finding["subject"] for finding in findings}
        assert {"rig", "model", "zenoh", "colour", "depth", "light", "arm", "capture", "pipeline"} <= subjects
        assert "PASS" in done.stderr
        after = {path: data for path, data in state_of(tmp_path).items() if path.name not in ("z", "z.lock")}
        assert after == before

    @pytest.mark.parametrize(
        ("setting", "subject", "said", "code"),
        [
            ("model=absent.npz", "rig and model", "absent.npz: cannot read the model", 78),
            ("map=absent/map.npz", "map", "absent is no folder", 78),
            ('sim.faults=[{device="depth", kind="absent"}]', "depth", "depth", 69),
        ],
    )
    def test_what_does_not_work_is_named(self, commissioned, tmp_path, setting, subject, said, code):
        configuration = commissioned.configuration(tmp_path)
        (tmp_path / "recordings").mkdir()
        arguments = ("-c", configuration, "--set", setting, "--json", "check.json")
        done = surfclass("check", *arguments, cwd=tmp_path, code=code)
        findings = json.loads((tmp_path / "check.json").read_text())
        wrong = [finding for finding in findings if finding["verdict"] != "ok"]
        assert {finding["subject"] for finding in wrong} == {subject}
        assert said in wrong[0]["message"]
        assert wrong[0]["advice"]
        assert "FAIL" in done.stderr
        assert "surfclass calibrate" not in done.stderr


class TestCapture:
    def test_captures_are_a_recording_that_can_be_replayed(self, commissioned, tmp_path):
        configuration = commissioned.configuration(tmp_path)
        for name in ("a.mcap", "b.mcap"):
            arguments = ("--count", 2, "--dark")
            surfclass("capture", name, "-c", configuration, *arguments, cwd=tmp_path)
        recording = Recording.open(tmp_path / "a.mcap")
        captures = list(recording.captures())
        assert [(c.name, c.role) for c in captures] == [("map_0001", "map"), ("map_0002", "map")]
        assert all(c.dark.rgb.mean() < 0.1 * c.colour.rgb.mean() for c in captures)
        assert recording.rig_text == (commissioned.folder / "rig.toml").read_text()
        assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
        surfclass("replay", "a.mcap", "--model", commissioned.model, "--map", "map.npz", cwd=tmp_path)
        found = from_npz_bytes((tmp_path / "map.npz").read_bytes(), "map.npz")
        assert np.abs(found.layers.index).max() < 300

    def test_boards_of_surfaces_are_labelled_and_can_be_trained_from(self, commissioned, tmp_path):
        configuration = commissioned.configuration(tmp_path)
        boards = [word for name in CLASSES for word in ("--surface", name)]
        arguments = (
            "-c",
            configuration,
            "--role",
            "train",
            "--classes",
            commissioned.folder / "classes.toml",
        )
        surfclass("capture", "t.mcap", *arguments, *boards[:4], cwd=tmp_path)
        captures = list(Recording.open(tmp_path / "t.mcap").captures("train"))
        assert [c.name for c in captures] == ["train_rusted_0001", "train_blasted_0001"]
        assert [set(np.unique(c.label)) for c in captures] == [{1}, {2}]
        refused = surfclass("train", "t.mcap", "--out", "m.npz", cwd=tmp_path, code=2)
        assert "painted, timber, cardboard" in refused.stderr
        done = surfclass("capture", "x.mcap", *arguments, "--surface", "mud", cwd=tmp_path, code=2)
        assert "--surface mud" in done.stderr

    @pytest.mark.parametrize(
        ("arguments", "said", "code"),
        [
            (["--count", "60"], r"capture map_00\d\d: joint \d moved 0\.0\d+ rad meanwhile", 69),
            (["--set", 'sim.faults=[{device="depth", kind="silent"}]'], "depth: ", 69),
            (["--set", 'sim.faults=[{device="light", kind="absent"}]'], "light: ", 69),
            (["--role", "souvenir"], "role 'souvenir', allowed: train, test, map", 2),
            (["--set", "rig=absent.toml"], "absent.toml: cannot read the rig", 78),
            (["--set", "colour.backend=webcam"], "all share one world", 78),
        ],
    )
    def test_all_of_them_or_nothing(self, commissioned, tmp_path, arguments, said, code):
        configuration = commissioned.configuration(tmp_path)
        before = state_of(tmp_path)
        done = surfclass("capture", "out.mcap", "-c", configuration, *arguments, cwd=tmp_path, code=code)
        assert re.search(said, done.stderr)
        assert done.stderr.startswith("surfclass: ")
        assert done.stderr.count("\n") == 1
        assert state_of(tmp_path) == before


def test_the_light_can_be_turned_off_by_itself(commissioned, tmp_path):
    configuration = commissioned.configuration(tmp_path)
    surfclass("light-off", "--config", configuration, cwd=tmp_path)
