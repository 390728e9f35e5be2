"""A camera in a process of its own is the camera that it is, or a lost one; never a daemon that hangs."""

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from isolated_doubles import picture

from drivers import errors
from drivers.errors import DeviceFaultError, DeviceLostError, DeviceTimeoutError, DriverUnavailableError
from drivers.isolation import camera as isolation
from drivers.isolation.camera import IsolatedCamera
from surfclass import errors as input_errors
from surfclass.errors import ConfigurationError, InputError

HERE = Path(__file__).parent
CALLS = ("open", "grab", "check", "about")
SLOW_COMPUTER_S = 5.0
PARENT_ID, SESSION = 3, 5


def isolated(deeds=None, factory="isolated_doubles:camera", environment=None, open_timeout_s=20.0, **options):
    return IsolatedCamera(
        factory,
        name="depth",
        options={"deeds": deeds or {}, **options},
        environment={"PYTHONPATH": str(HERE), **(environment or {})},
        open_timeout_s=open_timeout_s,
    )


def call(camera, name):
    if name == "grab":
        return camera.grab(time.monotonic_ns(), 2.0)
    return getattr(camera, name)()


def opened_and_called(camera, name):
    call(camera, "open")
    if name != "open":
        call(camera, name)


def called_until_it_fails(camera, name, times=100):
    for _ in range(times):
        with contextlib.suppress(DeviceTimeoutError):
            call(camera, name)
        time.sleep(0.05)


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def gone_within(pid, seconds=SLOW_COMPUTER_S):
    until = time.monotonic() + seconds
    while is_alive(pid) and time.monotonic() < until:
        time.sleep(0.01)
    return not is_alive(pid)


def processes(field, number):
    """Those of which a field of /proc/PID/stat, counted from 0, is `number`; only our own zombies count."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[field - 2]) == number and (fields[0] != "Z" or field == PARENT_ID):
                found.append(int(stat.parent.name))
    return sorted(found)


def held():
    return {
        "descriptors": sum(1 for _ in Path("/proc/self/fd").iterdir()),
        "children": processes(PARENT_ID, os.getpid()),
        "threads": threading.active_count(),
        "memories": Path("/proc/self/maps").read_text().count("memfd:surfclass"),
    }


@pytest.fixture(autouse=True)
def _checks_may_take_long(monkeypatch):
    """A computer that is busy with other tests is none of these tests' business."""
    monkeypatch.setattr(isolation, "_CHECK_S", SLOW_COMPUTER_S)


@pytest.fixture(autouse=True)
def _nothing_is_left():
    before = held()
    yield
    assert held() == before


class TestFrames:
    @pytest.mark.parametrize("pixels", ["uint8", "uint16"])
    def test_a_colour_frame_comes_through_as_it_is(self, pixels):
        with isolated(kind="colour", shapes=[[48, 64, 3]], pixels=pixels) as camera:
            frame = camera.grab(time.monotonic_ns(), 5.0)
        assert frame.rgb.dtype == pixels
        assert np.array_equal(frame.rgb, picture([48, 64, 3], pixels, 1))
        assert not frame.rgb.flags.writeable
        assert (frame.sequence, frame.exposure_s, frame.t_sd_ns, frame.gain_db) == (1, 0.004, 17, 6.5)

    @pytest.mark.parametrize("ir", ["uint8", "uint16"])
    def test_depth_and_ir_of_one_exposure_come_through_as_they_are(self, ir):
        asked_ns = time.monotonic_ns()
        with isolated(shapes=[[48, 64]], ir=ir) as camera:
            without = camera.grab(asked_ns, 5.0)
            both = camera.grab(asked_ns, 5.0, with_ir=True)
        assert without.ir is None
        assert np.array_equal(without.depth_mm, picture([48, 64], "uint16", 1))
        assert np.array_equal(both.depth_mm, picture([48, 64], "uint16", 2))
        assert both.ir is not None
        assert both.ir.dtype == ir
        assert np.array_equal(both.ir, picture([48, 64], ir, 3))
        assert asked_ns <= without.t_ns < both.t_ns <= time.monotonic_ns()
        assert (both.exposure_s, both.t_sd_ns) == (None, 23)

    def test_a_later_frame_changes_no_earlier_one_whatever_its_size(self):
        shapes = [[480, 640], [6, 8], [960, 1280], [1, 1], [0, 5]]
        with isolated(shapes=shapes) as camera:
            frames = [camera.grab(0, 5.0, with_ir=True) for _ in range(2 * len(shapes))]
        for n, frame in enumerate(frames):
            assert np.array_equal(frame.depth_mm, picture(shapes[n % len(shapes)], "uint16", n + 1))
            assert np.array_equal(frame.ir, picture(shapes[n % len(shapes)], "uint16", n + 2))

    def test_a_frame_may_have_64_mib_and_no_more(self):
        with isolated(kind="colour", pixels="uint8", shapes=[[4096, 5461, 3], [4096, 5462, 3]]) as camera:
            frame = camera.grab(0, 20.0)
            assert frame.rgb.shape == (4096, 5461, 3)
            assert (frame.rgb == 1).all()
            with pytest.raises(DeviceFaultError, match=r"4096 × 5462 × 3 pixels has 64.0 MiB"):
                camera.grab(0, 20.0)
            assert camera.grab(0, 20.0).sequence == 3, "the camera still works"

    def test_a_time_far_ahead_is_waited_for(self):
        with isolated() as camera:
            ahead_ns = time.monotonic_ns() + 1_300_000_000
            assert camera.grab(ahead_ns, 0.1).t_ns >= ahead_ns

    @pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
    def test_a_timeout_that_is_none_is_refused(self, timeout_s):
        with isolated() as camera, pytest.raises(InputError, match="allowed is above 0 and finite"):
            camera.grab(0, timeout_s)


