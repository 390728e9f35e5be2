"""Input that the command cannot use: one clear line, the right exit code, and nothing written."""

import os
import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from cli_site import CLASSES, rewritten, rows_of, state_of, surfclass, write_png, write_rows

from daemon.offline import import_folder
from drivers.recordings import Recording
from surfclass.map_file import to_npz_bytes
from surfclass.rig import SurfaceClasses
from surfclass.voxel_map import VoxelMap

USAGE, DEVICE, CONFIGURATION = 2, 69, 78


def fails(arguments, code, said, cwd, wrapper=()):
    """Runs a command that has to fail, with a last line that matches `said`."""
    done = surfclass(*arguments, cwd=cwd, code=code, wrapper=wrapper)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("surfclass: "), f"{arguments}\n{done.stderr}"
    assert re.search(said, last), f"{arguments}\n{last}"
    assert done.stdout == ""


@pytest.fixture
def refuses(tmp_path):
    """Runs a command that has to fail in `tmp_path`, which has to stay as it was."""

    def run(*arguments, code, said):
        before = state_of(tmp_path)
        fails(arguments, code, said, tmp_path)
        assert state_of(tmp_path) == before

    return run


@pytest.fixture
def all_refused(tmp_path):
    """The same for many commands, as many at once as there are processors."""

    def run(cases, wrapper=()):
        before = state_of(tmp_path)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            running = [pool.submit(fails, *case, tmp_path, wrapper) for case in cases]
        for process in running:
            process.result()
        assert state_of(tmp_path) == before

    return run


def edited(path, *changes):
    """Replaces text in a file; each has to be there."""
    text = path.read_text()
    for old, new in changes:
        text, count = re.subn(old, new, text, flags=re.MULTILINE)
        assert count, old
    path.write_text(text)


class TestFolders:
    def test_a_depth_image_of_the_wrong_size(self, commissioned, refuses, tmp_path):
        def shrink(folder):
            path = folder / "depth" / "view_5.png"
            write_png(path, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-2])

        commissioned.variant(tmp_path / "set", shrink)
        said = r"set/depth/view_5\.png: 160 × 118 pixels, rig\.toml says 160 × 120"
        refuses("import", "set", "out.mcap", code=USAGE, said=said)

    @pytest.mark.parametrize(
        ("missing", "code", "said"),
        [
            ("rig.toml", CONFIGURATION, r"set/rig\.toml: missing"),
            ("classes.toml", CONFIGURATION, r"set/classes\.toml: missing"),
            ("captures.csv", USAGE, r"set/captures\.csv: missing"),
            (
                "colour/view_2.png",
                USAGE,
                r"set/colour/view_2\.png\|\.jpg: missing; set/captures\.csv, line 9",
            ),
        ],
    )
    def test_a_missing_file(self, commissioned, refuses, tmp_path, missing, code, said):
        commissioned.variant(tmp_path / "set", lambda folder: (folder / missing).unlink())
        refuses("import", "set", "out.mcap", code=code, said=said)

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ((r"^schema = 1$", "schema = 2"), r"rig\.toml: schema: .*unknown schema, allowed is 1"),
            ((r"^voxel_size_m", "voxel_size"), r"rig\.toml:"),
            ((r"^position_rgb_m", "positon_rgb_m"), r"rig\.toml:"),
        ],
    )
    def test_a_rig_that_is_none(self, commissioned, refuses, tmp_path, changes, said):
        commissioned.variant(tmp_path / "set", lambda folder: edited(folder / "rig.toml", changes))
        before = state_of(tmp_path)
        done = surfclass("import", "set", "out.mcap", cwd=tmp_path, code=CONFIGURATION)
        assert re.search(said, done.stderr)
        if changes[1] != "schema = 2":  # the key that is missing, and the one that is not known
            assert f"did you mean '{changes[0].lstrip('^')}'?" in done.stderr
        assert state_of(tmp_path) == before

    def test_a_folder_that_is_not_there(self, refuses):
        refuses("import", "absent", "out.mcap", code=USAGE, said="absent: no such folder")

    def test_an_image_that_breaks_off_halfway_through_the_import(self, commissioned, refuses, tmp_path):
        def cut(folder):
            path = folder / "colour" / "view_2.png"
            path.write_bytes(path.read_bytes()[:500])

        commissioned.variant(tmp_path / "set", cut)
        (tmp_path / "out.mcap").write_bytes(b"an older recording")
        refuses("import", "set", "out.mcap", code=USAGE, said=r"set/colour/view_2\.png: ")

    def test_a_label_without_a_class(self, commissioned, refuses, tmp_path):
        def fewer(folder):
            edited(
                folder / "classes.toml",
                (r"^names = .*", 'names = ["rusted", "blasted"]'),
                (r"^colours = .*", 'colours = ["#b7410e", "#999999"]'),
            )

        commissioned.variant(tmp_path / "set", fewer)
        refuses("import", "set", "out.mcap", code=USAGE, said=r"label 3 .*allowed are 0 to 2")

    def test_joints_and_pose_that_disagree(self, commissioned, refuses, tmp_path):
        def disagree(folder):
            rows = rows_of(folder)
            identity = np.eye(4)[:3]
            rows[-1] |= {f"p{i}{j}": identity[i, j] for i in range(3) for j in range(4)}
            write_rows(folder, rows)

        commissioned.variant(tmp_path / "set", disagree)
        refuses("import", "set", "out.mcap", code=USAGE, said="capture view_2: ")


