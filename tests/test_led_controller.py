import os
import socket
import termios
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators.led_controller import LedController
from drivers.emulators.led_outputs import CONTINUOUS, PULSE, SWITCHED, LedOutputs, LightHistory
from drivers.serial_port import SerialPort
from surfclass.errors import ConfigurationError

MS = 1_000_000


class Lamp:
    def __init__(self):
        self.levels = []

    def set_light(self, level, holds_from_ns):
        self.levels.append((level, holds_from_ns))


@pytest.fixture
def outputs():
    return LedOutputs(settle_s=0.0)


@pytest.fixture
def rated(outputs):
    assert outputs.execute(b"VL1,0,700mA") == b">"
    return outputs


def said(outputs, line):
    return outputs.execute(line).decode().replace("\n\r", " ").strip()


def heard(port, question=b"", seconds=10.0):
    """What comes until a prompt, or until nothing more comes."""
    port.write(question)
    answer, deadline = b"", time.monotonic() + seconds
    while not answer.endswith(b">") and time.monotonic() < deadline:
        answer += port.read(4096, 0.2)
    return answer


class TestCommands:
    @pytest.mark.parametrize(
        ("line", "answer"),
        [
            (b"VR", "RT860F-20 (HW02) V031 >"),
            (b"vr", "RT860F-20 (HW02) V031 >"),
            (b" V R ", "RT860F-20 (HW02) V031 >"),
            (b"", "Err 2 >"),
            (b"XX1", "Err 2 >"),
            (b"VR1", "Err 4 >"),
            (b"RS1", "Err 4 >"),
            (b"RS1,2,3", "Err 4 >"),
            (b"RS1,abc", "Err 3 >"),
            (b"RSx,1", "Err 3 >"),
            (b"RS0,1", "Err 1 >"),
            (b"RS9,1", "Err 1 >"),
            (b"VL1,0,21", "Err 1 >"),
            (b"RS1,50", "Err 19 >"),
            (b"RS1,0", ">"),
            (b"GT2", "Err 1 >"),
            (b"RP1,9", "Err 1 >"),
            (b"ST0", "TM 0, TP 20.00ms >"),
            (b"VR;XX;GT1", "RT860F-20 (HW02) V031 Err 2 >"),
            (b"GR", ">"),
            (b"AW", ">"),
        ],
    )
    def test_are_answered_as_the_manual_says(self, outputs, line, answer):
        assert said(outputs, line) == answer

    def test_a_brightness_out_of_range_is_adjusted_with_a_warning(self, rated):
        assert said(rated, b"RS1,120") == "Err 5 >"
        assert rated.level == 1.0

    def test_a_delay_out_of_range_is_adjusted_with_a_warning(self, rated):
        assert said(rated, b"RT1,5,0,100") == "Err 5 >"
        assert rated.outputs[0].delay_ms == 0.01

    @pytest.mark.parametrize(
        ("line", "answer"),
        [
            (b"RT1,999,1,100", ">"),
            (b"RT1,30,1,200", ">"),
            (b"RT1,30.1,1,200", "Err 1 >"),
            (b"RT1,10,1,300,50", ">"),
            (b"RT1,10,1,300,49", "Err 5 >"),
            (b"RT1,2ms,1,500", ">"),
            (b"RT1,1000us,1,999", ">"),
            (b"RT1,1.1,1,501", "Err 1 >"),
            (b"RT1,1,1,1001", "Err 5 >"),
        ],
    )
    def test_overdrive_is_limited(self, rated, line, answer):
        assert said(rated, line) == answer

    def test_the_status_tells_all_channels_or_one(self, rated):
        rated.execute(b"RT1,10,0.5,250;RP1,3")
        assert said(rated, b"ST1") == (
            "CH 1, MD 1, S 250.0%, DL 0.500ms, PU 10.000ms, RT 50.0ms, IP 3, FL 0, CS 0.000A, RA 0.700A >"
        )
        assert rated.execute(b"ST").count(b"CH ") == 8

    @given(st.binary(max_size=60))
    def test_noise_is_answered_with_a_prompt(self, noise):
        assert LedOutputs().execute(noise).endswith(b">")

    @given(st.lists(st.sampled_from([b"RS1,50", b"RT1,1,1,100", b"RW1,20", b"RS1,0", b"GR", b"VL1,0,0"])))
    def test_a_light_that_was_put_out_is_out_whatever_came_before(self, lines):
        outputs = LedOutputs()
        for line in (b"VL1,0,1", *lines, b"RS1,0"):
            outputs.execute(line)
        assert outputs.level == 0
        outputs.strobe(1, 0, MS)
        assert outputs.outputs[0].mode == CONTINUOUS


