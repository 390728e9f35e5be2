"""The arm's driver against a controller that behaves, and one that does not."""

from __future__ import annotations

import math
import socket
import threading
import time

import numpy as np
import pytest

from drivers.arm_bcap import arm
from drivers.bcap.result import Result
from drivers.clock import SystemClock
from drivers.emulators.bcap_controller import BcapController
from drivers.emulators.bcap_machine import BcapFaults
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)
from surfclass.errors import ConfigurationError

REST = np.array([0.1, -0.2, 1.5, 0.3, -0.4, 0.5])
PATIENT_S = 5.0
READING = {1, 2, 3, 4, 7, 17, 62, 64, 84, 101, 111}


class RestingArm:
    def joints(self, t_ns):
        return REST


class SwingingArm:
    """Joint 1 goes to and fro at up to 1 rad/s."""

    def joints(self, t_ns):
        return REST + np.array([0.5 * math.sin(2.0 * t_ns / 1e9), 0, 0, 0, 0, 0])


class HiccupingArm:
    """One reading of many is of no arm."""

    def __init__(self):
        self.readings = 0

    def joints(self, t_ns):
        self.readings += 1
        return REST + (10.0 if self.readings % 8 == 0 else 0.0)


@pytest.fixture
def controller(request, tmp_path):
    how = getattr(request, "param", {})
    cell = how.get("cell", RestingArm)()
    made = BcapController(cell, serial_link=tmp_path / "tty", model=how.get("model", "RC8"))
    with made:
        yield made


def made_arm(controller, transport="tcp", **options):
    where = {"host": controller.host, "port": controller.port}
    if transport == "serial":
        where = {"port_path": str(controller._serial_link)}
    options = {"transport": transport, "max_gap_s": 2.0, **where, **options}
    return arm(name="arm", clock=SystemClock(), options=options, shared={})


def status(device):
    return device.about()["status"]


def used_until_it_fails(device, within_s=PATIENT_S):
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        device.read_joints(PATIENT_S)
        time.sleep(0.005)


def eventually(condition, within_s=PATIENT_S):
    until = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


both_models = pytest.mark.parametrize("controller", [{"model": "RC8"}, {"model": "RC7"}], indirect=True)
every_transport = pytest.mark.parametrize(
    "transport", ["tcp", "udp", pytest.param("serial", marks=pytest.mark.slow)]
)


@both_models
@every_transport
def test_the_joints_are_read_in_radians(controller, transport):
    with made_arm(controller, transport) as device:
        for _ in range(3):
            assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        assert device.joints_at(time.monotonic_ns(), PATIENT_S).q == pytest.approx(REST)
        device.check()
        expected = "HighCurJntEx" if controller.machine.model == "RC8" else "@CURRENT_ANGLE"
        assert expected in device.about()["format"]


@both_models
@every_transport
def test_it_never_asks_for_more_than_reading(controller, transport):
    with made_arm(controller, transport) as device:
        device.read_joints(PATIENT_S)
        controller.faults.result = Result.E_FAIL
        with pytest.raises(DeviceFaultError):
            used_until_it_fails(device)
    assert {call.function for call in controller.calls} <= READING
    assert {call.text for call in controller.calls if call.function == 64} == {"HighCurJntEx"}
    assert {call.text for call in controller.calls if call.function == 17} == {"GetErrorDescription"}
    assert {call.text for call in controller.calls if call.function == 62} <= {"@CURRENT_ANGLE"}


@both_models
@every_transport
def test_close_gives_everything_back(controller, transport):
    with made_arm(controller, transport) as device:
        device.read_joints(PATIENT_S)
        assert controller.open_sessions == 1
    assert controller.open_sessions == 0
    asked = [call.function for call in controller.calls]
    ends = [111, 84, 4, 2] if controller.machine.model == "RC7" else [84, 4, 2]
    assert asked[-len(ends) :] == ends
    assert not [thread for thread in threading.enumerate() if thread.name == "arm reader"]


