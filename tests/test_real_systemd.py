"""Runs the unit, as it is, under a real systemd in a container over this machine's own files."""

import contextlib
import os
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import pytest
from service_site import build_site

ROOT = Path(__file__).parents[1]
SYSTEMD = ROOT / "systemd"
NOISY = ("systemd-udevd", "systemd-udev-trigger", "systemd-networkd", "systemd-resolved", "systemd-timesyncd")
LAUNCHER = """#!/bin/sh
export LD_LIBRARY_PATH=/opt/python/lib
exec /opt/python/bin/python3 -c "
import site, sys
site.addsitedir('/opt/site')
sys.path.insert(0, '/opt/src')
from daemon.cli import main
main()" "$@"
"""
TARGET = "[Unit]\nRequires=basic.target dbus.socket\nAfter=basic.target dbus.socket\nAllowIsolate=yes\n"
# A hang is found in seconds and not in half a minute; everything else is the unit's own.
QUICKER = "[Service]\nWatchdogSec=4\nRestartSec=0.2\n"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


class Container:
    """A booted container; `run` runs a command inside and returns what it printed."""

    def __init__(self, leader):
        self.leader = leader

    def run(self, *command, check=True):
        inside = [
            "nsenter",
            "-t",
            str(self.leader),
            *["-m", "-p", "-u", "-i", "-n", "-C", "-r", "-w"],
            *command,
        ]
        done = subprocess.run(inside, capture_output=True, text=True, timeout=60, check=False)
        assert not check or done.returncode == 0, f"{command}: {done.stdout}{done.stderr}\n{self.journal()}"
        return done.stdout.strip()

    def show(self, name):
        return self.run("systemctl", "show", "-P", name, "surfclass")

    def journal(self):
        return self.run("journalctl", "-u", "surfclass", "--no-pager", "-o", "cat", check=False)

    def until(self, condition, what):
        until = time.monotonic() + 40
        while not condition():
            assert time.monotonic() < until, f"{what} did not happen\n{self.journal()}"
            time.sleep(0.2)


