from functools import cache

import numpy as np
import pytest
from board_images import BOARD, pose

from calibration.cameras.adjustment import rms_px
from calibration.cameras.boards import Board, Found, symmetries
from calibration.cameras.conditions import faults, serial_faults, square_fault
from calibration.cameras.observations import View, observations_of
from calibration.cameras.resampling import jackknife, left_out
from calibration.cameras.solution import solve
from calibration.projection import by_motion, moved, projected, projected_with_jacobians

DEPTH = np.array([585.0, 586.0, 322.0, 241.0, -0.03, 0.04, 0.0, 0.0, 0.0])
RGB = np.array([1624.0, 1623.0, 645.0, 476.0, -0.06, 0.08, 0.0006, -0.0005, 0.0])
SIZES = {"depth": (640, 480), "rgb": (1280, 960)}
RGB_T_DEPTH = pose((-0.04, -0.02, 0.01), (0.003, 0.077, 0.001))
NOISE = {"depth": 0.15, "rgb": 0.03}


@cache
def poses(count=18, tilt=0.75):
    rng = np.random.default_rng(5)
    found = []
    while len(found) < count:
        turn = rng.uniform(-tilt, tilt, 3) * (1, 1, 3)
        at = np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.45, 0.9)])
        matrix = pose(turn, at)
        matrix[:3, 3] -= matrix[:3, :3] @ BOARD.points_m.mean(axis=0)
        found.append(matrix)
    return tuple(found)


def views(seed=0, board=BOARD, chosen=None, noise=NOISE):
    """The corners that lie in each camera's image."""
    rng = np.random.default_rng(seed)
    result = []
    for index, matrix in enumerate(chosen or poses()):
        found = {}
        for name, camera, place in (("depth", DEPTH, np.eye(4)), ("rgb", RGB, RGB_T_DEPTH)):
            whole = place @ matrix
            pixel = projected(board.points_m @ whole[:3, :3].T + whole[:3, 3], camera)
            width, height = SIZES[name]
            inside = ((pixel > 0) & (pixel < (width, height))).all(axis=1)
            pixel = pixel + rng.normal(0, noise[name], pixel.shape)
            if inside.sum() >= 20:
                found[name] = Found(pixel[inside], np.flatnonzero(inside))
        result.append(View(f"v{index:02d}", found))
    return result


def solved(seen, **options):
    return solve(observations_of(seen, BOARD, SIZES), BOARD, **options)


def extrinsic_error(solution):
    left = solution.adjustment.state.to_camera[1] @ np.linalg.inv(RGB_T_DEPTH)
    return np.degrees(np.arccos(np.clip((np.trace(left[:3, :3]) - 1) / 2, -1, 1))), np.linalg.norm(
        solution.adjustment.state.to_camera[1][:3, 3] - RGB_T_DEPTH[:3, 3]
    )


def test_the_jacobians_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3)) * 0.2 + (0, 0, 1)
    camera = RGB + np.array([0, 0, 0, 0, 0.1, -0.2, 0.01, 0.02, 0.3])
    pixel, by_point, by_camera = projected_with_jacobians(points, camera)
    step = 1e-6
    for i in range(9):
        change = step * max(1, abs(camera[i])) * np.eye(9)[i]
        slope = (projected(points, camera + change) - projected(points, camera - change)) / (2 * change[i])
        assert np.allclose(by_camera[:, :, i], slope, rtol=1e-5, atol=1e-4)
    for i in range(6):
        change = step * np.eye(6)[i]
        shifted = [
            projected(points @ m[:3, :3].T + m[:3, 3], camera)
            for m in (moved(np.eye(4), change), moved(np.eye(4), -change))
        ]
        slope = (shifted[0] - shifted[1]) / (2 * step)
        assert np.allclose((by_point @ by_motion(points))[:, :, i], slope, rtol=1e-5, atol=1e-4)
    assert np.allclose(pixel, projected(points, camera))


def test_without_noise_the_world_is_recovered():
    solution = solved(views(noise={"depth": 1e-7, "rgb": 1e-7}), order=5)
    state = solution.adjustment.state
    assert np.allclose(state.parameters[0], DEPTH, rtol=1e-6, atol=1e-4)
    assert np.allclose(state.parameters[1], RGB, rtol=1e-6, atol=1e-4)
    assert extrinsic_error(solution)[1] < 1e-7


def test_with_noise_the_distortion_model_is_chosen_and_the_truth_is_near():
    solution = solved(views(1))
    assert solution.orders == (2, 4)
    angle, shift = extrinsic_error(solution)
    assert angle < 0.06
    assert shift < 5e-4
    assert not solution.outlier_views
    assert not solution.outlier_corners


def test_the_order_of_the_views_does_not_matter():
    seen = views(2)
    one, other = solved(seen), solved(seen[::-1])
    apart = one.adjustment.state.to_camera[1] - other.adjustment.state.to_camera[1]
    assert np.abs(apart).max() < 1e-8
    assert np.allclose(one.adjustment.state.parameters, other.adjustment.state.parameters, atol=1e-5)