class TestLight:
    def test_follows_after_the_settling_time(self):
        lamp = Lamp()
        outputs = LedOutputs(lamp.set_light, settle_s=0.5)
        before = time.monotonic_ns()
        outputs.execute(b"VL1,0,1;RS1,40")
        ((level, holds_ns),) = lamp.levels
        assert level == 0.4
        assert before + 500 * MS <= holds_ns <= time.monotonic_ns() + 500 * MS
        assert outputs.history.at(holds_ns - 1) == 0
        assert outputs.history.at(holds_ns) == 0.4

    def test_full_level_may_be_another_brightness_and_another_channel(self):
        outputs = LedOutputs(channel=2, full_percent=50.0)
        outputs.execute(b"VL1,0,1;VL2,0,1;RS1,100")
        assert outputs.level == 0
        outputs.execute(b"RS2,25")
        assert outputs.level == 0.5

    def test_a_pulse_is_one_flash_for_each_trigger(self, rated):
        rated.execute(b"RT1,2,1,80")
        rated.strobe(1, 100 * MS, 110 * MS)
        assert rated.outputs[0].mode == PULSE
        assert rated.mean_level(100 * MS, 110 * MS) == pytest.approx(0.8 * 0.2)
        assert rated.mean_level(101 * MS, 103 * MS) == pytest.approx(0.8)

    def test_switched_follows_the_trigger(self, rated):
        rated.execute(b"RW1,50")
        rated.strobe(1, 100 * MS, 110 * MS)
        assert rated.outputs[0].mode == SWITCHED
        assert rated.mean_level(100 * MS, 110 * MS) == pytest.approx(0.5)
        assert rated.mean_level(110 * MS, 120 * MS) == 0

    def test_a_simulated_trigger_flashes_now(self, rated):
        rated.execute(b"RT1,500,0.01,100")
        before = time.monotonic_ns()
        rated.execute(b"TR1")
        assert rated.mean_level(before + 100 * MS, before + 400 * MS) == pytest.approx(1)

    @given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 1000)), max_size=20))
    def test_the_mean_is_that_of_every_moment(self, changes):
        history = LightHistory()
        for level, at in changes:
            history.add(level, at)
        expected = sum(history.at(t) for t in range(200, 800)) / 600
        assert history.mean(200, 800) == pytest.approx(expected, abs=1e-9)


class TestFaults:
    def test_heat_keeps_it_off_until_it_is_cool_and_cleared(self, rated):
        rated.execute(b"RS1,100")
        rated.overheat()
        assert rated.level == 0
        assert said(rated, b"RS1,100") == "Err 44 >"
        assert said(rated, b"RS1,0") == ">"
        assert said(rated, b"GR") == "Evt1,130 >"
        assert said(rated, b"RS1,100") == "Err 44 >"
        rated.cool_down()
        assert said(rated, b"GR") == "Evt1,130 >"
        assert said(rated, b"GR") == ">"
        assert said(rated, b"RS1,100") == ">"

    def test_a_corrupt_eeprom_forgets_all_and_says_so_once(self, rated):
        rated.execute(b"RS1,100")
        rated.corrupt_eeprom(12)
        assert rated.level == 0
        assert said(rated, b"RS1,100") == "Err 12 >"
        assert said(rated, b"RS1,100") == "Err 19 >"

    def test_a_restart_resumes_what_was_saved(self, rated):
        rated.execute(b"RS1,30;AW;RS1,90;GT1")
        rated.restart()
        assert rated.level == 0.3
        assert not rated.events_told

    def test_an_unrated_light_does_not_shine(self, rated):
        rated.execute(b"RS1,50")
        rated.change_light(rated=False)
        assert rated.level == 0
        assert said(rated, b"GR") == "Evt1,129 >"
        assert said(rated, b"RS1,50") == "Err 19 >"

    def test_too_much_duty_switches_it_off(self, rated):
        rated.execute(b"GT1;RS1,50")
        rated.duty_cycle_exceeded()
        assert rated.level == 0
        assert rated.take_events() == b"Evt1,140\r\n"


