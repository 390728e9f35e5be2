"""The simulated cell on the host's clock, in this process and served to another one."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from drivers.sim.cell import host_cell
from drivers.sim.cell_server import CellClient, CellServer
from surfclass.errors import ConfigurationError, InputError

MS = 1_000_000


def small(scene="grey_card", seed=1):
    return host_cell(scene, seed, scale=0.05)


@pytest.fixture
def cell():
    return small()


@pytest.fixture
def served(cell, tmp_path):
    with CellServer(cell, tmp_path / "cell.sock", small):
        client = CellClient(tmp_path / "cell.sock")
        yield client
        client.close()


def lit(cell, level=1.0):
    """Turns the light on and returns a time from which it holds."""
    now = time.monotonic_ns()
    cell.set_light(level, now)
    return now


def test_its_time_is_the_hosts(cell):
    before = time.monotonic_ns()
    assert before <= cell.world.clock.now_ns() <= time.monotonic_ns()
    with cell.world.clock.held():
        held = cell.world.clock.now_ns()
        time.sleep(0.002)
        assert cell.world.clock.now_ns() >= held + 2 * MS


def test_an_exposure_is_waited_for(cell):
    begin = time.monotonic_ns()
    cell.raw(begin, begin + 30 * MS, 0.0, 1)
    assert time.monotonic_ns() >= begin + 30 * MS


@pytest.mark.parametrize(
    ("exposure_ms", "gain_db", "factor"), [(5, 0.0, 0.5), (10, -6.0206, 0.5), (4, 6.0206, 0.8)]
)
def test_exposure_and_gain_scale_the_linear_image(cell, exposure_ms, gain_db, factor):
    begin = lit(cell)
    whole = cell.raw(begin, begin + 10 * MS, 0.0, 1)
    part = cell.raw(begin, begin + exposure_ms * MS, gain_db, 2)
    assert whole.dtype == np.uint16
    assert part.mean() / whole.mean() == pytest.approx(factor, rel=0.02)


def test_the_processed_image_is_the_plain_cameras(cell):
    begin = lit(cell)
    image = cell.rgb(begin, begin + 10 * MS, 0.0, 7)
    assert (image == cell.world.render_colour(cell.joints(begin), 1.0, 7)).all()


def test_the_raw_image_is_the_same_light_without_the_response(cell):
    begin = lit(cell)
    rgb, raw = cell.rgb(begin, begin + 10 * MS, 0.0, 7), cell.raw(begin, begin + 10 * MS, 0.0, 7)
    curve = cell.world.package.response_inverse
    for channel in range(3):
        linear = np.interp(rgb[..., channel] / 255, np.linspace(0, 1, curve.shape[1]), curve[channel])
        np.testing.assert_allclose(linear, raw[..., channel] / 65535, atol=0.005)


def test_the_programme_goes_on_when_the_capture_is_over():
    cell = host_cell("cell", 1, scale=0.05, viewpoints=3)
    world = cell.world
    begin = lit(cell)
    cell.raw(begin, begin + MS, 0.0, 1)
    assert world.program_index == 0
    cell.set_light(0.0, time.monotonic_ns())
    assert world.program_index == 1
    cell.set_light(0.0, time.monotonic_ns())  # off while off says nothing new
    assert world.program_index == 1


def test_an_arm_that_waits_to_be_told_leaves_when_it_was_captured():
    cell = host_cell("cell", 1, scale=0.05, viewpoints=3, told=True)
    begin = lit(cell)
    cell.raw(begin, begin + MS, 0.0, 1)
    cell.set_light(0.0, time.monotonic_ns())
    cell.go_on(0)
    assert cell.world.program_index == 0
    cell.go_on(1)
    cell.go_on(1)
    assert cell.world.program_index == 1
    cell.go_on(2)
    cell.go_on(3)
    assert cell.world.program_done


def test_an_unlit_exposure_does_not_let_the_programme_go_on():
    cell = host_cell("cell", 1, scale=0.05, viewpoints=3)
    begin = time.monotonic_ns()
    cell.raw(begin, begin + MS, 0.0, 1)
    cell.set_light(0.0, time.monotonic_ns())
    assert cell.world.program_index == 0


def test_a_client_gets_what_the_cell_gives(cell, served):
    assert (served.colour_size, served.depth_size) == (cell.colour_size, cell.depth_size)
    begin = time.monotonic_ns()
    served.set_light(0.5, begin)
    assert served.light_level(begin, begin + MS) == 0.5
    np.testing.assert_array_equal(served.joints(begin), cell.joints(begin))
    for mine, theirs in zip(served.depth(begin, 3), cell.depth(begin, 3), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    window = begin, begin + 10 * MS
    np.testing.assert_array_equal(served.raw(*window, 3.0, 4), cell.raw(*window, 3.0, 4))
    np.testing.assert_array_equal(served.rgb(*window, 0.0, 4), cell.rgb(*window, 0.0, 4))
    assert served.program_done == cell.world.program_done


def test_another_scene_can_be_put_up(served):
    begin = time.monotonic_ns()
    card, _ = served.depth(begin, 1)
    served.show("board:rusted", 2)
    board, _ = served.depth(begin, 1)
    assert (card != board).any()
    with pytest.raises(InputError, match=r"show: ConfigurationError: .*nowhere"):
        served.show("nowhere", 2)
    np.testing.assert_array_equal(served.depth(begin, 1)[0], board)


def test_the_light_is_off_when_its_controller_is_killed(cell, tmp_path):
    with CellServer(cell, tmp_path / "cell.sock"):
        code = (
            "import sys, time; from pathlib import Path; from drivers.sim.cell_server import CellClient;"
            "c = CellClient(Path(sys.argv[1])); c.set_light(1.0, time.monotonic_ns());"
            "print('lit', flush=True); time.sleep(60)"
        )
        process = subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path / "cell.sock")], stdout=subprocess.PIPE
        )
        with process:
            assert process.stdout.readline() == b"lit\n"
            assert cell.light_is_on
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        until = time.monotonic() + 5
        while cell.light_is_on and time.monotonic() < until:
            time.sleep(0.01)
        assert not cell.light_is_on


def test_a_client_that_only_looks_leaves_the_light_alone(cell, tmp_path):
    with CellServer(cell, tmp_path / "cell.sock"):
        lit(cell)
        client = CellClient(tmp_path / "cell.sock")
        client.depth(time.monotonic_ns(), 1)
        client.close()
        time.sleep(0.1)
        assert cell.light_is_on


def test_a_server_that_is_gone_is_said(served, cell, tmp_path):
    with pytest.raises(InputError, match="no simulated cell answers there"):
        CellClient(tmp_path / "nothing.sock")
    with pytest.raises(
        InputError, match=r"nonsense: InputError: the cell has no 'nonsense', allowed: joints"
    ):
        served._ask("nonsense")


@pytest.mark.parametrize(
    "garbage", [b"\x00", b"GET / HTTP/1.1\r\n\r\n", b"\x7f" * 5000, b"\x00\x00\x00\x02{}"]
)
def test_garbage_from_one_client_does_not_disturb_another(served, tmp_path, garbage):
    with socket.socket(socket.AF_UNIX) as raw:
        raw.connect(str(tmp_path / "cell.sock"))
        raw.sendall(garbage)
    assert served.light_level(0, 1) == 0.0


def test_numbers_outside_their_range_are_refused():
    with pytest.raises(ConfigurationError, match="scale"):
        host_cell(scale=7.0)
