"""The reader of an emulated PLC's frames: what it believes, how it fails, and that it only listens."""

import socket
import threading
import time
from types import SimpleNamespace

import can
import can.interfaces.slcan
import can.interfaces.virtual
import can_site
import numpy as np
import pytest

import drivers.canbus.bus
from drivers.backends import create
from drivers.canbus.joints import JointSet
from drivers.canbus.stamps import Arrivals, Span
from drivers.clock import SystemClock
from drivers.emulators.slcan_adapter import SlcanAdapter
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverUnavailableError,
)
from surfclass.errors import ConfigurationError, InputError


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize("closed", [{"counter": "Counter"}, {"sync": "Sync"}], ids=["counter", "sync"])
class TestSets:
    def test_all_six_angles_are_of_one_time_and_that_time_is_told(self, tmp_path, closed):
        cell = can_site.Turning()
        with (
            can_site.bridge_on_a_bus(tmp_path, cell),
            can_site.reader(can_site.bridge_options("virtual", tmp_path, **closed)) as arm,
        ):
            for _ in range(10):
                before_ns = time.monotonic_ns()
                reading = arm.read_joints(can_site.PATIENT_S)
                assert before_ns <= reading.t_ns - reading.t_sd_ns
                assert reading.t_ns + reading.t_sd_ns <= time.monotonic_ns()
                can_site.assert_of_one_time(cell, reading)

    def test_a_time_between_two_sets_is_interpolated(self, tmp_path, closed):
        cell = can_site.Turning()
        with (
            can_site.bridge_on_a_bus(tmp_path, cell),
            can_site.reader(can_site.bridge_options("virtual", tmp_path, **closed)) as arm,
        ):
            time.sleep(0.1)
            for back_ns in (0, 7_000_000, 43_000_000):
                t_ns = time.monotonic_ns() - back_ns
                reading = arm.joints_at(t_ns, can_site.PATIENT_S)
                assert reading.t_ns == t_ns
                can_site.assert_of_one_time(cell, reading)

    @pytest.mark.parametrize("fault", ["missing", "late", "short", "garbage", "mute"])
    def test_a_set_that_is_not_whole_is_none(self, tmp_path, closed, fault):
        with can_site.bridge_on_a_bus(tmp_path, late_s=0.11) as (bridge, _):
            options = can_site.bridge_options("virtual", tmp_path, **closed)
            with can_site.reader(options) as arm:
                bridge.faults = {fault}
                time.sleep(0.22)
                with pytest.raises(DeviceTimeoutError, match=r"\d+ frames came, sets: "):
                    arm.read_joints(0.1)
                with pytest.raises(DeviceTimeoutError):
                    arm.check()
                bridge.faults = set()
                arm.read_joints(can_site.PATIENT_S)
                arm.check()

    def test_frames_that_come_twice_change_nothing(self, tmp_path, closed):
        cell = can_site.Turning()
        with can_site.bridge_on_a_bus(tmp_path, cell) as (bridge, _):
            bridge.faults = {"duplicated"}
            with can_site.reader(can_site.bridge_options("virtual", tmp_path, **closed)) as arm:
                for _ in range(5):
                    can_site.assert_of_one_time(cell, arm.read_joints(can_site.PATIENT_S))