@pytest.mark.parametrize("controller", [{"cell": SwingingArm}], indirect=True)
@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_a_moving_arm_is_where_it_was_within_the_uncertainty(controller, transport):
    truth = SwingingArm()
    with made_arm(controller, transport) as device:
        time.sleep(0.05)  # for some readings before the first time asked for
        for _ in range(20):
            before_ns = time.monotonic_ns()
            reading = device.read_joints(PATIENT_S)
            assert before_ns <= reading.t_ns - reading.t_sd_ns
            assert reading.t_ns + reading.t_sd_ns <= time.monotonic_ns()
            asked_ns = time.monotonic_ns() - 3_000_000
            between = device.joints_at(asked_ns, PATIENT_S)
            assert between.t_ns == asked_ns
            assert abs(reading.q - truth.joints(reading.t_ns)).max() <= reading.t_sd_ns / 1e9 + 1e-6
            # 2 rad/s² over the gap between two readings, which on a busy computer may be long
            assert abs(between.q - truth.joints(asked_ns)).max() <= between.t_sd_ns / 1e9 + 0.01


@pytest.mark.parametrize("transport", ["udp", "serial"])
def test_lost_and_doubled_packets_cost_time_and_nothing_else(controller, transport):
    with made_arm(controller, transport) as device:
        controller.faults.lose_requests, controller.faults.lose_replies = 5, 7
        controller.faults.duplicate = True
        for _ in range(15):
            assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        assert "repeated calls" in status(device)
        if transport == "udp":  # on a line what is left over is dropped before the next call
            assert "late replies" in status(device)


@every_transport
def test_a_controller_that_executes_is_busy_or_slow_is_waited_for(controller, transport):
    with made_arm(controller, transport, service="WDT=80") as device:
        controller.faults.executing = 3
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        controller.faults.busy = 4
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        controller.faults.delay_s = 0.7  # longer than its silence may be
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        assert "busy" in status(device)
        assert "time-outs" not in status(device)


@pytest.mark.parametrize("wire", ["garbage", "half", "huge", "fin", "rst"])
def test_what_breaks_the_stream_is_a_loss_after_which_it_is_opened_anew(controller, wire):
    with made_arm(controller) as device:
        before = device.read_joints(PATIENT_S)
        controller.faults.wire = wire
        with pytest.raises(DeviceLostError):
            used_until_it_fails(device)
        with pytest.raises(DeviceLostError):
            device.check()
        with pytest.raises(DeviceLostError):
            device.joints_at(before.t_ns, PATIENT_S)
        device.close()
        controller.machine.faults = BcapFaults()
        device.open()
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        with pytest.raises(DeviceTimeoutError, match="oldest"):  # nothing from before the loss
            device.joints_at(before.t_ns, PATIENT_S)


@pytest.mark.parametrize("transport", ["udp", "serial"])
@pytest.mark.parametrize("wire", ["garbage", "half", "huge"])
def test_where_packets_are_single_garbage_is_silence(controller, transport, wire):
    with made_arm(controller, transport, timeout_s=0.2) as device:
        controller.faults.wire = wire
        with pytest.raises(DeviceTimeoutError):
            device.read_joints(0.3)
        controller.faults.wire = ""
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)


@every_transport
def test_a_mute_controller_is_noticed_by_the_check_and_closed_in_time(controller, transport):
    device = made_arm(controller, transport, timeout_s=0.2)
    device.open()
    controller.faults.mute = True
    with pytest.raises(DeviceTimeoutError):
        eventually(lambda: device.check() is not None)
    begin = time.monotonic()
    device.close()
    assert time.monotonic() - begin < 3.0
    with pytest.raises(DeviceNotFoundError):
        device.open()
    assert not device.is_open
    controller.faults.mute = False
    with device:
        device.read_joints(PATIENT_S)


def test_a_clock_that_stands_still_gives_no_readings_now_or_after_opening_anew(controller):
    with made_arm(controller) as device:
        device.read_joints(PATIENT_S)
        controller.faults.frozen = True
        time.sleep(0.05)
        with pytest.raises(DeviceTimeoutError, match="clock stands still"):
            device.read_joints(0.3)
        with pytest.raises(DeviceTimeoutError, match="clock stands still"):
            device.joints_at(time.monotonic_ns(), 0.3)
        with pytest.raises(DeviceTimeoutError, match="clock stands still"):
            eventually(lambda: device.check() is not None)
        device.close()
        with pytest.raises(DeviceNotFoundError, match="use_controller_clock"):
            device.open()
        controller.faults.frozen = False
        device.open()
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)


def test_without_its_clock_a_controller_is_read_by_the_hosts(controller):
    controller.faults.frozen = True
    with made_arm(controller, use_controller_clock=False) as device:
        device.read_joints(PATIENT_S)
        assert "host" in device.about()["clock"]


