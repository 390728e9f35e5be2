"""The reader of CiA 406 encoders and CiA 402 drives, on emulated nodes."""

import math
import threading
import time

import can_site
import pytest

from drivers.canbus.nodes import JointNode
from drivers.emulators.can_nodes import COUNTS_PER_TURN
from drivers.errors import DeviceFaultError, DeviceNotFoundError, DeviceTimeoutError, DriverError
from surfclass.errors import ConfigurationError

COUNT_RAD = math.tau / COUNTS_PER_TURN
ENCODER, DRIVE = (406, 0x6004), (402, 0x6064)


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


def reader(channel, thing=0x6004, **more):
    return can_site.node_reader(can_site.node_options(channel, thing, **more))


def sent_ids(end):
    return {frame.can_id for frame in end.heard}


@pytest.mark.parametrize(("profile", "thing"), [ENCODER, DRIVE])
class TestReading:
    def test_pdos_after_a_sync_of_another_node_are_of_its_time(self, tmp_path, profile, thing):
        cell = can_site.Turning()
        with (
            can_site.nodes_on_a_bus(tmp_path, cell, profile=profile, sync_period_s=can_site.PERIOD_S) as (
                _,
                end,
            ),
            reader(tmp_path, thing) as arm,
        ):
            end.heard.clear()
            for _ in range(5):
                before_ns = time.monotonic_ns()
                reading = arm.read_joints(can_site.PATIENT_S)
                assert before_ns <= reading.t_ns - reading.t_sd_ns
                can_site.assert_of_one_time(cell, reading, COUNT_RAD)
            assert sent_ids(end) == set(), "once its PDOs are known, nothing is sent"

    def test_pdos_after_our_own_sync_are_of_the_time_it_was_sent(self, tmp_path, profile, thing):
        cell = can_site.Turning()
        with (
            can_site.nodes_on_a_bus(tmp_path, cell, profile=profile) as (_, end),
            reader(tmp_path, thing, send_sync=True) as arm,
        ):
            end.heard.clear()
            for _ in range(5):
                reading = arm.read_joints(can_site.PATIENT_S)
                can_site.assert_of_one_time(cell, reading, COUNT_RAD)
                assert abs(cell.times_ns(reading.q).mean() - reading.t_ns) <= reading.t_sd_ns + 1e5
            assert sent_ids(end) == {0x80}

    def test_sdo_answers_lie_between_the_first_question_and_the_last_answer(self, tmp_path, profile, thing):
        cell = can_site.Turning()
        with (
            can_site.nodes_on_a_bus(tmp_path, cell, profile=profile) as (_, end),
            reader(tmp_path, thing, read="sdo", window_ms=200.0) as arm,
        ):
            for _ in range(5):
                reading = arm.read_joints(can_site.PATIENT_S)
                times_ns = cell.times_ns(reading.q)
                assert abs(times_ns - reading.t_ns).max() <= reading.t_sd_ns + COUNT_RAD / can_site.RATE * 1e9
            assert sent_ids(end) == {0x600 + node for node in range(1, 7)}


class TestFaults:
    @pytest.mark.parametrize("fault", ["missing", "late", "short", "mute"])
    def test_a_set_that_is_not_whole_is_none(self, tmp_path, fault):
        with (
            can_site.nodes_on_a_bus(tmp_path, sync_period_s=can_site.PERIOD_S) as (nodes, _),
            reader(tmp_path) as arm,
        ):
            nodes.faults = {fault}
            time.sleep(0.22)
            with pytest.raises(DeviceTimeoutError, match="frames came, sets"):
                arm.read_joints(0.1)
            with pytest.raises(DeviceTimeoutError):
                arm.check()
            nodes.faults = set()
            arm.read_joints(can_site.PATIENT_S)

    @pytest.mark.parametrize(("read", "window_ms"), [("pdo", 10.0), ("sdo", 200.0)])
    def test_an_impossible_position_is_a_fault(self, tmp_path, read, window_ms):
        with (
            can_site.nodes_on_a_bus(tmp_path, sync_period_s=can_site.PERIOD_S) as (nodes, _),
            reader(tmp_path, read=read, window_ms=window_ms) as arm,
        ):
            nodes.faults = {"impossible"}
            error = can_site.fails(arm)
            assert isinstance(error, DeviceFaultError)
            assert "joint 2 at 400°, allowed are -93° to 138°" in str(error)

    def test_an_emergency_is_a_fault_until_it_is_over(self, tmp_path):
        with (
            can_site.nodes_on_a_bus(tmp_path, sync_period_s=can_site.PERIOD_S) as (nodes, _),
            reader(tmp_path) as arm,
        ):
            nodes.emergency(3, 0x5530)
            error = can_site.fails(arm)
            assert isinstance(error, DeviceFaultError)
            assert "node 3 reports an emergency: Code 0x5530" in str(error)
            time.sleep(0.1)
            with pytest.raises(DeviceFaultError):
                arm.check()
            nodes.emergency(3, 0)
            can_site.waits_for(lambda: not isinstance(can_site.outcome(arm), DeviceFaultError))
            arm.read_joints(can_site.PATIENT_S)
            arm.check()

    def test_a_node_that_is_silent_for_a_while_is_asked_again(self, tmp_path):
        cell = can_site.Turning()
        with (
            can_site.nodes_on_a_bus(tmp_path, cell) as (nodes, _),
            reader(tmp_path, read="sdo", window_ms=200.0, sdo_timeout_s=0.05) as arm,
        ):
            nodes.faults = {"mute"}
            time.sleep(0.22)
            with pytest.raises(DeviceTimeoutError):
                arm.read_joints(0.1)
            nodes.faults = set()
            reading = arm.read_joints(can_site.PATIENT_S)
            assert abs(cell.times_ns(reading.q) - reading.t_ns).max() <= reading.t_sd_ns + 1e6

    def test_no_answer_when_it_is_opened_is_not_found(self, tmp_path):
        with can_site.nodes_on_a_bus(tmp_path) as (nodes, _):
            nodes.faults = {"mute"}
            with pytest.raises(DeviceNotFoundError, match=r"node 1, object 0x1001\.0: No SDO response"):
                reader(tmp_path).open()

    def test_an_object_that_a_node_does_not_have_is_a_fault(self, tmp_path):
        with can_site.nodes_on_a_bus(tmp_path):
            with pytest.raises(DeviceFaultError, match="node 1 sends 0x6064 in none of its TPDOs"):
                reader(tmp_path, 0x6064).open()
            with pytest.raises(
                DeviceFaultError, match=r"node 1, object 0x6064\.0: .*[Oo]bject does not exist"
            ):
                reader(tmp_path, 0x6064, read="sdo").open()

    def test_short_services_are_counted_and_nothing_else(self, tmp_path):
        with (
            can_site.nodes_on_a_bus(tmp_path, sync_period_s=can_site.PERIOD_S) as (_, end),
            reader(tmp_path) as arm,
        ):
            for can_id in (0x081, 0x581, 0x701):
                end.send(can_id, b"\x01\x02")
            end.send(0x7E4, bytes(8))
            end.send(0x000, b"")
            arm.read_joints(can_site.PATIENT_S)
            assert "3 malformed" in arm.about()["status"]