@pytest.fixture
def container(tmp_path_factory):
    for tool in ("systemd-nspawn", "nsenter", "systemd-sysusers", "dbus-daemon"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed (apt-get install systemd systemd-container dbus)")
    if os.geteuid() != 0:
        pytest.skip("a container with a systemd of its own needs root")
    folder = tmp_path_factory.mktemp("container")
    with contextlib.ExitStack() as clean:
        root = overlay(folder, clean)
        install(root, build_site(tmp_path_factory.mktemp("site")))
        yield boot(root, folder, clean)


def overlay(folder, clean):
    """Returns this machine's root folder, over which everything that is written stays in memory."""
    memory, root = folder / "memory", folder / "root"
    memory.mkdir()
    root.mkdir()
    mount("tmpfs", "tmpfs", memory, "size=1g", clean)
    for name in ("upper", "work"):
        (memory / name).mkdir()
    mount("overlay", "overlay", root, f"lowerdir=/,upperdir={memory}/upper,workdir={memory}/work", clean)
    return root


def mount(kind, what, where, options, clean):
    done = subprocess.run(
        ["mount", "-t", kind, what, "-o", options, str(where)], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"{kind} cannot be mounted here: {done.stderr.strip()}")
    clean.callback(subprocess.run, ["umount", str(where)], check=False)


def install(root, site):
    units = root / "etc/systemd/system"
    shutil.copy(SYSTEMD / "surfclass.service", units)
    (units / "surfclass.service.d").mkdir()
    (units / "surfclass.service.d/quicker.conf").write_text(QUICKER)
    (units / "surfclass-test.target").write_text(TARGET)
    for name in NOISY:
        masked = units / f"{name}.service"
        masked.unlink(missing_ok=True)
        masked.symlink_to("/dev/null")
    for tool, file in (("systemd-sysusers", "sysusers"), ("systemd-tmpfiles", "tmpfiles")):
        create = ["--create"] if file == "tmpfiles" else []
        subprocess.run([tool, *create, f"--root={root}", SYSTEMD / f"surfclass.{file}.conf"], check=True)
    for name in ("python", "site", "src", "surfclass/bin"):
        (root / "opt" / name).mkdir(parents=True)
    launcher = root / "opt/surfclass/bin/surfclass"
    launcher.write_text(LAUNCHER)
    launcher.chmod(0o755)
    group = next(
        int(line.split(":")[2])
        for line in (root / "etc/group").read_text().splitlines()
        if line.startswith("surfclass:")
    )
    text = (site / "surfclass.toml").read_text()
    for name in ("recordings", "map.npz"):
        text = text.replace(f'"{name}"', f'"/var/lib/surfclass/{name}"')
    endpoint = text.split("listen = [")[1].split("]")[0]
    (site / "surfclass.toml").write_text(text.replace(endpoint, '"tcp/127.0.0.1:7447"'))
    for name in ("surfclass.toml", "rig.toml", "model.npz"):
        file = root / "etc/surfclass" / name
        shutil.copy(site / name, file)
        os.chown(file, 0, group)
        file.chmod(0o640)


def boot(root, folder, clean):
    binds = {
        "python": sys.base_prefix,
        "site": sysconfig.get_path("purelib"),
        "src": str(ROOT),
    }
    command = [
        *("systemd-nspawn", "-q", "-D", str(root), "--register=no", "--keep-unit", "--link-journal=no"),
        *("--private-network", "--machine=surfclass-test", "--boot", "--console=pipe"),
        # Without these the device and address rules would silently not hold, and Zenoh would fail.
        *("--system-call-filter=bpf", "--system-call-filter=@memlock"),
        "--capability=CAP_BPF,CAP_NET_ADMIN,CAP_PERFMON,CAP_IPC_LOCK",
        *(f"--bind-ro={outside}:/opt/{inside}" for inside, outside in binds.items()),
        "systemd.unit=surfclass-test.target",
    ]
    console = clean.enter_context((folder / "console").open("wb"))
    environment = os.environ | {"UNIFIED_CGROUP_HIERARCHY": "1"}
    spawn = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT, env=environment
    )
    clean.callback(spawn.wait, 30)
    clean.callback(spawn.terminate)
    until = time.monotonic() + 20
    while time.monotonic() < until and spawn.poll() is None:
        children = Path(f"/proc/{spawn.pid}/task/{spawn.pid}/children").read_text().split()
        if children:
            booted = Container(int(children[0]))
            if booted.run("systemctl", "is-active", "basic.target", check=False) == "active":
                return booted
        time.sleep(0.2)
    pytest.skip(f"no container boots here: {(folder / 'console').read_text(errors='replace')[-300:]}")


def test_the_unit_under_a_real_systemd(container):
    def mapped(times):
        return lambda: container.journal().count("capture mapped name=000002") >= times

    container.run("systemctl", "start", "surfclass")  # comes back when the service says READY=1
    assert container.show("ActiveState") == "active"
    container.until(mapped(1), "two captures")
    assert container.show("StatusText") == "ok"

    container.run("systemctl", "reload", "surfclass")
    container.until(lambda: container.show("StatusText") == "ok", "health after the reload")

    container.run("kill", "-SEGV", container.show("MainPID"))
    container.until(lambda: container.show("NRestarts") == "1", "a restart after a crash")
    container.until(mapped(2), "two captures")

    container.run("kill", "-STOP", container.show("MainPID"))
    container.until(lambda: container.show("NRestarts") == "2", "a restart after a hang")
    assert "Failed with result 'watchdog'" in container.journal()
    assert "surfclass recover /var/lib/surfclass/recordings" in container.journal()
    container.until(mapped(3), "two captures")

    container.run("systemctl", "stop", "surfclass")
    assert container.show("Result") == "success"
    assert container.show("ExecMainStatus") == "0"
    kept = container.run("ls", "/var/lib/surfclass", "/var/lib/surfclass/recordings").split()
    assert "map.npz" in kept
    assert [name.endswith(".active") for name in sorted(kept) if ".mcap" in name] == [True, True, False]

    container.run("sed", "-i", "s/^robot/robbot/", "/etc/surfclass/surfclass.toml")
    container.run("systemctl", "start", "surfclass", check=False)
    assert container.show("ExecMainStatus") == "78"
    time.sleep(1)
    assert container.show("ActiveState") == "failed"  # and not restarting for ever
    assert "did you mean 'robot'" in container.journal()