class TestErrors:
    @pytest.mark.parametrize(
        "kind",
        [
            "DeviceNotFoundError",
            "DeviceLostError",
            "DeviceTimeoutError",
            "DeviceFaultError",
            "DriverUnavailableError",
            "ConfigurationError",
            "InputError",
        ],
    )
    def test_an_error_of_the_driver_keeps_its_class_and_its_words(self, kind):
        said = "temperature 81 °C, allowed: 70; \N{SNOWMAN}\n  line 2"
        wanted = getattr(errors, kind, None) or getattr(input_errors, kind)
        words = f"depth: {said}" if issubclass(wanted, errors.DriverError) else said
        deed = [f"raise {kind} {said}"]
        camera = isolated({"open": deed})
        with pytest.raises(wanted) as raised:
            camera.open()
        assert (type(raised.value), str(raised.value)) == (wanted, words)
        assert not camera.is_open
        assert camera.pid is None
        with isolated({"grab": deed, "check": deed, "about": deed}) as camera:
            for name in ("grab", "check", "about"):
                with pytest.raises(wanted) as raised:
                    call(camera, name)
                assert (type(raised.value), str(raised.value)) == (wanted, words)
                call(camera, name)  # the process is still there, and so is the camera

    @pytest.mark.parametrize(
        ("name", "kind"),
        [("open", "ValueError"), ("grab", "OSError"), ("check", "OSError"), ("about", "ValueError")],
    )
    def test_any_other_error_is_a_lost_device_with_its_traceback_in_the_log(self, name, kind, caplog):
        camera = isolated({name: [f"raise {kind} index 7 is out of bounds"]})
        with contextlib.closing(camera):
            with pytest.raises(DeviceLostError, match=f"defect.*{kind}: index 7 is out of bounds"):
                opened_and_called(camera, name)
            assert camera.pid is None, "what such a driver would do next is not known"
        (record,) = [record for record in caplog.records if record.levelno >= logging.ERROR]
        assert "isolated_doubles.py" in record.getMessage()

    def test_a_missing_library_names_itself(self):
        with pytest.raises(DriverUnavailableError, match="'no_such_library'"):
            isolated(factory="isolated_doubles:needs_a_library").open()

    @pytest.mark.parametrize("factory", ["drivers.no_such_module:camera", "isolated_doubles:no_such_factory"])
    def test_a_factory_that_is_not_there_is_a_lost_device(self, factory, caplog):
        with pytest.raises(DeviceLostError, match="defect"):
            isolated(factory=factory).open()

    @pytest.mark.parametrize("factory", ["", "module", "module:", ":x", "a b:c", "a:b:c", "../a:b", "a:b()"])
    def test_refuses_what_is_no_factory(self, factory):
        with pytest.raises(ConfigurationError, match="allowed is module:function"):
            isolated(factory=factory)

    @pytest.mark.parametrize("value", [{1, 2}, b"bytes", float("nan"), object(), "x" * 50_000])
    def test_refuses_options_that_cannot_travel(self, value):
        with pytest.raises(ConfigurationError, match="options"):
            isolated(value=value)

    @pytest.mark.parametrize("about", [7, {"model": 3}, "endless"])
    def test_facts_that_are_none_are_a_lost_device(self, about):
        with isolated(about=about) as camera, pytest.raises(DeviceLostError):
            camera.about()


