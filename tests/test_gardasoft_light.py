import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from drivers import backends
from drivers.clock import SystemClock
from drivers.emulators.led_controller import LedController
from drivers.emulators.led_outputs import LedOutputs
from drivers.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
)
from drivers.gardasoft.options import LightOptions
from drivers.light_gardasoft import GardasoftLight
from surfclass.errors import ConfigurationError

ROOT = Path(__file__).resolve().parents[1]
STROBE = {"mode": "strobe", "pulse_width_ms": 5.0}


@pytest.fixture
def controller(tmp_path):
    with LedController(None, tmp_path / "led") as running:
        yield running


@pytest.fixture
def made(controller):
    """Makes lights on the controller; closes them in the end."""
    with contextlib.ExitStack() as closing:

        def make(**options):
            options = {
                "port_path": str(controller.link_path),
                "rating_a": 0.7,
                "reply_timeout_s": 1.0,
                **options,
            }
            light = backends.create("light", "gardasoft", clock=SystemClock(), options=options)
            closing.callback(light.close)
            return light

        yield make


@pytest.fixture
def light(made):
    opened = made()
    opened.open()
    return opened


def until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it never came to be so"
        time.sleep(0.005)


def output(controller):
    return controller.outputs.outputs[0]


class TestOptions:
    def refused(self, match, **options):
        with pytest.raises(ConfigurationError, match=match):
            backends.create("light", "gardasoft", clock=SystemClock(), options={"rating_a": 0.7, **options})

    def test_need_one_wire_and_no_more(self):
        self.refused("port_path and host")
        self.refused("port_path and host", port_path="/dev/null", host="127.0.0.1")

    def test_need_a_rating(self):
        self.refused("rating_v or rating_a", port_path="/dev/null", rating_a=0.0)

    def test_take_addresses_only(self):
        self.refused("IPv4", host="led.local")

    def test_are_checked_by_name(self):
        self.refused("max_percent", port_path="/dev/null", max_precent=50.0)

    @pytest.mark.parametrize(
        ("options", "allowed"),
        [
            ({"max_percent": 101.0}, "strobe"),
            ({"pulse_width_ms": 1.0}, "pulse_width_ms"),
            ({**STROBE, "max_percent": 250.0, "pulse_width_ms": 10.1}, "allowed is to 10"),
            ({**STROBE, "max_percent": 501.0, "pulse_width_ms": 1.5}, "allowed is to 1"),
            ({**STROBE, "max_percent": 250.0, "retrigger_ms": 24.0}, "from 25.*20%"),
            ({"max_percent": 1000.0, "mode": "strobe"}, "999"),
            ({"max_on_s": 0.0}, "0.05"),
        ],
    )
    def test_say_what_is_allowed_of_overdrive(self, options, allowed):
        self.refused(allowed, port_path="/dev/null", **options)

    def test_give_the_shortest_retrigger_time_that_the_brightness_allows(self):
        options = LightOptions(
            port_path="x", rating_a=0.7, max_percent=300.0, mode="strobe", pulse_width_ms=8.0
        )
        assert options.allowed_retrigger_ms == pytest.approx(40)


