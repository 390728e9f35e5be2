import os
import queue
import socket
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from service_fakes import Rig, Source, capture

from daemon import service as service_module
from daemon.notify import Watchdog, notify
from daemon.recovery import POLICY, Backoff, Remedy, remedy
from daemon.requests import CommandError, RequestQueue
from drivers.capture_source import CaptureRequest
from drivers.errors import (
    CaptureRejectedError,
    DeviceFaultError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    DriverError,
    DriverUnavailableError,
)
from surfclass.errors import InputError


def in_order(events, *wanted):
    """Whether `wanted` appear in this order, other events in between allowed."""
    rest = iter(events)
    return all(item in rest for item in wanted)


def held_up(rig):
    """Waits until the source sits in a call that lasts until the event is set, and returns the event."""
    entered, leave = threading.Event(), threading.Event()
    rig.source.script.append(lambda: (entered.set(), leave.wait(5), None)[2])
    assert entered.wait(5)
    return leave


# ---- the way of one capture


def test_a_capture_is_recorded_then_mapped_then_published(tmp_path):
    with Rig(tmp_path, [capture("a"), capture("b")]) as rig:
        rig.until(lambda: "publish 2" in rig.events)
    assert rig.outcome == 0
    told = [event for event in rig.events if event.split()[0] in ("record", "map", "publish")]
    assert told == [
        *("record a", "map a", "publish 1", "record update"),
        *("record b", "map b", "publish 2", "record update"),
    ]
    assert in_order(rig.events, "close source", "close run-001.mcap", "close publisher")
    assert rig.map_path.read_bytes() == b"2 voxels"


def test_status_tells_what_happened(tmp_path):
    with Rig(tmp_path, [capture("a")]) as rig:
        rig.until(lambda: "publish 1" in rig.events)
        rig.until(lambda: any(s["counts"]["mapped"] for s in rig.publisher.statuses), "a status")
    told = next(s for s in rig.publisher.statuses if s["counts"]["mapped"])
    assert told["health"] == "ok"
    assert told["map"] == {"epoch": "0" * 32, "sequence": 1, "voxels": 1, "voxel_size_m": 0.01}
    assert told["counts"]["accepted"] == told["counts"]["recorded"] == 1
    assert told["stage_ms"]["geometry"] == 2.0
    assert {"capture", "record", "process", "publish"} <= told["stage_ms"].keys()
    assert told["last_error"] is None
    assert rig.publisher.statuses[-1]["health"] == "stopping"


def test_a_request_is_answered_with_what_became_of_it(tmp_path):
    with Rig(tmp_path, dark=True) as rig:
        answer = rig.service.capture({"name": "asked"})
        assert answer["name"] == "asked"
        assert (answer["sequence"], answer["voxels"], answer["touched"]) == (1, 1, 1)
        assert answer["recorded"] is True
        assert rig.service.capture({"dark": False})["sequence"] == 2
        asked = [request for request in rig.source.requests if request is not None]
        assert [request.with_dark for request in asked] == [True, False]
        with pytest.raises(CommandError, match="there is a capture asked already"):
            rig.service.capture({"name": "asked"})
        with pytest.raises(InputError, match="nam: unknown key; did you mean 'name'"):
            rig.service.capture({"nam": "x"})
        with pytest.raises(InputError, match="name"):
            rig.service.capture({"name": "../../etc"})


def test_what_cannot_be_mapped_is_kept_and_told(tmp_path):
    with Rig(tmp_path) as rig:
        rig.pipeline.fail["bad"] = InputError("no pose")
        with pytest.raises(CommandError, match="bad could not be mapped: no pose"):
            rig.service.capture({"name": "bad"})
        assert "record bad" in rig.events
        assert rig.health() == "degraded"
        rig.service.capture({"name": "good"})
        assert rig.health() == "ok"
        assert rig.service.status()["counts"]["unmapped"] == 1
        assert "no pose" in rig.service.status()["last_error"]["message"]