class TestDeath:
    @pytest.mark.parametrize(
        ("name", "kind"),
        [
            ("open", "SIGSEGV"),
            ("open", "SIGKILL"),
            ("grab", "SIGSEGV"),
            ("check", "SIGABRT"),
            ("about", "SIGBUS"),
        ],
    )
    def test_a_process_that_is_killed_in_a_call_is_a_lost_device(self, name, kind):
        camera = isolated({name: f"die {kind}"})
        with contextlib.closing(camera):
            with pytest.raises(DeviceLostError, match=f"killed by {kind} in {name}") as raised:
                opened_and_called(camera, name)
            assert "something is wrong with the bus" in str(raised.value)
            assert raised.value.device == "depth"

    @pytest.mark.parametrize("deed", ["exit 0", "exit 3"])
    def test_a_process_that_ends_by_itself_is_a_lost_device(self, deed):
        with isolated({"grab": deed}) as camera, pytest.raises(DeviceLostError, match=f"status {deed[-1]}"):
            call(camera, "grab")

    @pytest.mark.parametrize("name", ["grab", "check", "about"])
    def test_a_process_that_died_between_calls_is_noticed_at_once(self, name):
        with isolated() as camera:
            call(camera, "grab")
            pid = camera.pid
            os.kill(pid, signal.SIGKILL)
            before = time.monotonic()
            with pytest.raises(DeviceLostError, match="killed by SIGKILL"):
                call(camera, name)
            assert time.monotonic() - before < SLOW_COMPUTER_S
            assert camera.pid is None
            assert camera.is_open, "until it is closed"
            with pytest.raises(DeviceLostError, match="killed by SIGKILL"):
                camera.check()
        with pytest.raises(DeviceLostError, match="not open"):
            camera.check()

    def test_nothing_from_before_a_loss_comes_after_it(self):
        camera = isolated()
        pids = set()
        with contextlib.closing(camera):
            for _ in range(3):
                camera.open()
                pids.add(camera.pid)
                assert [camera.grab(0, 5.0).sequence for _ in range(3)] == [1, 2, 3]
                os.kill(camera.pid, signal.SIGKILL)
                with pytest.raises(DeviceLostError):
                    camera.grab(0, 5.0)
        assert len(pids) == 3

    def test_a_kill_at_any_moment_leaves_a_camera_that_opens_again(self):
        rng = np.random.default_rng(1)
        camera = isolated({"open": "wait 0.02", "grab": "wait 0.02", "close": "wait 0.02"})
        for _ in range(8):
            killer = threading.Timer(rng.uniform(0, 0.5), lambda: camera.pid and os.kill(camera.pid, 9))
            killer.start()
            try:
                with camera:
                    for _ in range(10):
                        camera.grab(0, 5.0)
            except DeviceLostError as error:
                assert "killed by SIGKILL" in str(error)  # noqa: PT017 - which of the calls it hits is left to chance
            killer.join()
            assert camera.pid is None
        with camera:
            assert camera.grab(0, 5.0).sequence == 1

    def test_what_the_library_started_ends_with_it(self):
        with isolated({"grab": ["start-a-child", "exit 1"]}) as camera:
            camera.grab(0, 5.0)
            session = camera.pid
            with pytest.raises(DeviceLostError):
                camera.grab(0, 5.0)
        until = time.monotonic() + SLOW_COMPUTER_S
        while (left := processes(SESSION, session)) and time.monotonic() < until:
            time.sleep(0.01)
        assert not left

    @pytest.mark.parametrize(
        "deed",
        [
            "talk-nonsense nonsense",
            "talk-nonsense [1]",
            'talk-nonsense {"id": 2, "frame": "depth"}',
            'talk-nonsense {"id": 2, "error": "KeyboardInterrupt", "text": ""}',
            "talk-at-length 70000",
        ],
    )
    def test_a_process_that_talks_nonsense_is_a_lost_device(self, deed):
        with isolated({"grab": deed}) as camera:
            with pytest.raises(DeviceLostError, match="its process s"):
                camera.grab(0, 5.0)
            assert camera.pid is None

    def test_a_message_that_answers_nothing_is_dropped(self):
        with isolated({"grab": "talk-nonsense {}"}) as camera:
            assert camera.grab(0, 5.0).sequence == 1

    def test_more_processes_than_allowed_are_a_lost_device(self, monkeypatch):
        def refuse(*arguments, **options):
            raise BlockingIOError(11, "Resource temporarily unavailable")

        monkeypatch.setattr(subprocess, "Popen", refuse)
        with pytest.raises(DeviceLostError, match=r"cannot be started: \[Errno 11\]"):
            isolated().open()


