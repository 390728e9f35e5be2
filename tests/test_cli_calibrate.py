"""`surfclass calibrate` as people call it: verdicts, exit codes, what is kept, and what a kill leaves."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from cli_site import running, state_of, surfclass

from calibration.outcome import Outcome
from calibration.rotations import motion
from calibration.store import Provenance, Store, described
from drivers.recordings import RecordingWriter
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.rig import parse_rig

TURNS = [
    (0.5, 0, 0),
    (0, 0.5, 0),
    (0, 0, 0.6),
    (-0.4, 0.3, 0),
    (0.3, 0, -0.5),
    (0, -0.5, 0.3),
    (-0.3, -0.3, -0.3),
]
HAND_EYE = motion(np.array([0.1, -0.2, 1.5, 0.05, -0.02, 0.08]), "flange", "camera")
TARGET = motion(np.array([0.1, 0.05, -0.1, 1.4, 0.1, 0.6]), "base", "target")
GRID = np.array([[0.04 * i, 0.04 * j, 0.0] for i in range(6) for j in range(5)])


def observations(path, turns=TURNS, noise_m=2e-4):
    """Views of a board by a camera with depth, from flange poses that look at it."""
    random = np.random.default_rng(3)
    poses = []
    for number, turn in enumerate(turns):
        camera_T_target = motion(np.array([*turn, -0.1, -0.08, 0.8 + 0.02 * number]), "camera", "target")
        base_T_flange = TARGET @ camera_T_target.inverse @ HAND_EYE.inverse
        seen = camera_T_target @ GRID + random.normal(0, noise_m, GRID.shape)
        points = [{"target_m": t.tolist(), "camera_m": c.tolist()} for t, c in zip(GRID, seen, strict=True)]
        poses.append({"base_T_flange": base_T_flange.matrix.tolist(), "points": points})
    path.write_text(json.dumps({"schema": 1, "mounting": "eye_in_hand", "poses": poses}))
    return path


@pytest.fixture(scope="module")
def commissioned_once(tmp_path_factory):
    """A hand-eye calibration that passed, in a directory of results."""
    folder = tmp_path_factory.mktemp("results")
    file = observations(folder / "obs.json")
    arguments = ("--observations", file, "--calibration", folder / "kept", "--json", folder / "result.json")
    said = surfclass("calibrate", "hand-eye", *arguments, cwd=folder).stderr
    return folder, said


def test_a_result_that_passes_is_kept_with_where_it_comes_from(commissioned_once):
    folder, said = commissioned_once
    assert said.splitlines()[-1].startswith("PASS: hand-eye: 7 poses")
    told = json.loads((folder / "result.json").read_text())
    assert told["verdict"] == "pass"
    np.testing.assert_allclose(told["flange_T_camera"], HAND_EYE.matrix, atol=1e-3)
    assert told["options"]["observations"].endswith("obs.json")
    assert len(next(iter(told["inputs"].values()))) == 64
    kept = Store(folder / "kept").current("hand-eye")
    assert dict(kept.told) == told


def test_a_refusal_says_why_leaves_what_is_in_use_and_exits_with_1(commissioned_once, tmp_path):
    folder, _ = commissioned_once
    before = state_of(folder / "kept")
    about_one_axis = observations(tmp_path / "one.json", [(0, 0, angle) for angle in (0.0, 0.4, 0.8)])
    arguments = ("--observations", about_one_axis, "--calibration", folder / "kept", "--json", "-")
    done = surfclass("calibrate", "hand-eye", *arguments, cwd=tmp_path, code=1)
    assert done.stderr.splitlines()[-1].startswith("REFUSED: hand-eye: ")
    told = json.loads(done.stdout)
    assert told["verdict"] == "refused"
    assert told["reasons"]
    assert told["rig"] == {}
    assert state_of(folder / "kept") == before


def test_a_result_that_misses_a_limit_is_kept_and_not_used(commissioned_once, tmp_path):
    folder, _ = commissioned_once
    (tmp_path / "surfclass.toml").write_text(
        f'schema = 1\nmodel = "model.npz"\nreplay = "none.mcap"\n[calibration]\ndirectory = "{folder}/kept"\n'
        "[calibration.gates.hand_eye]\ntranslation_sd_m = 1e-9\n"
    )
    in_use = Store(folder / "kept").current("hand-eye").number
    arguments = ("--observations", folder / "obs.json", "-c", "surfclass.toml")
    said = surfclass("calibrate", "hand-eye", *arguments, cwd=tmp_path, code=1).stderr
    assert said.splitlines()[-1].startswith("FAIL: hand-eye: ")
    assert "kept, and not in use" in said
    store = Store(folder / "kept")
    assert store.current("hand-eye").number == in_use
    assert not store.results("hand-eye")[-1].passed


def test_status_says_what_is_in_use_and_what_a_new_result_made_stale(commissioned_once, tmp_path):
    folder, _ = commissioned_once
    done = surfclass("calibrate", "--status", "--calibration", folder / "kept", "--json", "-", cwd=tmp_path)
    told = json.loads(done.stdout)
    assert told["results"]["hand-eye"]["file"].endswith(".json")
    assert told["results"]["light"] == {
        "file": None,
        "written": None,
        "sentence": None,
        "rests_on": ["cameras", "response"],
        "stale_since": [],
        "older": 0,
        "newest_failed": False,
    }


def test_the_rig_in_use_can_be_written_out(commissioned_once, tmp_path):
    folder, _ = commissioned_once
    (tmp_path / "rig.toml").write_text(truth.rig(SimWorld("grey_card", scale=0.1)))
    arguments = ("--calibration", folder / "kept", "--rig", "rig.toml", "--write-rig", "out.toml")
    surfclass("calibrate", *arguments, cwd=tmp_path)
    assert "flange_T_depth" in (tmp_path / "out.toml").read_text()


def test_without_captures_observations_or_devices_it_says_what_to_give(tmp_path):
    for step in ("cameras", "hand-eye", "response", "light", "limits"):
        said = surfclass("calibrate", step, cwd=tmp_path, code=78).stderr
        assert "--from" in said
        assert "--config" in said


def test_killing_it_at_any_moment_leaves_the_old_result_whole(commissioned_once, tmp_path):
    folder, _ = commissioned_once
    kept, result = tmp_path / "kept", tmp_path / "result.json"
    command = [sys.executable, "-m", "daemon", "calibrate", "hand-eye"]
    command += ["--observations", str(folder / "obs.json"), "--calibration", str(kept), "--json", str(result)]
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    start = time.monotonic()
    subprocess.run(command, check=True, timeout=100, cwd=tmp_path, **quiet)
    took_s = time.monotonic() - start
    first = Store(kept).current("hand-eye").number
    for share in (0.5, 0.9, 0.97, 1.0):
        process = subprocess.Popen(command, cwd=tmp_path, **quiet)
        time.sleep(share * took_s)
        os.kill(process.pid, signal.SIGKILL)
        process.wait(10)
        json.loads(result.read_text())
        assert Store(kept).current("hand-eye").number >= first
    surfclass(*command[3:], cwd=tmp_path)
    assert Store(kept).current("hand-eye").passed


def live_site(folder, scene):
    """A configuration of simulated devices before a scene's targets, and the rig that is commissioned."""
    (folder / "rig.toml").write_text(truth.rig(SimWorld(scene, scale=0.25)))
    (folder / "plate.toml").write_text(truth.plate_toml(SimWorld("reflector_discs", scale=0.25)))
    devices = "".join(f'[{kind}]\nbackend = "sim"\n' for kind in ("colour", "depth", "light", "arm"))
    (folder / "surfclass.toml").write_text(
        'schema = 1\nrig = "rig.toml"\nmodel = "model.npz"\n[calibration]\ndirectory = "kept"\n'
        f'plate = "plate.toml"\n{devices}[sim]\nscene = "{scene}"\nscale = 0.25\n'
    )