def test_a_bug_ends_the_service_after_everything_is_flushed(tmp_path):
    rig = Rig(tmp_path, [capture("a"), capture("b"), capture("c")])
    rig.pipeline.gate.clear()
    rig.pipeline.fail["a"] = ZeroDivisionError("bug")
    with rig:
        rig.until(lambda: rig.shots.qsize() == 2, "two waiting captures")
        rig.pipeline.gate.set()
        rig.join()
    assert isinstance(rig.outcome, ZeroDivisionError)
    assert in_order(rig.events, "record a", "record b", "record c", "close run-001.mcap", "close publisher")
    assert not [event for event in rig.events if event.startswith("publish")]


def test_a_bug_in_the_source_ends_the_service_too(tmp_path):
    with Rig(tmp_path, [capture("a"), ZeroDivisionError("bug")]) as rig:
        rig.join()
    assert isinstance(rig.outcome, ZeroDivisionError)
    assert "publish 1" in rig.events
    assert not rig.source.is_open


# ---- stopping


def test_stop_finishes_what_was_accepted(tmp_path):
    rig = Rig(tmp_path, [capture(name) for name in "abcdef"])
    rig.pipeline.gate.clear()
    with rig:
        rig.until(lambda: rig.acquisition.counts["accepted"] == 4)
        time.sleep(0.2)
        accepted_before = rig.acquisition.counts["accepted"]
        rig.service.stop()
        rig.pipeline.gate.set()
        rig.join()
    assert rig.outcome == 0
    assert accepted_before == 4  # one is mapped, two wait, and the fourth waits for its place
    assert [event for event in rig.events if event.startswith("map")] == ["map a", "map b", "map c", "map d"]


def test_a_stop_waits_for_the_capture_under_way_and_maps_it(tmp_path):
    with Rig(tmp_path) as rig:
        rig.until(lambda: rig.source.is_open)
        entered, leave = threading.Event(), threading.Event()
        rig.source.script.append(lambda: (entered.set(), leave.wait(5), capture("last"))[2])
        assert entered.wait(5)
        rig.service.stop()
        time.sleep(0.3)
        leave.set()
        rig.join()
    assert in_order(rig.events, "record last", "map last", "publish 1", "close run-001.mcap")


def test_requests_are_refused_while_stopping(tmp_path):
    with Rig(tmp_path) as rig:
        rig.until(lambda: rig.source.is_open)
        leave = held_up(rig)
        waiting = rig.requests.offer({})
        rig.service.stop()
        leave.set()
        rig.join()
    assert rig.outcome == 0
    with pytest.raises(CommandError, match="stopping"):
        waiting.answer.result(0)
    with pytest.raises(CommandError, match="stopping"):
        rig.service.capture({})


def test_a_map_that_cannot_be_written_fails_the_exit_but_nothing_else(tmp_path):
    def broken(voxels):
        raise OSError("no space")

    with Rig(tmp_path, [capture("a")], map_bytes=broken) as rig:
        rig.until(lambda: "publish 1" in rig.events)
    assert rig.outcome == 1
    assert in_order(rig.events, "close run-001.mcap", "close publisher")
    assert not rig.map_path.exists()


# ---- queues


def test_a_full_request_queue_refuses(tmp_path):
    with Rig(tmp_path, limits={"waiting_requests": 2}) as rig:
        leave = held_up(rig)
        first = rig.requests.offer({})
        rig.requests.offer({})
        with pytest.raises(CommandError, match="busy: 2 requests"):
            rig.requests.offer({})
        leave.set()
        assert first.answer.result(5)["name"] == "000001"
        assert rig.service.status()["counts"]["refused"] == 1


def test_a_request_nobody_serves_is_answered_in_time():
    now = [0.0]
    requests = RequestQueue(4, 2.0, lambda: now[0])
    early = requests.offer({})
    now[0] = 1.5
    late = requests.offer({})
    now[0] = 2.0
    requests.expire("waiting for depth")
    with pytest.raises(CommandError, match="within 2 s: waiting for depth"):
        early.answer.result(0)
    assert not late.answer.done()
    assert requests.head() is late