class TestHang:
    @pytest.mark.parametrize(
        ("name", "deed"), [("open", "hang-in-a-library"), ("grab", "hang"), ("grab", "hang-in-a-library")]
    )
    def test_a_process_that_hangs_is_killed_and_a_lost_device(self, name, deed):
        camera = isolated({name: deed}, open_timeout_s=2.0 if name == "open" else 20.0)
        with contextlib.closing(camera):
            if name != "open":
                camera.open()
                pid = camera.pid
            before = time.monotonic()
            with pytest.raises(DeviceLostError, match=rf"hung in {name}\(\) and was killed"):
                camera.open() if name == "open" else camera.grab(0, 0.1)
            assert time.monotonic() - before < 2.0 + SLOW_COMPUTER_S
            assert camera.pid is None
            assert name == "open" or not is_alive(pid)

    @pytest.mark.parametrize("deed", ["hang-in-a-library", "die SIGSEGV", "raise OSError no", "sys.exit 1"])
    def test_close_ends_in_time_and_never_raises(self, deed):
        camera = isolated({"close": deed})
        camera.open()
        pid = camera.pid
        before = time.monotonic()
        camera.close()
        assert time.monotonic() - before < 2.0 + SLOW_COMPUTER_S
        assert not camera.is_open
        assert not is_alive(pid)
        camera.close()

    def test_a_mute_device_times_out_by_its_driver_and_the_process_stays(self):
        with isolated({"grab": ["raise DeviceTimeoutError no frame came in time"]}) as camera:
            pid = camera.pid
            with pytest.raises(DeviceTimeoutError):
                call(camera, "grab")
            assert camera.grab(0, 5.0).sequence == 1
            assert camera.pid == pid

    def test_a_check_tells_a_busy_computer_from_a_process_that_hangs(self, monkeypatch):
        with isolated() as camera:
            camera.check()
            os.kill(camera.pid, signal.SIGSTOP)
            monkeypatch.setattr(isolation, "_CHECK_S", 0.3)
            before = time.monotonic()
            with pytest.raises(DeviceTimeoutError, match=r"not answered check\(\) in 0.3 s"):
                camera.check()
            assert time.monotonic() - before < 0.3 + SLOW_COMPUTER_S
            os.kill(camera.pid, signal.SIGCONT)
            assert camera.grab(0, 5.0).sequence == 1, "and not the answer to check()"
            os.kill(camera.pid, signal.SIGSTOP)
            with pytest.raises(DeviceLostError, match=r"hung in check\(\)"):
                called_until_it_fails(camera, "check")

    def test_a_driver_whose_checks_take_too_long_is_slow_and_does_not_hang(self, monkeypatch):
        with isolated({"check": ["wait 0.5"] * 4}) as camera:
            monkeypatch.setattr(isolation, "_CHECK_S", 0.3)
            for _ in range(4):
                with pytest.raises(DeviceTimeoutError):
                    camera.check()
                time.sleep(0.4)
            assert camera.grab(0, 5.0).sequence == 1

    def test_an_answer_that_came_too_late_is_not_taken_for_the_next(self):
        def interrupt(number, frame):
            raise InterruptedError

        handler = signal.signal(signal.SIGALRM, interrupt)
        try:
            with isolated({"grab": ["wait 0.5"]}) as camera:
                signal.setitimer(signal.ITIMER_REAL, 0.1)
                with pytest.raises(InterruptedError):
                    camera.grab(0, 5.0)
                assert camera.about()["library"] == "none"
                assert camera.grab(0, 5.0).sequence == 2
        finally:
            signal.signal(signal.SIGALRM, handler)


class TestOutput:
    def test_what_a_library_prints_never_stops_it(self):
        with isolated({"grab": "print 10000 \x1b[31mnoise without an end "}) as camera:
            for n in range(5):
                assert camera.grab(0, 5.0).sequence == n + 1

    def test_lines_go_to_the_log_and_the_last_ones_into_the_message(self, caplog):
        caplog.set_level(logging.DEBUG, "surfclass.isolation")
        deeds = {"grab": ["print 3 \x07usb reset\n", "die SIGKILL"]}
        with isolated(deeds) as camera:
            camera.grab(0, 5.0)
            with pytest.raises(DeviceLostError) as raised:
                camera.grab(0, 5.0)
        assert str(raised.value).endswith(
            "it said last: \N{REPLACEMENT CHARACTER}usb reset | \N{REPLACEMENT CHARACTER}usb reset | "
            "libdouble: something is wrong with the bus"
        )
        lines = [record for record in caplog.records if "something is wrong" in record.getMessage()]
        assert [record.levelno for record in lines] == [logging.DEBUG]

    def test_where_a_crash_happened_is_in_the_log_and_not_in_the_message(self, caplog):
        with isolated({"grab": "die SIGSEGV"}) as camera, pytest.raises(DeviceLostError) as raised:
            camera.grab(0, 5.0)
        told = "\n".join(record.getMessage() for record in caplog.records if record.levelno == logging.ERROR)
        assert "Segmentation fault" in told
        assert "isolated_doubles.py" in told
        assert "isolated_doubles.py" not in str(raised.value)