def test_outlier_corners_and_an_outlier_view_are_named_and_left_out():
    seen = views(3)
    corners = seen[2].found["depth"].corners.copy()
    corners[4] += (6, -5)
    number = int(seen[2].found["depth"].ids[4])
    seen[2] = View(seen[2].name, {**seen[2].found, "depth": Found(corners, seen[2].found["depth"].ids)})
    bent = seen[7].found["depth"]
    wave = 8 * np.sin(np.arange(len(bent.ids)))[:, None] * np.ones(2)
    seen[7] = View(seen[7].name, {"depth": Found(bent.corners + wave, bent.ids)})
    solution = solved(seen)
    assert set(solution.outlier_views) == {"v07"}
    assert [found[:3] for found in solution.outlier_corners] == [("v02", "depth", number)]
    assert extrinsic_error(solution)[1] < 5e-4


def test_a_board_numbered_from_its_other_end_in_one_camera_does_no_harm():
    board = Board(columns=8, rows=6, square_m=0.025)
    order = symmetries(board)[1]
    seen = views(4, board)
    both = [index for index, view in enumerate(seen) if len(view.found) == 2]
    for index in both[:3]:
        found = seen[index].found["rgb"]
        renumbered = np.argsort(order)[found.ids]
        seen[index] = View(seen[index].name, {**seen[index].found, "rgb": Found(found.corners, renumbered)})
    solution = solve(observations_of(seen, board, SIZES), board)
    assert extrinsic_error(solution)[1] < 5e-4
    assert rms_px(solution.adjustment.residual) < 0.25


def test_one_camera_alone_is_enough():
    seen = [View(view.name, {"depth": view.found["depth"]}) for view in views(5) if "depth" in view.found]
    solution = solve(observations_of(seen, BOARD, {"depth": SIZES["depth"]}), BOARD)
    assert np.abs(solution.adjustment.state.parameters[0, :2] / DEPTH[:2] - 1).max() < 0.003


def test_a_held_camera_stays_as_it_is():
    solution = solved(views(6), fixed={"rgb": RGB})
    assert np.array_equal(solution.adjustment.state.parameters[1], RGB)
    assert extrinsic_error(solution)[1] < 5e-4


def test_leaving_out_a_view_in_one_step_is_leaving_it_out():
    seen = views(7)
    whole = solved(seen, order=2)
    step = left_out(whole.adjustment)[3]
    rest = solve(observations_of([view for view in seen if view.name != "v03"], BOARD, SIZES), BOARD, order=2)
    change = rest.adjustment.state.parameters[0, :4] - whole.adjustment.state.parameters[0, :4]
    assert np.allclose(step[:4], change, atol=0.15 * np.abs(change).max() + 0.01)


@pytest.mark.slow
def test_the_spread_over_seeds_is_the_reported_one():
    errors, reported = [], []
    for seed in range(24):
        solution = solved(views(seed), order=4)
        fit = solution.adjustment
        sd = np.sqrt(np.maximum(np.diag(jackknife(fit)), np.diag(fit.covariance)))
        parameters = (fit.state.parameters - np.stack([DEPTH, RGB]))[fit.free]
        shift = fit.state.to_camera[1][:3, 3] - RGB_T_DEPTH[:3, 3]
        errors.append(np.concatenate([parameters, shift]))
        reported.append(np.concatenate([sd[: len(parameters)], sd[-3:]]))
    sampled, said = np.sqrt(np.mean(np.square(errors), axis=0)), np.mean(reported, axis=0)
    ratio = sampled / said
    assert (ratio < 1.5).all()
    assert (ratio > 0.5).all()
    assert (np.abs(errors) < 3 * np.array(reported)).mean() > 0.97


def test_few_views_are_refused():
    assert "at least 4" in faults(observations_of(views()[:3], BOARD, SIZES))[0]


def test_parallel_boards_are_refused_for_the_focal_length():
    still = tuple(pose((0, 0, 0), (x, y, z)) for x in (-0.2, 0.0) for y in (-0.1, 0.0) for z in (0.6, 0.8))
    found = faults(observations_of(views(chosen=still), BOARD, SIZES))
    assert any("parallel" in fault and "focal length" in fault for fault in found)


def test_a_board_in_one_corner_is_refused_with_the_part_that_is_empty():
    corner = tuple(
        pose((0.4 * np.sin(i), 0.4 * np.cos(i), 0), (-0.55, -0.42, 1.15 + 0.01 * i)) for i in range(8)
    )
    seen = [View(view.name, {"depth": view.found["depth"]}) for view in views(chosen=corner)]
    (found,) = faults(observations_of(seen, BOARD, {"depth": SIZES["depth"]}))
    assert "the right and the bottom saw no corner" in found


def test_squares_of_another_size_than_told_are_seen_by_the_depth():
    assert square_fault(1.02, 0.025) is None
    said = square_fault(0.96, 0.025)
    assert said is not None
    assert "look like 24.0 mm, not 25 mm" in said


def test_another_cameras_serial_number_is_said():
    assert serial_faults({"colour": "A1"}, {"colour": "A1", "depth": "D7"}) == []
    (said,) = serial_faults({"colour": "A1", "depth": "D7"}, {"colour": "B2"})
    assert "B2, expected is A1" in said
