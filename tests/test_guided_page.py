"""The page of a guided capture: what it is told, when, and what may be said to it."""

import http.client
import json
import shutil
import subprocess
import threading
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from calibration.live.page import PageUi
from calibration.live.ui import Judged, Situation


def situation(**more):
    told = {
        "title": "cameras",
        "doing": "waiting",
        "next_step": "turn it to the left",
        "taken": 1,
        "needed": 14,
        "judged": (Judged(1, "board_0001", "accepted"), Judged(2, "", "refused", ("it is <cut off>",))),
        "coverage": {"image": [[0, 2], [1, 0]], "tilt": 0.25},
        "picture": None,
    }
    return Situation(**{**told, **more})


def asked(page, path, body=None, token=None):
    """The status and the content of an answer."""
    where = urlsplit(page.url)
    connection = http.client.HTTPConnection(where.hostname, where.port, timeout=15)
    headers = {} if token is None else {"X-Token": token}
    method = "GET" if body is None else "POST"
    try:
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def state(page, seen=0):
    status, data = asked(page, f"/state?seen={seen}")
    assert status == 200
    return json.loads(data)


@pytest.fixture
def page():
    with PageUi() as made:
        yield made


def token_of(page):
    _, data = asked(page, "/")
    return data.decode().partition('const TOKEN = "')[2].partition('"')[0]


def test_the_page_tells_what_was_shown_last(page):
    page.show(situation())
    page.show(situation(taken=2, notice="once more"))
    told = state(page)
    assert (told["title"], told["doing"], told["next_step"]) == ("cameras", "waiting", "turn it to the left")
    assert (told["taken"], told["needed"], told["notice"]) == (2, 14, "once more")
    assert told["judged"][1] == {
        "number": 2, "name": "", "verdict": "refused", "reasons": ["it is <cut off>"],
    }  # fmt: skip
    assert told["coverage"] == {"image": [[0, 2], [1, 0]], "tilt": 0.25}
    assert not told["closed"]


def test_it_waits_for_news_and_has_them_at_once(page):
    page.show(situation())
    seen = state(page)["version"]
    threading.Timer(0.3, lambda: page.show(situation(taken=7))).start()
    start = time.monotonic()
    assert state(page, seen)["taken"] == 7
    assert 0.2 < time.monotonic() - start < 5


def test_the_picture_is_a_jpeg_no_wider_than_a_screen_and_changes_its_version(page):
    assert asked(page, "/picture.jpg")[0] == 404
    red = np.zeros((1500, 2000, 3), np.uint8)
    red[..., 0] = 200
    page.show(situation(picture=red))
    first = state(page)["picture"]
    image = cv2.imdecode(np.frombuffer(asked(page, "/picture.jpg")[1], np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (960, 1280, 3)
    assert image[0, 0].tolist() == pytest.approx([0, 0, 200], abs=4)  # blue, green, red
    page.show(situation(picture=red, taken=2))
    assert state(page)["picture"] == first
    page.show(situation(picture=red.copy()))
    assert state(page)["picture"] > first


def test_numbers_that_json_has_not_are_zero(page):
    page.show(situation(coverage={"tilt": float("nan"), "image": [[np.inf, 1.0]], "row": [1, 2]}))
    told = state(page)["coverage"]
    assert told["tilt"] == 0
    assert told["row"] == [[1, 2]]
    assert np.isfinite(told["image"]).all()


def test_what_is_pressed_comes_out_in_order_and_once(page):
    token = token_of(page)
    for said in ("capture", "done"):
        assert asked(page, "/command", json.dumps({"command": said}), token)[0] == 200
    assert [page.command() for _ in range(3)] == ["capture", "done", None]


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ('{"command": "dance"}', "capture"),
        ('{"commands": "done"}', "command"),
        ("[]", "the body must be like"),
        ("{", "not JSON"),
    ],
)
def test_what_is_no_command_is_refused_with_what_is(page, body, says):
    status, data = asked(page, "/command", body, token_of(page))
    assert status == 400
    assert says in json.loads(data)["error"]
    assert page.command() is None


def test_other_pages_cannot_press_anything(page):
    assert asked(page, "/command", '{"command": "abort"}', "guessed")[0] == 403
    assert page.command() is None


def test_commands_that_nobody_takes_do_not_pile_up(page):
    token = token_of(page)
    answers = [asked(page, "/command", '{"command": "capture"}', token)[0] for _ in range(18)]
    assert answers == [200] * 16 + [429] * 2


