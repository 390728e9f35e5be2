"""The emulated controller, asked byte by byte: what it answers, refuses, repeats and does wrongly."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.bcap import packet as bcap
from drivers.bcap.packet import Function, Packet
from drivers.bcap.result import Result, unsigned
from drivers.bcap.variant import EMPTY, Type, Variant, bstr, i4
from drivers.emulators.bcap_controller import BcapController

ANGLES = np.radians([10.0, 20.0, 90.0, -30.0, 40.0, 50.0])


class RestingArm:
    def joints(self, t_ns):
        return ANGLES


class Tcp:
    def __init__(self, controller):
        self.socket = socket.create_connection((controller.host, controller.port), 5.0)
        self.serial = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, code, *args, reserved=0):
        self.serial = bcap.next_serial(self.serial)
        self.socket.sendall(bcap.encode(Packet(self.serial, reserved, code, args)))

    def receive(self):
        data = b""
        while (length := bcap.expected_length(data)) is None or len(data) < length:
            more = self.socket.recv((length or 5) - len(data))
            if not more:
                raise ConnectionError
            data += more
        return bcap.decode(data)

    def call(self, code, *args):
        self.send(code, *args)
        packet = self.receive()
        assert packet.serial == self.serial
        return unsigned(packet.code), packet.args[0].value if packet.args else None

    def handles(self):
        assert self.call(Function.SERVICE_START, bstr("WDT=400"))[0] == Result.S_OK
        texts = map(bstr, ("b-CAP", "CaoProv.DENSO.VRC", "localhost", ""))
        controller = self.call(Function.CONTROLLER_CONNECT, *texts)[1]
        robot = self.call(Function.CONTROLLER_GET_ROBOT, i4(controller), bstr("Arm"), bstr(""))[1]
        variable = self.call(Function.ROBOT_GET_VARIABLE, i4(robot), bstr("@CURRENT_ANGLE"), bstr(""))[1]
        return controller, robot, variable


class Udp(Tcp):
    def __init__(self, controller):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((controller.host, controller.port))
        self.socket.settimeout(5.0)
        self.serial = 0

    def receive(self):
        return bcap.decode(self.socket.recv(2000))


@pytest.fixture
def controller():
    with BcapController(RestingArm()) as made:
        yield made


@pytest.fixture
def client(controller):
    with Tcp(controller) as made:
        yield made


def test_a_joint_readers_calls_are_answered(client):
    controller, robot, variable = client.handles()
    result, names = client.call(13, i4(controller), bstr(""))
    assert names == ("Arm",)
    for code, *args in [
        (Function.VARIABLE_GET_VALUE, i4(variable)),
        (Function.ROBOT_EXECUTE, i4(robot), bstr("CurJnt"), bstr("")),
    ]:
        result, angles = client.call(code, *args)
        assert result == Result.S_OK
        assert len(angles) == 8
        assert angles[:6] == pytest.approx(np.degrees(ANGLES))
    result, stamped = client.call(Function.ROBOT_EXECUTE, i4(robot), bstr("HighCurJntEx"), EMPTY)
    assert len(stamped) == 9
    assert stamped[1:7] == pytest.approx(np.degrees(ANGLES))
    words = client.call(Function.CONTROLLER_EXECUTE, i4(controller), bstr("GetErrorDescription"), i4(-1))[1]
    assert "0xFFFFFFFF" in words
    for code, handle in [
        (Function.VARIABLE_RELEASE, variable),
        (Function.ROBOT_RELEASE, robot),
        (Function.CONTROLLER_DISCONNECT, controller),
    ]:
        assert client.call(code, i4(handle)) == (Result.S_OK, None)
        assert client.call(code, i4(handle))[0] == Result.E_HANDLE
    assert client.call(Function.SERVICE_STOP) == (Result.S_OK, None)


def test_a_handle_of_another_kind_or_session_is_none(controller, client):
    first, robot, variable = client.handles()
    assert client.call(Function.VARIABLE_GET_VALUE, i4(robot))[0] == Result.E_HANDLE
    assert client.call(Function.ROBOT_EXECUTE, i4(variable), bstr("CurJnt"), EMPTY)[0] == Result.E_HANDLE
    with Tcp(controller) as other:
        other.call(Function.SERVICE_START)
        assert other.call(Function.VARIABLE_GET_VALUE, i4(variable))[0] == Result.E_HANDLE
    assert client.call(Function.CONTROLLER_DISCONNECT, i4(first))[0] == Result.S_OK
    assert client.call(Function.VARIABLE_GET_VALUE, i4(variable))[0] == Result.E_HANDLE  # it went with it


def test_what_is_wrong_with_a_call_is_told(client):
    _, robot, variable = client.handles()
    assert client.call(Function.VARIABLE_GET_VALUE, Variant(Type.UI4, variable))[0] == Result.S_OK
    assert client.call(Function.VARIABLE_GET_VALUE, bstr("4"))[0] == Result.E_INVALIDARGTYPE
    assert client.call(Function.ROBOT_GET_VARIABLE, i4(robot), i4(1), bstr(""))[0] == Result.E_INVALIDARGTYPE
    assert client.call(Function.VARIABLE_GET_VALUE)[0] == Result.E_INVALIDARG
    assert client.call(Function.VARIABLE_GET_VALUE, i4(variable), EMPTY)[0] == Result.E_INVALIDARG
    assert (
        client.call(Function.ROBOT_GET_VARIABLE, i4(robot), bstr("@NO"), bstr(""))[0] == Result.E_INVALIDARG
    )
    assert client.call(Function.ROBOT_EXECUTE, i4(robot), bstr("TakeArm"))[0] == Result.E_INVALIDCOMMAND
    assert client.call(72, i4(robot), i4(1), bstr("P1"), bstr(""))[0] == Result.E_NOTIMPL
    assert client.call(9999)[0] == Result.E_NOTIMPL


def test_nothing_is_answered_before_the_service_starts(client):
    assert client.call(Function.VARIABLE_GET_VALUE, i4(2))[0] == Result.E_NOT_CONNECTED


@pytest.mark.parametrize("options", ["WDT=79", "WDT=x", "wdt=", "InvokeTimeout=1"])
def test_options_that_a_service_cannot_keep_are_refused(client, options):
    assert client.call(Function.SERVICE_START, bstr(options))[0] == Result.E_INVALIDARG


def test_an_rc7_has_no_time_stamps():
    with BcapController(RestingArm(), model="RC7") as controller, Tcp(controller) as client:
        _, robot, variable = client.handles()
        call = Function.ROBOT_EXECUTE, i4(robot), bstr("HighCurJntEx"), EMPTY
        assert client.call(*call)[0] == Result.E_INVALIDCOMMAND
        assert client.call(Function.VARIABLE_GET_VALUE, i4(variable))[0] == Result.S_OK


def test_a_slow_call_says_every_wdt_that_it_goes_on(controller, client):
    _, _, variable = client.handles()
    client.call(Function.SERVICE_START, bstr("WDT=100,InvokeTimeout=10000"))
    controller.faults.delay_s = 0.35
    client.send(Function.VARIABLE_GET_VALUE, i4(variable))
    packets = [client.receive()]
    while packets[-1].code == Result.S_EXECUTING:
        packets.append(client.receive())
    assert 2 <= len(packets) - 1 <= 3
    assert {packet.serial for packet in packets} == {client.serial}
    assert packets[-1].code == Result.S_OK


def test_a_call_that_takes_longer_than_it_may_is_ended(controller, client):
    _, _, variable = client.handles()
    client.call(Function.SERVICE_START, bstr("InvokeTimeout=100,WDT=80"))
    controller.faults.delay_s = 5.0
    client.send(Function.VARIABLE_GET_VALUE, i4(variable))
    while (packet := client.receive()).code == Result.S_EXECUTING:
        pass
    assert unsigned(packet.code) == Result.E_TIMEOUT


def test_more_sessions_than_it_has_are_refused():
    with BcapController(RestingArm(), max_sessions=1) as controller, Tcp(controller) as first:
        assert first.call(Function.SERVICE_START)[0] == Result.S_OK
        with Tcp(controller) as second:
            assert second.call(Function.SERVICE_START)[0] == Result.E_MAX_CONNECT
            assert first.call(Function.SERVICE_STOP)[0] == Result.S_OK
            assert second.call(Function.SERVICE_START)[0] == Result.S_OK


def test_a_repeated_datagram_is_answered_as_before_and_not_executed_again(controller):
    with Udp(controller) as client:
        client.send(Function.SERVICE_START, reserved=1)
        assert client.receive().serial == 1
        texts = tuple(map(bstr, ("b-CAP", "CaoProv.DENSO.VRC", "localhost", "")))
        for _ in range(3):
            client.send(Function.CONTROLLER_CONNECT, *texts, reserved=2)
        replies = [client.receive() for _ in range(3)]
        assert [packet.serial for packet in replies] == [2, 3, 4]
        assert len({packet.args for packet in replies}) == 1
    assert [call.function for call in controller.calls] == [1, 3]


def test_what_is_no_packet_ends_a_connection_with_the_reason(client):
    client.handles()
    client.socket.sendall(b"GET / HTTP/1.1\r\n\r\n")
    assert unsigned(client.receive().code) == Result.E_INVALIDRCVPACKET
    with pytest.raises(ConnectionError):
        client.receive()


def test_the_end_of_a_connection_is_the_end_of_its_session(controller):
    with Tcp(controller) as client:
        client.handles()
        assert controller.open_sessions == 1
    until = time.monotonic() + 5.0
    while controller.open_sessions and time.monotonic() < until:
        time.sleep(0.01)
    assert controller.open_sessions == 0


def test_its_clock_drifts_jumps_and_stands_as_told():
    with BcapController(RestingArm(), drift_ppm=10_000.0) as controller:
        machine = controller.machine
        first, later = machine.stamp_ms(10**12), machine.stamp_ms(10**12 + 10**9)
        assert later - first == pytest.approx(1010, abs=1)
        assert first == int(first)
        controller.faults.jump_ms = -500.0
        assert machine.stamp_ms(10**12) == pytest.approx(first - 500, abs=1)
        controller.faults.frozen = True
        t_ns = machine.now_ns()
        time.sleep(0.01)
        assert machine.now_ns() == t_ns
        controller.faults.frozen = False
        assert machine.now_ns() > t_ns


def test_it_comes_back_at_the_same_port(controller):
    port = controller.port
    controller.stop()
    with pytest.raises(ConnectionRefusedError):
        Tcp(controller)
    controller.start()
    assert controller.port == port
    with Tcp(controller) as client:
        client.handles()


@pytest.fixture(scope="module")
def long_lived():
    with BcapController(RestingArm()) as made:
        yield made


@given(st.binary(min_size=1, max_size=300))
@settings(max_examples=30, deadline=None)
def test_garbage_never_stops_it(long_lived, data):
    with Tcp(long_lived) as client:
        client.socket.sendall(data)
    with Udp(long_lived) as client:
        client.socket.send(data)
    with Tcp(long_lived) as client:
        assert client.call(Function.SERVICE_START)[0] == Result.S_OK
