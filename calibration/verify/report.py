"""The one-page report: a step's verdict, its table, its pictures and where everything comes from, as HTML."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

from calibration.outcome import Figures, Outcome, Verdict

_WORDS = {"pass": "Passed", "fail": "Failed", "refused": "Refused"}
_MOST_INPUTS = 12


@dataclass(frozen=True, slots=True)
class About:
    """What a report says beside the result.

    Attributes:
        written: When, as people read it.
        robot: Which robot.
        rig: Name of its sensor package.
        source: Where the captures come from.
        versions: Of the software and of what it depends on, by name.
        inputs: sha256 by file name.
        calibrations: The results in use by kind, such as {"light": "number 3, 2026-05-04, passed"}.
    """

    written: str
    robot: str
    rig: str
    source: str
    versions: Mapping[str, str]
    inputs: Mapping[str, str]
    calibrations: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Report:
    """All that the page shows.

    Attributes:
        title: Its heading.
        about: Beside the result.
        verdict: Of the whole.
        sentence: The figures that decide.
        reasons: Why it did not pass, a sentence each.
        figures: Tables; the first decides and stands on top, the others follow the pictures.
        pictures: PNG by caption.
    """

    title: str
    about: About
    verdict: Verdict
    sentence: str
    reasons: Sequence[str]
    figures: Sequence[Figures]
    pictures: Mapping[str, bytes]


def report_of(outcome: Outcome, about: About, title: str = "Verification of the sensor package") -> Report:
    """Returns the report of a step's outcome; draws its pictures."""
    with tempfile.TemporaryDirectory() as folder:
        pictures = {}
        for name, draw in outcome.pictures.items():
            path = Path(folder) / f"{name}.png"
            draw(path)
            pictures[name.replace("-", " ").removeprefix("verify ")] = path.read_bytes()
    return Report(title, about, outcome.verdict, outcome.sentence, outcome.reasons, outcome.figures, pictures)


def html(report: Report) -> str:
    """Returns a report as one HTML page without anything outside of it; it prints on A4.

    Whatever a file said (names of captures, of rigs, of classes) appears as text and never as markup.
    """
    first, others = report.figures[:1], report.figures[1:]
    body = [
        f"<h1>{escape(report.title)}</h1>",
        _about(report.about),
        f'<p class="verdict {report.verdict}"><b>{_WORDS[report.verdict]}.</b> {escape(report.sentence)}</p>',
        _list(report.reasons),
        *(_table(one, judged=True) for one in first),
        _pictures(report.pictures),
        f'<div class="details">{"".join(_table(one) for one in others)}</div>' if others else "",
        _provenance(report.about),
    ]
    style = files("calibration.verify").joinpath("report.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width">\n'
        f"<title>{escape(report.title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in body if part)
        + "\n</body>\n</html>\n"
    )


def _about(about: About) -> str:
    told = {"robot": about.robot, "rig": about.rig, "date": about.written, "captures": about.source}
    return "<dl>" + "".join(f"<div>{_pair(key, value)}</div>" for key, value in told.items()) + "</dl>"


def _pair(key: str, value: str) -> str:
    return f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>"


def _list(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return "<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences) + "</ul>"


def _table(figures: Figures, judged: bool = False) -> str:
    """Returns a table; one that is judged has the verdict in its last column, which shows as a colour too."""
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in figures.columns)
    rows = []
    for row in figures.rows:
        mark = f' class="{escape(row[-1].replace(" ", "-"))}"' if judged else ""
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row[1:])
        rows.append(f'<tr{mark}><th scope="row">{escape(row[0])}</th>{cells}</tr>')
    kind = ' class="judged"' if judged else ""
    return (
        f"<table{kind}><caption>{escape(figures.title)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _pictures(pictures: Mapping[str, bytes]) -> str:
    if not pictures:
        return ""
    drawn = [
        f'<figure><img src="data:image/png;base64,{base64.b64encode(data).decode()}" alt="{escape(name)}">'
        f"<figcaption>{escape(name)}</figcaption></figure>"
        for name, data in pictures.items()
    ]
    return f'<div class="pictures">{"".join(drawn)}</div>'


def _provenance(about: About) -> str:
    inputs = dict(list(about.inputs.items())[:_MOST_INPUTS])
    left = len(about.inputs) - len(inputs)
    if left:
        inputs[f"and {left} more files"] = "the result file (--json) lists them"
    groups = {"Calibrations in use": about.calibrations, "Software": about.versions, "Inputs, sha256": inputs}
    blocks = [
        f"<section><h2>{escape(title)}</h2><dl>{_pairs(told)}</dl></section>"
        for title, told in groups.items()
        if told
    ]
    return f"<footer>{''.join(blocks)}</footer>"


def _pairs(told: Mapping[str, str]) -> str:
    return "".join(_pair(*pair) for pair in told.items())