class TestTheCounter:
    @pytest.mark.parametrize(("fault", "count"), [("mixed", "incomplete"), ("frozen", "repeated")])
    def test_one_that_is_wrong_or_stands_still_gives_no_set(self, tmp_path, fault, count):
        with (
            can_site.bridge_on_a_bus(tmp_path) as (bridge, _),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            bridge.faults = {fault}
            time.sleep(0.1)
            with pytest.raises(DeviceTimeoutError, match=count):
                arm.read_joints(0.2)


def test_the_latency_is_taken_off_and_its_doubt_added(tmp_path):
    cell = can_site.Turning()
    options = can_site.bridge_options("virtual", tmp_path, latency_ms=50.0, latency_sd_ms=10.0)
    with can_site.bridge_on_a_bus(tmp_path, cell), can_site.reader(options) as arm:
        before_ns = time.monotonic_ns()
        reading = arm.read_joints(can_site.PATIENT_S)
        assert reading.t_sd_ns >= 10_000_000
        assert reading.t_ns - reading.t_sd_ns >= before_ns
        assert cell.times_ns(reading.q).mean() - reading.t_ns >= 30_000_000


def test_impossible_angles_are_a_fault_until_possible_ones_come(tmp_path):
    with can_site.bridge_on_a_bus(tmp_path) as (bridge, _):
        options = can_site.bridge_options("virtual", tmp_path)
        with can_site.reader(options) as arm:
            seen = arm.read_joints(can_site.PATIENT_S)
            bridge.faults = {"impossible"}
            assert "joint 2 at 400°, allowed are -93° to 138°" in str(can_site.fails(arm))
            with pytest.raises(DeviceFaultError):
                arm.check()
            with pytest.raises(DeviceFaultError):
                arm.joints_at(time.monotonic_ns(), 0.3)
            bridge.faults = set()
            can_site.waits_for(lambda: not failing(arm))
            with pytest.raises(DeviceTimeoutError, match="before the oldest"):
                arm.joints_at(seen.t_ns, 0.3)
        bridge.faults = {"unavailable"}
        with pytest.raises(DeviceFaultError, match=r"j5: Joints56\.J5 says 'NotAvailable'"):
            can_site.reader(options).open()


def test_a_single_impossible_set_is_passed_over(tmp_path):
    sets = iter([0.5, 0.51, 3.5, 0.52, 0.9, 0.53])  # beyond its limits, then faster than it can turn
    arm = can_site.reader(can_site.bridge_options("virtual", tmp_path))
    start_ns = time.monotonic_ns() - 60_000_000
    for number, angle in enumerate(sets):
        span = Span(start_ns + number * 10_000_000, start_ns + number * 10_000_000 + 1000)
        arm.heard(JointSet(span, (angle,) * 6))
    kept = [arm._history._ring[index].q[0] for index in range(len(arm._history._ring))]
    assert kept == [0.5, 0.51, 0.52, 0.53]


def test_a_loss_is_told_after_a_fault_too(tmp_path):
    with (
        can_site.bridge_by_slcan(tmp_path / "can") as (bridge, adapter),
        can_site.reader(can_site.bridge_options("slcan", tmp_path / "can")) as arm,
    ):
        bridge.faults = {"impossible"}
        assert isinstance(can_site.fails(arm), DeviceFaultError)
        adapter.stop()
        can_site.waits_for(lambda: isinstance(can_site.outcome(arm), DeviceLostError))


def failing(arm):
    try:
        arm.check()
    except (DeviceFaultError, DeviceTimeoutError):
        return True
    return False


def test_a_bus_without_the_arms_frames_is_not_found_and_the_message_says_what_came(tmp_path):
    with can_site.bridge_on_a_bus(tmp_path) as (bridge, _):
        bridge.faults = {"missing"}
        arm = can_site.reader(can_site.bridge_options("virtual", tmp_path))
        with pytest.raises(
            DeviceNotFoundError, match=r"virtual .*no joint reading.*frames came, sets: \d+ incomp"
        ):
            arm.open()
        assert not arm.is_open


def test_it_sends_nothing(tmp_path):
    with can_site.bridge_on_a_bus(tmp_path / "bus") as (_, end):
        with can_site.reader(can_site.bridge_options("virtual", tmp_path / "bus")) as arm:
            arm.read_joints(can_site.PATIENT_S)
            arm.check()
            arm.about()
        assert list(end.heard) == []
        with pytest.raises(DeviceLostError, match="listening only"):
            drivers.canbus.bus.CanBus(
                "arm", SimpleNamespace(interface="virtual", channel="x", bitrate=None)
            ).send(1, b"")
    with can_site.bridge_by_slcan(tmp_path / "can") as (_, adapter):
        with can_site.reader(can_site.bridge_options("slcan", tmp_path / "can", bitrate=500_000)) as arm:
            arm.read_joints(can_site.PATIENT_S)
            assert adapter.mode == "listening"
        can_site.waits_for(lambda: adapter.mode == "closed")
        assert set(adapter.commands) <= {b"C", b"S6", b"", b"L"}


def test_timeouts_have_to_be_above_0(tmp_path):
    with (
        can_site.bridge_on_a_bus(tmp_path),
        can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
    ):
        for timeout_s in (0.0, -1.0, float("nan")):
            with pytest.raises(InputError):
                arm.read_joints(timeout_s)


class WallClock:
    """The wall clock as the driver and python-can's virtual bus see it."""

    def __init__(self, monkeypatch):
        self.ahead_s = 0.0
        monkeypatch.setattr(can.interfaces.virtual, "time", SimpleNamespace(time=self.now))
        monkeypatch.setattr(can.bus, "time", self.now)
        monkeypatch.setattr(
            drivers.canbus.bus,
            "Arrivals",
            lambda: Arrivals(wall_ns=lambda: time.time_ns() + round(self.ahead_s * 1e9)),
        )

    def now(self):
        return time.time() + self.ahead_s


class TestTheWallClock:
    @pytest.mark.parametrize("step_s", [3600.0, -3600.0, 0.05])
    def test_setting_it_moves_no_reading(self, tmp_path, monkeypatch, step_s):
        wall, cell = WallClock(monkeypatch), can_site.Turning()
        with (
            can_site.bridge_on_a_bus(tmp_path, cell),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            arm.read_joints(can_site.PATIENT_S)
            wall.ahead_s += step_s
            for _ in range(5):
                before_ns = time.monotonic_ns()
                reading = arm.read_joints(can_site.PATIENT_S)
                assert before_ns <= reading.t_ns - reading.t_sd_ns
                assert reading.t_ns + reading.t_sd_ns <= time.monotonic_ns()
                can_site.assert_of_one_time(cell, reading)
            assert "set 1 times" in arm.about()["clock"]

    def test_setting_it_back_keeps_nothing_waiting(self, tmp_path, monkeypatch):
        wall = WallClock(monkeypatch)
        with (
            can_site.bridge_on_a_bus(tmp_path) as (bridge, _),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            bridge.faults = {"mute"}
            until_s = time.monotonic() + 0.3
            while time.monotonic() < until_s:
                wall.ahead_s -= 1000.0
                time.sleep(0.003)
            began_s = time.monotonic()
            arm.close()
            assert time.monotonic() - began_s < 1.0


class TestUnplugging:
    def test_a_pulled_adapter_is_lost_and_nothing_from_before_is_delivered_after(self, tmp_path):
        cell = can_site.Turning()
        with can_site.bridge_by_slcan(tmp_path / "can", cell) as (_, adapter):
            options = can_site.bridge_options("slcan", tmp_path / "can", bitrate=500_000)
            with can_site.reader(options) as arm:
                seen = arm.read_joints(can_site.PATIENT_S)
                adapter.stop()
                assert isinstance(can_site.fails(arm), DeviceLostError)
                with pytest.raises(DeviceLostError):
                    arm.joints_at(seen.t_ns, 0.3)
                with pytest.raises(DeviceLostError):
                    arm.check()
                arm.close()
                with pytest.raises(DeviceNotFoundError, match="is the adapter plugged in"):
                    arm.open()
                adapter.start()
                arm.open()
                with pytest.raises(DeviceTimeoutError):
                    arm.joints_at(seen.t_ns, 0.3)
                can_site.assert_of_one_time(cell, arm.read_joints(can_site.PATIENT_S), late_s=1.0)

    def test_a_silent_bus_that_is_gone_is_lost_though_python_can_returns_nothing(self, tmp_path, monkeypatch):
        with (
            can_site.bridge_by_slcan(tmp_path / "can") as (_, adapter),
            can_site.reader(can_site.bridge_options("slcan", tmp_path / "can")) as arm,
        ):
            monkeypatch.setattr(
                can.interfaces.slcan.slcanBus,
                "_recv_internal",
                lambda self, timeout: (time.sleep(timeout), (None, False))[1],
            )
            arm.check()
            adapter.stop()
            error = can_site.fails(arm)
            assert isinstance(error, DeviceLostError)
            assert "unplugged" in str(error)

    def test_two_readers_do_not_share_an_adapter(self, tmp_path):
        with can_site.bridge_by_slcan(tmp_path / "can") as (_, adapter):
            options = can_site.bridge_options("slcan", tmp_path / "can", bitrate=500_000)
            with can_site.reader(options) as arm:
                adapter.commands.clear()
                with pytest.raises(DeviceNotFoundError, match="another program has it open"):
                    can_site.reader(options).open()
                assert list(adapter.commands) == [], "nothing was written to it"
                arm.read_joints(can_site.PATIENT_S)
            with can_site.reader(options) as arm:
                arm.read_joints(can_site.PATIENT_S)


class TestGarbageFromAnAdapter:
    @pytest.mark.parametrize(
        "line",
        [
            *(b"t1818zz\r", b"\xff\xfe\x80\r", b"\r\r\a\a", b"t\r", b"t18\r", b"t1819\r", b"T0\r", b"x\r"),
            *(b"t1818001122\r", b"b1\r", b"q" * 5000 + b"\r"),
        ],
        ids=lambda line: repr(line[:12]),
    )  # fmt: skip
    def test_it_costs_a_set_at_most(self, tmp_path, line):
        cell = can_site.Turning()
        with (
            can_site.bridge_by_slcan(tmp_path / "can", cell) as (_, adapter),
            can_site.reader(can_site.bridge_options("slcan", tmp_path / "can")) as arm,
        ):
            for _ in range(3):
                adapter.babble(line)
                can_site.assert_of_one_time(cell, arm.read_joints(can_site.PATIENT_S))

    def test_it_is_counted(self, tmp_path):
        with (
            can_site.bridge_by_slcan(tmp_path / "can") as (_, adapter),
            can_site.reader(can_site.bridge_options("slcan", tmp_path / "can")) as arm,
        ):
            adapter.babble(b"t1818zz\r\xff\r")
            can_site.waits_for(lambda: "2 lines that are no frame" in arm.about()["status"])


class TestErrorFrames:
    @pytest.fixture
    def other(self, tmp_path):
        with can.Bus(interface="virtual", channel=str(tmp_path), ignore_config=True) as bus:
            yield bus

    def send(self, bus, kind, data=bytes(8)):
        bus.send(can.Message(arbitration_id=kind, data=data, is_error_frame=True, is_extended_id=False))

    def test_bus_off_is_a_loss(self, tmp_path, other):
        with (
            can_site.bridge_on_a_bus(tmp_path),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            self.send(other, 0x40)
            error = can_site.fails(arm)
            assert isinstance(error, DeviceLostError)
            assert "bus-off" in str(error)
            arm.close()
            arm.open()
            arm.read_joints(can_site.PATIENT_S)

    def test_others_are_counted_and_tell_the_controllers_state(self, tmp_path, other):
        with (
            can_site.bridge_on_a_bus(tmp_path),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            self.send(other, 0x04, bytes([0, 0x20, 0, 0, 0, 0, 0, 0]))
            self.send(other, 0x02)
            can_site.waits_for(lambda: "error-passive, 2 error frames" in arm.about()["status"])
            self.send(other, 0x100)
            can_site.waits_for(lambda: "error-active, 3 error frames" in arm.about()["status"])
            arm.read_joints(can_site.PATIENT_S)

    def test_remote_frames_and_frames_of_others_are_none_of_the_arms(self, tmp_path, other):
        with (
            can_site.bridge_on_a_bus(tmp_path) as (_, _),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            other.send(can.Message(arbitration_id=0x181, is_remote_frame=True, is_extended_id=False))
            other.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=True))
            other.send(can.Message(arbitration_id=0x7FF, data=bytes(8), is_extended_id=False))
            arm.read_joints(can_site.PATIENT_S)
            assert "malformed" not in arm.about()["status"]


class TestAvailability:
    def test_a_kernel_without_can_is_told_from_an_absent_interface(self, monkeypatch):
        def no_can(*_):
            raise OSError(97, "Address family not supported by protocol")

        monkeypatch.setattr(socket, "socket", no_can)
        with pytest.raises(DriverUnavailableError, match="this kernel has no CAN"):
            can_site.reader(can_site.bridge_options("socketcan", "can0")).open()

    @pytest.mark.parametrize(
        ("channel", "message"), [("nocan0", "no such network interface"), ("lo", "is no CAN bus")]
    )
    def test_an_absent_network_interface_is_not_found(self, monkeypatch, channel, message):
        monkeypatch.setattr(socket, "socket", lambda *_: SimpleNamespace(close=lambda: None))
        with pytest.raises(DeviceNotFoundError, match=message):
            can_site.reader(can_site.bridge_options("socketcan", channel)).open()

    @pytest.mark.parametrize("interface", ["pcan", "kvaser", "gs_usb", "vector", "ixxat", "usb2can"])
    def test_a_make_whose_library_is_missing_is_unavailable(self, interface):
        with pytest.raises(
            (DriverUnavailableError, DeviceNotFoundError, ConfigurationError), match=interface
        ):
            can_site.reader(can_site.bridge_options(interface, 0)).open()

    def test_a_bitrate_that_an_adapter_does_not_have_is_refused(self, tmp_path):
        with SlcanAdapter(tmp_path / "can"):
            arm = can_site.reader(can_site.bridge_options("slcan", tmp_path / "can", bitrate=333_333))
            with pytest.raises(ConfigurationError, match="Invalid bitrate"):
                arm.open()
            assert not arm.is_open

    def test_it_is_the_backend_can(self, tmp_path):
        arm = create("arm", "can", clock=SystemClock(), options=can_site.bridge_options("virtual", tmp_path))
        assert arm.name == "arm"
        assert not arm.is_open

    def test_python_cans_configuration_files_and_variables_are_not_read(self, tmp_path, monkeypatch):
        monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true, "bitrate": 1}')
        with (
            can_site.bridge_on_a_bus(tmp_path),
            can_site.reader(can_site.bridge_options("virtual", tmp_path)) as arm,
        ):
            assert np.isfinite(arm.read_joints(can_site.PATIENT_S).q).all()