def test_a_request_to_a_service_without_devices_is_told_why(tmp_path):
    absent = [DeviceNotFoundError("depth", "nothing at usb 1-2")] * 1000
    told = pytest.raises(CommandError, match=r"within 0\.3 s: depth: nothing at usb 1-2")
    with Rig(tmp_path, opens=absent, limits={"request_s": 0.3}) as rig, told:
        rig.service.capture({})


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from(["offer", "take", "tick", "close", "reopen"]), max_size=40))
def test_every_request_is_answered_exactly_once_or_waits(steps):
    now = [0.0]
    requests = RequestQueue(3, 2.0, lambda: now[0])
    offered, taken, closed = [], 0, False
    for step in steps:
        if step == "offer":
            room = not closed and len(requests) < 3
            try:
                offered.append(requests.offer({}))
                assert room
            except CommandError:
                assert not room
        elif step == "take" and (head := requests.head()) is not None:
            requests.take(head)
            head.reply({})
            head.refuse("a second answer changes nothing")
            taken += 1
        elif step == "tick":
            now[0] += 1.0
            requests.expire("slow")
        elif step == "close":
            requests.close("closed")
            closed = True
        elif step == "reopen":
            requests.reopen()
            closed = False
    assert sum(not request.answer.done() for request in offered) == len(requests)
    assert sum(request.answer.done() and not request.answer.exception() for request in offered) == taken


# ---- the policy of each error class


def test_every_error_class_has_a_policy():
    kinds = {kind for kind in DriverError.__subclasses__() if kind.__module__ == "drivers.errors"}
    assert kinds == POLICY.keys()
    assert remedy(DeviceTimeoutError("x", "")) is Remedy.RETRY
    assert remedy(DriverError("x", "")) is Remedy.STOP


def test_backoff_doubles_to_two_seconds_and_starts_again():
    backoff = Backoff()
    assert [backoff.next_s() for _ in range(5)] == [0.5, 1, 2, 2, 2]
    backoff.reset()
    assert backoff.next_s() == 0.5
    backoff.attempts = 10**6
    assert backoff.next_s() == 2


def test_missing_hardware_is_waited_for(tmp_path):
    absent = DeviceNotFoundError("depth", "nothing at usb 1-2")
    with Rig(tmp_path, opens=[absent] * 4) as rig:
        rig.until(lambda: rig.service.status()["counts"]["device_errors"] >= 3)
        assert rig.service.capture({})["sequence"] == 1  # it waited with us
    assert rig.acquisition.counts["reopened"] == 1
    assert rig.acquisition.counts["device_errors"] == 4


def test_a_lost_device_is_opened_again_and_the_request_survives(tmp_path):
    with Rig(tmp_path) as rig:
        leave = held_up(rig)
        request = rig.requests.offer({"name": "kept"})
        rig.source.script.append(DeviceLostError("depth", "unplugged"))
        leave.set()
        assert request.answer.result(5)["name"] == "kept"
    assert in_order(rig.events, "open", "close source", "open", "record kept")


def test_the_wait_is_short_again_after_a_success(tmp_path, caplog):
    lost = DeviceLostError("depth", "unplugged")
    with caplog.at_level("WARNING"), Rig(tmp_path, [lost, capture("a"), lost, capture("b")]) as rig:
        rig.until(lambda: "publish 2" in rig.events)
    waits = [record.fields["next"] for record in caplog.records if record.message == "device error"]
    assert waits == ["opening again in 0.01 s"] * 2


def test_a_device_that_stays_away_is_logged_once_until_it_was_back(tmp_path, caplog):
    absent = DeviceNotFoundError("depth", "nothing at usb 1-2")
    with caplog.at_level("WARNING"), Rig(tmp_path, [absent], opens=[absent] * 5) as rig:
        rig.until(lambda: rig.acquisition.counts["reopened"] == 2)
    told = [record.fields["error"] for record in caplog.records if record.message == "device error"]
    assert len(told) == 2  # five times away, then there, then away again
    assert rig.acquisition.counts["device_errors"] == 6