class TestOpening:
    def test_puts_out_first_then_clears_then_rates(self, controller, light):
        assert controller.commands[1].startswith("VR;VR")
        assert controller.commands[0] == "RS1,0"
        assert controller.commands[2:] == ["RS1,0", "GR", "GR", "GT1", "VL1,0,0.7", "RS1,0", "ST1"]

    def test_a_light_that_shone_is_put_out(self, controller, made):
        controller.outputs.execute(b"VL1,0,0.5;RS1,80")
        assert controller.outputs.level == 0.8
        made().open()
        assert controller.outputs.level == 0

    def test_tells_what_answers_and_what_was_set(self, controller, light):
        about = light.about()
        assert about["model"] == "RT860F-20"
        assert about["firmware"] == "V031, hardware HW02"
        assert str(controller.link_path) in about["address"]
        assert "rated 0.7 A, full level 100 %" in about["settings"]
        assert "RA 0.700A" in about["status"]

    def test_a_rating_by_voltage_is_read_back_too(self, controller, made):
        light = made(rating_a=0.0, rating_v=24.0)
        light.open()
        assert "not read back" not in light.about()["settings"]
        assert output(controller).volts == 24

    def test_a_rating_that_is_not_taken_is_a_fault(self, controller, made, monkeypatch):
        monkeypatch.setattr(controller.outputs, "_rate", lambda numbers: "")
        controller.outputs.execute(b"RS1,0")
        monkeypatch.setattr(
            "drivers.emulators.led_outputs._status_text", lambda *_: "CH 1, S 0.0%, RA 2.000A"
        )
        light = made()
        with pytest.raises(DeviceFaultError, match=r"0\.7 for the current.*2\.000A"):
            light.open()
        assert not light.is_open

    def test_a_firmware_with_another_status_can_be_used_but_is_noted(self, controller, made, monkeypatch):
        monkeypatch.setattr("drivers.emulators.led_outputs._status_text", lambda *_: "all is well")
        light = made()
        light.open()
        light.set_level(0.5)
        light.check()
        about = light.about()
        assert "not understood" in about["status"]
        assert "not read back" in about["settings"]

    def test_a_channel_that_is_not_there_is_a_fault(self, made, monkeypatch):
        monkeypatch.setattr("drivers.emulators.led_outputs._CHANNELS", 2)
        with pytest.raises(DeviceFaultError, match="Err 1: a parameter is invalid"):
            made(channel=3).open()

    def test_never_writes_the_flash(self, controller, light):
        light.set_level(1.0)
        light.check()
        light.close()
        assert not any(command.startswith("AW") for command in controller.commands)


class TestLevels:
    def test_are_fractions_of_the_configured_maximum(self, controller, made):
        light = made(max_percent=40.0)
        light.open()
        for level, percent in ((1.0, 40), (0.5, 20), (0.333, 13.3), (1e-9, 0.1), (0.0, 0)):
            light.set_level(level)
            assert output(controller).percent == pytest.approx(percent)

    def test_hold_from_the_answer_and_the_settling_on(self, controller, made):
        light = made(settle_ms=30.0)
        light.open()
        holds_ns = light.set_level(1.0)
        assert holds_ns > time.monotonic_ns()
        assert controller.outputs.history.at(holds_ns) == 1.0

    def test_a_late_prompt_is_not_taken_for_the_next_one(self, controller, made):
        light = made(reply_timeout_s=0.3)
        light.open()
        controller.faults.late_s = 0.6
        with pytest.raises(DeviceTimeoutError):
            light.set_level(0.5)
        controller.faults.late_s = 0.0
        asked = len(controller.commands)
        until(lambda: not light._lit)  # the answers that were late have come, and it is known to be off
        assert controller.outputs.level == 0
        light.set_level(0.25)
        assert controller.outputs.level == 0.25
        assert any(command.startswith("VR;VR") for command in controller.commands[asked:])

    def test_events_between_command_and_answer_do_no_harm(self, controller, light):
        controller.faults.event = (1, 128)
        for level in (0.2, 0.4, 0.6):
            light.set_level(level)
            assert controller.outputs.level == level
        light.check()
        assert "a light was connected" in light.about()["status"]

    def test_a_value_that_the_controller_adjusts_is_refused_and_put_out(self, controller, light, monkeypatch):
        monkeypatch.setattr(
            controller.outputs,
            "_shine",
            lambda numbers: controller.outputs._set_mode(0, 0, float(numbers[1]), 50.0),
        )
        with pytest.raises(DeviceLostError, match="50 %, it was set to 80 %"):
            light.set_level(0.8)
        until(lambda: controller.outputs.level == 0)

    def test_a_level_that_is_not_confirmed_is_put_out_at_once(self, controller, made):
        light = made(reply_timeout_s=0.3)
        light.open()
        controller.faults.mute = "dumb"
        with pytest.raises(DeviceTimeoutError):
            light.set_level(1.0)
        until(lambda: "RS1,100" in controller.commands and controller.outputs.level == 0)
        assert controller.commands[controller.commands.index("RS1,100") + 1] == "RS1,0"

    def test_an_error_number_is_told_with_the_command_and_its_meaning(self, controller, light):
        controller.faults.error = 2
        with pytest.raises(DeviceFaultError, match=r"RS1,100: Err 2: the command is not recognised"):
            light.set_level(1.0)
        controller.faults.error = None


