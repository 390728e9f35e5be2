import contextlib
import socket
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.link import GardasoftLink, NetworkPort
from drivers.gardasoft.protocol import Event

VERSION = b"RT860F-20 (HW02) V031\n\r"
OFF = gardasoft.continuous(1, 0)
TIMEOUT_S = 0.01


class ScriptedWire:
    """Answers in order as the next of its `moods` says; STn is answered with "CH n"."""

    name = "led"

    def __init__(self):
        self.is_open = False
        self.moods, self.coming, self.held, self.asked = [], b"", b"", []

    def open(self):
        self.is_open = True

    def close(self):
        self.is_open = False

    def write(self, data):
        for line in data.decode().split("\r")[:-1]:
            self.asked.append(line)
            parts = [
                VERSION if word == "VR" else b"CH %s\n\r" % word[2:].encode() for word in line.split(";")
            ]
            self.answer(b"".join(parts) + b">")

    def answer(self, answer):
        mood = self.moods.pop(0) if self.moods else "well"
        if mood == "lost":
            return
        if mood == "half":
            answer = answer[: len(answer) // 2]
        if mood == "noise":
            answer = b"\xfe\x00" + answer[:3] + b"\x80>"
        if mood == "event":
            answer = b"Evt1,128\r\n" + answer
        if mood == "lag":
            self.coming, self.held = self.coming + self.held, answer
            return
        self.held += answer
        if mood != "late":  # what is late holds up what comes after it: there is one wire
            self.coming, self.held = self.coming + self.held, b""

    def read(self, limit, timeout_s):
        data, self.coming = self.coming[:limit], self.coming[limit:]
        if not data:
            time.sleep(min(timeout_s, 0.001))
        return data


@pytest.fixture
def wire():
    return ScriptedWire()


@pytest.fixture
def link(wire):
    made = GardasoftLink("led", wire, TIMEOUT_S)
    made.open(OFF)
    wire.asked.clear()
    return made


def ask(link, number):
    return link.ask(gardasoft.status(number))


class TestAnswers:
    def test_one_question_gets_one_answer(self, wire, link):
        assert ask(link, 1).lines == ("CH 1",)
        assert ask(link, 2).lines == ("CH 2",)
        assert wire.asked == ["ST1", "ST2"]

    def test_a_late_prompt_is_not_taken_for_the_next_answer(self, wire, link):
        wire.moods = ["late"]
        with pytest.raises(DeviceTimeoutError, match="ST1"):
            ask(link, 1)
        assert ask(link, 2).lines == ("CH 2",)
        assert ask(link, 3).lines == ("CH 3",)

    def test_not_even_when_every_answer_comes_one_question_late(self, wire, link):
        wire.moods = ["late", "lag", "lag", "lag"]
        for _ in range(3):
            with pytest.raises(DeviceTimeoutError):
                ask(link, 1)
        for number in (2, 3, 4):
            with contextlib.suppress(DeviceTimeoutError):
                assert ask(link, number).lines == (f"CH {number}",)

    def test_not_even_when_the_question_that_was_late_is_asked_again(self, wire, link):
        wire.moods = ["late", "late"]
        for _ in range(2):
            with pytest.raises(DeviceTimeoutError):
                ask(link, 1)
        assert ask(link, 1).lines == ("CH 1",)
        assert ask(link, 2).lines == ("CH 2",)

    @given(
        st.lists(
            st.sampled_from(["well", "late", "lag", "lost", "half", "noise", "event"]),
            min_size=1,
            max_size=12,
        )
    )
    @settings(max_examples=40, deadline=None)
    def test_what_is_answered_is_the_question_whatever_happened_before(self, moods):
        wire = ScriptedWire()
        link = GardasoftLink("led", wire, TIMEOUT_S)
        link.open(OFF)
        wire.moods = list(moods)
        for number in range(1, len(moods) + 1):
            try:
                assert ask(link, number).lines == (f"CH {number}",)
            except DeviceTimeoutError:
                continue
        wire.moods.clear()
        answered = []
        for number in range(20, 25):  # it finds its way back by itself
            try:
                answered.append(ask(link, number).lines == (f"CH {number}",))
            except DeviceTimeoutError:
                assert not answered
        assert len(answered) >= 3
        assert all(answered)

    def test_noise_while_nobody_asks_harms_nobody(self, wire, link):
        for noise in (b">", b">>>", b"\xff\xfe", b"RT860F", b"\xff>", b"x" * 9000):
            wire.coming += noise
            for number in (1, 2, 3):  # a read takes 4096 bytes at most
                try:
                    ask(link, number)
                except DeviceTimeoutError:
                    assert len(noise) > 4096
            assert ask(link, 4).lines == ("CH 4",)

    def test_a_stream_of_noise_ends_at_the_timeout_or_before(self, wire, link):
        wire.read = lambda limit, timeout_s: b"x" * limit
        with pytest.raises(DeviceTimeoutError, match="noise"):
            ask(link, 1)

    def test_events_are_told_with_the_next_answer_and_once(self, wire, link):
        wire.coming = b"Evt1,128\r\n"
        wire.moods = ["event"]
        assert ask(link, 1).events == (Event(1, 128), Event(1, 128))
        assert ask(link, 2).events == ()

    def test_a_fatal_error_in_a_late_answer_is_not_lost(self, wire, link):
        wire.coming = b"Err 44\n\r>"
        assert ask(link, 1).events == (Event(0, 44),)

    def test_events_while_nobody_asks_are_bounded(self, wire, link):
        for _ in range(50):
            wire.coming += b"Evt1,128\r\n" * 100
            link._drop_what_came_unasked()
        assert len(link._events) == 100

    def test_what_is_told_without_waiting_makes_the_next_question_careful(self, wire, link):
        link.tell(gardasoft.continuous(1, 0))
        assert ask(link, 5).lines == ("CH 5",)
        assert wire.asked[0] == "RS1,0"
        assert wire.asked[1].startswith("VR;VR")


class TestOpening:
    def test_learns_what_answers(self, link):
        assert link.version.model == "RT860F-20"

    def test_a_mute_wire_is_no_controller(self, wire):
        wire.moods = ["lost"] * 5
        with pytest.raises(DeviceNotFoundError, match="no light controller"):
            GardasoftLink("led", wire, TIMEOUT_S).open(OFF)
        assert not wire.is_open
        assert wire.asked[0] == wire.asked[-1] == "RS1,0"  # it may hear, though

    def test_something_else_that_answers_is_no_controller(self, wire):
        wire.answer = lambda _: setattr(wire, "coming", b"OK\r\n>")
        with pytest.raises(DeviceNotFoundError, match="no light controller"):
            GardasoftLink("led", wire, TIMEOUT_S).open(OFF)
        assert not wire.is_open


class TestNetworkPort:
    def test_nobody_there_is_not_found(self):
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            port = NetworkPort("led", "127.0.0.1", taken.getsockname()[1], None, 0.5)
            with pytest.raises(DeviceNotFoundError, match="tcp://127"):
                port.open()
        assert not port.is_open

    def test_a_local_port_that_is_taken_is_named(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("", 0))
            number = taken.getsockname()[1]
            with pytest.raises(DeviceNotFoundError, match=f"UDP port {number}"):
                NetworkPort("led", "127.0.0.1", 30313, number, 0.5).open()

    def test_a_connection_that_is_closed_is_lost(self):
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = NetworkPort("led", "127.0.0.1", server.getsockname()[1], None, 0.5)
            port.open()
            server.accept()[0].close()
            with pytest.raises(DeviceLostError):
                port.read(1, 5)
            port.close()
            port.close()
            for use in (lambda: port.read(1, 0), lambda: port.write(b"x")):
                with pytest.raises(DeviceLostError, match="not connected"):
                    use()

    def test_a_peer_that_does_not_read_is_a_timeout(self):
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = NetworkPort("led", "127.0.0.1", server.getsockname()[1], None, 0.1)
            port.open()
            with server.accept()[0], pytest.raises(DeviceTimeoutError, match="not taken"):
                port.write(bytes(50_000_000))
            port.close()