def test_a_reload_ends_the_wait_but_an_earlier_one_does_not_shorten_it(tmp_path):
    with Rig(tmp_path, backoff=Backoff(60, 60)) as rig:
        rig.until(lambda: rig.source.is_open)
        rig.service.ask_reload()
        rig.until(lambda: rig.acquisition._retry.is_set(), "the reload")
        rig.source.script.append(DeviceLostError("depth", "unplugged"))
        rig.until(lambda: rig.health() == "waiting")
        time.sleep(0.3)
        assert rig.health() == "waiting"
        rig.service.ask_reload()
        rig.until(lambda: rig.health() == "ok")


def test_a_timeout_is_retried_once_and_then_as_lost(tmp_path):
    silent = DeviceTimeoutError("colour", "no frame in 2 s")
    with Rig(tmp_path, [silent, capture("a")]) as rig:
        rig.until(lambda: "publish 1" in rig.events)
        assert rig.events.count("open") == 1
        rig.source.script += [silent, silent, capture("b")]
        rig.until(lambda: "publish 2" in rig.events)
        assert rig.events.count("open") == 2
    assert rig.acquisition.counts["device_errors"] == 3


@pytest.mark.parametrize(("device", "asked_again"), [("colour", True), ("light", True), ("arm", False)])
def test_a_capture_whose_tick_is_past_is_asked_for_again(tmp_path, device, asked_again):
    with Rig(tmp_path, [DeviceTimeoutError(device, "silent"), capture("a")], dark=True) as rig:
        rig.until(lambda: "publish 1" in rig.events)
    first, second = rig.source.requests[:2]
    assert first is None
    assert second == (CaptureRequest(with_dark=True) if asked_again else None)


def test_a_fault_is_not_retried_until_a_reload(tmp_path):
    with Rig(tmp_path, [DeviceFaultError("light", "over temperature")]) as rig:
        rig.until(lambda: rig.health() == "failed")
        assert not rig.source.is_open  # which is what turns the light off
        assert "over temperature" in rig.service.status()["detail"]
        with pytest.raises(CommandError, match="over temperature"):
            rig.service.capture({})
        time.sleep(0.2)
        assert rig.events.count("open") == 1
        rig.service.ask_reload()
        rig.until(lambda: rig.health() == "ok")
        assert rig.service.capture({})["sequence"] == 1
    assert rig.outcome == 0


def test_a_missing_vendor_library_ends_with_78(tmp_path):
    missing = DriverUnavailableError("depth", "install pyk4a")
    with Rig(tmp_path, opens=[missing]) as rig:
        rig.join()
    assert rig.outcome == 78
    assert rig.events[-1] == "close publisher"


def test_a_rejected_capture_is_no_device_error(tmp_path):
    with Rig(tmp_path) as rig:
        leave = held_up(rig)
        request = rig.requests.offer({})
        rig.source.script.append(CaptureRejectedError("the arm moved 0.02 rad", "motion"))
        leave.set()
        with pytest.raises(CommandError, match=r"rejected: .*arm moved"):
            request.answer.result(5)
        assert rig.health() == "ok"
    assert rig.acquisition.counts["rejected"] == 1
    assert rig.acquisition.counts["device_errors"] == 0


def test_rejections_are_paced_and_logged_once(tmp_path, caplog):
    stale = [CaptureRejectedError("the joint angles are old", "stale") for _ in range(50)]
    with caplog.at_level("WARNING"), Rig(tmp_path, stale) as rig:
        time.sleep(0.55)
        rejected = rig.acquisition.counts["rejected"]
    assert 2 <= rejected <= 8
    assert len([record for record in caplog.records if "rejected" in record.message]) == 1


def test_another_source_goes_on_with_the_numbers(tmp_path):
    made = []

    def make(first_number):
        made.append(first_number)
        return Source([capture("from the new one")], rig.events)

    with Rig(tmp_path) as rig:
        rig.service.capture({})
        rig.service.capture({"name": "mine"})
        rig.service.capture({})
        rig.acquisition.replace(make, dark=True)
        rig.until(lambda: "map from the new one" in rig.events)
        assert not rig.source.is_open
        assert rig.health() == "ok"
    assert made == [3]
    assert rig.acquisition.dark


