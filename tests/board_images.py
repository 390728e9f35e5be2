"""Images of boards with known corners, for the tests of detection."""

import cv2
import numpy as np

from calibration.cameras.boards import Board

BOARD = Board(columns=9, rows=6, square_m=0.025)
_MARGIN = 2  # squares of white around


def pose(rotation, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(rotation, np.float64))[0]
    matrix[:3, 3] = translation
    return matrix


def homography_of(board, camera_matrix, camera_T_board):
    """Takes the board's x, y (m) to pixels."""
    return camera_matrix @ np.column_stack([camera_T_board[:3, :2], camera_T_board[:3, 3]])


def corners_of(board, homography):
    return cv2.perspectiveTransform(board.points_m[None, :, :2], homography)[0]


def drawn(board, homography, size, blur_px=0.7, dark=0.1, light=0.9):
    """A checkerboard (h, w) float64 that is integrated over the pixels: 3 × 3 samples each, then blurred."""
    columns, rows = board.columns + 1, board.rows + 1
    fine = 3
    v, u = (np.mgrid[: size[1] * fine, : size[0] * fine] + 0.5) / fine - 0.5
    place = cv2.perspectiveTransform(np.stack([u, v], axis=-1).reshape(1, -1, 2), np.linalg.inv(homography))
    s, t = (place[0] / board.square_m).reshape(size[1] * fine, size[0] * fine, 2).transpose(2, 0, 1) + 1
    inside = (s >= 0) & (s < columns) & (t >= 0) & (t < rows)
    black = inside & ((np.floor(s) + np.floor(t)) % 2 == 0)
    outside = (np.abs(s - columns / 2) > columns / 2 + _MARGIN) | (np.abs(t - rows / 2) > rows / 2 + _MARGIN)
    image = np.where(black, dark, np.where(outside, 0.35, light))
    image = image.reshape(size[1], fine, size[0], fine).mean(axis=(1, 3))
    return cv2.GaussianBlur(image, (0, 0), blur_px)


def speckled(image, rng, width_px=0.9):
    """The image in a projector's light: 16 bits."""
    draw = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), width_px)
    dots = 0.35 + 0.9 * (np.clip(draw / draw.std(), -0.7, None) + 0.7)
    counts = 400 * image * dots + 6
    return np.clip(counts + np.sqrt(counts + 9) * rng.normal(size=image.shape), 0, 1023).astype(np.uint16)