@pytest.fixture
def controller(tmp_path):
    with LedController(Lamp(), tmp_path / "led", tcp_port=0, udp_port=0) as running:
        yield running


@pytest.fixture
def port(controller):
    with SerialPort("test", str(controller.link_path), 115_200) as opened:
        yield opened


class TestWires:
    def test_speaks_on_a_terminal(self, port):
        assert heard(port, b"VR\r") == b"RT860F-20 (HW02) V031\n\r>"

    def test_speaks_tcp_to_several_at_once(self, controller):
        address = ("127.0.0.1", controller.tcp_port)
        with socket.create_connection(address, 10) as one, socket.create_connection(address, 10) as other:
            for peer in (one, other, one):
                peer.sendall(b"VR\r")
                assert peer.recv(100) == b"RT860F-20 (HW02) V031\n\r>"

    def test_speaks_udp(self, controller):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.settimeout(10)
            peer.sendto(b"GT1\r", ("127.0.0.1", controller.udp_port))
            assert peer.recv(100) == b">"
            controller.event(128)
            assert peer.recv(100) == b"Evt1,128\r\n"

    def test_commands_may_come_byte_by_byte_and_all_at_once(self, port, controller):
        for byte in b"VL1,0,1\r":
            port.write(bytes([byte]))
        assert heard(port) == b">"
        port.write(b"RS1,1\rRS1,2\rRS1,3\r")
        answers = b""
        while len(answers) < 3:
            answers += port.read(100, 10)
        assert answers == b">>>"
        assert controller.outputs.level == 0.03

    def test_another_baud_rate_hears_nonsense(self, controller):
        with SerialPort("test", str(controller.link_path), 9600) as slow:
            slow.write(b"VR\r")
            assert b"RT860F" not in slow.read(100, 10)
        # A terminal's speed stays as it was set, so the next one has to set it again, and does.
        with SerialPort("test", str(controller.link_path), 115_200) as fast:
            assert b"RT860F" in heard(fast, b"VR\r")

    def test_the_cell_s_light_is_told(self, tmp_path):
        lamp = Lamp()
        with LedController(lamp, tmp_path / "led") as running:
            with SerialPort("test", str(running.link_path), 115_200) as opened:
                heard(opened, b"VL1,0,1\r")
                heard(opened, b"RS1,60\r")
            assert lamp.levels[-1][0] == 0.6
        assert lamp.levels[-1][0] == 0

    def test_people_see_what_was_asked_and_answered(self, tmp_path):
        seen = []
        running = LedController(None, tmp_path / "led", on_command=seen.append)
        with running, SerialPort("test", str(running.link_path), 115_200) as opened:
            heard(opened, b"VR\r")
        assert seen == ["VR -> RT860F-20 (HW02) V031 >"]