# ---- recording


def test_what_cannot_be_recorded_is_not_published_but_held(tmp_path):
    with Rig(tmp_path) as rig:
        rig.until(lambda: rig.source.is_open)
        rig.disk_fault.append(OSError("No space left on device"))
        with pytest.raises(CommandError, match="No space left"):
            rig.service.capture({"name": "held"})
        rig.until(lambda: rig.health() == "failed")
        with pytest.raises(CommandError, match="No space left"):
            rig.service.capture({})
        assert not [event for event in rig.events if event.startswith("publish")]
        rig.disk_fault.clear()
        rig.service.ask_reload()
        rig.until(lambda: "publish 1" in rig.events)
        assert rig.health() == "ok"
    assert in_order(rig.events, "close run-001.mcap", "record held", "publish 1", "close run-002.mcap")
    assert rig.service.status()["counts"]["lost"] == 0


def test_a_capture_that_never_reached_the_disk_is_owned_up_to(tmp_path):
    rig = Rig(tmp_path, [capture("a")])
    rig.disk_fault.append(OSError("No space left on device"))
    with rig:
        rig.until(lambda: rig.health() == "failed")
    assert rig.outcome == 1
    assert rig.service.status()["counts"]["lost"] == 1


def test_a_disk_that_is_nearly_full_stops_capturing(tmp_path):
    with Rig(tmp_path, [capture("a")], min_free_bytes=1 << 62) as rig:
        rig.until(lambda: rig.health() == "failed")
        assert "must stay" in rig.service.status()["detail"]


def test_parts_are_split_between_captures(tmp_path):
    with Rig(tmp_path, [capture("a"), capture("b"), capture("c")], part_bytes=30) as rig:
        rig.until(lambda: "publish 3" in rig.events)
    told = [event for event in rig.events if event.startswith(("record ", "close run"))]
    assert told == [
        *("record a", "record update", "record b", "record update", "close run-001.mcap"),
        *("record c", "record update", "close run-002.mcap"),
    ]


# ---- a recording as source


def test_a_recording_is_processed_and_then_served(tmp_path):
    with Rig(tmp_path, [capture("a"), capture("b")], finite=True, recording=False) as rig:
        rig.until(lambda: rig.health() == "finished")
        rig.until(rig.map_path.exists, "the map file")  # at once, not only at the end
        assert rig.map_path.read_bytes() == b"2 voxels"
        assert rig.thread.is_alive()
        with pytest.raises(CommandError, match="at its end"):
            rig.service.capture({})
    assert rig.outcome == 0


def test_exit_when_done(tmp_path):
    with Rig(tmp_path, [capture("a")], finite=True, recording=False, exit_when_done=True) as rig:
        rig.join()
    assert rig.outcome == 0
    assert "publish 1" in rig.events


def test_a_damaged_recording_ends_it_only_if_it_was_to_end(tmp_path):
    damage = InputError("REC.mcap: cut off")
    with Rig(tmp_path, [capture("a"), damage], finite=True, recording=False) as rig:
        rig.until(lambda: rig.health() == "failed")
        rig.service.ask_reload()
        time.sleep(0.2)
        assert rig.health() == "failed"
        assert rig.events.count("open") == 1  # a second run would count everything twice
    assert rig.outcome == 0
    with Rig(tmp_path, [capture("a"), damage], finite=True, recording=False, exit_when_done=True) as rig:
        rig.join()
    assert isinstance(rig.outcome, InputError)
    assert "publish 1" in rig.events


# ---- the supervisor


class Supervisor:
    """The other end of $NOTIFY_SOCKET."""

    def __init__(self, address):
        self.channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.channel.bind(str(address))

    def wait_for(self, words):
        """Returns the first message that holds `words`."""
        self.channel.settimeout(10)
        while words not in (message := self.channel.recv(4096).decode()):
            pass
        return message

    def hear(self, seconds):
        """Returns what comes within so long."""
        told, until = [], time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.channel.settimeout(left)
            try:
                told.append(self.channel.recv(4096).decode())
            except TimeoutError:
                break
        return told


