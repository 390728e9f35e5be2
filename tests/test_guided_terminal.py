"""The guided capture on a terminal: the same as on the page, in lines; and what is typed at it."""

import io
import os

import pytest
from guided_site import SETTINGS, CountingGuide, site
from rich.console import Console

from calibration.live.loop import guided
from calibration.live.terminal import TerminalUi, shaded, terminal_ui
from calibration.live.ui import Judged, Several, Situation, thin


def situation(**more):
    told = {
        "title": "hand-eye",
        "doing": "waiting",
        "next_step": "roll it [30°]",
        "taken": 1,
        "needed": 14,
        "judged": (Judged(1, "hand_eye_0001", "accepted"),),
        "coverage": {"rolled": 0.5, "image": [[0, 4], [1, 0]]},
        "picture": None,
    }
    return Situation(**{**told, **more})


@pytest.fixture
def printed():
    return io.StringIO()


@pytest.fixture
def typed():
    """A line that is typed at, and what reads it."""
    ours, theirs = os.pipe()
    with os.fdopen(ours) as reading, os.fdopen(theirs, "w") as writing:
        yield writing, reading


def ui(printed, typed=None):
    return TerminalUi(Console(file=printed, width=100, force_terminal=False), typed)


def type_in(writing, text):
    writing.write(text)
    writing.flush()


def test_a_log_gets_a_line_for_each_thing_and_none_twice(printed):
    with ui(printed) as terminal:
        terminal.show(situation())
        terminal.show(situation())
        refused = Judged(2, "", "refused", ("it is cut off", "go back"))
        terminal.show(situation(judged=(situation().judged[0], refused), notice="thin at the left"))
    assert printed.getvalue().splitlines() == [
        "hand-eye",
        "  1 taken hand_eye_0001 (1/14)",
        "  still thin: rolled 50%",
        "  next: roll it [30°]",
        "  2 refused: it is cut off; go back",
        "  thin at the left",
    ]


def test_what_of_the_image_is_covered_is_drawn_at_the_end(printed):
    with ui(printed) as terminal:
        terminal.show(situation(doing="ended", next_step=""))
    assert printed.getvalue().splitlines()[-2:] == ["  image |  ██|", "        |░░  |"]


def test_a_whole_capture_can_be_followed_in_a_log(printed, tmp_path):
    with site(tmp_path) as at, ui(printed) as terminal:
        guided(at.package, CountingGuide(refuse=(2,)), at.writer, SETTINGS, terminal, at.world.clock)
    text = printed.getvalue()
    for line in ("next: show view 1", "1 taken board_0001 (1/3)", "2 refused: view 2 shows nothing"):
        assert line in text
    assert text.rstrip().splitlines()[-3:] == [
        "  4 taken board_0003 (3/3)", "  all is covered", "  image |██  |",
    ]  # fmt: skip


def test_a_terminal_is_told_how_to_answer_and_a_log_is_not(printed, typed):
    with ui(printed, typed[1]) as terminal:
        terminal.show(situation())
    assert "Enter takes a view now" in printed.getvalue()


@pytest.mark.parametrize(
    ("text", "says"), [("", "capture"), ("c", "capture"), (" D ", "done"), ("done", "done"), ("q", "abort")]
)
def test_lines_are_commands(printed, typed, text, says):
    writing, reading = typed
    terminal = ui(printed, reading)
    assert terminal.command() is None
    type_in(writing, f"{text}\n")
    assert terminal.command() == says
    assert terminal.command() is None


def test_half_a_line_waits_for_its_end_and_two_come_one_by_one(printed, typed):
    writing, reading = typed
    terminal = ui(printed, reading)
    type_in(writing, "d")
    assert terminal.command() is None
    type_in(writing, "one\n\n")
    assert [terminal.command() for _ in range(3)] == ["done", "capture", None]


def test_what_is_no_command_is_answered_with_what_is(printed, typed):
    writing, reading = typed
    terminal = ui(printed, reading)
    type_in(writing, "help\n")
    assert terminal.command() is None
    assert "q and Enter aborts" in printed.getvalue()


def test_the_end_of_what_is_typed_ends_no_capture(printed, typed):
    writing, reading = typed
    terminal = ui(printed, reading)
    writing.close()
    assert [terminal.command() for _ in range(3)] == [None] * 3


def test_nobody_is_listened_to_where_standard_input_is_no_terminal(printed, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("q\n"))
    assert terminal_ui(Console(file=printed), interactive=True).command() is None


def test_another_target_starts_its_own_list(printed):
    with ui(printed) as terminal:
        terminal.show(situation())
        terminal.show(situation(judged=(), taken=0))
        terminal.show(situation(judged=(Judged(1, "hand_eye_0002", "accepted"),)))
    assert "hand_eye_0002" in printed.getvalue()


def test_a_grid_of_counts_is_darker_where_there_is_more():
    assert shaded([[0, 1], [2, 8]]) == ["  ░░", "░░██"]
    assert shaded([[0, 0]]) == ["    "]


def test_what_is_thin_is_every_share_below_one_and_every_grid_with_holes():
    assert thin({"a": 1.0, "b": 0.3, "c": [[1, 0]], "d": [[1]], "e": []}) == (
        "b 30%",
        "c: 1 of 2 cells empty",
    )


def test_the_page_and_the_terminal_are_one_ui():
    class Said:
        def __init__(self, *says):
            self.says, self.shown = list(says), []

        def show(self, one):
            self.shown.append(one)

        def command(self):
            return self.says.pop(0) if self.says else None

    first, second = Said(None, "done"), Said("capture")
    both = Several((first, second))
    both.show(situation())
    assert (len(first.shown), len(second.shown)) == (1, 1)
    assert [both.command() for _ in range(3)] == ["capture", "done", None]