@pytest.mark.parametrize("controller", [{"cell": SwingingArm}], indirect=True)
@pytest.mark.parametrize("jump_ms", [-100_000.0, 100_000.0])
def test_a_clock_that_jumps_is_counted_and_dates_nothing_wrong(controller, jump_ms):
    truth = SwingingArm()
    with made_arm(controller) as device:
        device.read_joints(PATIENT_S)
        controller.faults.jump_ms = jump_ms
        for _ in range(20):
            reading = device.read_joints(PATIENT_S)
            assert abs(reading.q - truth.joints(reading.t_ns)).max() <= reading.t_sd_ns / 1e9 + 1e-6
        assert "1 jumps" in device.about()["clock"]


REFUSED = {
    Result.E_HANDLE: DeviceLostError,
    Result.E_INVALIDRCVPACKET: DeviceLostError,
    Result.E_FAIL: DeviceFaultError,
    Result.E_ABORT: DeviceFaultError,
    0x83201482: DeviceFaultError,
}


@pytest.mark.parametrize(("result", "error"), REFUSED.items(), ids=str)
def test_a_refused_read_is_a_loss_or_a_fault_in_the_controllers_words(controller, result, error):
    with made_arm(controller) as device:
        controller.faults.result = result
        with pytest.raises(error, match=f"0x{result:08X}") as caught:
            used_until_it_fails(device)
        assert ("controller's words" in str(caught.value)) == (error is DeviceFaultError)
        with pytest.raises(error):
            device.check()
        controller.faults.result = 0
        with pytest.raises(error):  # until it is opened anew
            device.read_joints(PATIENT_S)


def test_a_controllers_own_timeout_is_a_timeout_that_passes(controller):
    with made_arm(controller) as device:
        controller.faults.result = Result.E_TIMEOUT
        with pytest.raises(DeviceTimeoutError, match="0x80000900"):
            device.read_joints(0.3)
        controller.faults.result = 0
        device.read_joints(PATIENT_S)


def test_a_controller_that_refuses_at_once_is_not_opened(controller):
    controller.faults.result = Result.E_FAIL
    device = made_arm(controller)
    with pytest.raises(DeviceFaultError, match="0x80004005"):
        device.open()
    assert not device.is_open
    eventually(lambda: controller.open_sessions == 0)


IMPOSSIBLE = {
    "no number": (math.nan, 0.0, 90.0, 0.0, 0.0, 0.0),
    "infinite": (math.inf, 0.0, 90.0, 0.0, 0.0, 0.0),
    "beyond its limit": (0.0, 0.0, 200.0, 0.0, 0.0, 0.0),
    "of another unit": (1000.0, 2000.0, 9000.0, 0.0, 0.0, 0.0),
    "a jump": (90.0, 0.0, 45.0, 0.0, 0.0, 0.0),
}


@pytest.mark.parametrize("degrees", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_joints_that_stay_impossible_are_a_fault(controller, degrees):
    with made_arm(controller, max_speed_deg_s=1.0) as device:
        device.read_joints(PATIENT_S)
        controller.faults.degrees = degrees
        with pytest.raises(DeviceFaultError, match="impossible joints"):
            used_until_it_fails(device)


@pytest.mark.parametrize("controller", [{"cell": HiccupingArm}], indirect=True)
def test_a_single_impossible_reading_is_passed_over_and_counted(controller):
    with made_arm(controller) as device:
        for _ in range(30):
            assert device.read_joints(PATIENT_S).q == pytest.approx(REST)
        assert "impossible" in status(device)


@pytest.mark.parametrize("rest", [(), (math.nan, math.inf), (1e300, -5e-324), (0.0,) * 10])
def test_what_stands_after_six_joints_means_nothing(controller, rest):
    controller.faults.degrees = (*np.degrees(REST), *rest)
    with made_arm(controller) as device:
        assert device.read_joints(PATIENT_S).q == pytest.approx(REST)


@both_models
def test_fewer_than_six_joints_are_a_fault(controller):
    controller.faults.degrees = (1.0, 2.0, 3.0)
    with pytest.raises(DeviceFaultError, match="numbers"):
        made_arm(controller).open()


def test_it_reads_by_itself_as_often_as_it_is_told(controller):
    with made_arm(controller, rate_hz=50.0) as device:
        first = len(controller.calls)
        time.sleep(1.0)
        assert 10 <= len(controller.calls) - first <= 60
        device.check()


def test_readings_that_were_asked_for_do_not_put_off_the_others(controller):
    with made_arm(controller) as device:
        for _ in range(200):
            device.read_joints(PATIENT_S)
        first = len(controller.calls)
        eventually(lambda: len(controller.calls) > first + 10, within_s=1.0)


def test_no_session_left_is_tried_again_later(controller):
    controller._max_sessions = 1
    with made_arm(controller), pytest.raises(DeviceNotFoundError, match="0x8000090B"):
        made_arm(controller).open()
    with made_arm(controller) as device:
        device.read_joints(PATIENT_S)


def test_whoever_takes_connections_and_says_nothing_is_no_controller():
    with socket.create_server(("127.0.0.1", 0)) as server:
        options = {"host": "127.0.0.1", "port": server.getsockname()[1], "timeout_s": 0.2}
        device = arm(name="arm", clock=SystemClock(), options=options, shared={})
        with pytest.raises(DeviceNotFoundError, match="SERVICE_START"):
            device.open()
        assert not device.is_open


def test_whoever_speaks_another_protocol_is_no_controller():
    def answer(server):
        connection, _ = server.accept()
        with connection:
            connection.recv(100)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=answer, args=(server,))
        thread.start()
        options = {"host": "127.0.0.1", "port": server.getsockname()[1]}
        device = arm(name="arm", clock=SystemClock(), options=options, shared={})
        with pytest.raises(DeviceNotFoundError, match=r"no b-CAP"):
            device.open()
        thread.join()


