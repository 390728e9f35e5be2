"""The kernel's test camera, vivid: what is written to its output node comes out of its capture node."""

from __future__ import annotations

import subprocess
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

_DRIVER = Path("/sys/bus/platform/drivers/vivid")
_CLASS = Path("/sys/class/video4linux")


def missing() -> str:
    """Why there is no vivid here; empty where there is one."""
    return "" if (_DRIVER / "bind").exists() else "needs the virtual machine: ./run test --vm"


def until(condition, what: str, patience_s: float = 20.0):
    """Returns what `condition()` gives as soon as that is true."""
    end = time.monotonic() + patience_s
    while not (result := condition()):
        assert time.monotonic() < end, f"{what} did not come in {patience_s} s"
        time.sleep(0.02)
    return result


def ctl(node: Path, *arguments: str) -> str:
    """Runs v4l2-ctl, which is no code of ours."""
    done = subprocess.run(
        ["v4l2-ctl", "-d", str(node), *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"
    return done.stdout


class Vivid:
    """Both nodes of one vivid at one size, with an output that is fed until it is closed.

    Args:
        width: Pixels.
        height: Rows.
        fps: Frames per second.
    """

    def __init__(self, width: int, height: int, fps: int) -> None:
        self.size, self._fps = (width, height), fps
        self._stop, self._thread = threading.Event(), None
        self._fed: tuple[bytes, str] | None = None
        self.plug()

    @property
    def capture(self) -> Path:
        return self._node("vid-cap")

    @property
    def output(self) -> Path:
        return self._node("vid-out")

    def set(self, **controls: int) -> None:
        """Sets controls of the capture node."""
        ctl(self.capture, "-c", ",".join(f"{name}={value}" for name, value in controls.items()))

    def feed(self, image: bytes, pixel_format: str) -> None:
        """Lets the capture node show an image of that format from now on, and after plug(), too."""
        self._stop_feeding()
        self._fed = image, pixel_format
        started = threading.Event()
        self._stop.clear()
        self._thread = threading.Thread(target=self._write, args=(image, pixel_format, started), daemon=True)
        self._thread.start()
        assert started.wait(20), "the output node took no frame"

    def unplug(self) -> None:
        """Takes the camera off its bus."""
        self._stop_feeding()
        if (_DRIVER / "vivid.0").exists():
            (_DRIVER / "unbind").write_text("vivid.0")
        until(lambda: not self._nodes(), "the end of its nodes")

    def plug(self) -> None:
        """Puts it there, if it is not; everything is as new, but for the image that is fed."""
        if not (_DRIVER / "vivid.0").exists():
            (_DRIVER / "bind").write_text("vivid.0")
        until(lambda: len(self._nodes()) == 2, "its nodes")
        subprocess.run(["udevadm", "settle", "--timeout=20"], check=True, timeout=30)
        self.set(percentage_of_dropped_buffers=0)  # which holds for the output, too: it would wait for ever
        timings = "cvt,width={},height={},fps={}".format(*self.size, self._fps)
        for node in (self.capture, self.output):
            ctl(node, f"--set-dv-bt-timings={timings}")
        self.set(loop_video=1, osd_text_mode=2, gain_automatic=1)
        if self._fed is not None:
            self.feed(*self._fed)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._nodes():
            self.set(percentage_of_dropped_buffers=0)  # the output drops its buffers, too, and would wait
        self._stop_feeding()

    def _nodes(self) -> list[tuple[str, Path]]:
        names = [(each, each / "name") for each in _CLASS.glob("video*")] if _CLASS.exists() else []
        found = [(file.read_text(), Path("/dev") / each.name) for each, file in names if file.exists()]
        return [(name, node) for name, node in found if name.startswith("vivid") and node.exists()]

    def _node(self, kind: str) -> Path:
        return next(node for name, node in self._nodes() if kind in name)

    def _write(self, image: bytes, pixel_format: str, started: threading.Event) -> None:
        from linuxpy.video.device import Device, VideoOutput

        with Device(str(self.output)) as device:
            output = VideoOutput(device, size=4)
            output.set_format(*self.size, pixel_format)
            told = output.get_format()
            assert (told.width, told.height, told.size) == (*self.size, len(image)), told
            with output:
                for count in range(1_000_000_000):
                    if self._stop.is_set():
                        return
                    output.write(image)
                    if count == 4:  # the first ones were taken: the loop shows the image
                        started.set()

    def _stop_feeding(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(20)
            assert not self._thread.is_alive(), "the output node is stuck"
            self._thread = None
