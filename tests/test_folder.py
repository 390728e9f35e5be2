"""Data folders: what is read, and that every fault is named with its file, line and column."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_values import (
    CLASSES_TOML,
    DEPTH_ONLY_TOML,
    HEIGHT,
    PLATE_TOML,
    RIG_TOML,
    WIDTH,
    assert_same,
    capture,
    row_of,
    write_folder,
    write_image,
    write_rows,
)

from drivers.recordings.folder import FolderSet, read_folder
from surfclass.errors import ConfigurationError, InputError, MissingCalibrationError
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState
from surfclass.rig import DepthRig, Rig


def as_imported(of: Capture, sequence: int) -> Capture:
    """The capture as a folder can say it: one time, no device counters, nothing measured around it."""
    t_ns, exposure = of.t_ns, None if of.colour is None else of.colour.exposure_s
    return replace(
        of,
        depth=DepthFrame(t_ns, sequence, None, of.depth.depth_mm, of.depth.ir),
        colour=None if of.colour is None else ColourFrame(t_ns, sequence, exposure, of.colour.rgb),
        dark=None if of.dark is None else ColourFrame(t_ns, sequence, exposure, of.dark.rgb),
        joints=None if of.joints is None else JointState(t_ns, 0, of.joints.q),
        light_level=None,
        light_timing=None,
        joint_motion_rad=None,
        skew_ns=0,
    )


def read_all(folder: Path) -> list[Capture]:
    return [one for one, _ in read_folder(folder).captures()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "set", [capture(0), capture(1, role="train")])


def test_everything_that_a_folder_says_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    deep = rng.integers(0, 65536, (HEIGHT, WIDTH, 3)).astype(np.uint16)
    written = [
        capture(0),
        capture(
            1,
            role="map",
            dark=None,
            label=None,
            joints=None,
            depth=DepthFrame(0, 0, None, capture(1).depth.depth_mm),
        ),
        capture(2, base_T_depth=None, colour=ColourFrame(5, 0, None, deep), dark=None),
    ]
    found = list(read_folder(write_folder(tmp_path / "set", written)).captures())
    assert len(found) == 3
    for sequence, ((one, _), original) in enumerate(zip(found, written, strict=True)):
        wanted = as_imported(original, sequence)
        # The pose is snapped to the nearest rotation, a change in the last digits.
        if wanted.base_T_depth is not None and one.base_T_depth is not None:
            np.testing.assert_allclose(one.base_T_depth.matrix, wanted.base_T_depth.matrix, atol=1e-14)
            wanted = replace(wanted, base_T_depth=one.base_T_depth)
        assert_same(one, wanted)
    assert found[2][0].colour is not None
    assert found[2][0].colour.rgb.dtype == np.uint16


def test_the_original_bytes_come_with_each_capture(folder: Path) -> None:
    for one, encoded in read_folder(folder).captures():
        assert encoded.keys() == {"depth", "ir", "colour", "dark", "label"}
        for kind, data in encoded.items():
            assert data == (folder / kind / f"{one.name}.png").read_bytes()


def test_a_jpeg_has_its_channels_in_the_right_order(tmp_path: Path) -> None:
    red = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    red[..., 0] = 250
    folder = write_folder(tmp_path / "set", [capture(0, colour=ColourFrame(0, 0, None, red))], suffix=".jpg")
    colour = read_all(folder)[0].colour
    assert colour is not None
    assert colour.rgb[..., 0].min() > 240
    assert colour.rgb[..., 1:].max() < 10


def test_images_are_read_one_capture_at_a_time(folder: Path) -> None:
    captures = read_folder(folder).captures()
    next(captures)
    (folder / "depth" / "c001.png").write_bytes(b"gone bad meanwhile")
    with pytest.raises(InputError, match=r"c001\.png"):
        next(captures)


def test_drifted_rotations_are_made_rotations(folder: Path) -> None:
    row = row_of(capture(0))
    for key in ("p00", "p11", "p22"):
        row[key] = str(float(row[key]) * 1.0004)
    write_rows(folder, [row])
    pose = read_all(folder)[0].base_T_depth
    assert pose is not None
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-15)


Fault = Callable[[Path], object]


def cell(**changes: str) -> Fault:
    """Changes cells of the second row, line 3."""
    return lambda folder: write_rows(
        folder, [row_of(capture(0)), {**row_of(capture(1, role="train")), **changes}]
    )


def text(name: str, old: str, new: str) -> Fault:
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new))


def image(kind: str, pixels: np.ndarray) -> Fault:
    return lambda folder: write_image(folder / kind / "c001.png", pixels)


def gone(name: str) -> Fault:
    return lambda folder: (folder / name).unlink()


def cut(name: str, keep: float) -> Fault:
    def apply(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * keep)])

    return apply


NO_POSE = {f"p{i}{j}": "" for i in range(3) for j in range(4)}
NO_JOINTS = {f"q{i}": "" for i in range(1, 7)}

FAULTS: dict[str, tuple[Fault, str]] = {
    "no rig": (gone("rig.toml"), r"rig\.toml: missing"),
    "no classes": (gone("classes.toml"), r"classes\.toml: missing"),
    "no captures": (gone("captures.csv"), r"captures\.csv: missing"),
    "unknown schema": (
        text("rig.toml", "schema = 1", "schema = 7"),
        r"rig\.toml:\s+schema: .*allowed is 1, got 7",
    ),
    "rig key": (
        text("rig.toml", "voxel_size_m", "voxel_size"),
        r"rig\.toml:(?s:.*)did you mean 'voxel_size_m'",
    ),
    "rgb without size": (
        text("rig.toml", f"size = [{WIDTH}, {HEIGHT}]", ""),
        r"rig\.toml:\s+rgb\.size: missing",
    ),
    "rig not toml": (
        lambda f: (f / "rig.toml").write_text("schema = = 1"),
        r"rig\.toml: not a TOML file.*line 1",
    ),
    "rig not text": (lambda f: (f / "rig.toml").write_bytes(b"\xff\xfe\x00"), r"rig\.toml: not UTF-8"),
    "class colour": (text("classes.toml", "#b7410e", "red"), r"classes\.toml:\s+colours\.0"),
    "column missing": (
        lambda f: write_rows(f, [row_of(capture(0))], tuple(k for k in row_of(capture(0)) if k != "p23")),
        r"captures\.csv, line 1: columns: missing 'p23'",
    ),
    "column unknown": (
        lambda f: (f / "captures.csv").write_text((f / "captures.csv").read_text().replace("p23", "p33", 1)),
        r"line 1: columns: missing 'p23'; unknown 'p33'",
    ),
    "no rows": (lambda f: write_rows(f, []), r"captures\.csv: no captures"),
    "empty file": (lambda f: (f / "captures.csv").write_text(""), r"captures\.csv, line 1"),
    "field missing": (
        lambda f: (f / "captures.csv").write_text(
            (f / "captures.csv").read_text().rstrip().rsplit(",", 1)[0]
        ),
        r"captures\.csv, line 3: 21 fields, allowed are 22",
    ),
    "quote": (
        lambda f: (f / "captures.csv").write_text((f / "captures.csv").read_text() + '"'),
        r"captures\.csv, line 4: not CSV",
    ),
    "not text": (lambda f: (f / "captures.csv").write_bytes(b"name\xff"), r"captures\.csv: .*UTF-8"),
    "role": (cell(role="tset"), r"captures\.csv, line 3, column role: 'tset', allowed: train, test"),
    "duplicate": (cell(name="c000"), r"line 3, column name: 'c000' is already at .*captures\.csv, line 2"),
    "no name": (cell(name=""), r"line 3, column name"),
    "path as name": (cell(name="../c000"), r"line 3, column name"),
    "time": (cell(t_ns="1.5"), r"line 3, column t_ns: '1\.5', allowed is a whole number"),
    "negative time": (cell(t_ns="-1"), r"line 3, column t_ns"),
    "exposure": (cell(exposure_s="fast"), r"line 3, column exposure_s: 'fast', allowed is a finite number"),
    "exposure zero": (cell(exposure_s="0"), r"line 3, column exposure_s: 0, allowed is above 0"),
    "joint": (cell(q4="o.1"), r"line 3, column q4: 'o\.1', allowed is a finite number"),
    "joint nan": (cell(q4="nan"), r"line 3, column q4: 'nan'"),
    "joint empty": (cell(q5=""), r"line 3, column q5: empty, but q1…q6 go together"),
    "pose": (cell(p12="x"), r"line 3, column p12: 'x'"),
    "pose empty": (cell(p03=""), r"line 3, column p03: empty"),
    "pose mirrored": (
        cell(**{f"p0{j}": str(-float(row_of(capture(1))[f"p0{j}"])) for j in range(3)}),
        r"determinant -1",
    ),
    "pose scaled": (cell(p00="3"), r"line 3, columns p00…p22: no rotation"),
    "neither": (cell(**NO_POSE, **NO_JOINTS), r"line 3: capture c001 has neither q1…q6 nor p00…p23"),
    "depth missing": (gone("depth/c001.png"), r"depth/c001\.png: missing; .*line 3"),
    "colour missing": (gone("colour/c001.png"), r"colour/c001\.png\|\.jpg: missing; .*line 3"),
    "label missing": (gone("label/c001.png"), r"label/c001\.png: missing; .*the train capture c001"),
    "two colours": (
        lambda f: write_image(f / "colour" / "c001.jpg", np.zeros((6, 8, 3), np.uint8)),
        r"both .*c001\.png and .*c001\.jpg",
    ),
    "depth 8 bit": (
        image("depth", np.zeros((5, 7), np.uint8)),
        r"depth/c001\.png: 1 channel of 8 bit, allowed: 1 channel of 16 bit",
    ),
    "depth colour": (
        image("depth", np.zeros((5, 7, 3), np.uint16)),
        r"depth/c001\.png: 3 channels of 16 bit",
    ),
    "depth size": (
        image("depth", np.zeros((7, 5), np.uint16)),
        r"depth/c001\.png: 5 × 7 pixels, rig\.toml says 7 × 5",
    ),
    "colour grey": (
        image("colour", np.zeros((6, 8), np.uint8)),
        r"colour/c001\.png: 1 channel of 8 bit, allowed: 3",
    ),
    "colour size": (
        image("colour", np.zeros((8, 6, 3), np.uint8)),
        r"colour/c001\.png: 6 × 8 pixels, rig\.toml says 8 × 6",
    ),
    "dark size": (image("dark", np.zeros((8, 6, 3), np.uint8)), r"dark/c001\.png: 6 × 8"),
    "ir size": (image("ir", np.zeros((8, 6), np.uint8)), r"ir/c001\.png: 6 × 8"),
    "label size": (image("label", np.zeros((8, 6), np.uint8)), r"label/c001\.png: 6 × 8"),
    "label 16 bit": (
        image("label", np.zeros((6, 8), np.uint16)),
        r"label/c001\.png: 1 channel of 16 bit, allowed: 1 channel of 8",
    ),
    "label value": (
        image("label", np.eye(6, 8, 2, dtype=np.uint8) * 3),
        r"label/c001\.png: label 3 at row 0, column 2; classes\.toml has 2 classes, allowed are 0 to 2",
    ),
    "alpha": (
        lambda f: cv2.imwrite(str(f / "colour/c001.png"), np.zeros((6, 8, 4), np.uint8)),
        r"colour/c001\.png: 4 channels",
    ),
    "not an image": (
        lambda f: (f / "colour/c001.png").write_text("nothing"),
        r"colour/c001\.png: not an image",
    ),
    "empty image": (lambda f: (f / "colour/c001.png").write_bytes(b""), r"colour/c001\.png: not an image"),
    "png cut": (cut("depth/c001.png", 0.6), r"depth/c001\.png: the image is damaged or cut off"),
    "hand eye": (cell(role="hand_eye"), r"plate\.toml: missing; hand_eye captures need it"),
    "plate": (
        lambda f: (f / "plate.toml").write_text(PLATE_TOML.replace("0.018", "-1.0")),
        r"plate\.toml:\s+disc_radius_m",
    ),
}


@pytest.mark.parametrize(("fault", "message"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_named(folder: Path, fault: Fault, message: str) -> None:
    assert len(read_all(folder)) == 2
    fault(folder)
    with pytest.raises(InputError, match=message):
        read_all(folder)


def test_no_folder_at_all(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_folder(tmp_path / "nothing")


def test_reflector_discs_need_neither_colour_nor_classes(tmp_path: Path) -> None:
    one = capture(0, role="hand_eye", colour=None, dark=None, label=None, base_T_depth=None)
    folder = write_folder(tmp_path / "set", [one])
    (folder / "rig.toml").write_text(DEPTH_ONLY_TOML)
    (folder / "classes.toml").unlink()
    (folder / "plate.toml").write_text(PLATE_TOML)
    found = read_folder(folder)
    assert_same(next(found.captures())[0], as_imported(one, 0))
    assert found.plate is not None
    assert found.plate.positions_base_m[1] == (1.0, 0.1, 0.5)
    assert type(found.depth_rig) is DepthRig
    with pytest.raises(MissingCalibrationError, match=r"\[rgb\] and transforms\.rgb_T_depth are missing"):
        _ = found.rig


NO_TRANSFORMS = RIG_TOML.split("[transforms]")[0]


@pytest.mark.parametrize("role", ["hand_eye", "board"])
@pytest.mark.parametrize(
    ("rig", "missing"),
    [
        (NO_TRANSFORMS, r"transforms\.rgb_T_depth is missing"),
        (f"{NO_TRANSFORMS}[transforms]\n", r"transforms\.rgb_T_depth is missing"),
        (DEPTH_ONLY_TOML, r"\[rgb\] and transforms\.rgb_T_depth are missing"),
    ],
)
def test_what_is_to_be_calibrated_may_be_left_out(tmp_path: Path, role: str, rig: str, missing: str) -> None:
    one = capture(0, role=role, label=None, base_T_depth=None)
    folder = write_folder(tmp_path / "set", [one])
    (folder / "rig.toml").write_text(rig)
    (folder / "plate.toml").write_text(PLATE_TOML)
    found = read_folder(folder)
    assert_same(next(found.captures())[0], as_imported(one, 0))
    with pytest.raises(MissingCalibrationError, match=f"rig bench: {missing}.*to rig.toml"):
        _ = found.rig


@pytest.mark.parametrize("kind", ["colour", "dark", "label"])
def test_an_unknown_colour_camera_is_still_one_camera(folder: Path, kind: str) -> None:
    (folder / "rig.toml").write_text(DEPTH_ONLY_TOML)
    assert len(read_all(folder)) == 2
    shape = (8, 6) if kind == "label" else (8, 6, 3)
    write_image(folder / kind / "c001.png", np.zeros(shape, np.uint8))
    says = rf"{kind}/c001\.png: 6 × 8 pixels, rig\.toml has no \[rgb\], and .*colour/c000\.png is 8 × 6"
    with pytest.raises(InputError, match=says):
        read_all(folder)


@pytest.mark.parametrize("name", ["rig.toml", "classes.toml", "plate.toml", "captures.csv"])
def test_a_byte_order_mark_changes_nothing(folder: Path, name: str) -> None:
    (folder / "plate.toml").write_text(PLATE_TOML)
    plain = read_folder(folder)
    (folder / name).write_bytes(b"\xef\xbb\xbf" + (folder / name).read_bytes())
    marked = read_folder(folder)
    assert (marked.rig, marked.classes, marked.plate) == (plain.rig, plain.classes, plain.plate)
    assert len(marked) == len(plain)


@pytest.mark.parametrize("blank", ["  ", "\t\n \n", " , ,\n"])
def test_lines_of_white_space_are_no_captures(folder: Path, blank: str) -> None:
    with (folder / "captures.csv").open("a") as file:
        file.write(blank)
    assert len(read_folder(folder)) == 2


def test_classes_may_be_missing_where_nothing_is_classified(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set", [capture(0, role="light", label=None)])
    (folder / "classes.toml").unlink()
    assert read_folder(folder).classes is None
    (folder / "classes.toml").write_text(CLASSES_TOML.replace("names", "name"))
    with pytest.raises(ConfigurationError, match="did you mean 'names'"):
        read_folder(folder)


@pytest.mark.parametrize(
    ("name", "count", "kinds"),
    [
        ("kitchen", 14, {"depth", "colour"}),
        ("rendered", 37, {"depth", "colour"}),
        ("hand_eye_discs", 14, {"depth", "ir"}),
    ],
)
def test_real_sets(shared: Path, name: str, count: int, kinds: set[str]) -> None:
    found: FolderSet = read_folder(shared / "data" / name)
    captures = list(found.captures())
    assert len(captures) == len(found) == count
    assert isinstance(found.depth_rig, Rig) == (name != "hand_eye_discs")
    for one, encoded in captures:
        found.depth_rig.check(one)
        assert encoded.keys() - {"label"} == kinds
        assert (one.label is not None) == (one.role in ("train", "test"))


def test_rig_text_is_kept_as_it_stands(folder: Path) -> None:
    assert read_folder(folder).rig_text == RIG_TOML
