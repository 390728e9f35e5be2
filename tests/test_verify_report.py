"""The verification's verdict, and its one-page report."""

import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.outcome import Figures, Outcome
from calibration.plots import drawing
from calibration.verify.command import VerifyOptions, outcome_of, summary
from calibration.verify.part import Finding, Part
from calibration.verify.report import About, Report, html, report_of
from surfclass.errors import ConfigurationError

ABOUT = About("today", "r", "rig", "a.mcap", {"surfclass": "1"}, {"a.mcap": "ab12"}, {"light": "number 3"})
GOOD = Finding("a_m", "length", 0.0011, 0.002, "mm", 1e3)
BAD = Finding("b", "share right", 0.6, 0.85, "%", 100, at_least=True)


def part(*findings, key="discs", why_not=""):
    return Part(key, f"The {key}", tuple(findings), suspect="look there", not_checked=why_not)


def test_a_figure_is_judged_by_its_limit_and_told_in_its_unit():
    assert (GOOD.kept, GOOD.told, GOOD.allowed) == (True, "1.1 mm", "≤ 2 mm")
    assert (BAD.kept, BAD.told, BAD.allowed) == (False, "60 %", "≥ 85 %")
    assert Finding("c", "any", 9e9, None, "px").kept
    assert not Finding("c", "any", math.nan, 1.0, "px").kept
    assert Finding("c", "any", 1.0, 1.0, "px").kept


def test_one_bad_figure_fails_the_whole_and_is_named_with_what_it_points_at():
    outcome = outcome_of([part(GOOD), part(GOOD, BAD, key="boards")])
    assert outcome.verdict == outcome.result["verdict"] == "fail"
    assert outcome.reasons == ("The boards: share right is 60 %, allowed is ≥ 85 %; look there",)
    assert outcome.result["parts"]["discs"]["verdict"] == "pass"
    assert outcome.result["parts"]["boards"]["b"] == 0.6
    assert outcome.result["parts"]["boards"]["limits"] == {"a_m": 0.002, "b": 0.85}


def test_what_was_not_checked_is_said_and_fails_only_where_it_was_required():
    parts = [part(GOOD), part(key="boards", why_not="no model was given")]
    outcome = outcome_of(parts)
    assert outcome.verdict == "pass"
    assert "The boards not checked" in outcome.sentence
    assert outcome.result["parts"]["boards"]["not_checked"] == "no model was given"
    required = outcome_of(parts, require=("boards",))
    assert required.verdict == "fail"
    assert required.reasons == ("The boards: could not be checked: no model was given",)


def test_the_deciding_table_has_every_figure_its_limit_and_a_verdict():
    rows = summary([part(GOOD, BAD), part(key="boards", why_not="no model")]).rows
    assert [row[1:] for row in rows] == [
        ("1.1 mm", "≤ 2 mm", "pass"),
        ("60 %", "≥ 85 %", "fail"),
        ("–", "–", "not checked"),
    ]
    assert "no model" in rows[2][0]


def test_a_part_that_does_not_exist_cannot_be_required():
    with pytest.raises(ConfigurationError, match="'disks', allowed: cameras, discs"):
        VerifyOptions(require=("disks",))


class Page(HTMLParser):
    """Collects tags and text; fails on what HTML does not allow."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.open, self.text, self.links = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def report(word="x", figures=(), pictures=None):
    about = About(word, word, word, word, {word: word}, {word: word}, {word: word})
    told = (Figures(word, (word, word), [(word, word)]), *figures)
    return Report(
        word, about, "fail", word, [word], told, {word: b"\x89PNG"} if pictures is None else pictures
    )


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"])))
@settings(max_examples=200, deadline=None)
def test_whatever_a_file_says_is_text_and_never_markup(word):
    plain, told = Page(html(report())), Page(html(report(word)))
    assert told.tags == plain.tags
    assert told.links == plain.links
    if word.strip():
        assert sum(word in text for text in told.text) >= 9


@pytest.mark.parametrize(
    "word", ['"><script>alert(1)</script>', "</style><img src=x>", "' onerror='x", "&lt;&amp;"]
)
def test_attacks_by_name_come_out_as_they_were_written(word):
    text = html(report(word))
    assert "<script" not in text
    assert Page(text).tags == Page(html(report())).tags


def test_the_page_needs_nothing_outside_of_it_and_prints():
    text = html(report(pictures={"one": b"\x89PNG\r\n", "two": b"\x89PNG"}))
    links = Page(text).links
    assert links
    assert all(link.startswith("data:image/png;base64,") for link in links)
    assert not re.search(r"https?:|url\(|@import|<link|<script", text)
    assert "size: A4" in text
    assert "prefers-color-scheme: dark" in text
    assert text == html(report(pictures={"one": b"\x89PNG\r\n", "two": b"\x89PNG"}))


def test_many_inputs_do_not_fill_the_page():
    about = About("d", "r", "rig", "folder", {}, {f"file{i}": f"{i:064x}" for i in range(200)}, {})
    text = html(Report("t", about, "pass", "s", [], [], {}))
    assert "file11" in text
    assert "file12" not in text
    assert "and 188 more files" in text


def test_the_verdict_of_each_row_can_be_seen_without_colours_too():
    told = summary([part(GOOD, BAD), part(key="boards", why_not="no model")])
    text = html(Report("t", ABOUT, "fail", "s", [], [told], {}))
    for verdict in ("pass", "fail", "not checked"):
        assert re.search(rf'<tr class="{verdict.replace(" ", "-")}">.*<td>{verdict}</td></tr>', text)
    assert "Failed." in text


def test_an_outcomes_pictures_are_drawn_into_the_page():
    def draw(path):
        with drawing(path, figsize=(1, 1)) as (_, axes):
            axes[0, 0].plot(np.arange(3))

    outcome = Outcome("verify", "pass", (), "fine", {}, pictures={"verify-grey-card": draw})
    made = report_of(outcome, ABOUT)
    assert made.pictures["grey card"].startswith(b"\x89PNG")
    assert "number 3" in html(made)
