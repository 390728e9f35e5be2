import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
from service_site import build_site

from daemon import check, wiring
from daemon.config import load_config
from daemon.findings import Verdict, exit_code
from daemon.transport import TransportError, ask, open_session
from drivers.recordings import Recording
from surfclass.errors import ConfigurationError
from surfclass.wire import decode_update


@pytest.fixture
def site(tmp_path):
    return build_site(tmp_path)


class Running:
    """A service that runs in a thread, with a console's session to it."""

    def __init__(self, site, overrides=(), replay=None, **options):
        def load():
            return load_config(site / "surfclass.toml", overrides, replay)

        config = load()
        self.endpoint = config.zenoh.listen[0]
        self.session = wiring.open_zenoh(config)
        self.service = wiring.build_service(config, self.session, load=load, **options)
        self.outcome = None
        self.thread = threading.Thread(target=self._run)

    def _run(self):
        self.outcome = self.service.run()

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.service.stop()
        self.thread.join(30)
        assert not self.thread.is_alive()
        self.session.close()

    def until(self, condition):
        until = time.monotonic() + 40
        while not condition(self.service.status()):
            assert time.monotonic() < until, self.service.status()
            assert self.thread.is_alive(), self.outcome
            time.sleep(0.02)


def test_simulated_arm_is_mapped_recorded_and_replayed_to_the_same_bytes(site):
    with Running(site) as running:
        running.until(lambda told: told["program_done"] and told["counts"]["mapped"] == 2)
        with open_session("client", connect=[running.endpoint]) as console:
            answer = ask(console, "test", "capture", {"name": "asked", "dark": False})
        assert answer["name"] == "asked"
        assert answer["sequence"] == 3
        told = running.service.status()
        assert told["health"] == "ok"
        assert told["map"]["voxels"] == answer["voxels"] > 0
    assert running.outcome == 0

    (path,) = (site / "recordings").iterdir()
    assert re.fullmatch(r"test-\d{8}T\d{6}Z-001\.mcap", path.name)
    recording = Recording.open(path)
    assert [capture.name for capture in recording.captures()] == ["000001", "000002", "asked"]
    assert recording.rig_text == (site / "rig.toml").read_text()
    assert recording.classes.names == ("rusted", "blasted", "painted", "timber", "cardboard")
    assert recording.metadata["robot"] == "test"
    updates = [decode_update(data, 5) for data in recording.updates()]
    assert [update.sequence for update in updates] == [1, 2, 3]
    assert {update.epoch for update in updates} == {recording.metadata["epoch"]}

    first = (site / "map.npz").read_bytes()
    (site / "map.npz").unlink()
    with Running(site, replay=path, exit_when_done=True) as again:
        again.thread.join(40)
        assert not again.thread.is_alive()
    assert again.outcome == 0
    assert (site / "map.npz").read_bytes() == first
    assert [path] == list((site / "recordings").iterdir())  # what is recorded is not recorded again


def test_two_runs_record_the_same_captures(site):
    seen = []
    for run in ("a", "b"):
        directory = site / run
        with Running(site, [f"recording.directory={directory}"]) as running:
            running.until(lambda told: told["program_done"])
        (path,) = directory.iterdir()
        captures = list(Recording.open(path).captures())
        seen.append([(c.t_ns, c.colour.rgb.tobytes(), c.depth.depth_mm.tobytes()) for c in captures])
    assert seen[0] == seen[1]
    assert len(seen[0]) == 2


def test_a_lost_simulated_camera_comes_back(site):
    fault = '[{device = "depth", kind = "absent", from_s = 0.2, to_s = 3.0}]'
    with Running(site, [f"sim.faults={fault}"]) as running:
        running.until(lambda told: told["program_done"])
        assert running.service.status()["counts"]["reopened"] >= 1


def test_reload_takes_over_the_trigger_and_names_what_it_cannot(site):
    file = site / "surfclass.toml"
    with Running(site) as running:
        running.until(lambda told: told["counts"]["mapped"] == 2)
        text = file.read_text().replace("[trigger.rest]", "[trigger]\ninterval_s = 0.2")
        file.write_text(text.replace('robot = "test"', 'robot = "other"'))
        running.service.ask_reload()
        running.until(lambda told: told["counts"]["mapped"] >= 5)
        file.write_text("robot = 3")
        running.service.ask_reload()
        running.until(
            lambda told: "not taken over" in told["last_error"]["message"] if told["last_error"] else 0
        )
        assert running.service.status()["robot"] == "test"
    (path,) = (site / "recordings").iterdir()
    names = [capture.name for capture in Recording.open(path).captures()]
    assert names == [f"{number:06d}" for number in range(1, len(names) + 1)]


def test_a_recording_that_a_crash_left_is_named(site, caplog):
    (site / "recordings").mkdir()
    (site / "recordings" / "old.mcap.active").write_bytes(b"")
    with caplog.at_level("WARNING"), Running(site):
        pass
    told = next(record for record in caplog.records if "cut off" in record.message)
    assert told.fields == {"mend": f"surfclass recover {site}/recordings/old.mcap.active"}


def test_what_a_reload_says():
    base = load_config(Path(__file__).parents[1] / "systemd" / "surfclass.toml")
    new = [
        base.model_copy(update={"log_level": "debug", "robot": "other"}),
        base.model_copy(update={"log_level": "debug"}),
    ]
    reload = wiring.Reload(base, lambda: new.pop(0), acquisition=None, sensors=None)
    assert reload() == "taken over: log_level; needs a restart: robot"
    assert reload() == ""


