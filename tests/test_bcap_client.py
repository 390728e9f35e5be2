"""Calls over a link that does what a test says: serial numbers, repeats, waiting, and what refusals mean."""

from __future__ import annotations

import threading
import time
from collections import deque

import pytest

from drivers.bcap.client import BcapClient, CallRefusedError
from drivers.bcap.packet import Function, Packet
from drivers.bcap.result import Result, signed
from drivers.bcap.variant import EMPTY, PacketError, bstr, i4
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceTimeoutError


class ScriptedLink:
    """Answers each packet by what `answer(packet)` returns: packets, or seconds of silence between them."""

    address = "a script"
    ignored = 0

    def __init__(self, answer, repeats=False):
        self.answer, self.repeats = answer, repeats
        self.sent = []
        self.due = deque()
        self.amid = False

    def send(self, packet):
        self.sent.append(packet)
        self.due.extend(self.answer(packet))

    def receive(self, timeout_s):
        until = time.monotonic() + timeout_s
        while self.due and not isinstance(self.due[0], Packet):
            left = until - time.monotonic()
            if self.due[0] > left:
                self.due[0] -= left
                break
            time.sleep(self.due.popleft())
        else:
            if self.due:
                return self.due.popleft()
        time.sleep(max(0.0, until - time.monotonic()))
        return None

    def is_amid_packet(self):
        return self.amid


def reply(packet, *args, result=Result.S_OK, serial=None):
    return Packet(packet.serial if serial is None else serial, 0, signed(result), args)


def client(answer, repeats=False, timeout_s=0.3, retries=5, patience_s=2.0):
    link = ScriptedLink(answer, repeats)
    made = BcapClient("arm", link, timeout_s=timeout_s, retries=retries, patience_s=patience_s)
    return made, link


def test_a_call_returns_its_result_and_when_it_was_asked_and_answered():
    made, _ = client(lambda packet: [0.05, reply(packet, i4(7))])
    before_ns = time.monotonic_ns()
    answer = made.call(Function.VARIABLE_GET_VALUE, i4(3))
    assert answer.value == i4(7)
    assert before_ns <= answer.sent_ns <= answer.came_ns - 50_000_000
    assert answer.came_ns <= time.monotonic_ns()


def test_serial_numbers_rise_and_wrap_to_1_and_tcp_reserves_nothing():
    made, link = client(lambda packet: [reply(packet)])
    made._serial = 0xFFFD
    for _ in range(4):
        made.call(Function.SERVICE_STOP)
    assert [packet.serial for packet in link.sent] == [0xFFFE, 0xFFFF, 1, 2]
    assert {packet.reserved for packet in link.sent} == {0}


def test_a_repeat_has_a_new_serial_number_and_the_first_one_in_reserved():
    made, link = client(lambda packet: [reply(packet)] if len(link.sent) == 3 else [], repeats=True)
    made._serial = 0xFFFE
    made.call(Function.SERVICE_STOP)
    numbers = [(packet.serial, packet.reserved) for packet in link.sent]
    assert numbers == [(65535, 65535), (1, 65535), (2, 65535)]
    assert made.repeated == 2


def test_a_call_that_is_never_answered_is_sent_so_often_and_no_more():
    made, link = client(lambda packet: [], repeats=True, timeout_s=0.2, retries=4)
    begin = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="SERVICE_STOP"):
        made.call(Function.SERVICE_STOP)
    assert len(link.sent) == 4
    assert 0.19 < time.monotonic() - begin < 1.0
    assert made.mute


def test_a_stream_is_never_asked_twice():
    made, link = client(lambda packet: [], timeout_s=0.1)
    with pytest.raises(DeviceTimeoutError):
        made.call(Function.SERVICE_STOP)
    assert len(link.sent) == 1


def test_a_late_answer_to_the_first_attempt_is_the_answer_and_dates_from_it():
    made, link = client(
        lambda packet: [0.15, reply(packet, i4(1))] if len(link.sent) == 1 else [], repeats=True, retries=3
    )
    answer = made.call(Function.VARIABLE_GET_VALUE, i4(3))
    assert answer.value == i4(1)
    assert len(link.sent) == 2
    assert answer.came_ns - answer.sent_ns >= 150_000_000


def test_answers_to_other_calls_are_passed_over():
    def answer(packet):
        other = (packet.serial + 7) % 0xFFFF
        return [reply(packet, i4(0), serial=other), reply(packet, i4(0), serial=0), reply(packet, i4(5))]

    made, _ = client(answer)
    assert made.call(Function.VARIABLE_GET_VALUE, i4(3)).value == i4(5)
    assert made.late == 2


def test_a_controller_that_says_that_it_executes_is_waited_for():
    executing = [0.2, None] * 4

    def answer(packet):
        signs = [reply(packet, result=Result.S_EXECUTING) if sign is None else sign for sign in executing]
        return [*signs, 0.1, reply(packet, i4(1))]

    made, link = client(answer, timeout_s=0.3)
    assert made.call(Function.VARIABLE_GET_VALUE, i4(3)).value == i4(1)
    assert len(link.sent) == 1
    assert made.busy == 4


def test_a_controller_that_executes_for_ever_is_not():
    def answer(packet):
        return [step for _ in range(50) for step in (0.1, reply(packet, result=Result.S_EXECUTING))]

    made, _ = client(answer, timeout_s=0.3, patience_s=0.5)
    begin = time.monotonic()
    with pytest.raises(DeviceTimeoutError):
        made.call(Function.VARIABLE_GET_VALUE, i4(3))
    assert time.monotonic() - begin < 1.5