class TestStrobe:
    @pytest.fixture
    def strobe(self, made):
        opened = made(**STROBE, max_percent=300.0, trigger_input=3)
        opened.open()
        return opened

    def flash(self, controller, at_ns):
        controller.outputs.strobe(3, at_ns, at_ns + 1_000_000)
        return controller.outputs.mean_level(at_ns, at_ns + 6_000_000)

    def test_its_timing_is_the_hardware_s(self, strobe, made):
        assert strobe.timing == "hardware"
        assert made().timing == "software"

    def test_shines_for_the_pulse_and_only_while_armed(self, controller, strobe):
        now = time.monotonic_ns()
        assert self.flash(controller, now) == 0
        strobe.set_level(1.0)
        assert controller.commands[-1] == "RT1,5,0.01,300,25"
        assert self.flash(controller, now + 1_000_000_000) == pytest.approx(3 * 5 / 6, rel=0.01)
        strobe.set_level(0.0)
        assert self.flash(controller, now + 2_000_000_000) == 0

    def test_listens_to_its_input_only(self, controller, strobe):
        strobe.set_level(1.0)
        now = time.monotonic_ns()
        controller.outputs.strobe(1, now, now + 1_000_000)
        assert controller.outputs.mean_level(now, now + 6_000_000) == 0

    def test_a_trigger_that_comes_too_soon_is_ignored_in_silence(self, controller, strobe):
        strobe.set_level(1.0)
        now = time.monotonic_ns()
        assert self.flash(controller, now) > 0
        assert self.flash(controller, now + 20_000_000) == 0
        assert self.flash(controller, now + 26_000_000) > 0

    def test_an_armed_channel_is_disarmed_in_the_end(self, controller, made):
        light = made(**STROBE, max_on_s=0.1)
        light.open()
        light.set_level(1.0)
        until(lambda: output(controller).mode == 0)