@pytest.mark.parametrize("seen", ["", "-1", "x", "9" * 30, "1.5"])
def test_a_version_that_is_none_is_refused(page, seen):
    assert asked(page, f"/state?seen={seen}")[0] == 400


def test_closing_tells_who_waits_and_does_not_wait_itself():
    page = PageUi()
    told = []
    with page:
        page.show(situation())
        seen = state(page)["version"]
        waiting = threading.Thread(target=lambda: told.append(state(page, seen)))
        waiting.start()
        time.sleep(0.3)
        start = time.monotonic()
    assert time.monotonic() - start < 2
    waiting.join(5)
    assert told[0]["closed"]
    assert told[0]["taken"] == 1


def test_nothing_of_the_page_is_loaded_from_elsewhere(page):
    text = asked(page, "/")[1].decode()
    assert "http" not in text.replace("http-equiv", "")
    assert "{{" not in text


NODE = shutil.which("node")
STAND_IN = """
const made = {};
class Node {
  constructor(kind) { Object.assign(this, {kind, textContent: "", children: [], style: {}, hidden: false,
    disabled: false, listeners: {}, className: "", attributes: {}}); this.classList = {toggle() {}}; }
  addEventListener(name, call) { this.listeners[name] = call; }
  replaceChildren(...children) { this.children = children; }
  setAttribute(name, value) { this.attributes[name] = value; }
  getContext() { return {fillRect: (x, y) => { (this.cells ??= []).push([x, y]); }}; }
}
globalThis.document = {
  getElementById: (id) => made[id] ??= new Node(id),
  createElement: (kind) => new Node(kind),
  addEventListener: (name, call) => { (made.document ??= new Node("document")).listeners[name] = call; },
};
globalThis.confirm = () => true;
const states = JSON.parse(process.argv[2]), posted = [];
globalThis.fetch = async (path, options) => {
  if (path === "/command") { posted.push([JSON.parse(options.body).command, options.headers["X-Token"]]); }
  if (path === "/command") return {ok: true, json: async () => ({})};
  const told = states.shift();
  return {ok: true, json: async () => told};
};
"""
REPORT = """
setTimeout(() => {
  made.capture.listeners.click(); made.abort.listeners.click();
  const text = (id) => made[id].textContent;
  console.log(JSON.stringify({step: text("step"), count: text("count"), title: text("title"),
    notice: text("notice"), bar: made.done.style.width, picture: made.picture.src ?? null,
    judged: made.judged.children.map((one) => [one.textContent, one.className]),
    coverage: made.coverage.children.map((one) => one.children.map((part) => [part.kind, part.textContent,
      part.value ?? null, part.cells?.length ?? 0])),
    last: [text("last"), made.last.className], disabled: made.capture.disabled, posted}));
  process.exit(0);
}, 100);
"""


@pytest.mark.skipif(NODE is None, reason="needs node to run the page's script")
def test_the_script_puts_everything_where_it_belongs(page, tmp_path):
    page.show(situation(picture=np.zeros((4, 4, 3), np.uint8), notice="thin at the left"))
    told = state(page)
    text = asked(page, "/")[1].decode()
    script = text.partition("<script")[2].partition(">")[2].partition("</script>")[0]
    (tmp_path / "page.js").write_text(STAND_IN + script + REPORT)
    states = json.dumps([told, {**told, "closed": True}])
    done = subprocess.run(
        [NODE, tmp_path / "page.js", states], capture_output=True, text=True, timeout=30, check=True
    )
    seen = json.loads(done.stdout)
    assert (seen["title"], seen["count"], seen["step"]) == ("cameras", "1 of 14", "turn it to the left")
    assert seen["bar"].startswith("7.14")
    assert seen["picture"] == f"/picture.jpg?version={told['picture']}"
    assert seen["judged"] == [["2 refused: it is <cut off>", "refused"], ["1 taken board_0001", "accepted"]]
    image, tilt = seen["coverage"]
    assert image == [["h2", "image", None, 0], ["canvas", "", None, 4]]
    assert tilt == [["h2", "tilt 25 %", None, 0], ["meter", "", 0.25, 0]]
    assert seen["last"] == ["2 refused: it is <cut off>", "refused"]
    assert seen["disabled"]
    assert [command for command, _ in seen["posted"]] == ["capture", "abort"]
    assert {token for _, token in seen["posted"]} == {token_of(page)}
