import importlib
import os
import threading
import time
import tty
from pathlib import Path

import pytest

from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverUnavailableError,
)
from drivers.serial_port import SerialPort


def open_files():
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


class Wire:
    """A pseudo-terminal; the test is the device at its other end."""

    def __init__(self):
        self._ends = threading.Lock()
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def unplug(self):
        with self._ends:  # a timer of the test may still be at it when the test is over
            for end in (self.master, self.slave):
                if end is not None:
                    os.close(end)
            self.master = self.slave = None


@pytest.fixture
def wire():
    made = Wire()
    yield made
    made.unplug()


@pytest.fixture
def port(wire):
    with SerialPort("led", wire.path, 115200, write_timeout_s=0.1) as opened:
        yield opened


class TestOpening:
    def test_a_port_that_is_not_there_is_not_found(self, tmp_path):
        port = SerialPort("led", str(tmp_path / "ttyUSB0"), 9600)
        with pytest.raises(DeviceNotFoundError, match="no such port"):
            port.open()
        assert not port.is_open

    def test_a_link_that_leads_nowhere_is_not_found(self, tmp_path):
        (tmp_path / "led").symlink_to("/dev/pts/999999")
        with pytest.raises(DeviceNotFoundError, match="no such port"):
            SerialPort("led", str(tmp_path / "led"), 9600).open()

    def test_a_file_or_a_folder_is_no_serial_port(self, tmp_path):
        (tmp_path / "file").touch()
        for path in (tmp_path / "file", tmp_path):
            with pytest.raises(DeviceNotFoundError, match="no serial port"):
                SerialPort("led", str(path), 9600).open()

    def test_a_port_that_somebody_has_is_refused_with_what_to_do(self, wire, port):
        second = SerialPort("arm", wire.path, 115200)
        with pytest.raises(DeviceNotFoundError, match="another program") as caught:
            second.open()
        assert caught.value.device == "arm"
        port.close()
        with second:
            assert second.is_open

    def test_no_permission_says_which_group(self, monkeypatch, tmp_path):
        def refuse(*_):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr("serial.serialposix.os.open", refuse)
        with pytest.raises(DeviceNotFoundError, match="dialout"):
            SerialPort("led", str(tmp_path), 9600).open()

    def test_an_impossible_baud_rate_is_a_fault(self, wire):
        port = SerialPort("led", wire.path, -1)
        with pytest.raises(DeviceFaultError, match="-1 baud"):
            port.open()
        assert not port.is_open

    def test_without_pyserial_it_names_the_package(self, monkeypatch, wire):
        def missing(name):
            raise ModuleNotFoundError(name=name)

        monkeypatch.setattr(importlib, "import_module", missing)
        with pytest.raises(DriverUnavailableError, match="python3-serial"):
            SerialPort("led", wire.path, 9600).open()

    def test_a_refused_opening_leaves_no_file_open(self, wire, port):
        before = open_files()
        for _ in range(5):
            with pytest.raises(DeviceNotFoundError):
                SerialPort("led", wire.path, 115200).open()
        assert open_files() == before

    def test_what_came_before_is_not_read(self, wire):
        os.write(wire.master, b"old")
        with SerialPort("led", wire.path, 115200) as port:
            assert port.read(10, 0.05) == b""

    def test_closing_twice_or_after_a_loss_is_allowed(self, wire, port):
        wire.unplug()
        port.close()
        port.close()
        assert not port.is_open


class TestReading:
    def test_gives_what_is_there_at_once(self, wire, port):
        os.write(wire.master, b"abc")
        assert port.read(100, 5) == b"abc"

    def test_gives_no_more_than_asked_for_and_keeps_the_rest(self, wire, port):
        os.write(wire.master, b"abcdef")
        assert port.read(4, 5) == b"abcd"
        assert port.read(4, 5) == b"ef"

    def test_all_bytes_pass_unchanged(self, wire, port):
        every = bytes(range(256))
        os.write(wire.master, every)
        got = b""
        while len(got) < 256 and (part := port.read(256, 5)):
            got += part
        assert got == every
        port.write(every)
        assert os.read(wire.master, 512) == every

    def test_a_mute_device_gives_nothing_after_the_timeout(self, port):
        before = time.monotonic()
        assert port.read(1, 0.05) == b""
        assert time.monotonic() - before >= 0.05

    def test_discards_what_was_not_read(self, wire, port):
        os.write(wire.master, b"late reply>")
        assert port.read(1, 5) == b"l"
        port.discard()
        assert port.read(10, 0.05) == b""


class TestLoss:
    def test_a_device_that_does_not_drain_is_a_timeout(self, port):
        with pytest.raises(DeviceTimeoutError, match="not taken"):
            port.write(bytes(1_000_000))

    @pytest.mark.parametrize(
        "use",
        [lambda port: port.read(1, 1), lambda port: port.write(b"x"), lambda port: port.discard()],
        ids=["read", "write", "discard"],
    )
    def test_unplugged_is_lost(self, wire, port, use):
        wire.unplug()
        with pytest.raises(DeviceLostError, match=r"led: .*went away"):
            use(port)

    @pytest.mark.parametrize(
        "use",
        [lambda port: port.read(1, 1), lambda port: port.write(b"x"), lambda port: port.discard()],
        ids=["read", "write", "discard"],
    )
    def test_closed_is_lost(self, port, use):
        port.close()
        with pytest.raises(DeviceLostError, match="not open"):
            use(port)

    def test_an_unplug_ends_a_read_that_waits(self, wire, port):
        threading.Timer(0.05, wire.unplug).start()
        before = time.monotonic()
        with pytest.raises(DeviceLostError):
            port.read(1, 30)
        assert time.monotonic() - before < 20