class TestFaults:
    @pytest.mark.parametrize("number", [40, 47, 8])
    def test_fatal_errors_stay_until_it_is_opened_anew(self, controller, light, number):
        controller.faults.error = number
        with pytest.raises(DeviceFaultError, match=f"Err {number}"):
            light.set_level(1.0)
        controller.faults.error = None
        asked = len(controller.commands)
        for use in (lambda: light.set_level(1.0), lambda: light.set_level(0.0), light.check):
            with pytest.raises(DeviceFaultError, match=f"Err {number}.*closed and opened"):
                use()
        until(lambda: not light._lit)
        assert not any(command.startswith("RS1,1") for command in controller.commands[asked:])
        light.close()
        light.open()
        light.set_level(1.0)
        assert controller.outputs.level == 1

    @pytest.mark.parametrize("code", [130, 131, 44])
    def test_fatal_events_put_out_and_stay(self, controller, light, code):
        light.set_level(1.0)
        controller.event(code)
        with pytest.raises(DeviceFaultError, match=f"event {code}"):
            light.check()
        until(lambda: controller.outputs.level == 0)
        with pytest.raises(DeviceFaultError, match=f"event {code}"):
            light.set_level(0.0)

    def test_a_controller_that_is_still_too_hot_is_still_a_fault(self, controller, light):
        controller.outputs.overheat()
        with pytest.raises(DeviceFaultError, match="over-temperature"):
            light.set_level(1.0)
        light.close()
        for _ in range(2):
            with pytest.raises(DeviceFaultError, match="over-temperature"):
                light.open()
            assert not light.is_open
        controller.outputs.cool_down()
        light.open()
        light.set_level(1.0)
        assert controller.outputs.level == 1

    def test_what_was_cleared_is_told(self, controller, made):
        controller.outputs.overcurrent()
        light = made()
        light.open()
        assert "cleared when opened: event 131 of channel 1: over-current" in light.about()["status"]
        light.set_level(1.0)
        assert controller.outputs.level == 1

    @pytest.mark.parametrize(
        ("code", "error"), [(132, DeviceFaultError), (140, DeviceFaultError), (129, DeviceLostError)]
    )
    def test_the_light_s_troubles_fail_one_call(self, controller, light, code, error):
        light.set_level(1.0)
        controller.event(code)
        with pytest.raises(error, match=f"event {code}"):
            light.set_level(0.0)
        assert controller.outputs.level == 0
        light.set_level(1.0)

    def test_another_channel_s_troubles_are_noted(self, controller, light):
        controller.event(140, channel=2)
        light.check()
        assert "event 140 of channel 2" in light.about()["status"]

    def test_a_controller_that_was_restarted_is_opened_anew(self, controller, light):
        controller.outputs.execute(b"RS1,30;AW;RS1,0")  # somebody saved a light that shines
        light.check()
        controller.outputs.restart()
        assert controller.outputs.level == 0.3
        with pytest.raises(DeviceLostError, match="30 %, it was set to 0 %"):
            light.check()
        until(lambda: controller.outputs.level == 0)


class TestLimitOfTime:
    def test_a_light_that_was_left_on_is_put_out_and_the_next_call_says_so(self, controller, made):
        light = made(max_on_s=0.1)
        light.open()
        light.set_level(1.0)
        assert controller.outputs.level == 1
        until(lambda: controller.outputs.level == 0)
        with pytest.raises(DeviceTimeoutError, match=r"max_on_s = 0\.1 s"):
            light.check()
        with pytest.raises(DeviceTimeoutError, match=r"max_on_s = 0\.1 s"):
            light.set_level(1.0)
        assert controller.outputs.level == 0
        light.set_level(1.0)
        assert controller.outputs.level == 1

    def test_the_capture_that_it_spoilt_fails(self, controller, made):
        light = made(max_on_s=0.1)
        light.open()
        light.set_level(1.0)
        until(lambda: controller.outputs.level == 0)
        with pytest.raises(DeviceTimeoutError, match="max_on_s"):
            light.set_level(0.0)
        light.set_level(0.0)

    def test_what_the_controller_said_to_the_timer_is_told_too(self, controller, made):
        light = made(max_on_s=0.1)
        light.open()
        light._put_out()  # as after a call that failed: the timer asks until there is an answer
        controller.event(132)
        until(lambda: not light._lit)
        with pytest.raises(DeviceFaultError, match=r"^light: event 132"):
            light.set_level(1.0)
        light.set_level(1.0)

    def test_counts_from_the_last_level(self, controller, made):
        light = made(max_on_s=2.0)
        light.open()
        for _ in range(3):
            light.set_level(1.0)
            light.set_level(0.0)
        assert light._timer._due is None

    def test_it_goes_on_telling_a_controller_that_does_not_answer(self, controller, made):
        light = made(max_on_s=0.1, reply_timeout_s=0.3)
        light.open()
        light.set_level(1.0)
        controller.faults.mute = "deaf"
        asked = len(controller.commands)
        until(lambda: len(controller.commands) > asked + 1)
        assert controller.outputs.level == 1
        controller.faults.mute = ""
        until(lambda: controller.outputs.level == 0)

    def test_no_thread_outlives_the_light(self, made):
        before = threading.active_count()
        light = made()
        for _ in range(3):
            light.open()
            light.set_level(1.0)
            light.close()
        assert threading.active_count() == before