def test_live_a_step_captures_solves_keeps_and_can_be_solved_again(tmp_path):
    live_site(tmp_path, "exposure_card")
    arguments = ("calibrate", "response", "-c", "surfclass.toml", "--no-page", "--json")
    surfclass(*arguments, "live.json", cwd=tmp_path)
    (recording,) = (tmp_path / "kept" / "captures").glob("response-*.mcap")
    live = json.loads((tmp_path / "live.json").read_text())
    assert live["devices"]["colour"] == "SIM-COLOUR"
    assert Store(tmp_path / "kept").current("response").number == 1
    surfclass(*arguments, "again.json", "--from", recording, cwd=tmp_path)
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["inverse"] == live["inverse"]
    assert again["inputs"] == live["inputs"]
    assert Store(tmp_path / "kept").current("response").number == 2


def test_live_a_signal_ends_it_with_nothing_kept_and_nothing_changed(tmp_path):
    live_site(tmp_path, "cell")  # where there are no discs, so that it goes on
    before = state_of(tmp_path)
    log = tmp_path.parent / "live.log"
    with running(log, "calibrate", "hand-eye", "-c", "surfclass.toml", "--no-page", cwd=tmp_path) as process:
        until = time.monotonic() + 60
        while "refused" not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 128 + signal.SIGTERM
    said = log.read_text()
    assert "Traceback" not in said
    assert "stopped by SIGTERM" in said
    assert state_of(tmp_path) == before


def test_captures_of_another_camera_are_refused_until_that_is_meant(tmp_path):
    rig = truth.rig(SimWorld("grey_card", scale=0.1))
    outcome = Outcome("cameras", "pass", (), "", {"schema": 1})
    provenance = Provenance("old.mcap", {}, {}, {}, {"colour": "A1", "depth": "D1"})
    Store(tmp_path / "kept").add("cameras", described(outcome, provenance, parse_rig(rig, "rig")))
    RecordingWriter(tmp_path / "new.mcap", rig, None, {"serial of colour": "B2"}).close()
    before = state_of(tmp_path / "kept")
    arguments = ("calibrate", "response", "--from", "new.mcap", "--calibration", "kept", "--json", "-")
    told = json.loads(surfclass(*arguments, cwd=tmp_path, code=1).stdout)
    assert told["verdict"] == "refused"
    assert "B2" in told["reasons"][0]
    assert "A1" in told["reasons"][0]
    meant = json.loads(surfclass(*arguments, "--new-devices", cwd=tmp_path, code=1).stdout)
    assert "B2" not in str(meant["reasons"])  # it has no captures, which is another matter
    assert state_of(tmp_path / "kept") == before
