"""The real command on files: a simulated cell, a real kitchen and a renderer's pictures, start to end."""

import json

import cv2
import numpy as np
import pytest
from cli_site import (
    CLASSES,
    VIEWS,
    ended,
    endpoint_in,
    rewritten,
    rows_of,
    running,
    state_of,
    surfclass,
)
from mcap.reader import make_reader

from drivers.recordings import Recording, RecordingWriter
from surfclass.map_file import from_npz_bytes

FIGURES = {"overall", "balanced", "ece", "nll", "rejected", "voxels", "confusion"}


@pytest.fixture(scope="module")
def evaluation(commissioned):
    """What `evaluate --json -` says on standard output."""
    arguments = ("--model", commissioned.model, "--json", "-")
    done = surfclass("evaluate", commissioned.recording, *arguments, cwd=commissioned.root)
    return json.loads(done.stdout)


def test_help_names_every_command():
    said = surfclass("--help", cwd="/").stdout
    for command in ("import", "train", "replay", "evaluate", "show", "capture", "run", "watch", "check"):
        assert f" {command} " in said


class TestImport:
    def test_every_capture_arrives_with_its_pixels(self, commissioned):
        captures = {capture.name: capture for capture in Recording.open(commissioned.recording).captures()}
        roles = {f"train_{name}": "train" for name in CLASSES} | {n: role for n, (role, _) in VIEWS.items()}
        assert {name: capture.role for name, capture in captures.items()} == roles
        for name, capture in captures.items():
            path = commissioned.folder / "depth" / f"{name}.png"
            assert np.array_equal(capture.depth.depth_mm, cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            path = commissioned.folder / "colour" / f"{name}.png"
            assert np.array_equal(capture.colour.rgb, cv2.imread(str(path))[..., ::-1])
            assert (capture.label is None) == (name == "view_2")

    def test_the_files_are_kept_as_they_are(self, commissioned):
        with commissioned.recording.open("rb") as stream:
            kept = [message.data for _, _, message in make_reader(stream).iter_messages(topics=["/colour"])]
        names = [row["name"] for row in rows_of(commissioned.folder)]
        for name, data in zip(names, kept, strict=True):
            assert (commissioned.folder / "colour" / f"{name}.png").read_bytes() in data
        rig = (commissioned.folder / "rig.toml").read_text()
        assert Recording.open(commissioned.recording).rig_text == rig

    def test_twice_gives_the_same_bytes(self, commissioned, tmp_path):
        surfclass("import", commissioned.folder, tmp_path / "again.mcap", cwd=tmp_path)
        surfclass("import", ".", tmp_path / "from_inside.mcap", cwd=commissioned.folder)
        assert (tmp_path / "again.mcap").read_bytes() == commissioned.recording.read_bytes()
        assert (tmp_path / "from_inside.mcap").read_bytes() == commissioned.recording.read_bytes()
        assert len(state_of(tmp_path)) == 2


class TestTrain:
    def test_twice_gives_the_same_bytes(self, commissioned, tmp_path):
        arguments = ("--out", tmp_path / "again.npz", "--classifier", "naive-bayes")
        surfclass("train", commissioned.recording, *arguments, cwd=tmp_path)
        assert (tmp_path / "again.npz").read_bytes() == commissioned.model.read_bytes()


class TestReplay:
    def test_the_map_file_holds_what_is_promised(self, commissioned):
        with np.load(commissioned.map, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
        n, k = len(found["index"]), len(CLASSES)
        assert set(found) == {
            "voxel_size_m", "classes", "colours", "index", "p_colour", "p_texture", "p", "weight", "count",
            "made_with",
        }  # fmt: skip
        assert n > 1000
        assert found["voxel_size_m"] == 0.010
        assert tuple(found["classes"]) == CLASSES
        assert found["index"].dtype == np.int32
        for name in ("p_colour", "p_texture", "p"):
            assert found[name].dtype == np.float32
            assert found[name].shape == (n, k)
            np.testing.assert_allclose(found[name].sum(axis=1), 1, atol=1e-5)
        assert found["weight"].shape == found["count"].shape == (n,)

    def test_twice_gives_the_same_bytes(self, commissioned, tmp_path):
        arguments = ("--model", commissioned.model, "--map", tmp_path / "again.npz")
        surfclass("replay", commissioned.recording, *arguments, cwd=tmp_path)
        assert (tmp_path / "again.npz").read_bytes() == commissioned.map.read_bytes()

    def test_the_parts_of_a_recording_make_its_map(self, commissioned, tmp_path):
        whole = Recording.open(commissioned.recording)
        captures = list(whole.captures())
        for name, part in (("a.mcap", captures[:-2]), ("b.mcap", captures[-2:])):
            with RecordingWriter(tmp_path / name, whole.rig_text, whole.classes_text) as writer:
                for capture in part:
                    writer.write(capture)
        arguments = ("--model", commissioned.model, "--map", "parts.npz")
        surfclass("replay", "a.mcap", "b.mcap", *arguments, cwd=tmp_path)
        assert (tmp_path / "parts.npz").read_bytes() == commissioned.map.read_bytes()
        other = whole.rig_text.replace("simulated cell", "another cell")
        with RecordingWriter(tmp_path / "c.mcap", other, whole.classes_text) as writer:
            writer.write(captures[-1])
        done = surfclass("replay", "a.mcap", "c.mcap", *arguments, cwd=tmp_path, code=2)
        assert "c.mcap: has another rig" in done.stderr

    def test_the_boards_stay_out_of_the_map(self, commissioned, tmp_path):
        """They stood where the cell is, at another time."""
        views = rewritten(commissioned.recording, tmp_path / "views.mcap", roles=("map", "test"))
        surfclass("replay", views, "--model", commissioned.model, "--map", "map.npz", cwd=tmp_path)
        assert (tmp_path / "map.npz").read_bytes() == commissioned.map.read_bytes()

    def test_thesis_mode_is_both_of_its_switches(self, commissioned, tmp_path):
        for name, switches in (
            ("thesis", ["--thesis"]),
            ("switched", ["--update", "independent", "--pool", "linear"]),
        ):
            arguments = ("--model", commissioned.model, "--map", f"{name}.npz", *switches)
            surfclass("replay", commissioned.recording, *arguments, cwd=tmp_path)
        thesis = (tmp_path / "thesis.npz").read_bytes()
        assert thesis == (tmp_path / "switched.npz").read_bytes()
        assert thesis != commissioned.map.read_bytes()


class TestEvaluate:
    def test_the_json_is_of_the_form_that_others_rely_on(self, evaluation):
        assert set(evaluation) == {"schema", "classes", "routes"}
        assert evaluation["schema"] == 1
        assert tuple(evaluation["classes"]) == CLASSES
        assert set(evaluation["routes"]) == {"rgb", "ab", "kd", "texture", "combined"}
        for route in evaluation["routes"].values():
            assert set(route) == {"fused", "views", "pixels"}
            assert set(route["views"]) == set(route["pixels"]) == {"view_0", "view_5"}
            for figures in (route["fused"], *route["views"].values()):
                assert set(figures) >= FIGURES
            for figures in route["pixels"].values():
                assert {"overall", "balanced", "pixels", "confusion"} <= set(figures)

    def test_the_figures_follow_from_the_confusion(self, evaluation):
        rejections = 0
        for route in evaluation["routes"].values():
            for figures in (route["fused"], *route["views"].values()):
                confusion = np.array(figures["confusion"])
                assert confusion.shape == (len(CLASSES), len(CLASSES))
                rejected = round(figures["rejected"] * figures["voxels"])
                rejections += rejected
                assert confusion.sum() + rejected == figures["voxels"] > 500
                assert figures["overall"] == pytest.approx(np.trace(confusion) / figures["voxels"])
                assert 0 <= figures["ece"] <= 1
                assert figures["nll"] > 0
        assert rejections > 100  # naive Bayes rejects: else nothing of this was tested

    def test_the_cell_is_recognised(self, evaluation):
        right = {name: route["fused"]["overall"] for name, route in evaluation["routes"].items()}
        assert right["combined"] > 0.7
        assert right["kd"] > right["rgb"]

    def test_a_file_gets_the_same_json_as_standard_output(self, commissioned, evaluation, tmp_path):
        arguments = ("--model", commissioned.model, "--json", "e.json", "--png", "confusion.png")
        done = surfclass("evaluate", commissioned.recording, *arguments, cwd=tmp_path)
        assert done.stdout == ""
        assert json.loads((tmp_path / "e.json").read_text()) == evaluation
        assert cv2.imread(str(tmp_path / "confusion.png")).std() > 10

    def test_one_route_alone_gives_its_figures(self, commissioned, evaluation, tmp_path):
        arguments = ("--model", commissioned.model, "--route", "kd", "--json", "-")
        done = surfclass("evaluate", commissioned.recording, *arguments, cwd=tmp_path)
        assert json.loads(done.stdout)["routes"] == {"kd": evaluation["routes"]["kd"]}

    def test_a_finished_map_scores_as_the_one_made_anew(self, commissioned, evaluation, tmp_path):
        views = rewritten(commissioned.recording, tmp_path / "views.mcap", roles=("test",))
        surfclass("replay", views, "--model", commissioned.model, "--map", "map.npz", cwd=tmp_path)
        done = surfclass("evaluate", views, "--map", "map.npz", "--json", "-", cwd=tmp_path)
        found = {name: route["fused"] for name, route in json.loads(done.stdout)["routes"].items()}
        wanted = {name: evaluation["routes"][name]["fused"] for name in ("kd", "texture", "combined")}
        assert found == {"colour": wanted["kd"], **{name: wanted[name] for name in ("texture", "combined")}}

    @pytest.mark.parametrize(("required", "code", "verdict"), [(0.5, 0, "PASS"), (0.999, 1, "FAIL")])
    def test_the_gate(self, commissioned, required, code, verdict, tmp_path):
        arguments = ("--map", commissioned.map, "--require", required)
        done = surfclass("evaluate", commissioned.recording, *arguments, cwd=tmp_path, code=code)
        assert f"{verdict}: combined" in done.stderr

    def test_the_gate_of_one_route_is_its_own(self, commissioned, evaluation, tmp_path):
        reached = evaluation["routes"]["rgb"]["fused"]["overall"]
        assert reached + 0.01 < evaluation["routes"]["combined"]["fused"]["overall"]
        arguments = ("--model", commissioned.model, "--route", "rgb", "--require", reached + 0.01)
        done = surfclass("evaluate", commissioned.recording, *arguments, cwd=tmp_path, code=1)
        assert "FAIL: rgb" in done.stderr


class TestShow:
    def test_a_map_as_picture_and_as_points(self, commissioned, tmp_path):
        classes = commissioned.folder / "classes.toml"
        arguments = ("--png", "map.png", "--ply", "map.ply", "--classes", classes)
        done = surfclass("show", "map", commissioned.map, *arguments, cwd=tmp_path)
        found = from_npz_bytes(commissioned.map.read_bytes(), "map")
        assert f"{len(found.layers.index):,} voxels of 10 mm" in done.stderr
        assert cv2.imread(str(tmp_path / "map.png")).std() > 10
        points, colours = read_ply(tmp_path / "map.ply")
        np.testing.assert_allclose(points, (found.layers.index + 0.5) * 0.010)
        rusted = found.layers.label() == 1
        assert {tuple(colour) for colour in colours[rusted].tolist()} == {(0xB7, 0x41, 0x0E)}
        assert set(state_of(tmp_path)) == {path.relative_to(tmp_path) for path in tmp_path.iterdir()}
        assert sorted(path.name for path in tmp_path.iterdir()) == ["map.ply", "map.png"]

    def test_a_map_in_words(self, commissioned, tmp_path):
        said = surfclass("show", "map", commissioned.map, cwd=tmp_path).stderr
        p = from_npz_bytes(commissioned.map.read_bytes(), "map").layers.p
        known = p.max(axis=1) > 1 / len(CLASSES) + 1e-6
        counts = np.bincount(p[known].argmax(axis=1), minlength=len(CLASSES))
        words = [line.split() for line in said.splitlines()[1:]]
        assert words[: len(CLASSES)] == [
            [name, f"{count:,}"] for name, count in zip(CLASSES, counts, strict=True)
        ]
        assert state_of(tmp_path) == {}

    def test_captures_with_and_without_a_model(self, commissioned, tmp_path):
        names = ("--name", "view_0", "--name", "view_2")
        surfclass("show", "capture", commissioned.recording, *names, "--png", "a.png", cwd=tmp_path)
        more = (*names, "--png", "b.png", "--model", commissioned.model)
        surfclass("show", "capture", commissioned.recording, *more, cwd=tmp_path)
        narrow, wide = cv2.imread(str(tmp_path / "a.png")), cv2.imread(str(tmp_path / "b.png"))
        assert narrow.shape[0] == pytest.approx(wide.shape[0], rel=0.1)
        assert wide.shape[1] > 1.5 * narrow.shape[1]
        assert narrow.std() > 10


def read_ply(path):
    """The points and RGB colours of a binary PLY."""
    import open3d  # two seconds

    cloud = open3d.io.read_point_cloud(str(path))
    return np.asarray(cloud.points), np.round(np.asarray(cloud.colors) * 255).astype(int)


@pytest.fixture(scope="module")
def kitchen(shared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitchen")
    surfclass("import", shared / "data" / "kitchen", "rec.mcap", cwd=folder)
    surfclass("train", "rec.mcap", "--out", "model.npz", cwd=folder)
    surfclass("replay", "rec.mcap", "--model", "model.npz", "--map", "replayed.npz", cwd=folder)
    return folder


class TestKitchen:
    """A real Kinect's recording, without controlled light and without an arm."""

    def test_is_recognised(self, kitchen):
        arguments = ("--model", "model.npz", "--route", "all", "--json", "-", "--require", "0.97")
        result = json.loads(surfclass("evaluate", "rec.mcap", *arguments, cwd=kitchen).stdout)
        assert result["classes"] == ["painted", "timber", "carpet"]
        assert set(result["routes"]) == {"rgb", "ab", "texture", "combined"}  # K_d needs a light
        assert result["routes"]["combined"]["fused"]["overall"] >= 0.97

    def test_service_console_and_replay_make_the_same_map(self, kitchen, tmp_path):
        endpoint = endpoint_in(tmp_path)
        watched, served = tmp_path / "watch.log", tmp_path / "run.log"
        watch = ("--until-gone", "--timeout-s", "60", "--map", "console.npz", "--json", "console.json")
        settings = ("model=model.npz", f"map={tmp_path}/daemon.npz", f'zenoh.listen=["{endpoint}"]')
        overrides = [word for setting in settings for word in ("--set", setting)]
        run = ("run", "--from", "rec.mcap", "--exit-when-done", *overrides)
        with running(watched, "watch", "--connect", endpoint, *watch, cwd=tmp_path) as console:
            # Until this is done the console has long been asking for the service.
            arguments = ("--model", "model.npz", "--map", tmp_path / "again.npz")
            surfclass("replay", "rec.mcap", *arguments, cwd=kitchen)
            with running(served, *run, cwd=kitchen) as service:
                ended(service, served)
            ended(console, watched)
        replayed = (kitchen / "replayed.npz").read_bytes()
        assert (tmp_path / "again.npz").read_bytes() == replayed
        assert (tmp_path / "daemon.npz").read_bytes() == replayed
        assert (tmp_path / "console.npz").read_bytes() == replayed
        told = json.loads((tmp_path / "console.json").read_text())
        assert told["sequence"] == told["status"]["counts"]["mapped"] == 12
        assert told["voxels"] == len(from_npz_bytes(replayed, "map").layers.index)
        # Nothing is recorded that was recorded already.
        names = {path.name for path in (*tmp_path.iterdir(), *kitchen.iterdir())}
        assert [name for name in names if ".mcap" in name] == ["rec.mcap"]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_printed_method_on_a_renderers_pictures(shared, tmp_path):
    """K_d holds from 0.65 to 1.3 m where colours of one distance do not."""
    surfclass("import", shared / "data" / "rendered", "rec.mcap", cwd=tmp_path)
    surfclass("train", "rec.mcap", "--out", "model.npz", "--thesis", cwd=tmp_path, timeout_s=300)
    arguments = ("--model", "model.npz", "--thesis", "--json", "-")
    done = surfclass("evaluate", "rec.mcap", *arguments, cwd=tmp_path, timeout_s=200)
    routes = json.loads(done.stdout)["routes"]
    names = [f"exp1_{number}" for number in ("03", "06", "09", "12", "16")]
    kd, ab, rgb = (
        np.mean([routes[route]["pixels"][name]["overall"] for name in names]) for route in ("kd", "ab", "rgb")
    )
    assert kd >= ab >= rgb