def test_paths_and_files_are_refused_before_anything_runs(site):
    with open_session("peer") as session:
        for override, says in [
            ("map=nowhere/map.npz", "no folder"),
            ("model=absent.npz", "absent.npz: cannot read the model"),
            ("rig=model.npz", "not a TOML file"),
            ("recording.directory=/proc/nothing", "recording.directory /proc/nothing"),
            ("sim.scene=moon", "moon"),
        ]:
            config = load_config(site / "surfclass.toml", [override])
            with pytest.raises(Exception, match=re.escape(says)) as caught:
                wiring.build_service(config, session)
            assert isinstance(caught.value, ValueError)  # InputError and below


def test_unknown_backend_and_option_name_what_is_known(site):
    text = (site / "surfclass.toml").read_text()
    (site / "surfclass.toml").write_text(text.replace('"sim"', '"kinekt"').split("[sim]")[0])
    with pytest.raises(ConfigurationError, match="'kinekt', allowed: "):
        wiring.build_sensors(load_config(site / "surfclass.toml"))
    (site / "surfclass.toml").write_text(text)
    with pytest.raises(ConfigurationError, match="gain"):
        wiring.build_sensors(load_config(site / "surfclass.toml", ["colour.gain=3"]))


# ---- as a process of its own

RUN = """
import sys
from pathlib import Path
from daemon.config import load_config
from daemon.wiring import run
code = run(lambda: load_config(Path(sys.argv[1])))
heavy = [name for name in ("sklearn", "open3d", "matplotlib", "skimage") if name in sys.modules]
print("heavy:", heavy)
sys.exit(code)
"""


def test_process_is_ready_soon_reloads_and_stops_whole(site, monkeypatch):
    channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    channel.bind(str(site / "notify"))
    channel.settimeout(20)

    def heard(words):
        while words not in (message := channel.recv(4096).decode()):
            pass
        return message

    # One camera is never there: that is no reason not to start.
    text = (site / "surfclass.toml").read_text() + 'faults = [{device = "depth", kind = "absent"}]\n'
    (site / "surfclass.toml").write_text(text)
    environment = os.environ | {"NOTIFY_SOCKET": str(site / "notify"), "WATCHDOG_USEC": "400000"}
    environment.pop("WATCHDOG_PID", None)
    command = [sys.executable, "-c", RUN, str(site / "surfclass.toml")]
    root = Path(__file__).parents[1]
    process = subprocess.Popen(
        command, cwd=root, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert "STATUS=waiting: depth" in heard("READY=1")
        heard("WATCHDOG=1")
        process.send_signal(signal.SIGHUP)
        heard("RELOADING=1")
        heard("READY=1")
        heard("WATCHDOG=1")
        process.send_signal(signal.SIGTERM)
        heard("STOPPING=1")
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
        channel.close()
    assert process.returncode == 0, err
    assert "heavy: []" in out
    assert not (site / "map.npz").exists()  # an empty map must not replace the last good one
    assert not list((site / "recordings").iterdir())  # no capture, no file
    assert "device error" in err


def test_an_endpoint_that_is_taken_is_said_in_words(site, caplog):
    config = load_config(site / "surfclass.toml")
    with wiring.open_zenoh(config), pytest.raises(TransportError):
        wiring.open_zenoh(config)


# ---- check


def test_check_of_a_good_site(site):
    findings = check.check(load_config(site / "surfclass.toml", ["recording.directory=."]))
    by_subject = {finding.subject: finding for finding in findings}
    assert {f.verdict for f in findings} == {Verdict.OK}, findings
    for subject in ("installation", "rig", "model", "zenoh", "recording", "map", "light", "arm", "capture"):
        assert subject in by_subject
    assert re.search(r"128 × 96 uint8, [\d.]+ frames/s", by_subject["colour"].message)
    assert re.search(r"64 × 48 uint16, ", by_subject["depth"].message)
    assert re.search(r"[\d,]+ voxels in \d+ ms", by_subject["pipeline"].message)
    assert exit_code(findings) == 0
    json.dumps([finding.as_json() for finding in findings])
    assert not list(site.glob("*.mcap*"))


def test_check_tells_a_missing_device_from_a_wrong_file(site):
    fault = '[{device = "depth", kind = "absent"}, {device = "arm", kind = "silent"}]'
    base = ["recording.directory=.", f"sim.faults={fault}"]
    findings = check.check(load_config(site / "surfclass.toml", base))
    verdicts = {finding.subject: finding for finding in findings}
    assert verdicts["depth"].verdict is verdicts["arm"].verdict is Verdict.DEVICE
    assert "cable" in verdicts["depth"].advice
    assert "silent" in verdicts["arm"].advice
    assert verdicts["colour"].verdict is Verdict.OK
    assert "capture" not in verdicts
    assert exit_code(findings) == 69
    wrong = [*base, "model=rig.toml", "recording.directory=absent/absent"]
    findings = check.check(load_config(site / "surfclass.toml", wrong))
    count = Counter(finding.subject for finding in findings if finding.verdict is Verdict.CONFIGURATION)
    assert count == {"rig and model": 1, "recording": 1}
    assert all(finding.advice for finding in findings if finding.verdict is not Verdict.OK)
    assert exit_code(findings) == 78


def test_check_finds_what_a_crash_left(site):
    (site / "x.mcap.active").write_bytes(b"")
    findings = check.check(load_config(site / "surfclass.toml", ["recording.directory=."]))
    warned = [finding for finding in findings if finding.verdict is Verdict.WARNING]
    assert [finding.advice for finding in warned] == [f"surfclass recover {site}/x.mcap.active"]
    assert exit_code(findings) == 0
