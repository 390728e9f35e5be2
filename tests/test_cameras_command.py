import json
import math

import cv2
import numpy as np
import pytest
from board_images import BOARD, drawn, homography_of, pose

from calibration.cameras.command import Options, calibrate
from calibration.cameras.guide import CamerasGuide
from calibration.cameras.pairs import ImagePairs, holds_pairs
from calibration.gates import CamerasGates
from calibration.outcome import RefusedError
from calibration.source import Source
from drivers.recordings import RecordingWriter
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture, ColourFrame, DepthFrame
from surfclass.rig import parse_depth_rig

CAMERA = np.array([[292.0, 0, 158], [0, 292, 121], [0, 0, 1]])
RGB_T_DEPTH = pose((0.02, -0.01, 0.0), (0.0, 0.04, 0.0))
BOARD_TOML = "columns = 9\nrows = 6\nsquare_m = 0.025\n"
_GRID = "size = [320, 240]\nfx = 300.0\nfy = 300.0\ncx = 159.5\ncy = 119.5\n"
RIG_TOML = (
    f'schema = 1\nname = "bench"\nvoxel_size_m = 0.01\n[depth]\n{_GRID}[rgb]\n{_GRID}'
    "vignetting = [-0.5, 0.0, 0.0]\n"
)
TURNS = (
    (0.1, 0, 0), (0.5, 0, 0.2), (-0.5, 0, 0.1), (0, 0.5, 0), (0, -0.5, 1.4), (0.4, 0.4, 0.3), (-0.4, 0.4, 0),
    (0.4, -0.4, 1.5), (-0.4, -0.4, 0),
)  # fmt: skip


def poses():
    """All over the image, near enough for 12 px a square."""
    for index, turn in enumerate(TURNS):
        matrix = pose(turn, (0, 0, 0))
        at = (0.10 * math.cos(1.9 * index), 0.07 * math.sin(1.3 * index), 0.44 + 0.02 * (index % 4))
        matrix[:3, 3] = at - matrix[:3, :3] @ BOARD.points_m.mean(axis=0)
        yield matrix


def captured(index, matrix, depth_scale=1.0):
    images = [
        drawn(BOARD, homography_of(BOARD, CAMERA, place @ matrix), (320, 240))
        for place in (np.eye(4), RGB_T_DEPTH)
    ]
    ir, grey = (np.round(255 * image).astype(np.uint8) for image in images)
    y, x = np.mgrid[:240, :320]
    ray = np.stack([(x - 158) / 292, (y - 121) / 292, np.ones(x.shape)])
    plane = matrix[:3, 2] @ matrix[:3, 3] / np.tensordot(matrix[:3, 2], ray, axes=1)
    depth = np.clip(np.round(1000 * depth_scale * plane), 0, 65535).astype(np.uint16)
    t = 10**9 * (index + 1)
    colour = ColourFrame(t, index, 0.01, np.repeat(grey[..., None], 3, axis=2))
    return Capture(f"v{index}", "board", DepthFrame(t, index, None, depth, ir), colour)


@pytest.fixture(scope="module")
def captures():
    return [captured(index, matrix) for index, matrix in enumerate(poses())]


def recorded(path, captures, board=BOARD_TOML):
    with RecordingWriter(path, RIG_TOML, None, board_text=board) as writer:
        for capture in captures:
            writer.write(capture)
    return Source.open(path)


def solved(source, **options):
    return calibrate(source, Options(**options), CamerasGates(), lambda _: None)


def test_a_recording_gives_both_cameras_and_what_is_between_them(captures, tmp_path):
    outcome = solved(recorded(tmp_path / "a.mcap", captures))
    result = outcome.result
    assert outcome.verdict == "pass", outcome.reasons
    assert json.loads(json.dumps(result, allow_nan=False))["schema"] == 1
    for name in ("depth", "rgb"):
        assert outcome.rig[name]["fx"] == pytest.approx(292, rel=3e-3)
        assert result["rms_px"][name] < 0.1
    assert np.abs(np.array(outcome.rig["transforms"]["rgb_T_depth"]) - RGB_T_DEPTH).max() < 2e-3
    assert result["depth"]["scale"] == pytest.approx(1, abs=3e-3)
    assert "depth_correction" not in outcome.rig
    # What was there and is not calibrated here stays.
    rig = parse_depth_rig(RIG_TOML, "rig.toml").with_values(outcome.rig)
    assert rig.rgb is not None
    assert rig.rgb.vignetting == (-0.5, 0.0, 0.0)
    for name, draw in outcome.pictures.items():
        draw(tmp_path / f"{name}.png")
        assert cv2.imread(str(tmp_path / f"{name}.png")) is not None
    assert {table.title for table in outcome.figures} == {"Cameras", "Views"}