class TestWireFaults:
    def test_mute_comes_in_two_kinds(self, controller, port):
        heard(port, b"VL1,0,1\r")
        controller.faults.mute = "dumb"
        assert heard(port, b"RS1,50\r", 0.3) == b""
        assert controller.outputs.level == 0.5
        controller.faults.mute = "deaf"
        assert heard(port, b"RS1,0\r", 0.3) == b""
        assert controller.outputs.level == 0.5

    def test_half_an_answer_has_no_prompt(self, controller, port):
        controller.faults.half = True
        assert heard(port, b"VR\r", 0.3) == b"RT860F-20 (H"

    def test_a_late_answer_is_the_right_one(self, controller, port):
        controller.faults.late_s = 0.3
        before = time.monotonic()
        assert heard(port, b"VR\r") == b"RT860F-20 (HW02) V031\n\r>"
        assert time.monotonic() - before >= 0.3

    def test_an_error_stands_for_the_answer(self, controller, port):
        controller.faults.error = 20
        assert heard(port, b"VR\r") == b"Err 20\n\r>"

    def test_an_event_comes_before_the_answer(self, controller, port):
        controller.faults.event = (2, 140)
        assert heard(port, b"VR\r") == b"Evt2,140\r\nRT860F-20 (HW02) V031\n\r>"

    def test_events_come_by_themselves_only_when_asked_for(self, controller, port):
        controller.event(128)
        assert port.read(100, 0.1) == b""
        heard(port, b"GT1\r")
        controller.event(140)
        assert port.read(100, 10) == b"Evt1,140\r\n"


class TestPlugs:
    def test_unplugged_there_is_no_port_and_replugged_another_one(self, controller):
        before = controller.link_path.readlink()
        held = os.open(before, os.O_RDWR | os.O_NOCTTY)  # so that the number is not given again
        controller.unplug()
        assert not controller.link_path.is_symlink()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", controller.tcp_port), 5)
        controller.replug()
        controller.replug()
        assert controller.link_path.readlink() != before
        os.close(held)
        with SerialPort("test", str(controller.link_path), 115_200) as opened:
            assert heard(opened, b"VR\r").endswith(b">")
        socket.create_connection(("127.0.0.1", controller.tcp_port), 5).close()

    def test_stopping_takes_the_link_and_the_light_away(self, tmp_path):
        controller = LedController(None, tmp_path / "led")
        controller.start()
        controller.outputs.execute(b"VL1,0,1;RS1,100")
        assert not controller.wait(0.01)
        controller.stop()
        controller.stop()
        assert controller.wait(0.01)
        assert controller.outputs.level == 0
        assert not controller.link_path.is_symlink()

    def test_it_starts_again_after_a_stop(self, tmp_path):
        controller = LedController(None, tmp_path / "led")
        for _ in range(2):
            with controller, SerialPort("test", str(controller.link_path), 115_200) as opened:
                assert heard(opened, b"RS1,50\r") == b"Err 19\n\r>"

    def test_a_link_that_was_left_over_is_replaced(self, tmp_path):
        (tmp_path / "led").symlink_to("/dev/pts/999999")
        with LedController(None, tmp_path / "led") as running:
            assert running.link_path.resolve().exists()

    def test_a_link_that_somebody_else_took_over_is_left_alone(self, tmp_path):
        with LedController(None, tmp_path / "led"):
            (tmp_path / "led").unlink()
            (tmp_path / "led").symlink_to("/dev/null")
        assert (tmp_path / "led").readlink() == Path("/dev/null")

    def test_a_file_in_the_link_s_place_is_no_link_and_stays(self, tmp_path):
        (tmp_path / "led").write_text("precious")
        before = open_files()
        with pytest.raises(ConfigurationError, match="no link"):
            LedController(None, tmp_path / "led").start()
        assert (tmp_path / "led").read_text() == "precious"
        assert open_files() == before

    def test_a_folder_that_is_not_there_is_named(self, tmp_path):
        with pytest.raises(ConfigurationError, match="nowhere"):
            LedController(None, tmp_path / "nowhere" / "led").start()

    def test_a_port_that_is_taken_is_named(self, tmp_path, controller):
        with pytest.raises(ConfigurationError, match=str(controller.tcp_port)):
            LedController(None, tmp_path / "other", tcp_port=controller.tcp_port).start()


def open_files():
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_the_terminal_is_raw_from_the_start(controller):
    descriptor = os.open(controller.link_path, os.O_RDWR | os.O_NOCTTY)
    try:
        flags = termios.tcgetattr(descriptor)
    finally:
        os.close(descriptor)
    assert not flags[3] & (termios.ECHO | termios.ICANON | termios.ISIG)
    assert flags[4] == flags[5] == termios.B115200