@pytest.fixture
def supervisor(tmp_path, monkeypatch):
    heard = Supervisor(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    yield heard
    heard.channel.close()


def test_ready_comes_with_missing_hardware_and_says_so(tmp_path, supervisor):
    with Rig(tmp_path, opens=[DeviceNotFoundError("depth", "nothing at usb 1-2")] * 1000) as rig:
        told = supervisor.wait_for("READY=1")
        assert "STATUS=waiting: depth: nothing at usb 1-2" in told
    assert "flushing" in supervisor.wait_for("STOPPING=1")
    assert rig.outcome == 0


def test_ready_comes_while_a_device_hangs_in_open(tmp_path, supervisor, monkeypatch):
    monkeypatch.setattr(service_module, "_START_S", 0.3)
    leave = threading.Event()
    rig = Rig(tmp_path)
    slow_open = rig.source.open
    rig.source.open = lambda: (leave.wait(10), slow_open())
    with rig:
        assert "STATUS=starting" in supervisor.wait_for("READY=1")
        leave.set()


def test_reload_is_announced_and_says_what_it_did(tmp_path, supervisor):
    outcomes = ["restart to take over: model", InputError("robot: missing")]

    def reload():
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    with Rig(tmp_path, reload=reload) as rig:
        supervisor.wait_for("READY=1")
        for says in ("restart to take over: model", "not taken over: robot: missing"):
            rig.service.ask_reload()
            assert "MONOTONIC_USEC=" in supervisor.wait_for("RELOADING=1")
            assert says in supervisor.wait_for("READY=1")
        assert rig.service.capture({})["sequence"] == 1
    assert "robot: missing" in rig.service.status()["last_error"]["message"]


def test_a_hung_acquisition_starves_the_watchdog(tmp_path, supervisor, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    leave = threading.Event()
    limits = {"heartbeat_s": 0.5, "device_s": 0.05, "stop_s": 1.0}
    with Rig(tmp_path, limits=limits) as rig:
        supervisor.wait_for("WATCHDOG=1")
        rig.source.script.append(lambda: (leave.wait(10), None)[1])
        told = supervisor.wait_for("silent")
        assert "STATUS=failed: the acquisition has been silent" in told
        assert not [message for message in supervisor.hear(0.7) if "WATCHDOG=1" in message]
        leave.set()
        supervisor.wait_for("WATCHDOG=1")


def test_watchdog_is_silent_where_it_is_not_ours(monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid() + 1))
    assert Watchdog().interval_s is None
    monkeypatch.delenv("WATCHDOG_PID")
    assert Watchdog().interval_s == 0.05


def test_notify_needs_no_supervisor_and_knows_abstract_addresses(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert notify("READY=1") is False
    monkeypatch.setenv("NOTIFY_SOCKET", "/nonexistent/socket")
    assert notify("READY=1") is False
    address = f"surfclass-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind("\0" + address)
        channel.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + address)
        assert notify("READY=1", "STATUS=good") is True
        assert channel.recv(100) == b"READY=1\nSTATUS=good"


def test_a_jumping_clock_does_not_keep_the_processor_busy(tmp_path):
    asked = []
    with Rig(tmp_path) as rig:
        rig.until(lambda: rig.source.is_open)
        rig.source.next = lambda timeout_s, request=None: asked.append(request)  # back at once
        rig.until(lambda: len(asked) > 150, "fast polls while an arm may be on its way")
        time.sleep(1.0)
    assert len(asked) < 250


def test_acquisition_waits_for_room_and_drops_nothing(tmp_path):
    names = [f"n{number}" for number in range(20)]
    with Rig(tmp_path, [capture(name) for name in names], limits={"waiting_captures": 1}) as rig:
        assert isinstance(rig.shots, queue.Queue)
        rig.until(lambda: "publish 20" in rig.events)
    assert [event for event in rig.events if event.startswith("map")] == [f"map {name}" for name in names]
