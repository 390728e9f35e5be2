import contextlib
from functools import cache

import cv2
import numpy as np
import pytest
from board_images import BOARD, corners_of, drawn, homography_of, pose, speckled
from hypothesis import given
from hypothesis import strategies as st

from calibration.cameras.boards import Board, find_board, size_seen, symmetries
from drivers.recordings.board import parse_board
from surfclass.errors import ConfigurationError, InputError

CAMERA = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
SIZE = (640, 480)
TILTED = pose((0.35, -0.3, 0.2), (-0.09, -0.05, 0.62))


@cache
def tilted():
    return view(TILTED)


def view(camera_T_board):
    homography = homography_of(BOARD, CAMERA, camera_T_board)
    return drawn(BOARD, homography, SIZE), corners_of(BOARD, homography)


def error(found, corners):
    assert found is not None
    return np.sqrt(((found.corners - corners[found.ids]) ** 2).mean())


def test_a_clear_boards_corners_are_right_to_a_hundredth_of_a_pixel():
    image, corners = tilted()
    found = find_board((255 * image).astype(np.uint8), BOARD)
    assert error(found, corners) < 0.02
    assert found.ids.tolist() == list(range(54))


def test_speckle_leaves_corners_without_bias_and_to_a_quarter_of_a_pixel():
    image, corners = tilted()
    errors = []
    for seed in range(3):
        found = find_board(speckled(image, np.random.default_rng(seed)), BOARD)
        errors.append(found.corners - corners[found.ids])
    left = np.concatenate(errors)
    assert np.sqrt((left**2).mean()) < 0.25
    assert np.abs(left.mean(axis=0)).max() < 0.04


def test_weights_by_the_noise_beat_opencvs_refinement_on_speckle_at_least_twice():
    image, corners = tilted()
    ir = speckled(image, np.random.default_rng(7))
    ours = error(find_board(ir, BOARD), corners)
    grey = np.clip(ir / 4, 0, 255).astype(np.uint8)
    start = (corners + np.random.default_rng(1).normal(0, 0.5, corners.shape)).astype(np.float32)
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    theirs = cv2.cornerSubPix(grey, start.reshape(-1, 1, 2), (6, 6), (-1, -1), ends).reshape(-1, 2)
    assert ours < 0.5 * np.sqrt(((theirs - corners) ** 2).mean())


def test_corners_keep_their_numbers_when_the_board_is_turned_over_half():
    image, corners = view(pose((0.3, -0.2, np.pi - 0.1), (0.1, 0.07, 0.6)))
    assert error(find_board((255 * image).astype(np.uint8), BOARD), corners) < 0.05


def test_faint_contrast_is_enough():
    image, corners = tilted()
    assert error(find_board((40 + 25 * image).astype(np.uint8), BOARD), corners) < 0.1


def test_a_colour_image_is_read_as_a_grey_one():
    image, corners = tilted()
    rgb = np.repeat((60000 * image).astype(np.uint16)[..., None], 3, axis=2)
    assert error(find_board(rgb, BOARD, quick=True), corners) < 0.1


def test_a_board_that_is_partly_outside_is_not_found():
    image, _ = view(pose((0, 0, 0), (-0.4, -0.05, 0.6)))
    assert find_board((255 * image).astype(np.uint8), BOARD) is None


def test_nothing_is_found_in_noise():
    rng = np.random.default_rng(0)
    assert find_board(rng.integers(0, 255, (240, 320)).astype(np.uint8), BOARD) is None


def test_the_size_of_another_board_is_told():
    image, _ = tilted()
    assert size_seen((255 * image).astype(np.uint8)) == (9, 6)


def test_the_boards_outer_edge_is_no_row_of_corners():
    image, _ = tilted()
    assert find_board((255 * image).astype(np.uint8), Board(columns=10, rows=6, square_m=0.025)) is None


def test_an_image_of_another_shape_is_refused():
    with pytest.raises(InputError, match="image of shape"):
        find_board(np.zeros((4, 4, 2), np.uint8), BOARD)


@pytest.mark.parametrize(
    ("columns", "rows", "count"), [(9, 6, 1), (8, 6, 2), (7, 7, 2), (6, 6, 4), (7, 5, 2)]
)
def test_a_boards_symmetries_are_those_that_keep_the_squares_colours(columns, rows, count):
    board = Board(columns=columns, rows=rows, square_m=0.02)
    orders = symmetries(board)
    assert len(orders) == count
    points = board.points_m
    for order in orders:
        moved, still = points[order], points
        distance = np.linalg.norm(moved[:, None] - moved[None], axis=-1)
        assert np.allclose(distance, np.linalg.norm(still[:, None] - still[None], axis=-1))


def test_a_charuco_board_is_found_where_half_of_it_is_hidden():
    board = Board(kind="charuco", columns=7, rows=5, square_m=0.03, dictionary="DICT_5X5_100", marker_m=0.022)
    pattern = cv2.aruco.CharucoBoard(
        (8, 6), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )
    image = pattern.generateImage((800, 600))
    whole = find_board(image, board)
    assert whole is not None
    assert len(whole.ids) == 35
    places = (board.points_m[whole.ids, :2] / 0.03 + 1) * 100 - 0.5
    assert np.abs(whole.corners - places).max() < 0.6
    image[:, 450:] = 128
    half = find_board(image, board)
    assert half is not None
    assert 6 <= len(half.ids) < 35
    assert np.abs(half.corners - (board.points_m[half.ids, :2] / 0.03 + 1) * 100 + 0.5).max() < 0.6


def test_an_unknown_dictionary_is_refused_with_those_that_there_are():
    board = Board(kind="charuco", columns=7, rows=5, square_m=0.03, dictionary="DICT_9X9", marker_m=0.02)
    with pytest.raises(ConfigurationError, match="DICT_5X5_100"):
        find_board(np.zeros((40, 40), np.uint8), board)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("columns = 9\nrows = 6", "square_m: missing"),
        ("columns = 2\nrows = 6\nsquare_m = 0.1", "columns"),
        ('kind = "charuco"\ncolumns = 9\nrows = 6\nsquare_m = 0.1', "needs dictionary and marker_m"),
        ("columns = 9\nrows = 6\nsquare_m = 0.1\nmarker_m = 0.05", "belong to kind"),
        (
            'kind = "charuco"\ncolumns = 9\nrows = 6\nsquare_m = 1.0\ndictionary = "DICT_4"\nmarker_m = 1.0',
            "not below square_m",
        ),
    ],
)
def test_a_faulty_board_file_names_its_fault(text, says):
    with pytest.raises(ConfigurationError, match=says):
        parse_board(text, "board.toml")


@given(st.text(max_size=60))
def test_any_text_is_a_board_or_a_configuration_error(text):
    with contextlib.suppress(ConfigurationError):
        assert parse_board(text, "board.toml").columns >= 3


@given(st.integers(3, 100), st.integers(3, 100), st.floats(1e-3, 1.0, allow_nan=False), st.floats(0.1, 0.9))
def test_every_board_that_is_written_is_read_again(columns, rows, square_m, share):
    text = f"columns = {columns}\nrows = {rows}\nsquare_m = {square_m!r}\n"
    board = parse_board(text, "board.toml")
    assert board.points_m.shape == (columns * rows, 3)
    assert np.allclose(board.points_m[-1], [(columns - 1) * square_m, (rows - 1) * square_m, 0])
    marked = f'kind = "charuco"\ndictionary = "DICT_4X4_50"\nmarker_m = {share * square_m!r}\n'
    assert parse_board(text + marked, "board.toml").marker_m == share * square_m