def test_colour_alone_or_ir_alone_is_enough_for_that_camera(captures, tmp_path):
    bare = [
        Capture(one.name, "board", DepthFrame(one.t_ns, 1, None, one.depth.depth_mm), one.colour)
        for one in captures
    ]
    outcome = solved(recorded(tmp_path / "a.mcap", bare))
    assert set(outcome.rig) == {"rgb"}
    assert not outcome.result["depth"]["judged"]
    assert "wrong size of the squares" in outcome.result["depth"]["note"].replace("\n", " ")


def test_a_wrong_square_size_is_refused_by_the_depth(captures, tmp_path):
    source = recorded(tmp_path / "a.mcap", captures, BOARD_TOML.replace("0.025", "0.0265"))
    with pytest.raises(RefusedError, match=r"look like 25\.0 mm, not 26\.5 mm"):
        solved(source)


def test_another_board_than_told_is_named(captures, tmp_path):
    source = recorded(tmp_path / "a.mcap", captures[:1], BOARD_TOML.replace("9", "7"))
    with pytest.raises(RefusedError, match="--board 9x6"):
        solved(source)


def test_a_depth_sensor_that_reads_too_far_is_corrected(tmp_path):
    made = [captured(index, matrix, 1.015) for index, matrix in enumerate(poses())]
    outcome = solved(recorded(tmp_path / "a.mcap", made))
    assert outcome.rig["depth_correction"]["multiplier"][0] == pytest.approx(1 / 1.015, abs=3e-3)


def test_an_older_correction_that_is_not_needed_any_more_is_taken_back(captures, tmp_path):
    source = recorded(tmp_path / "a.mcap", captures)
    older = source.with_values({"depth_correction": {"multiplier": [0.97]}})
    assert solved(older).rig["depth_correction"] == {"multiplier": [1.0], "inverse_offset_per_m": 0.0}


def test_no_board_told_is_an_error_that_says_how_to_tell_it(captures, tmp_path):
    with pytest.raises(ConfigurationError, match="--board 9x6 --square-mm 25"):
        solved(recorded(tmp_path / "a.mcap", captures[:1], None))


def test_few_views_are_refused(captures, tmp_path):
    with pytest.raises(RefusedError, match="at least 4"):
        solved(recorded(tmp_path / "a.mcap", captures[:3]))


def test_the_guide_takes_new_views_refuses_known_and_blurred_ones_and_says_what_is_next(captures):
    guide = CamerasGuide(parse_depth_rig(RIG_TOML, "rig.toml"), BOARD)
    assert "flat" in guide.next_step()
    assert guide.look(captures[0]).accepted
    again = guide.look(captures[0])
    assert not again.accepted
    assert "like one that is there" in again.reasons[0]
    assert again.picture.shape == (480, 1280, 3)
    assert "nearer" in guide.next_step()
    empty = np.zeros((240, 320), np.uint8)
    nothing = Capture("n", "board", DepthFrame(1, 1, None, captures[0].depth.depth_mm, empty), None)
    assert "whole" in guide.look(nothing).reasons[0]
    for one in captures[1:]:
        guide.look(one)
    assert guide.progress()[0] >= 7
    assert guide.coverage()["tilts"] == 1.0


def write_pairs(folder, captures, names=("ir", "rgb")):
    for index, one in enumerate(captures):
        cv2.imwrite(str(folder / f"{names[0]}{index:02d}.png"), one.depth.ir)
        cv2.imwrite(str(folder / f"{names[1]}{index:02d}.png"), one.colour.rgb)


def test_a_folder_of_pairs_needs_no_rig(captures, tmp_path):
    write_pairs(tmp_path, captures)
    assert holds_pairs(tmp_path)
    outcome = solved(ImagePairs.open(tmp_path), board=BOARD)
    assert np.abs(np.array(outcome.result["rgb_T_ir"]) - RGB_T_DEPTH).max() < 2e-3
    assert outcome.rig == {}


def test_a_folder_without_pairs_says_how_they_are_named(tmp_path):
    (tmp_path / "photo.png").write_bytes(b"")
    assert not holds_pairs(tmp_path)
    with pytest.raises(InputError, match=r"left01\.jpg"):
        ImagePairs.open(tmp_path)


def test_the_published_pairs_are_matched(shared, tmp_path):
    outcome = solved(ImagePairs.open(shared / "data" / "checkerboard_pairs"), board=BOARD)
    rms = outcome.result["rms_px"]
    assert outcome.verdict == "pass", outcome.reasons
    assert rms["left"] <= 0.20
    assert rms["right"] <= 0.21
    assert outcome.result["rms_stereo_px"] <= 0.22
    baseline = np.linalg.norm(np.array(outcome.result["right_T_left"])[:3, 3])
    assert baseline == pytest.approx(0.0834, abs=0.001)