class TestNetworkManagement:
    def test_nodes_that_wait_are_started_where_that_is_configured(self, tmp_path):
        with can_site.nodes_on_a_bus(tmp_path, sync_period_s=can_site.PERIOD_S, operational=False) as (
            nodes,
            end,
        ):
            with pytest.raises(DeviceNotFoundError):
                reader(tmp_path).open()
            assert 0 not in sent_ids(end)
            with reader(tmp_path, start_nodes=True) as arm:
                arm.read_joints(can_site.PATIENT_S)
                nodes.boot(4)
                arm.read_joints(can_site.PATIENT_S)
                assert 0 in sent_ids(end)

    def test_a_node_that_boots_is_missed_where_it_may_not_be_started(self, tmp_path):
        with (
            can_site.nodes_on_a_bus(tmp_path, sync_period_s=can_site.PERIOD_S) as (nodes, _),
            reader(tmp_path) as arm,
        ):
            nodes.boot(4)
            time.sleep(0.2)
            with pytest.raises(DeviceTimeoutError, match="incomplete"):
                arm.read_joints(0.1)

    def test_it_can_be_opened_again_and_again(self, tmp_path):
        with can_site.nodes_on_a_bus(tmp_path) as (nodes, _):
            arm = reader(tmp_path, send_sync=True)
            for _ in range(3):
                with arm:
                    arm.read_joints(can_site.PATIENT_S)
                with pytest.raises(DriverError):
                    arm.read_joints(0.1)
            nodes.faults = {"mute"}
            with pytest.raises(DeviceNotFoundError):
                arm.open()


class TestCounts:
    def node(self, **more):
        return JointNode(node_id=1, object=0x6004, counts_per_turn=1000.0, **more)

    @pytest.mark.parametrize(("position", "turns"), [(0, 0.0), (250, 0.25), ((1 << 32) - 250, -0.25)])
    def test_positions_count_from_zero_in_both_directions(self, position, turns):
        angle = self.node().angle(position.to_bytes(4, "little"))
        assert angle == pytest.approx(turns * math.tau)

    def test_zero_sign_and_range_are_the_configurations(self):
        node = self.node(zero_counts=100, range_counts=4096, sign=-1)
        assert node.angle((350).to_bytes(4, "little")) == pytest.approx(-0.25 * math.tau)
        assert node.angle((4096 - 150).to_bytes(4, "little")) == pytest.approx(0.25 * math.tau)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"read": "sdo", "send_sync": True}, "send_sync: for read"),
        ({"window_ms": 30.0}, "a set could hold answers to two SYNCs"),
        ({"read": "rpdo"}, "read: input should be 'pdo' or 'sdo'"),
        ({"listen_only": True, "interface": "slcan"}, "the nodes have to be asked"),
        ({"sync": 0x80}, "sync: unknown key; did you mean 'sync_id'"),
    ],
)
def test_options_that_do_not_fit_are_refused(more, message):
    with pytest.raises(ConfigurationError, match=message):
        reader("nowhere", **more)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"object": 0x6041}, r"nodes\.j2\.object: 0x6041 is no position"),
        ({"node_id": 1}, r"nodes\.j2: object 0x6004 of node 1 is j1 already"),
        ({"node_id": 128}, r"nodes\.j2\.node_id"),
        ({"counts_per_turn": 0}, r"nodes\.j2\.counts_per_turn"),
        ({"sign": 0}, r"nodes\.j2\.sign"),
    ],
)
def test_nodes_that_do_not_fit_are_refused(more, message):
    options = can_site.node_options("nowhere")
    options["nodes"]["j2"] |= more
    with pytest.raises(ConfigurationError, match=message):
        can_site.node_reader(options)
