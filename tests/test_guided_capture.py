"""The guided capture: which views it takes, which it keeps, and what is left whatever ends it."""

import numpy as np
import pytest
from guided_site import SETTINGS, CountingGuide, Person, site

from calibration.live.loop import CaptureAbortedError, GuidedSettings, guided, guided_all
from drivers.errors import CaptureRejectedError, DeviceLostError, DeviceTimeoutError
from drivers.recordings import Recording
from drivers.sensor_package import SensorSettings
from drivers.sim.faults import Fault, Faults
from surfclass.errors import ConfigurationError, InputError


def run(at, guide, person=None, settings=SETTINGS, **more):
    return guided(at.package, guide, at.writer, settings, person or Person(), at.world.clock, **more)


@pytest.mark.parametrize(
    ("scene", "role"),
    [
        ("checkerboard", "board"),
        ("reflector_discs", "hand_eye"),
        ("grey_card", "response"),
        ("highlight_board", "light"),
        ("limits:timber", "test"),
    ],
)
def test_a_simulated_arm_shows_every_viewpoint_and_nobody_has_to_say_anything(tmp_path, scene, role):
    with site(tmp_path, scene) as at:
        places = at.world.viewpoints
        guide = CountingGuide(role, needed=len(places))
        assert run(at, guide) == len(places)
        captures = at.captures
        assert [capture.name for capture in captures] == [f"{role}_{n + 1:04d}" for n in range(len(places))]
        assert {capture.role for capture in captures} == {role}
        for capture, place in zip(captures, places, strict=True):
            assert np.abs(capture.joints.q - place.q).max() < 1e-3
            assert capture.depth.ir is not None
    assert at.left == ["live.mcap"]


def test_what_the_guide_refuses_is_shown_with_the_reason_and_not_written(tmp_path):
    person = Person()
    with site(tmp_path) as at:
        guide = CountingGuide(needed=3, refuse=(2, 3))
        assert run(at, guide, person) == 3
    captures = at.captures
    q = [at.world.viewpoints[n].q for n in (0, 3, 4)]
    assert [np.abs(one.joints.q - there).max() < 1e-3 for one, there in zip(captures, q, strict=True)]
    assert [one.verdict for one in person.last.judged] == [
        "accepted", "refused", "refused", "accepted", "accepted",
    ]  # fmt: skip
    assert person.last.judged[1].reasons == ("view 2 shows nothing",)
    assert [one.name for one in person.last.judged] == ["board_0001", "", "", "board_0002", "board_0003"]
    assert person.last.doing == "done"


def test_the_person_sees_each_step_its_picture_and_what_is_covered(tmp_path):
    person = Person()
    with site(tmp_path) as at:
        run(at, CountingGuide(needed=2, refuse=(1,)), person)
    waiting = [shown for shown in person.shown if shown.doing == "waiting"]
    assert [shown.next_step for shown in waiting] == ["show view 1", "show view 1", "show view 2"]
    assert [(shown.taken, shown.needed) for shown in waiting] == [(0, 2), (0, 2), (1, 2)]
    assert [None if one.picture is None else int(one.picture[0, 0, 0]) for one in waiting] == [None, 1, 2]
    assert [shown.coverage["image"] for shown in waiting] == [[[0, 0]], [[0, 0]], [[1, 0]]]


def test_views_are_taken_on_request_where_the_arm_stands(tmp_path):
    person = Person(None, "capture", None, "capture")
    settings = GuidedSettings(by_rest=False, idle_s=20.0)
    with site(tmp_path, viewpoints=1) as at:
        assert run(at, CountingGuide(needed=2), person, settings) == 2
        assert len(at.captures) == 2


def test_done_keeps_what_there_is_and_says_what_is_still_thin(tmp_path):
    person = Person("capture", "done")
    with site(tmp_path) as at:
        assert run(at, CountingGuide(needed=5), person) == 1
    assert len(at.captures) == 1
    assert person.last.doing == "ended"
    assert "1 of 5 views" in person.last.notice
    assert "views 20%" in person.last.notice
    assert "image: 1 of 2 cells empty" in person.last.notice
    assert "show view 2" in person.last.notice


def test_an_arm_that_shows_nothing_new_ends_it_as_if_that_were_enough(tmp_path):
    person = Person()
    with site(tmp_path, viewpoints=2) as at:
        assert run(at, CountingGuide(needed=5), person) == 2
        assert at.world.seconds(at.world.clock.now_ns()) < 60
    assert "nothing new for 20 s" in person.last.notice


@pytest.mark.parametrize("says", ["done", None])
def test_without_one_view_of_use_there_is_no_recording(tmp_path, says):
    with site(tmp_path, viewpoints=1) as at, pytest.raises(InputError, match="no view was accepted"):
        run(at, CountingGuide(refuse=(1,)), Person("capture", says))
    assert at.left == []


def stops(how):
    """What ends a capture after its first view, and how."""
    if how == "a key":
        raise KeyboardInterrupt
    return "abort"


