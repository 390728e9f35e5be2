"""Small worlds for the virtual Kinect, in which every image tells its number."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


class Counting:
    """Images whose pixels are all different functions of place and number; nothing in them is symmetrical."""

    def __init__(self, size=(64, 48)):
        self.depth_size = size

    def depth(self, t_ns, key):
        width, height = self.depth_size
        rows, columns = np.mgrid[:height, :width]
        depth = 1000 + (7 * columns + 13 * rows + key) % 5000
        depth[:, ::5] = 0
        return depth.astype(np.uint16), ((3 * columns + 11 * rows + key) % 1024).astype(np.uint16)


def writer(path, latency_s=0.04):
    """A virtual Kinect in a process of its own, publishing; to be killed."""
    script = (
        "import sys, threading\nfrom pathlib import Path\nfrom openni2_cells import Counting\n"
        "from drivers.emulators.virtual_kinect import VirtualKinect\n"
        f"with VirtualKinect(Counting(), Path(sys.argv[1]), latency_s={latency_s}):\n"
        "    print('ready', flush=True)\n    threading.Event().wait()\n"
    )
    folder = Path(__file__).parent
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(path)],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{folder.parent}"},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def ended(process):
    process.kill()
    process.wait()
    process.stdout.close()


def until(condition, within_s=5.0):
    give_up_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < give_up_s, "it did not come true"
        time.sleep(0.01)
