"""The whole service on real wires: OpenNI2, Aravis, the light's serial protocol and b-CAP, all at once.

Behind each is an emulated device in a process of its own, which looks into one simulated cell; any of
them, and any driver's own process, may be killed.
"""

import dataclasses
import json
import os
import signal
import time
from pathlib import Path

import pytest
from cli_site import SCALE, endpoint_in, running, terminated

from daemon.console import MapClient
from daemon.emulated_rig import DEVICES, PIDS, SOCKET
from daemon.transport import TransportError, open_session
from drivers.recordings import Recording, recover
from drivers.sim import truth
from drivers.sim.cell_server import CellClient
from drivers.sim.world import SimWorld

pytest.importorskip("gi", reason="PyGObject is not installed: pip install '.[aravis]'")

RESTART_S = 4
# What the camera's loss takes to show: GigE Vision has a heartbeat, and nothing else says so.
NAMED_WITHIN_S = {"colour": 8.0}
BACK_WITHIN_S = 5.0
STARTS_WITHIN_S = 5.0  # an emulator, from its process until it answers

CONFIGURATION = """\
schema = 1
robot = "wires"
rig = "rig.toml"
model = "{model}"
[trigger]
interval_s = 0.5
[capture]
max_skew_s = 1.0
[recording]
directory = "recordings"
min_free_mb = 1
[zenoh]
listen = ["{endpoint}"]
{devices}
"""


@dataclasses.dataclass
class Site:
    """A running service, and the emulated devices that it uses."""

    devices: Path
    recordings: Path
    client: MapClient
    cell: CellClient
    log: Path
    kills: list = dataclasses.field(default_factory=list)

    @property
    def pids(self):
        return json.loads((self.devices / PIDS).read_text())

    @property
    def status(self):
        return self.client.status

    def until(self, condition, within_s, what):
        """Waits, and returns when it came true; the service's log is told if it did not."""
        give_up_s = time.monotonic() + within_s
        while time.monotonic() < give_up_s:
            if self.status and condition():
                return time.monotonic()
            time.sleep(0.02)
        pytest.fail(f"{what}: not within {within_s} s\n{self.status}\n{self.log.read_text()}")

    def captures_again(self, within_s):
        """Waits until captures are accepted after now."""
        self.until(lambda: True, within_s, "a status")
        accepted = self.status["counts"]["accepted"]
        self.until(
            lambda: self.status["health"] == "ok" and self.status["counts"]["accepted"] > accepted,
            within_s,
            "a capture",
        )

    def is_named(self, kind):
        return self.status["health"] == "waiting" and self.status["detail"].startswith(f"{kind}:")


@pytest.fixture(scope="module")
def site(commissioned, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wires")
    devices = folder / "d"
    arguments = (
        "sim",
        "cell",
        "--dir",
        devices,
        "--scale",
        SCALE,
        "--viewpoints",
        1,
        "--restart-s",
        RESTART_S,
    )
    (folder / "rig.toml").write_text(truth.rig(SimWorld("cell", scale=SCALE), raw=True))
    with running(folder / "devices.log", *arguments, cwd=folder) as rig:
        until = time.monotonic() + 100
        while not (devices / DEVICES).exists():
            assert rig.poll() is None, (folder / "devices.log").read_text()
            assert time.monotonic() < until, (folder / "devices.log").read_text()
            time.sleep(0.1)
        configuration = folder / "surfclass.toml"
        configuration.write_text(
            CONFIGURATION.format(
                model=commissioned.model,
                endpoint=endpoint_in(folder),
                devices=(devices / DEVICES).read_text(),
            )
        )
        log = folder / "run.log"
        with running(log, "run", "--config", configuration, cwd=folder) as service:
            session = connected(endpoint_in(folder), service, log)
            cell = CellClient(devices / SOCKET)
            with session, MapClient(session, "wires") as client:
                yield Site(devices, folder / "recordings", client, cell, log)
            cell.close()
            terminated(service, log)
        rig.send_signal(signal.SIGTERM)
        assert rig.wait(20) == 0, (folder / "devices.log").read_text()


def connected(endpoint, service, log):
    until = time.monotonic() + 60
    while True:
        try:
            return open_session("client", connect=[endpoint])
        except TransportError:
            assert service.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.1)


def test_the_service_captures_with_all_of_them(site):
    site.captures_again(60)
    told = site.status["devices"]
    assert {kind: device["backend"] for kind, device in told.items()} == {
        "colour": "aravis",
        "depth": "openni2",
        "light": "gardasoft",
        "arm": "bcap",
    }
    assert all(device["open"] for device in told.values())


@pytest.mark.parametrize("kind", ["depth", "light", "arm", "colour"])
def test_an_emulator_that_is_killed_is_named_and_used_again_when_it_is_back(site, kind):
    site.captures_again(30)
    pid = site.pids[kind]
    killed_ns = time.monotonic_ns()
    os.kill(pid, signal.SIGKILL)
    site.until(lambda: site.is_named(kind), NAMED_WITHIN_S.get(kind, 2.0), f"the loss of the {kind}")
    named_ns = time.monotonic_ns()
    site.until(lambda: site.pids[kind] not in (None, pid), RESTART_S + 10, f"a new {kind}")
    back_ns = time.monotonic_ns()
    assert site.cell.light_level(named_ns, back_ns) == 0.0  # nothing could be captured: no light
    site.kills.append((killed_ns, back_ns))
    site.captures_again(BACK_WITHIN_S + STARTS_WITHIN_S)
    named_s, resumed_s = (named_ns - killed_ns) / 1e9, (time.monotonic_ns() - back_ns) / 1e9
    print(f"{kind}: named after {named_s:.1f} s, captures {resumed_s:.1f} s after its start")


@pytest.mark.parametrize("kind", ["depth", "colour"])
def test_a_drivers_own_process_that_is_killed_is_replaced(site, kind):
    site.captures_again(30)
    pid = site.status["devices"][kind]["process"]
    killed_ns = time.monotonic_ns()
    os.kill(pid, signal.SIGKILL)
    site.until(
        lambda: site.status["devices"][kind]["process"] not in (None, pid), BACK_WITHIN_S, "a new process"
    )
    site.kills.append((killed_ns, time.monotonic_ns()))
    site.captures_again(BACK_WITHIN_S)
    print(f"{kind}: captures {(time.monotonic_ns() - killed_ns) / 1e9:.1f} s after its process was killed")
    assert f"{kind}: its process was killed by SIGKILL" in site.log.read_text()


def test_no_capture_is_of_before_and_after_a_loss(site):
    """The last test here: it looks at what all the others have left."""
    (active,) = site.recordings.glob("*.mcap.active")
    copied = active.with_name("copy.mcap.active")
    copied.write_bytes(active.read_bytes())
    captures = list(Recording.open(recover(copied)).captures())
    assert len(captures) > len(site.kills)
    for capture in captures:
        times = capture.colour.t_ns, capture.depth.t_ns, capture.joints.t_ns
        # A frame that was whole before another device was killed is as good as ever; what no capture may
        # hold is something from before a loss beside something from after the device's return.
        for killed_ns, back_ns in site.kills:
            assert max(times) < back_ns or min(times) > killed_ns
        assert capture.light_timing == "software"
        assert capture.colour.t_sd_ns > 0
        assert capture.depth.t_sd_ns > 0
        assert capture.joints.t_sd_ns > 0