class TestLoss:
    def test_a_cable_that_was_loose_for_a_moment_does_not_leave_the_light_on(self, controller, light):
        light.set_level(1.0)
        controller.unplug()
        controller.replug()
        assert controller.outputs.level == 1
        with pytest.raises(DeviceLostError):
            light.set_level(0.0)
        light.close()
        assert controller.outputs.level == 0

    def test_a_controller_that_hears_but_does_not_answer_is_put_out(self, controller, made):
        light = made(reply_timeout_s=0.3)
        light.open()
        light.set_level(1.0)
        controller.faults.mute = "dumb"
        before = time.monotonic()
        light.close()
        assert time.monotonic() - before < 5
        assert controller.outputs.level == 0

    def test_closing_puts_out_blindly_where_the_answers_are_not_to_be_told_apart(self, controller, made):
        light = made(reply_timeout_s=0.3)
        light.open()
        light.set_level(1.0)
        light._link.distrust()
        controller.faults.mute = "dumb"
        light.close()
        assert controller.outputs.level == 0

    def test_closing_gives_up_on_a_controller_that_is_deaf(self, controller, made, caplog):
        light = made(reply_timeout_s=0.3)
        light.open()
        light.set_level(1.0)
        controller.faults.mute = "deaf"
        before = time.monotonic()
        light.close()
        assert time.monotonic() - before < 5
        assert not light.is_open
        assert "without having confirmed that the light is off" in caplog.text

    def test_an_emulator_that_is_killed_is_lost_and_its_successor_found(self, tmp_path, made):
        link = tmp_path / "killed"
        program = (
            "import sys; from drivers.emulators.led_controller import LedController;"
            "c = LedController(None, sys.argv[1]);"
            "c.start(); print('here', flush=True); c.wait()"
        )

        def started():
            process = subprocess.Popen(
                [sys.executable, "-c", program, link], cwd=ROOT, stdout=subprocess.PIPE, text=True
            )
            assert process.stdout.readline() == "here\n"
            return process

        with started() as first:
            light = made(port_path=str(link))
            light.open()
            light.set_level(1.0)
            os.kill(first.pid, signal.SIGKILL)
        with pytest.raises(DeviceLostError):
            light.check()
        light.close()
        with pytest.raises(DeviceNotFoundError):
            light.open()
        assert link.is_symlink()  # stale, and no hindrance
        with started() as second:
            light.open()
            light.set_level(1.0)
            light.close()
            second.terminate()

    def test_a_driver_that_is_killed_leaves_the_light_on_until_the_next_one_opens(self, controller, made):
        program = (
            "import sys, time; from drivers.backends import create; from drivers.clock import SystemClock;"
            "options = {'port_path': sys.argv[1], 'rating_a': 1.0};"
            "light = create('light', 'gardasoft', clock=SystemClock(), options=options);"
            "light.open(); light.set_level(1.0); print('lit', flush=True); time.sleep(100)"
        )
        with subprocess.Popen(
            [sys.executable, "-c", program, controller.link_path], cwd=ROOT, stdout=subprocess.PIPE, text=True
        ) as driver:
            assert driver.stdout.readline() == "lit\n"
            os.kill(driver.pid, signal.SIGKILL)
        assert controller.outputs.level == 1
        made().open()
        assert controller.outputs.level == 0