def test_texts_that_fit_into_no_packet_are_told(controller):
    with pytest.raises(DeviceFaultError, match="CONTROLLER_CONNECT cannot be sent"):
        made_arm(controller, "udp", option="x" * 300).open()


def test_a_robot_of_another_name_is_not_there(controller):
    with pytest.raises(DeviceFaultError, match="CONTROLLER_GET_ROBOT"):
        made_arm(controller, robot="Arm7").open()


@pytest.mark.parametrize("service", ["", "WDT=400,InvokeTimeout=180000"])
def test_the_options_of_the_service_are_as_configured(controller, service):
    with made_arm(controller, service=service):
        assert next(iter(controller.calls)).text == service


def test_a_service_option_that_the_controller_refuses_is_told(controller):
    with pytest.raises(DeviceFaultError, match=r"SERVICE_START: 0x80070057"):
        made_arm(controller, service="WDT=10").open()


BAD_OPTIONS = {
    "no host": ({}, 'transport "tcp" needs host'),
    "no port path": ({"transport": "serial"}, 'transport "serial" needs port_path'),
    "both": ({"transport": "serial", "port_path": "/dev/ttyS0", "host": "10.0.0.1"}, "and no host"),
    "too many retries": ({"host": "h", "retries": 8}, "retries"),
    "a misspelt key": ({"host": "h", "rate_Hz": 100.0}, "did you mean 'rate_hz'"),
    "a gap below the rate": ({"host": "h", "rate_hz": 10.0, "max_gap_s": 0.1}, "max_gap_s"),
    "limits the wrong way": ({"host": "h", "limits_deg": [[1.0, 0.0]] * 6}, "limits_deg of joint 1"),
}


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_options_that_cannot_be_are_told(options, message):
    with pytest.raises(ConfigurationError, match=message):
        arm(name="arm", clock=SystemClock(), options=options, shared={})


def test_errors_are_of_the_five_whatever_happens_meanwhile(controller):
    """Faults come and go at random times; what leaves the driver is a reading or one of the five."""
    draw = np.random.default_rng(7)
    device = made_arm(controller, timeout_s=0.1, patience_s=0.3)
    kinds = [
        {"mute": True},
        {"wire": "garbage"},
        {"wire": "half"},
        {"wire": "rst"},
        {"result": Result.E_FAIL},
        {"result": Result.E_HANDLE},
        {"frozen": True},
        {"busy": 3},
        {"jump_ms": 5e4},
        {"degrees": (math.nan,) * 8},
    ]
    readings = 0
    for _ in range(15):
        controller.machine.faults = (
            BcapFaults(**kinds[draw.integers(len(kinds))]) if draw.random() < 0.6 else BcapFaults()
        )
        try:
            device.open()
            for _ in range(3):
                reading = device.read_joints(0.2)
                assert reading.q == pytest.approx(REST)
                readings += 1
        except DriverError:
            device.close()
    device.close()
    assert readings > 5