@pytest.mark.parametrize("repeats", [False, True])
def test_a_busy_robot_is_asked_anew_with_a_call_of_its_own(repeats):
    def answer(packet):
        if len(link.sent) < 4:
            return [reply(packet, result=Result.E_ROBOTISBUSY)]
        return [reply(packet, i4(1))]

    made, link = client(answer, repeats=repeats)
    assert made.call(Function.VARIABLE_GET_VALUE, i4(3)).value == i4(1)
    expected = [packet.serial if repeats else 0 for packet in link.sent]  # else it would be answered the same
    assert [packet.reserved for packet in link.sent] == expected


def test_a_robot_that_stays_busy_is_a_timeout():
    made, _ = client(lambda packet: [reply(packet, result=Result.E_ROBOTISBUSY)], patience_s=0.2)
    begin = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="0x80010004"):
        made.call(Function.VARIABLE_GET_VALUE, i4(3))
    assert time.monotonic() - begin < 1.0


def test_a_server_that_is_busy_with_this_very_call_is_waited_for():
    made, link = client(
        lambda packet: [reply(packet, result=Result.E_BUSY_PROC), 0.1, reply(packet, i4(1))], repeats=True
    )
    assert made.call(Function.VARIABLE_GET_VALUE, i4(3)).value == i4(1)
    assert len(link.sent) == 1


def test_half_a_packet_and_then_nothing_is_a_loss():
    made, link = client(lambda packet: [], timeout_s=0.1)
    link.amid = True
    with pytest.raises(DeviceLostError, match="half a packet"):
        made.call(Function.SERVICE_STOP)


def test_a_call_that_is_cancelled_ends_soon():
    made, _ = client(lambda packet: [], timeout_s=5.0, patience_s=60.0)
    timer = threading.Timer(0.1, made.cancelled.set)
    timer.start()
    begin = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="closed"):
        made.call(Function.SERVICE_STOP)
    timer.join()
    assert time.monotonic() - begin < 2.0
    assert not made.mute


REFUSALS = {
    Result.E_HANDLE: DeviceLostError,
    Result.E_INVALIDRCVPACKET: DeviceLostError,
    Result.E_NOT_CONNECTED: DeviceLostError,
    Result.E_MAX_CONNECT: DeviceLostError,
    Result.E_TIMEOUT: DeviceTimeoutError,
    Result.E_FAIL: DeviceFaultError,
    Result.E_ACCESSDENIED: DeviceFaultError,
    0x83500001: DeviceFaultError,
}


@pytest.mark.parametrize(("result", "error"), REFUSALS.items(), ids=str)
def test_a_refusal_is_one_of_the_five_with_its_number(result, error):
    def answer(packet):
        if packet.code == Function.CONTROLLER_EXECUTE:
            assert packet.args == (i4(2), bstr("GetErrorDescription"), i4(signed(result)))
            return [reply(packet, bstr("  the brakes are hot \r\n"))]
        return [reply(packet, result=result)]

    made, _ = client(answer)
    with pytest.raises(CallRefusedError) as caught:
        made.call(Function.VARIABLE_GET_VALUE, i4(3))
    meant = made.refusal(caught.value, 2)
    assert type(meant) is error
    assert f"0x{result:08X}" in str(meant)
    assert ("the brakes are hot" in str(meant)) == (error is DeviceFaultError)
    assert str(meant) == str(meant).strip()


@pytest.mark.parametrize("words", [[], [EMPTY], [i4(3)], [bstr("  ")]], ids=str)
def test_a_fault_without_words_is_told_by_its_number(words):
    def answer(packet):
        if packet.code == Function.CONTROLLER_EXECUTE:
            return [reply(packet, *words)]
        return [reply(packet, result=Result.E_FAIL)]

    made, _ = client(answer)
    with pytest.raises(CallRefusedError) as caught:
        made.call(Function.VARIABLE_GET_VALUE, i4(3))
    assert str(made.refusal(caught.value, 2)) == "arm: VARIABLE_GET_VALUE: 0x80004005 (E_FAIL)"


def test_a_handle_has_to_be_a_number():
    made, _ = client(lambda packet: [reply(packet, bstr("2"))])
    with pytest.raises(DeviceFaultError, match="not a handle"):
        made.handle(Function.ROBOT_GET_VARIABLE, i4(1), bstr("@CURRENT_ANGLE"), bstr(""))


def test_arguments_that_fit_into_no_packet_are_a_fault_of_the_configuration():
    made, _ = client(lambda packet: [])
    made._link.send = lambda packet: (_ for _ in ()).throw(PacketError("too long"))
    with pytest.raises(DeviceFaultError, match="CONTROLLER_CONNECT cannot be sent: too long"):
        made.call(Function.CONTROLLER_CONNECT, bstr("x"))


MOVING = ["TakeArm", "Motor", "Move", "slvMove", "slvChangeMode", "Hand", "ExtSpeed", "", "highcurjntex"]


@pytest.mark.parametrize("command", MOVING)
def test_a_command_that_does_more_than_read_is_never_sent(command):
    made, link = client(lambda packet: [reply(packet)])
    with pytest.raises(ValueError, match="HighCurJntEx"):
        made.call(Function.ROBOT_EXECUTE, i4(3), bstr(command), EMPTY)
    with pytest.raises(ValueError, match="GetErrorDescription"):
        made.call(Function.CONTROLLER_EXECUTE, i4(2), bstr(command), EMPTY)
    with pytest.raises(ValueError, match="allowed"):
        made.call(Function.ROBOT_EXECUTE, i4(3))
    assert link.sent == []


def test_there_is_no_function_that_writes_or_moves():
    assert {int(function) for function in Function} == {1, 2, 3, 4, 7, 17, 62, 64, 84, 101, 111}
