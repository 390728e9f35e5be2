"""The virtual Kinect's own side: its file, its clock and its raster."""

import time

import numpy as np
import pytest
from openni2_cells import Counting, until

from drivers.emulators.virtual_kinect import VirtualKinect
from drivers.openni2.call_thread import CallThread, HungError
from drivers.openni2.virtual_file import Header, VirtualFile
from surfclass.errors import InputError


class Slow(Counting):
    def depth(self, t_ns, key):
        time.sleep(0.12)
        return super().depth(t_ns, key)


def test_its_file_is_there_while_it_runs(tmp_path):
    kinect = VirtualKinect(Counting(), tmp_path / "kinect")
    for _ in range(2):
        kinect.start()
        kinect.start()
        assert [path.name for path in tmp_path.iterdir()] == ["kinect"]
        kinect.stop()
        kinect.stop()
        assert list(tmp_path.iterdir()) == []


def test_one_that_takes_over_the_path_is_not_removed_with_the_one_before(tmp_path):
    first = VirtualKinect(Counting(), tmp_path / "kinect")
    second = VirtualKinect(Counting(), tmp_path / "kinect")
    first.start()
    with second:
        first.stop()
        assert (tmp_path / "kinect").exists()


def test_exposures_come_after_a_constant_time_where_rendering_is_quick_enough(tmp_path):
    with VirtualKinect(Slow(), tmp_path / "kinect", latency_s=0.5, fps=4.0) as kinect:
        until(lambda: len(kinect.exposures()) >= 3)
        assert kinect.late == 0
    delays = [truth.published_ns - truth.t_ns for truth in kinect.exposures()]
    assert min(delays) >= 0.5e9
    with VirtualKinect(Slow(), tmp_path / "kinect", latency_s=0.0) as kinect:
        until(lambda: len(kinect.exposures()) >= 3)
        assert kinect.late >= 3


def test_exposures_lie_on_its_raster_and_its_clock_drifts_as_told(tmp_path):
    with VirtualKinect(Counting(), tmp_path / "k", fps=100.0, drift_ppm=-400.0, offset_us=77) as kinect:
        until(lambda: len(kinect.exposures()) >= 30)
        kinect.jump_clock(5_000_000)
        until(lambda: kinect.exposures()[-1].timestamp_us > 5_000_000)
    truths = kinect.exposures()
    t_ns = np.array([truth.t_ns for truth in truths])
    assert np.all(np.diff(t_ns) % 10_000_000 == 0)
    ticks = np.array([truth.timestamp_us for truth in truths])
    jump = int(np.argmax(np.diff(ticks))) + 1
    before = slice(0, jump)
    rate = np.polyfit(t_ns[before] - t_ns[0], (ticks[before] - ticks[0]) * 1000.0, 1)[0]
    assert abs(rate - (1 - 400e-6)) < 50e-6
    assert ticks[0] < 100_000


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_defect_in_the_world_looks_like_a_camera_that_was_unplugged(tmp_path):
    class Broken(Counting):
        def depth(self, t_ns, key):
            raise ArithmeticError

    with VirtualKinect(Broken(), tmp_path / "kinect"):
        until(lambda: Header.from_buffer_copy((tmp_path / "kinect").read_bytes()).plugged == 0)


@pytest.mark.parametrize(
    "wrong", [{"fps": 0.0}, {"latency_s": -1.0}, {"drift_ppm": 1e6}, {"offset_us": -1}, {"latency_s": 11.0}]
)
def test_numbers_out_of_range_are_refused(tmp_path, wrong):
    with pytest.raises(InputError, match="virtual Kinect"):
        VirtualKinect(Counting(), tmp_path / "kinect", **wrong)


@pytest.mark.parametrize(
    ("size", "fps", "serial"),
    [((0, 1), 30, ""), ((9000, 1), 30, ""), ((1, 1), 0, ""), ((1, 1), 30, "x" * 32)],
)
def test_a_file_of_another_kind_is_refused(tmp_path, size, fps, serial):
    with pytest.raises(InputError):
        VirtualFile(tmp_path / "kinect", size, fps, (1.0, 1.0), serial)
    assert list(tmp_path.iterdir()) == []


def test_a_call_that_does_not_come_back_hangs_nobody_but_its_thread():
    thread = CallThread()
    assert thread.call(divmod, 7, 3, timeout_s=5.0) == (2, 1)
    with pytest.raises(ZeroDivisionError):
        thread.call(divmod, 7, 0, timeout_s=5.0)
    for _ in range(2):
        with pytest.raises(HungError):
            thread.call(time.sleep, 1.0, timeout_s=0.05)
    assert thread.hangs
