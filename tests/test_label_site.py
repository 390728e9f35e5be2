"""Labelling over HTTP: open, draw, carry to the other views, finish; and a kill at any time."""

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.label.command import LabelOptions, label
from calibration.label.session import LabelSession
from calibration.label.shapes import outlines
from calibration.label.site import page
from calibration.label.state import ViewState, state_path
from drivers.recordings import Recording, RecordingWriter
from drivers.sensor_package import SensorPackage
from drivers.sim import truth
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld
from surfclass.errors import InputError

SCALE = 0.25
VIEWS = {"whole": ("map", 13), "front": ("map", 0), "left": ("test", 1), "lamp": ("light", 2)}
PLATE = "disc_radius_m = 0.03\npositions_base_m = [[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]\n"
BOARD = "columns = 9\nrows = 6\nsquare_m = 0.025\n"
SQUARE = {"label": 2, "points": [[10, 10], [60, 10], [60, 50], [10, 50.5]]}


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A recording of the simulated cell, and the true labels of its views."""
    path = tmp_path_factory.mktemp("label") / "cell.mcap"
    world = SimWorld("cell", seed=1, scale=SCALE)
    devices = SimColourCamera(world), SimDepthCamera(world), SimLight(world), SimArm(world)
    labels = {}
    with (
        SensorPackage(world.clock, *devices) as package,
        RecordingWriter(
            path,
            truth.rig(world),
            truth.classes_toml(),
            {"robot": "r"},
            plate_text=PLATE,
            board_text=BOARD,
            unix_offset_ns=5,
        ) as writer,
    ):
        for name, (role, index) in VIEWS.items():
            world.place(world.viewpoints[index].q)
            capture = package.capture(name, role)
            labels[name] = truth.label_image(world, capture.joints.q)
            writer.write(replace(capture, label=labels[name]) if role == "test" else capture)
    return path, labels


class Page:
    """Asks what the page asks."""

    def __init__(self, url):
        host, port = re.fullmatch(r"http://(.+):(\d+)/", url).groups()
        self._address = host, int(port)
        self.token = re.search(r'TOKEN = "([^"]+)"', self.get("/").decode())[1]

    def get(self, path, status=200):
        return self._ask(status, "GET", path)

    def post(self, path, value, status=200):
        return json.loads(self._ask(status, "POST", path, json.dumps(value), {"X-Token": self.token}))

    def _ask(self, status, *request):
        connection = http.client.HTTPConnection(*self._address, timeout=30)
        try:
            connection.request(*request)
            answer = connection.getresponse()
            body = answer.read()
            assert answer.status == status, body[:300]
            return body
        finally:
            connection.close()

    def session(self):
        return json.loads(self.get("/session"))

    def draw(self, index, *shapes, status=200, **values):
        view = self.session()["views"][index]
        kept = {key: view[key] for key in ("role", "below", "revision")}
        return self.post(f"/draw?view={index}", {**kept, "shapes": shapes, **values}, status)


@contextmanager
def labelling(recording, out, **options):
    """Serves the page in a thread; yields the page and a list that gets the result at the end."""
    told, stop, results = [], threading.Event(), []
    ready = threading.Event()

    def note(sentence):
        told.append(sentence)
        ready.set()

    def run():
        results.append(label(recording, out, LabelOptions(**options), note, stop=stop))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ready.wait(30)
        yield Page(told[0].rpartition(" ")[2]), results
    finally:
        stop.set()
        thread.join(30)


def test_draw_carry_and_finish_write_a_labelled_recording(cell, tmp_path):
    path, labels = cell
    out = tmp_path / "labelled.mcap"
    before = path.read_bytes()
    with labelling(path, out) as (page, results):
        views = page.session()["views"]
        assert [view["name"] for view in views] == ["whole", "front", "left"]
        drawn = [shape.model_dump(mode="json") for shape in outlines(labels["whole"])]
        page.draw(0, *drawn, role="train")
        suggested = page.post("/suggest", {"view": 1, "sources": [0]})["shapes"]
        page.draw(1, *suggested, role="test")
        assert page.post("/finish", {}) == {"out": str(out), "labelled": 3}
    assert results == [3]
    assert path.read_bytes() == before
    source, result = Recording.open(path), Recording.open(out)
    assert (result.rig_text, result.classes_text) == (source.rig_text, source.classes_text)
    assert (result.plate_text, result.board_text) == (PLATE, BOARD)
    assert (result.metadata, result.unix_offset_ns) == ({"robot": "r"}, 5)
    captures = {capture.name: capture for capture in result.captures()}
    assert [(name, one.role) for name, one in captures.items()] == [
        ("whole", "train"), ("front", "test"), ("left", "test"), ("lamp", "light"),
    ]  # fmt: skip
    assert np.array_equal(captures["whole"].label, labels["whole"])
    assert np.array_equal(captures["left"].label, labels["left"])
    assert captures["lamp"].label is None
    says = captures["front"].label > 0
    assert says.sum() > 0.6 * (labels["front"] > 0).sum()
    assert (captures["front"].label == labels["front"])[says].mean() > 0.97
    for one, other in zip(source.captures(), result.captures(), strict=True):
        assert np.array_equal(one.colour.rgb, other.colour.rgb)
        assert np.array_equal(one.depth.depth_mm, other.depth.depth_mm)
        assert np.array_equal(one.joints.q, other.joints.q)
        assert (one.t_ns, one.light_level) == (other.t_ns, other.light_level)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [out.name, state_path(out).name]


def test_what_is_drawn_is_there_again_at_the_next_start(cell, tmp_path):
    path, _ = cell
    out = tmp_path / "labelled.mcap"
    with labelling(path, out) as (page, results):
        page.draw(1, SQUARE, role="train")
        page.draw(2, below=False)
    assert results == [0]
    assert not out.exists()
    with labelling(path, out) as (page, _):
        views = page.session()["views"]
        assert views[1]["shapes"] == [SQUARE]
        assert (views[1]["role"], views[1]["revision"]) == ("train", 1)
        assert views[2]["below"] is False
        page.draw(1)
        assert page.session()["views"][1]["shapes"] == []


def test_a_kill_loses_nothing_that_was_answered_for(cell, tmp_path):
    path, _ = cell
    out = tmp_path / "labelled.mcap"
    code = (
        "import sys\nfrom pathlib import Path\nfrom calibration.label.command import *\n"
        "label(Path(sys.argv[1]), Path(sys.argv[2]), LabelOptions(), lambda s: print(s, flush=True))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, path, out], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            page = Page(process.stdout.readline().split()[-1])
            with pytest.raises(InputError, match="another surfclass label"):
                label(path, tmp_path / "other.mcap", LabelOptions(), print)
            for count in range(1, 4):
                page.draw(0, *[SQUARE] * count)
        finally:
            os.kill(process.pid, signal.SIGKILL)
    (tmp_path / f".{out.name}.part.active").write_bytes(b"a finish that was killed")
    session = LabelSession(path, out)
    assert len(session.state_of(0).shapes) == 3
    assert session.finish() == 2
    assert len(Recording.open(out)) == 4


def test_the_pictures_are_those_of_the_captures(cell, tmp_path):
    path, labels = cell
    with labelling(path, tmp_path / "out.mcap") as (page, _):
        colours = page.session()["classes"]
        colour = cv2.imdecode(np.frombuffer(page.get("/colour?view=1"), np.uint8), cv2.IMREAD_COLOR)[
            ..., ::-1
        ]
        below = cv2.imdecode(np.frombuffer(page.get("/below?view=2"), np.uint8), cv2.IMREAD_UNCHANGED)
        thumbnail = cv2.imdecode(np.frombuffer(page.get("/thumbnail?view=0"), np.uint8), cv2.IMREAD_COLOR)
    front = next(one for one in Recording.open(path).captures("map") if one.name == "front")
    assert np.abs(colour.astype(int) - front.colour.rgb).mean() < 4
    assert thumbnail.shape == (120, 160, 3)
    assert np.array_equal(below[..., 3] > 0, labels["left"] > 0)
    place = tuple(np.argwhere(labels["left"] == 4)[0])
    assert "#" + bytes(below[place][[2, 1, 0]]).hex() == colours[3]["colour"]


def test_two_windows_do_not_overwrite_each_other(cell, tmp_path):
    with labelling(cell[0], tmp_path / "out.mcap") as (page, _):
        page.draw(0, SQUARE)
        assert "another window" in page.draw(0, status=409, revision=0)["error"]
        assert page.session()["views"][0]["shapes"] == [SQUARE]


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        ("/draw?view=3", {}, "there are 3"),
        ("/draw?view=-1", {}, "its number"),
        ("/draw", {}, "its number"),
        ("/draw?view=0", [], "JSON object"),
        ("/draw?view=0", {"shape": []}, "did you mean 'shapes'"),
        ("/draw?view=0", {"role": "map"}, "role"),
        ("/draw?view=0", {"shapes": [{**SQUARE, "label": 6}]}, "label 6, allowed are 0 to 5"),
        ("/draw?view=0", {"shapes": [{**SQUARE, "points": [[0, 0], [1, 1]]}]}, "at least 3"),
        ("/suggest", {"view": 0}, "sources: missing"),
        ("/suggest", {"view": 0, "sources": []}, "sources"),
        ("/suggest", {"view": 0, "sources": [0]}, "itself"),
        ("/suggest", {"view": 0, "sources": [9]}, "there are 3"),
        ("/suggest", {"view": "0", "sources": [1]}, "view"),
    ],
)
def test_a_request_that_makes_no_sense_changes_nothing(cell, tmp_path, path, value, fault):
    session = LabelSession(cell[0], tmp_path / "out.mcap")
    with labelling(cell[0], tmp_path / "out.mcap") as (page, _):
        assert fault in page.post(path, value, 400)["error"]
    assert not state_path(session.out).exists()


def test_a_capture_for_training_without_labels_is_named_and_nothing_is_written(cell, tmp_path):
    out = tmp_path / "out.mcap"
    with labelling(cell[0], out) as (page, _):
        page.draw(1, role="train")
        assert page.post("/finish", {}, 400)["error"].endswith("without labels: front")
        assert not out.exists()
        page.draw(1, SQUARE)
        assert page.post("/finish", {})["labelled"] == 2


def test_a_full_disk_is_told_on_the_page_and_what_was_saved_stays(cell, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    out = tmp_path / "out.mcap"
    with labelling(cell[0], out) as (page, _):
        page.draw(0, SQUARE)
        before = state_path(out).read_bytes()
        monkeypatch.setattr("calibration.label.session.save_state", full)
        assert "No space left" in page.draw(0, SQUARE, SQUARE, status=507)["error"]
        monkeypatch.setattr("calibration.label.session.RecordingWriter", full)
        assert "No space left" in page.post("/finish", {}, 507)["error"]
        assert len(page.session()["views"][0]["shapes"]) == 1
    assert state_path(out).read_bytes() == before
    assert not out.exists()


def test_a_suggestion_keeps_what_was_recorded_and_is_nothing_where_nobody_says_anything(cell, tmp_path):
    session = LabelSession(cell[0], tmp_path / "out.mcap")
    assert session.suggest(2, [0, 1]) == ()
    everything = tuple(replace_label(shape, 1) for shape in outlines(np.ones((240, 320), np.uint8)))
    session.draw(0, ViewState(shapes=everything))
    session.draw(2, ViewState(shapes=session.suggest(2, [0]), revision=0))
    known = cell[1]["left"] > 0
    assert (session.label_of(2) == cell[1]["left"])[known].mean() > 0.98


def replace_label(shape, value):
    return shape.model_copy(update={"label": value})


@pytest.mark.parametrize("lack", ["rgb_T_depth", "flange_T_depth"])
def test_without_calibration_one_can_label_and_is_told_why_not_carry(cell, tmp_path, lack):
    source = Recording.open(cell[0])
    path = tmp_path / "bare.mcap"
    rig = re.sub(rf"^{lack} = .*\n", "", source.rig_text, flags=re.MULTILINE)
    with RecordingWriter(path, rig, source.classes_text) as writer:
        for capture in source.captures():
            writer.write(capture)
    session = LabelSession(path, tmp_path / "out.mcap")
    expected = {"rgb_T_depth": "rgb_T_depth", "flange_T_depth": "hand-eye"}[lack]
    assert expected in session.cannot_propagate
    with pytest.raises(InputError, match=expected):
        session.suggest(0, [1])
    session.draw(0, ViewState(shapes=outlines(np.ones((240, 320), np.uint8))))
    assert session.finish() == 2
    known = LabelSession(path, tmp_path / "other.mcap", rig=source.depth_rig)
    assert known.cannot_propagate == ""


def test_classes_may_be_added_and_not_renamed(cell, tmp_path):
    more, other = tmp_path / "more.toml", tmp_path / "other.toml"
    text = truth.classes_toml()
    more.write_text(
        text.replace('"cardboard"', '"cardboard", "moss"').replace(
            "]\ncolours = [", ']\ncolours = ["#00ff00", '
        )
    )
    other.write_text(text.replace("rusted", "rosted"))
    session = LabelSession(cell[0], tmp_path / "out.mcap", more)
    session.draw(0, ViewState(shapes=(replace_label(outlines(np.ones((240, 320), np.uint8))[0], 6),)))
    session.finish()
    assert Recording.open(tmp_path / "out.mcap").classes.names[5] == "moss"
    with pytest.raises(InputError, match="rusted, blasted"):
        LabelSession(cell[0], tmp_path / "out2.mcap", other)


def test_what_cannot_be_labelled_is_said_at_once(cell, tmp_path):
    source = Recording.open(cell[0])
    path = tmp_path / "lamp.mcap"
    with RecordingWriter(path, source.rig_text, None) as writer:
        for capture in source.captures("light"):
            writer.write(capture)
    with pytest.raises(InputError, match="--classes"):
        LabelSession(path, tmp_path / "out.mcap")
    classes = tmp_path / "classes.toml"
    classes.write_text(truth.classes_toml())
    with pytest.raises(InputError, match="no capture with colour"):
        LabelSession(path, tmp_path / "out.mcap", classes)
    with pytest.raises(InputError, match="the recording itself"):
        LabelSession(cell[0], cell[0])
    with pytest.raises(InputError, match="no directory"):
        LabelSession(cell[0], tmp_path / "none" / "out.mcap")
    with pytest.raises(InputError, match="cannot be read"):
        label(tmp_path / "none.mcap", tmp_path / "out.mcap", LabelOptions(), print)


def test_a_deep_image_is_shown_bright_enough_to_see(cell, tmp_path):
    source = Recording.open(cell[0])
    path = tmp_path / "deep.mcap"
    with RecordingWriter(path, source.rig_text, source.classes_text) as writer:
        for capture in source.captures("map"):
            linear = (capture.colour.rgb.astype(np.float64) / 255) ** 2.2 * 20_000
            writer.write(replace(capture, colour=replace(capture.colour, rgb=linear.astype(np.uint16))))
    jpeg = LabelSession(path, tmp_path / "out.mcap").view(0).jpeg
    assert np.percentile(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE), 99) > 180


def test_the_page_keeps_to_its_own_policy_and_finds_its_own_elements():
    html = page()
    assert html.count("{{nonce}}") == html.count("<script") + html.count("<style")
    assert not re.search(r"\bon[a-z]+=|\bstyle=|https?://|@import|url\(", html)
    assert "innerHTML" not in html
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'\$\("([^"]+)"\)', html)) <= set(ids)
    actions = set(
        re.findall(
            r'(?:^|, )"?([a-z-]+)"?(?:: \(\)|,|:)', html.split("const ACTIONS = {")[1].split("};")[0], re.M
        )
    )
    assert actions <= set(ids)