class FailingWire:
    """A controller without a wire between; its n-th operation fails as `how` says."""

    def __init__(self, outputs, how, at):
        self.outputs, self.how, self.at = outputs, how, at
        self.operations, self.coming, self.is_open = 0, b"", False

    @property
    def is_dead(self):
        return self.how == "dead" and self.operations > self.at

    def fails(self):
        self.operations += 1
        if self.is_dead:
            raise DeviceLostError("led", "dead")
        return self.operations == self.at + 1

    def open(self):
        if self.is_dead:
            raise DeviceNotFoundError("led", "dead")
        self.is_open = True

    def close(self):
        self.is_open, self.coming = False, b""

    def write(self, data):
        if not self.is_open:
            raise DeviceLostError("led", "not open")
        fails = self.fails()
        if fails and self.how in ("not written", "interrupted before"):
            raise (
                KeyboardInterrupt
                if self.how == "interrupted before"
                else DeviceTimeoutError("led", "not taken")
            )
        answer = self.outputs.execute(data.removesuffix(b"\r"))
        if fails and self.how == "lost":
            raise DeviceLostError("led", "lost")
        if fails and self.how == "interrupted after":
            raise KeyboardInterrupt
        if fails and self.how.startswith("error"):
            answer = f"Err {self.how.split()[1]}\n\r>".encode()
        if fails and self.how == "noise":
            answer = b"\xff\xfe>"
        if not (fails and self.how == "unanswered") and not (
            self.how == "mute" and self.operations > self.at
        ):
            self.coming += answer

    def read(self, limit, timeout_s):
        if not self.is_open:
            raise DeviceLostError("led", "not open")
        if timeout_s > 0 and self.fails():
            if self.how == "lost":
                raise DeviceLostError("led", "lost")
            if self.how.startswith("interrupted"):
                raise KeyboardInterrupt
        data, self.coming = self.coming[:limit], self.coming[limit:]
        if not data:
            time.sleep(min(timeout_s, 0.002))
        return data


HOW = [
    "not written",
    "unanswered",
    "lost",
    "interrupted before",
    "interrupted after",
    "noise",
    "error 1",
    "error 44",
]


class TestEveryStep:
    def session(self, wire, mode):
        """A life with a light; returns whether nothing went wrong."""
        strobe = STROBE if mode == "strobe" else {}
        options = LightOptions(
            port_path="none", rating_a=0.7, reply_timeout_s=0.02, settle_ms=0.0, mode=mode,
            **{key: value for key, value in strobe.items() if key != "mode"},
        )  # fmt: skip
        light = GardasoftLight("led", SystemClock(), options, wire)
        try:
            light.open()
            for level in (1.0, 0.5):
                light.set_level(level)
            light.check()
            light.set_level(0.0)
            light.set_level(1.0)
        except (DriverError, KeyboardInterrupt):
            return False
        finally:
            with contextlib.suppress(KeyboardInterrupt):
                light.close()
            assert not light.is_open
            assert not wire.is_open
        return True

    @pytest.mark.parametrize("mode", ["continuous", "strobe"])
    @pytest.mark.parametrize("how", HOW)
    def test_the_light_is_off_whichever_operation_fails(self, how, mode):
        for at in itertools.count():
            outputs = LedOutputs()
            outputs.execute(b"VL1,0,1;RS1,100")  # as somebody else left it
            wire = FailingWire(outputs, how, at)
            self.session(wire, mode)
            assert outputs.level == 0, f"operation {at}"
            assert outputs.outputs[0].mode == 0, f"operation {at}"
            if wire.operations <= at:
                break
        assert at > 20

    @pytest.mark.parametrize("how", ["mute", "dead"])
    def test_the_light_is_off_or_out_of_reach_when_all_fails_from_then_on(self, how):
        for at in itertools.count():
            outputs = LedOutputs()
            wire = FailingWire(outputs, how, at)
            self.session(wire, "continuous")
            assert outputs.level == 0 or wire.is_dead, f"operation {at}"
            if wire.operations <= at:
                break
        assert at > 20

    def test_without_a_failure_nothing_fails(self):
        assert self.session(FailingWire(LedOutputs(), "lost", 10_000), "continuous")