class TestRecordings:
    COMMANDS = (
        ("train", "bad.mcap", "--out", "out.npz"),
        ("replay", "bad.mcap", "--model", "MODEL", "--map", "out.npz"),
        ("evaluate", "bad.mcap", "--model", "MODEL", "--json", "out.json"),
        ("show", "capture", "bad.mcap", "--png", "out.png"),
        ("run", "--from", "bad.mcap", "--exit-when-done", "--set", "model=MODEL", "--set", "map=out.npz"),
    )

    def test_one_that_was_cut_off(self, commissioned, all_refused, tmp_path):
        whole = commissioned.recording.read_bytes()
        (tmp_path / "bad.mcap").write_bytes(whole[: len(whole) // 2])
        said = r"bad\.mcap: unfinished: .*surfclass recover .*bad\.mcap"
        model = str(commissioned.model)
        told = [[word.replace("MODEL", model) for word in command] for command in self.COMMANDS]
        all_refused([(command, USAGE, said) for command in told])

    def test_one_that_is_none(self, commissioned, all_refused, tmp_path):
        magic = b"\x89MCAP0\r\n"
        broken = {
            "empty.mcap": (b"", r"empty\.mcap: an empty file"),
            "garbage.mcap": (bytes(range(256)) * 40, r"garbage\.mcap: not an MCAP file"),
            "hollow.mcap": (magic + bytes(1000) + magic, r"hollow\.mcap: damaged"),
        }
        for name, (data, _) in broken.items():
            (tmp_path / name).write_bytes(data)
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        all_refused([(("replay", name, *arguments), USAGE, said) for name, (_, said) in broken.items()])

    def test_one_that_is_damaged_far_inside(self, commissioned, refuses, tmp_path):
        data = bytearray(commissioned.recording.read_bytes())
        middle = len(data) * 3 // 4
        data[middle : middle + 64] = bytes(64)
        (tmp_path / "bad.mcap").write_bytes(data)
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        refuses("replay", "bad.mcap", *arguments, code=USAGE, said=r"bad\.mcap: damaged")

    def test_one_that_is_not_there(self, commissioned, refuses):
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        refuses("replay", "bad.mcap", *arguments, code=USAGE, said=r"bad\.mcap: no such file")

    def test_a_recovered_one_can_be_used(self, commissioned, tmp_path):
        whole = commissioned.recording.read_bytes()
        (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 9 // 10])
        said = surfclass("recover", "cut.mcap", cwd=tmp_path).stderr
        assert said.strip() == "cut.recovered.mcap"
        names = [capture.name for capture in Recording.open(tmp_path / "cut.recovered.mcap").captures()]
        wanted = [capture.name for capture in Recording.open(commissioned.recording).captures()]
        assert 0 < len(names) < len(wanted)
        assert names == wanted[: len(names)]

    def test_nothing_to_train_on(self, commissioned, refuses, tmp_path):
        rewritten(commissioned.recording, tmp_path / "views.mcap", roles=("map", "test"))
        said = "no capture of role 'train' with a label to train from"
        refuses("train", "views.mcap", "--out", "out.npz", code=USAGE, said=said)

    def test_nothing_to_make_a_map_of(self, commissioned, refuses, tmp_path):
        rewritten(commissioned.recording, tmp_path / "boards.mcap", roles=("train",))
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        said = r"boards\.mcap: no capture of role map or test"
        refuses("replay", "boards.mcap", *arguments, code=USAGE, said=said)

    @pytest.mark.parametrize("what", ["model", "map"])
    def test_nothing_to_evaluate(self, commissioned, refuses, tmp_path, what):
        rewritten(commissioned.recording, tmp_path / "boards.mcap", roles=("train", "map"))
        arguments = (f"--{what}", getattr(commissioned, what), "--json", "out.json")
        said = "no capture of role 'test'"
        refuses("evaluate", "boards.mcap", *arguments, code=USAGE, said=said)


class TestCalibrations:
    def test_k_d_without_a_light(self, commissioned, refuses, tmp_path):
        def dark(folder):
            edited(folder / "rig.toml", (r"^\[light\]\n(\w+ = .*\n)*", ""))

        import_folder(commissioned.variant(tmp_path / "set", dark), tmp_path / "dark.mcap")
        said = r"features\.colour is K_d, which needs a \[light\]"
        refuses("train", "dark.mcap", "--out", "out.npz", code=CONFIGURATION, said=said)
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        refuses("replay", "dark.mcap", *arguments, code=CONFIGURATION, said="light")

    def test_joints_without_a_hand_eye(self, commissioned, refuses, tmp_path):
        def unknown(folder):
            edited(folder / "rig.toml", (r"^flange_T_depth = .*\n", ""))

        import_folder(commissioned.variant(tmp_path / "set", unknown), tmp_path / "unknown.mcap")
        said = r"transforms\.flange_T_depth is missing, and the captures give only joint angles"
        for command, result in (("replay", "--map"), ("evaluate", "--json")):
            arguments = ("--model", commissioned.model, result, "out")
            refuses(command, "unknown.mcap", *arguments, code=CONFIGURATION, said=said)

    def test_the_printed_polynomial_without_response_captures(self, commissioned, refuses, tmp_path):
        arguments = ("--out", "out.npz", "--thesis")
        said = r"response\.a2_a1_a0 is missing and 0 captures of role 'response'"
        refuses("train", commissioned.recording, *arguments, code=CONFIGURATION, said=said)


class TestModels:
    def test_one_trained_on_another_texture(self, commissioned, refuses, tmp_path):
        rig = Recording.open(commissioned.recording).rig_text.replace('"LBP"', '"GLCM"')
        rewritten(commissioned.recording, tmp_path / "glcm.mcap", rig=rig)
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        said = "texture route was trained on LBP, rig simulated cell says GLCM"
        refuses("replay", "glcm.mcap", *arguments, code=CONFIGURATION, said=said)

    def test_one_trained_without_this_colour_feature(self, commissioned, refuses, tmp_path):
        rig = Recording.open(commissioned.recording).rig_text
        blind = re.sub(r"^\[light\]\n(\w+ = .*\n)*", "", rig.replace('"K_d"', '"RGB"'), flags=re.MULTILINE)
        rewritten(commissioned.recording, tmp_path / "rgb.mcap", rig=blind)
        arguments = ("--out", "rgb.npz", "--classifier", "naive-bayes")
        surfclass("train", "rgb.mcap", *arguments, cwd=tmp_path)
        arguments = ("--model", "rgb.npz", "--map", "out.npz")
        said = r"the model has no colour route for K_d; it was trained on: RGB, a\*b\*"
        refuses("replay", commissioned.recording, *arguments, code=CONFIGURATION, said=said)
        arguments = ("--model", "rgb.npz", "--route", "kd", "--json", "out.json")
        said = r"rgb\.npz: has no K_d route"
        refuses("evaluate", "rgb.mcap", *arguments, code=CONFIGURATION, said=said)

    def test_one_of_other_classes(self, commissioned, refuses, tmp_path):
        classes = Recording.open(commissioned.recording).classes_text.replace("timber", "granite")
        rewritten(commissioned.recording, tmp_path / "stone.mcap", classes=classes)
        arguments = ("--model", commissioned.model, "--map", "out.npz")
        said = "the model knows the classes .*timber.*, the captures have .*granite"
        refuses("replay", "stone.mcap", *arguments, code=CONFIGURATION, said=said)

    def test_one_that_is_none(self, commissioned, all_refused, tmp_path):
        whole = commissioned.model.read_bytes()
        (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
        (tmp_path / "garbage.npz").write_bytes(b"PK" + bytes(100))
        no_model = r"(half|garbage)\.npz: not a surfclass model"
        no_file = r"absent\.npz: cannot read the model: No such file"
        rec = commissioned.recording
        all_refused(
            [
                (("replay", rec, "--model", "half.npz", "--map", "out"), CONFIGURATION, no_model),
                (("evaluate", rec, "--model", "garbage.npz", "--json", "out"), CONFIGURATION, no_model),
                (("replay", rec, "--model", "absent.npz", "--map", "out"), USAGE, no_file),
            ]
        )


def empty_map(size_m=0.010, names=CLASSES):
    colours = tuple("#000000" for _ in names)
    return to_npz_bytes(VoxelMap(size_m, SurfaceClasses(names=names, colours=colours), "frame"))


class TestMaps:
    def test_one_that_is_not_the_recordings(self, commissioned, all_refused, tmp_path):
        wrong = [
            (empty_map(names=CLASSES[::-1]), "classes cardboard, timber, .*; the recording has .* rusted"),
            (empty_map(names=("painted", "timber")), "classes painted, timber; the recording has"),
            (empty_map(size_m=0.020), r"voxels of 0\.02 m .*; the recording has 0\.01 m"),
            (b"garbage", r"map3\.npz: not a map file"),
            (empty_map()[:200], r"map4\.npz: not a map file"),
        ]
        cases = []
        for number, (data, said) in enumerate(wrong):
            (tmp_path / f"map{number}.npz").write_bytes(data)
            arguments = ("--map", f"map{number}.npz", "--json", "out.json")
            cases.append((("evaluate", commissioned.recording, *arguments), USAGE, said))
        all_refused(cases)

    def test_colours_of_other_classes(self, commissioned, refuses, tmp_path):
        (tmp_path / "other.npz").write_bytes(empty_map(names=("painted", "timber")))
        arguments = ("--classes", commissioned.folder / "classes.toml", "--png", "out.png")
        refuses(
            "show", "map", "other.npz", *arguments, code=USAGE, said="has the classes rusted, .*, the map"
        )

    def test_one_that_is_not_there(self, refuses):
        said = r"absent\.npz: cannot read the map: No such file"
        refuses("show", "map", "absent.npz", "--png", "out.png", code=USAGE, said=said)

    def test_a_capture_that_is_not_there(self, commissioned, refuses):
        arguments = ("--name", "view_9", "--png", "out.png")
        said = "no capture with a colour image named view_9"
        refuses("show", "capture", commissioned.recording, *arguments, code=USAGE, said=said)


class TestConfigurations:
    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            (
                (r"^min_free_mb", "min_fre_mb"),
                r"recording\.min_fre_mb: unknown key; did you mean 'min_free_mb'",
            ),
            ((r"^schema = 1$", "schema = 7"), r"schema: .*unknown schema, allowed is 1"),
            ((r"^\[trigger.rest\]", "[trigger.rest"), "not a TOML file"),
        ],
        ids=["key", "schema", "syntax"],
    )
    def test_a_wrong_file(self, commissioned, all_refused, tmp_path, changes, said):
        edited(commissioned.configuration(tmp_path), changes)
        commands = (("run",), ("check", "--json", "out.json"), ("capture", "out.mcap"))
        said = rf"surfclass\.toml: {said}"
        all_refused([((*command, "-c", "surfclass.toml"), CONFIGURATION, said) for command in commands])

    def test_every_fault_is_named_at_once(self, commissioned, tmp_path):
        path = commissioned.configuration(tmp_path)
        edited(path, (r"^min_free_mb", "min_fre_mb"), (r"^robot = .*", "robot = 7"))
        said = surfclass("check", "-c", path, cwd=tmp_path, code=CONFIGURATION).stderr.splitlines()
        assert said[0] == f"surfclass: {path}:"
        assert sorted(line.split(":")[0] for line in said[1:]) == ["  recording.min_fre_mb", "  robot"]

    def test_none_at_all(self, all_refused):
        commands = (("run",), ("check",), ("capture", "out.mcap"))
        said = "no configuration: give --config FILE"
        absent = (
            ("check", "-c", "absent.toml"),
            CONFIGURATION,
            r"absent\.toml: cannot be read \(No such file",
        )
        all_refused([*((command, CONFIGURATION, said) for command in commands), absent])


OUTPUTS = (
    ("import", "FOLDER", "OUT"),
    ("train", "RECORDING", "--out", "OUT"),
    ("replay", "RECORDING", "--model", "MODEL", "--map", "OUT"),
    ("evaluate", "RECORDING", "--model", "MODEL", "--json", "OUT"),
    ("evaluate", "RECORDING", "--model", "MODEL", "--json", "fine.json", "--png", "OUT"),
    ("show", "map", "MAP", "--png", "OUT"),
    ("show", "map", "MAP", "--png", "fine.png", "--ply", "OUT"),
    ("show", "capture", "RECORDING", "--png", "OUT"),
    ("capture", "OUT", "-c", "CONFIGURATION"),
    ("check", "-c", "CONFIGURATION", "--json", "OUT"),
    ("watch", "--map", "OUT"),
)


class TestOutputs:
    """A result that cannot be written is found out before the work, not after it."""

    @pytest.fixture
    def commands(self, commissioned, tmp_path):
        told = {
            "FOLDER": commissioned.folder,
            "RECORDING": commissioned.recording,
            "MODEL": commissioned.model,
            "MAP": commissioned.map,
            "CONFIGURATION": commissioned.configuration(tmp_path),
        }
        return [[str(told.get(word, word)) for word in command] for command in OUTPUTS]

    def test_in_a_directory_that_is_not_there(self, commands, all_refused):
        said = "absent/out: there is no directory absent"
        told = [["absent/out" if word == "OUT" else word for word in command] for command in commands]
        all_refused([(command, USAGE, said) for command in told])

    def test_in_a_directory_that_is_not_ours(self, commands, all_refused, tmp_path):
        (tmp_path / "theirs").mkdir(mode=0o555)
        said = "theirs/out: the directory theirs cannot be written to"
        told = [["theirs/out" if word == "OUT" else word for word in command] for command in commands]
        all_refused([(command, USAGE, said) for command in told], wrapper=without_root())

    def test_where_a_directory_is(self, commands, all_refused, tmp_path):
        (tmp_path / "taken").mkdir()
        told = ["taken" if word == "OUT" else word for word in commands[2]]
        all_refused([(told, USAGE, "taken: is a directory, and a file is to be written")])


def without_root():
    """What to put before a command so that permissions hold for it, although the tests may run as root."""
    if os.geteuid() != 0:
        return ()
    setpriv = shutil.which("setpriv")
    wrapper = (setpriv, "--bounding-set", "-dac_override,-dac_read_search,-fowner")
    if setpriv is None or subprocess.run([*wrapper, "true"], check=False).returncode != 0:
        pytest.skip("root may write everywhere, and setpriv cannot take that away here")
    return wrapper


def test_wrong_usage_is_explained(tmp_path):
    """What Typer finds itself, and what takes more than its types."""
    cases = {
        "replay": "Missing argument 'REC.mcap'",
        "replay a.mcap --map b.npz": "Missing option '--model'",
        "evaluate a.mcap": "give --model MODEL",
        "evaluate a.mcap --model m --map n": "give --model MODEL",
        "evaluate a.mcap --map n --route kd": "--map MAP.npz is scored as it is",
        "evaluate a.mcap --model m --require 97": "--require",
        "evaluate a.mcap --model m --route colour": "'colour' is not one of",
        "improt a b.mcap": "No such command 'improt'",
    }

    def explained(arguments, said):
        done = surfclass(*arguments.split(), cwd=tmp_path, code=USAGE)
        assert said in done.stderr, arguments

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = [pool.submit(explained, *case) for case in cases.items()]
    for process in running:
        process.result()
    assert state_of(tmp_path) == {}
