"""Captures of commissioning, from a recording or a data folder, or several of them."""

import cv2
import numpy as np
import pytest
from cli_site import surfclass, write_rows

from calibration.source import Source
from surfclass.errors import InputError

RIG = """schema = 1
name = "small"
voxel_size_m = 0.01
[depth]
size = [{width}, 30]
fx = 50.0
fy = 50.0
cx = 19.5
cy = 14.5
"""


def folder(path, names, role="hand_eye", width=40):
    (path / "depth").mkdir(parents=True)
    (path / "rig.toml").write_text(RIG.format(width=width))
    (path / "plate.toml").write_text(
        "disc_radius_m = 0.02\npositions_base_m = [[0, 0, 1], [0.1, 0, 1], [0, 0.2, 1]]\n"
    )
    for name in names:
        cv2.imwrite(str(path / "depth" / f"{name}.png"), np.full((30, width), 900, np.uint16))
    joints = dict.fromkeys((f"q{axis}" for axis in range(1, 7)), "0")
    rows = [{"name": name, "role": role, "t_ns": number, **joints} for number, name in enumerate(names)]
    write_rows(path, rows)
    return path


def test_a_folder_and_its_recording_are_the_same_source(tmp_path):
    there = folder(tmp_path / "set", ["a", "b"])
    surfclass("import", there, tmp_path / "set.mcap", cwd=tmp_path)
    for path in (there, tmp_path / "set.mcap"):
        source = Source.open(path)
        assert [capture.name for capture in source.captures("hand_eye")] == ["a", "b"]
        assert list(source.captures(["board", "light"])) == []
        assert (source.count("hand_eye"), source.count("board")) == (2, 0)
        assert source.plate.disc_radius_m == 0.02
        assert all(len(digest) == 64 for digest in source.digests().values())


def test_several_are_one_after_the_other_with_all_their_digests(tmp_path):
    first, second = folder(tmp_path / "one", ["a"]), folder(tmp_path / "two", ["b", "c"])
    source = Source.open(first, second)
    assert [capture.name for capture in source.captures({"hand_eye"})] == ["a", "b", "c"]
    assert source.count("hand_eye") == 3
    assert set(source.digests()) == {*Source.open(first).digests(), *Source.open(second).digests()}


def test_captures_of_another_image_size_do_not_go_together(tmp_path):
    first, second = folder(tmp_path / "one", ["a"]), folder(tmp_path / "two", ["b"], width=44)
    with pytest.raises(InputError, match=r"two: its images have not the size of those of .*one"):
        Source.open(first, second)


def test_values_go_on_top_of_the_rig_and_the_file_stays(tmp_path):
    source = Source.open(folder(tmp_path / "one", ["a"]))
    assert source.with_values({"depth": {"fx": 51.0}}).rig.depth.fx == 51.0
    assert source.rig.depth.fx == 50.0