@pytest.mark.parametrize(("how", "error"), [("a key", KeyboardInterrupt), ("a button", CaptureAbortedError)])
@pytest.mark.parametrize("keep", [False, True])
def test_an_abort_leaves_nothing_unless_what_was_accepted_is_wanted(tmp_path, how, error, keep):
    settings = GuidedSettings(idle_s=20.0, keep_aborted=keep)
    with site(tmp_path) as at, pytest.raises(error):
        run(at, CountingGuide(), Person("capture", lambda: stops(how)), settings)
    assert at.left == (["live.mcap"] if keep else [])
    if keep:
        assert len(at.captures) == 1


def test_a_signal_aborts_and_is_named(tmp_path):
    signals = iter([None, "SIGTERM"])
    with site(tmp_path) as at, pytest.raises(CaptureAbortedError, match="SIGTERM"):
        run(at, CountingGuide(), Person("capture"), stopped=lambda: next(signals))
    assert at.left == []


def test_an_old_recording_stays_whole_whatever_ends_the_new_one(tmp_path):
    with site(tmp_path) as first:
        run(first, CountingGuide(needed=1))
    before = first.writer.path.read_bytes()
    with site(tmp_path) as at, pytest.raises(CaptureAbortedError):
        run(at, CountingGuide(), Person("capture", "abort"))
    assert first.writer.path.read_bytes() == before


def test_a_lost_device_ends_it_and_what_was_accepted_can_be_used(tmp_path):
    faults = Faults((Fault("depth", "absent", from_s=3.0),))
    with site(tmp_path, faults=faults) as at, pytest.raises(DeviceLostError, match="depth"):
        run(at, CountingGuide(needed=9))
    assert at.left == ["live.mcap"]
    assert 1 <= len(Recording.open(at.writer.path)) < 9


def test_a_device_that_is_silent_once_is_asked_once_more(tmp_path):
    person = Person()
    faults = Faults((Fault("colour", "silent", from_s=0.0, to_s=2.0),))
    with site(tmp_path, viewpoints=3, faults=faults) as at:
        assert run(at, CountingGuide(needed=3), person) == 3
    assert any("trying once more" in shown.notice for shown in person.shown)


def test_a_device_that_stays_silent_ends_it(tmp_path):
    faults = Faults((Fault("colour", "silent", from_s=0.0),))
    with site(tmp_path, faults=faults) as at, pytest.raises(DeviceTimeoutError, match="colour"):
        run(at, CountingGuide())
    assert at.left == []


def test_a_capture_that_the_arm_moved_in_is_counted_and_taken_again(tmp_path):
    person = Person("capture")
    with site(tmp_path, viewpoints=1) as at:
        at.world.move_to(at.world.viewpoints[1].q)
        assert run(at, CountingGuide(needed=1), person) == 1
    assert [one.verdict for one in person.last.judged] == ["rejected", "accepted"]
    assert "moved" in person.last.judged[0].reasons[0]
    assert np.abs(at.captures[0].joints.q - at.world.viewpoints[1].q).max() < 1e-3


def test_too_many_rejections_in_a_row_end_it(tmp_path):
    person = Person()
    strict = SensorSettings(max_skew_s=1e-6)
    settings = GuidedSettings(rejected=3)
    with site(tmp_path, settings=strict) as at, pytest.raises(CaptureRejectedError, match="apart"):
        run(at, CountingGuide(), person, settings)
    assert person.last.count("rejected") == 3
    assert at.left == []


def test_captures_become_what_is_asked_before_they_are_written(tmp_path):
    def turned_down(capture):
        raise InputError(f"{capture.name} is not wanted")

    with site(tmp_path) as at, pytest.raises(InputError, match="board_0001 is not wanted"):
        run(at, CountingGuide(), finish=turned_down)
    assert at.left == []


class TestSeveralTargets:
    def both(self, at, person, guides):
        alike = [(guide, lambda capture: capture) for guide in guides]
        return guided_all(at.package, alike, at.writer, SETTINGS, person, at.world.clock)

    def test_the_second_waits_until_the_person_says_that_it_is_there(self, tmp_path):
        guides = [CountingGuide("train", needed=2), CountingGuide("train", needed=1)]
        asked = []

        def capture():
            asked.append(guides[1].seen)
            return "capture"

        with site(tmp_path) as at:
            assert self.both(at, Person(*[None] * 120, capture), guides) == 3
        assert asked == [0]
        assert [one.name for one in at.captures] == ["train_0001", "train_0002", "train_0003"]

    def test_nobody_who_says_it_leaves_the_first(self, tmp_path):
        guides = [CountingGuide("train", needed=2), CountingGuide("train", needed=1)]
        with site(tmp_path) as at:
            assert self.both(at, Person(), guides) == 2
        assert guides[1].seen == 0


@pytest.mark.parametrize("field", ["rest_s", "moved_rad", "idle_s", "poll_s", "rejected", "exposures"])
@pytest.mark.parametrize("value", [0, -1.0, float("inf"), float("nan")])
def test_settings_that_cannot_be_are_refused(field, value):
    with pytest.raises(ConfigurationError, match=field):
        GuidedSettings(**{field: value})
