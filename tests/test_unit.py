import re
import shutil
import subprocess
from pathlib import Path

import pytest

from daemon.config import RELOADABLE

SYSTEMD = Path(__file__).parents[1] / "systemd"
UNIT = SYSTEMD / "surfclass.service"


def run(tool, *arguments):
    if shutil.which(tool) is None:
        pytest.skip(f"{tool} is not installed")
    return subprocess.run([tool, *arguments], capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def unit(tmp_path):
    """The unit with a command that exists here, or `verify` would complain about nothing else."""
    path = tmp_path / "surfclass.service"
    path.write_text(UNIT.read_text().replace("/opt/surfclass/bin/surfclass", shutil.which("true")))
    return path


def test_unit_is_valid_for_this_systemd(unit):
    done = run("systemd-analyze", "verify", "--man=no", "--recursive-errors=yes", str(unit))
    assert done.returncode == 0, done.stderr
    unit.write_text(unit.read_text().replace("RestartSec=", "RestartSecs="))
    assert run("systemd-analyze", "verify", "--man=no", "--recursive-errors=yes", str(unit)).returncode != 0


def test_unit_is_confined(unit):
    done = run("systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", str(unit))
    assert done.returncode == 0, done.stdout[-300:]


def test_unit_has_nothing_that_systemd_252_ignores():
    text = UNIT.read_text()
    keys = set(re.findall(r"^([A-Za-z]+)=", text, re.MULTILINE))
    newer = {
        *("RestartSteps", "RestartMaxDelaySec", "RestartMode", "ImportCredential", "OpenFile"),
        *("MemoryPressureWatch", "BindsTo"),
    }
    assert not keys & newer
    assert "Type=notify\n" in text


def test_unit_knows_the_services_exit_code_and_times():
    from daemon.config import Limits
    from daemon.service import EXIT_CONFIGURATION

    text = UNIT.read_text()
    assert f"RestartPreventExitStatus=2 {EXIT_CONFIGURATION}\n" in text
    times = {key: int(value) for key, value in re.findall(r"^(\w+Sec)=(\d+)$", text, re.MULTILINE)}
    limits = Limits()
    # A hang is told in the status before the watchdog strikes, and a stop may wait for two captures.
    assert limits.heartbeat_s < times["WatchdogSec"]
    assert 2 * limits.stop_s <= times["TimeoutStopSec"]


def test_example_says_what_a_reload_takes_over():
    text = (SYSTEMD / "surfclass.toml").read_text().split("schema")[0]
    assert [name for name in RELOADABLE if name not in text] == []


def test_user_and_folders(tmp_path):
    etc = tmp_path / "etc"
    etc.mkdir()
    done = run("systemd-sysusers", f"--root={tmp_path}", str(SYSTEMD / "surfclass.sysusers.conf"))
    if done.returncode != 0 and "Permission denied" in done.stderr:
        pytest.skip("systemd-sysusers needs root")
    assert done.returncode == 0, done.stderr
    groups = {line.split(":")[0]: line for line in (etc / "group").read_text().splitlines()}
    user = re.search(r"^SupplementaryGroups=(.*)$", UNIT.read_text(), re.MULTILINE)[1].split()
    for name in user:
        assert groups[name].endswith("surfclass")
    done = run("systemd-tmpfiles", "--create", f"--root={tmp_path}", str(SYSTEMD / "surfclass.tmpfiles.conf"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "var/lib/surfclass/recordings").stat().st_mode & 0o7777 == 0o2770


def test_udev_rules_are_well_formed():
    rule = re.compile(r'[A-Z_]+(\{\w+\})?(==|!=|\+=|:=|=)"[^"]*"(, ?|$)')
    lines = (SYSTEMD / "60-surfclass.rules").read_text().splitlines()
    told = [line for line in lines if line and not line.startswith("#")]
    assert len(told) >= 4
    for line in told:
        assert rule.sub("", line) == "", line
        assert "==" in line  # without a match it would apply to every device
