"""The virtual machine is what the tests in it take it for."""

import subprocess
from pathlib import Path

import drivers


def test_systemd_is_the_first_process_and_udev_runs():
    assert Path("/proc/1/comm").read_text().strip() == "systemd"
    active = subprocess.run(
        ["systemctl", "is-active", "systemd-udevd"], capture_output=True, text=True, check=True
    )
    assert active.stdout.strip() == "active"


def test_the_project_is_installed_from_its_wheel():
    assert "/opt/surfclass/lib/python3.11/site-packages/drivers" in str(drivers.__path__)


def test_the_video_device_is_vivid_and_belongs_to_the_group_video():
    names = {
        path.parent.name: path.read_text().strip() for path in Path("/sys/class/video4linux").glob("*/name")
    }
    assert any(name.startswith("vivid") and "vid-cap" in name for name in names.values()), names
    assert Path("/dev/video0").group() == "video"
    assert Path("/dev/video0").stat().st_mode & 0o777 == 0o660


def test_the_can_bus_is_up():
    assert Path("/sys/class/net/vcan0/operstate").read_text().strip() in ("up", "unknown")


def test_the_usb_device_controller_is_there():
    assert list(Path("/sys/class/udc").iterdir())