class TestProcess:
    def test_it_knows_the_variables_that_it_was_given(self):
        with isolated(environment={"DOUBLE": "given"}) as camera:
            assert camera.about()["status"] == "given"

    def test_a_camera_outlives_the_thread_that_opened_it(self):
        camera = isolated()
        opener = threading.Thread(target=camera.open)
        opener.start()
        opener.join()
        with contextlib.closing(camera):
            time.sleep(0.2)
            assert camera.grab(0, 5.0).sequence == 1

    def test_a_termination_from_outside_closes_the_device(self, tmp_path):
        with isolated(closed_path=str(tmp_path / "closed")) as camera:
            os.kill(camera.pid, signal.SIGTERM)
            with pytest.raises(DeviceLostError, match="killed by SIGTERM"):
                called_until_it_fails(camera, "grab")
        assert (tmp_path / "closed").read_text() == "closed"

    def test_signals_that_the_opening_thread_had_blocked_are_not_blocked_in_it(self):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
        try:
            camera = isolated()
            camera.open()
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
        with contextlib.closing(camera):
            pid = camera.pid
            os.kill(pid, signal.SIGTERM)
            assert gone_within(pid)

    @pytest.mark.parametrize("deed", ["idle", "hang", "hang-in-a-library"])
    def test_it_ends_when_its_parent_is_killed(self, deed):
        with subprocess.Popen(
            [sys.executable, "-c", PARENT, deed], cwd=HERE, stdout=subprocess.PIPE, text=True
        ) as parent:
            pid = int(parent.stdout.readline())
            time.sleep(0.1)
            assert is_alive(pid)
            parent.kill()
        assert gone_within(pid)

    def test_it_ends_when_its_parent_is_killed_before_it_has_begun(self):
        for delay_s in (0.0, 0.01, 0.03):
            with subprocess.Popen(
                [sys.executable, "-c", PARENT_OF_A_BEGINNER, str(delay_s)],
                cwd=HERE,
                stdout=subprocess.PIPE,
                text=True,
            ) as parent:
                pid = int(parent.stdout.readline())
            assert gone_within(pid)

    def test_an_interrupt_of_the_terminal_leaves_closing_to_the_parent(self, tmp_path):
        closed = tmp_path / "closed"
        with subprocess.Popen(
            [sys.executable, "-c", PARENT, "wait 0.5", str(closed)],
            cwd=HERE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        ) as parent:
            pid = int(parent.stdout.readline())
            time.sleep(0.3)
            os.killpg(parent.pid, signal.SIGINT)
        assert gone_within(pid)
        assert closed.read_text() == "closed"

    @pytest.mark.slow
    @pytest.mark.timeout(600)
    def test_two_hundred_cycles_leave_nothing(self):
        before = held()
        camera = isolated()
        for cycle in range(200):
            with camera:
                camera.grab(0, 10.0)
                if cycle % 4 == 3:
                    os.kill(camera.pid, signal.SIGKILL)
            assert held() == before


PARENT = """
import os, sys, threading, time
from drivers.isolation.camera import IsolatedCamera
deed, *closed = sys.argv[1:]
options = {"deeds": {"grab": deed} if deed != "idle" else {}}
if closed:
    options["closed_path"] = closed[0]
with IsolatedCamera(
    "isolated_doubles:camera", name="depth", options=options, environment={"PYTHONPATH": os.getcwd()}
) as camera:
    print(camera.pid, flush=True)
    while True:
        camera.grab(time.monotonic_ns(), 60.0)
        time.sleep(0.01)
"""

PARENT_OF_A_BEGINNER = """
import os, signal, sys, time
from drivers.isolation.child_process import ChildProcess
child = ChildProcess("depth", {})
print(child.pid, flush=True)
time.sleep(float(sys.argv[1]))
os.kill(os.getpid(), signal.SIGKILL)
"""
