"""The kernel's test camera, vivid: what is written to its output node comes out of its capture node."""

from __future__ import annotations

import subprocess
import time
from contextlib import ExitStack
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
    """Both nodes of one vivid at one size.

    Its output keeps the last buffer that it was given, and the capture node shows that.

    Args:
        width: Pixels.
        height: Rows.
        fps: Frames per second.
    """

    def __init__(self, width: int, height: int, fps: int) -> None:
        self.size, self._fps = (width, height), fps
        self._shown: tuple[bytes, str] | None = None
        self._open = ExitStack()
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

    def show(self, image: bytes, pixel_format: str) -> None:
        """Lets the capture node show an image of that format from now on, and after plug(), too."""
        from linuxpy.video.device import Device, VideoOutput

        self._open.close()
        self._shown = image, pixel_format
        device = self._open.enter_context(Device(str(self.output)))
        output = VideoOutput(device, size=2)
        output.set_format(*self.size, pixel_format)
        told = output.get_format()
        assert (told.width, told.height, told.size) == (*self.size, len(image)), told
        self._open.enter_context(output)
        for _ in range(3):  # once for each buffer, which were queued empty, and one to push them out
            output.write(image)

    def unplug(self) -> None:
        """Takes the camera off its bus."""
        self._open.close()
        if (_DRIVER / "vivid.0").exists():
            (_DRIVER / "unbind").write_text("vivid.0")
        until(lambda: not self._nodes(), "the end of its nodes")

    def plug(self) -> None:
        """Puts it there, if it is not, with its controls as in the beginning and the image that it showed."""
        self._open.close()
        if not (_DRIVER / "vivid.0").exists():
            (_DRIVER / "bind").write_text("vivid.0")
        until(lambda: len(self._nodes()) == 2, "its nodes")
        subprocess.run(["udevadm", "settle", "--timeout=20"], check=True, timeout=30)
        # Dropping holds for the output, too, which would then wait for ever.
        self.set(percentage_of_dropped_buffers=0)
        timings = "cvt,width={},height={},fps={}".format(*self.size, self._fps)
        for node in (self.capture, self.output):
            ctl(node, f"--set-dv-bt-timings={timings}")
        self.set(loop_video=1, osd_text_mode=2, timestamp_source=0, contrast=128, gain_automatic=1)
        if self._shown is not None:
            self.show(*self._shown)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def _nodes(self) -> list[tuple[str, Path]]:
        names = [(each, each / "name") for each in _CLASS.glob("video*")] if _CLASS.exists() else []
        found = [(file.read_text(), Path("/dev") / each.name) for each, file in names if file.exists()]
        return [(name, node) for name, node in found if name.startswith("vivid") and node.exists()]

    def _node(self, kind: str) -> Path:
        return next(node for name, node in self._nodes() if kind in name)
