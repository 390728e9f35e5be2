"""The unit's own user, groups, device rules and filters let the drivers reach their devices."""

import shutil
import subprocess
from pathlib import Path

from vivid import Vivid

UNIT = Path(__file__).parents[2] / "systemd/surfclass.service"
RUN = Path("/run/systemd/system")
# Everything else is the unit's own.
INSTEAD = """[Service]
Type=oneshot
ExecStart=
ExecStart=/opt/surfclass/bin/python {program}
ExecStopPost=
Restart=no
WatchdogSec=0
TimeoutStartSec=100
"""
PROGRAM = """
import can
from drivers.backends import create
from drivers.clock import SystemClock
clock = SystemClock()
options = {"device_path": "/dev/video0", "width": 640, "height": 480, "pixel_format": "RGB3"}
with create("colour", "v4l2", clock=clock, options=options) as camera:
    print("got", camera.grab(clock.now_ns(), 20.0).rgb.shape)
with can.Bus(interface="socketcan", channel="vcan0") as bus:
    bus.send(can.Message(arbitration_id=1), timeout=5)
    print("sent on", bus.channel_info)
"""


def run_as_the_unit(program):
    """Returns what a program prints that runs as the unit would."""
    file = RUN / "surfclass-probe.py"
    file.write_text(program)
    shutil.copy(UNIT, RUN / "surfclass-probe.service")
    (RUN / "surfclass-probe.service.d").mkdir(exist_ok=True)
    (RUN / "surfclass-probe.service.d/instead.conf").write_text(INSTEAD.format(program=file))
    subprocess.run(["systemctl", "daemon-reload"], check=True)
    done = subprocess.run(["systemctl", "start", "surfclass-probe"], check=False, timeout=110)
    journal = ["journalctl", "-u", "surfclass-probe", "-o", "cat", "--no-pager"]
    printed = subprocess.run(journal, capture_output=True, text=True, check=True).stdout
    assert done.returncode == 0, printed
    return printed


def test_the_service_may_use_a_video_device_and_a_can_bus():
    with Vivid(640, 480, fps=40):
        printed = run_as_the_unit(PROGRAM)
    assert "got (480, 640, 3)" in printed
    assert "sent on socketcan channel 'vcan0'" in printed
