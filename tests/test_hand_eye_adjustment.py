"""The joint adjustment: make a world, corrupt it, recover it; and does it know how good it is?"""

import json
from dataclasses import replace

import numpy as np
import pytest
from hand_eye_world import (
    BASE_T_TARGET,
    CAMERA,
    FLANGE_T_CAMERA,
    arm_looks,
    board,
    observed,
    transform,
    with_poses,
)

from calibration.hand_eye.adjustment_columns import (
    Free,
    State,
    layout,
    moved,
    pixel_rows,
    position_rows,
    probed_rows,
)
from calibration.hand_eye.comparison import compare, rms_of
from calibration.hand_eye.leave_out import misses_of
from calibration.hand_eye.next_poses import propose
from calibration.hand_eye.observations import Observations, View, virtual_points
from calibration.hand_eye.problem import problem_of
from calibration.hand_eye.report import outlier_numbers, target_pose
from calibration.hand_eye.solution import solve
from calibration.rotations import difference
from surfclass.errors import InputError
from surfclass.types import Transform

FLANGE_OFFSET_M = 0.084
WORLDS = {
    "pixels": {},
    "positions": {"pixel_sd": None, "position_sd": 3e-4},
    "both": {"position_sd": 3e-4},
}


def solved(observations, **options):
    return solve(observations, FLANGE_OFFSET_M, lambda _: None, **options)


def error(solution, truth=FLANGE_T_CAMERA):
    return difference(Transform(truth.dst, truth.src, solution.fit.state.x), truth)


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("kind", WORLDS)
def test_exact_observations_give_the_exact_transform(kind, mounting):
    exact = {name: 1e-9 for name in ("pixel_sd", "position_sd") if WORLDS[kind].get(name, 1) is not None}
    exact |= {"pixel_sd": None} if kind == "positions" else {}
    exact = exact if kind != "pixels" else {"pixel_sd": 1e-9}
    found = solved(observed(0, turn_sd=0, shift_sd=0, mounting=mounting, **exact))
    assert np.abs(error(found)).max() < 1e-7
    np.testing.assert_allclose(found.fit.state.y, BASE_T_TARGET.matrix, atol=1e-7)


@pytest.mark.parametrize("kind", WORLDS)
def test_any_order_of_poses_and_points_gives_the_same_answer(kind):
    observations = observed(1, **WORLDS[kind])
    rng = np.random.default_rng(5)
    views = []
    for view in rng.permutation(np.array(observations.views, object)):
        pixel, position = (rng.permutation(len(part.target_m)) for part in (view.pixels, view.positions))
        pixels = replace(
            view.pixels,
            target_m=view.pixels.target_m[pixel],
            pixel=view.pixels.pixel[pixel],
            sd_px=view.pixels.sd_px[pixel],
        )
        positions = replace(
            view.positions,
            target_m=view.positions.target_m[position],
            camera_m=view.positions.camera_m[position],
            sd_m=view.positions.sd_m[position],
        )
        views.append(replace(view, pixels=pixels, positions=positions))
    first, again = solved(observations), solved(replace(observations, views=tuple(views)))
    np.testing.assert_allclose(again.fit.state.x, first.fit.state.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.sd, first.sd, rtol=1e-6)


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_derivatives_are_those_of_the_residuals(mounting):
    rng = np.random.default_rng(0)
    observations = observed(0, poses=3, position_sd=1e-3, mounting=mounting)
    problem = problem_of(observations, FLANGE_OFFSET_M)
    state = State(
        x=FLANGE_T_CAMERA.matrix,
        y=BASE_T_TARGET.matrix,
        target=problem.target,
        intrinsics=CAMERA.vector,
        deviation=np.zeros((3, 6)),
        scale=1.01,
        offsets=np.zeros(6),
        flange_offset_m=0.0,
    )
    free = Free(scale=True, intrinsics=9)
    places = layout(problem, free)
    for rows_of, unit in ((pixel_rows, 1e-3), (position_rows, 1e-7)):
        rows = rows_of(problem, state, free, places)
        step, deviation = 1e-7 * rng.normal(size=places.size), 1e-7 * rng.normal(size=(3, 6))
        after = rows_of(problem, moved(state, free, places, step, deviation), free, places)
        predicted = rows.by_global @ step + np.einsum("nrk,nk->nr", rows.by_deviation, deviation[rows.pose])
        np.testing.assert_allclose(rows.residual - after.residual, predicted, atol=1e-4 * unit)


def test_derivatives_by_the_arms_offsets_and_by_free_points_are_those_of_the_residuals():
    rng = np.random.default_rng(0)
    problem = problem_of(arm_looks(rng, 3, board(), probed_sd=3e-4), FLANGE_OFFSET_M)
    problem = replace(problem, shape_from_probing=True)
    nothing = np.zeros(6)
    state = State(
        FLANGE_T_CAMERA.matrix,
        BASE_T_TARGET.matrix,
        problem.target,
        np.zeros(9),
        np.zeros((3, 6)),
        1.0,
        nothing,
        0.0,
    )
    free = Free(joints=(1, 2, 3, 4), flange_offset=True)
    places = layout(problem, free)
    step, deviation = 1e-6 * rng.normal(size=places.size), np.zeros((3, 6))
    after_state = moved(state, free, places, step, deviation)
    rows, after = (position_rows(problem, one, free, places) for one in (state, after_state))
    np.testing.assert_allclose(rows.residual - after.residual, rows.by_global @ step, atol=1e-10)
    residual, columns = probed_rows(problem, state, places)
    np.testing.assert_allclose(
        residual - probed_rows(problem, after_state, places)[0], columns @ step, atol=1e-10
    )


def test_noise_of_the_arm_and_of_the_measurements_are_told_apart():
    found = solved(observed(3, poses=16, pixel_sd=0.2, turn_sd=4e-4, shift_sd=5e-5, target=board(6, 6, 0.04)))
    noise = found.fit.noise
    assert noise.pixel == pytest.approx(0.2, rel=0.1)
    assert noise.turn == pytest.approx(4e-4, rel=0.3)
    assert noise.shift < 1.5e-4


def test_points_are_weighted_by_their_stated_spread():
    observations = observed(4, poses=8, target=board(5, 5, 0.05), turn_sd=0, shift_sd=0)
    rng = np.random.default_rng(0)
    views = []
    for view in observations.views:
        bad = np.arange(25) % 2 == 0
        pixel = view.pixels.pixel + np.where(bad[:, None], rng.normal(0, 4, (25, 2)), 0)
        pixels = replace(view.pixels, pixel=pixel, sd_px=np.where(bad, 4.0, 0.15))
        views.append(replace(view, pixels=pixels))
    told = solved(replace(observations, views=tuple(views)))
    alike = [replace(view, pixels=replace(view.pixels, sd_px=np.zeros(0))) for view in views]
    untold = solved(replace(observations, views=tuple(alike)))
    assert np.linalg.norm(error(told)[3:]) < 0.5 * np.linalg.norm(error(untold)[3:])


def test_a_misplaced_point_does_not_pull():
    clean = observed(5)
    view = clean.views[3]
    pixel = view.pixels.pixel.copy()
    pixel[4] += [30, -20]
    views = list(clean.views)
    views[3] = replace(view, pixels=replace(view.pixels, pixel=pixel))
    found = solved(replace(clean, views=tuple(views)))
    assert found.fit.keep.all()
    assert np.abs(error(found) - error(solved(clean)))[3:].max() < 1e-4
    assert (found.fit.pixel_weight < 0.1).sum() == 1


@pytest.mark.parametrize("kind", WORLDS)
def test_poses_that_were_read_wrong_are_named_and_left_out(kind):
    def change(number, matrix):
        if number == 5:
            return matrix @ transform("flange", "flange", [0, 0, 0], [0.01, 0, 0]).matrix
        if number == 9:
            return matrix @ transform("flange", "flange", [0, 0.02, 0], [0, 0, 0]).matrix
        return matrix

    clean = observed(6, **WORLDS[kind])
    found = solved(with_poses(clean, change))
    assert outlier_numbers(found) == [5, 9]
    without = replace(clean, views=tuple(view for k, view in enumerate(clean.views) if k not in (5, 9)))
    np.testing.assert_allclose(found.fit.state.x, solved(without).fit.state.x, atol=1e-8)
    place = int(np.flatnonzero(found.problem.order == 5)[0])
    assert np.linalg.norm(found.left_out.deviation[place][3:]) == pytest.approx(0.01, rel=0.1)


def test_good_poses_are_not_left_out():
    for seed in range(3):
        assert solved(observed(seed + 40, position_sd=2e-4)).fit.keep.all()


def test_intrinsics_are_estimated_where_they_are_missing():
    flat = board(7, 6, 0.04)
    found = solved(replace(observed(7, poses=20, target=flat), intrinsics=None))
    assert found.fit.state.intrinsics[:4] == pytest.approx(CAMERA.vector[:4], rel=0.01)
    assert np.linalg.norm(error(found)[3:]) < 0.002
    solid = flat + np.column_stack([0 * flat[:, :2], 0.06 * (np.arange(42) % 3)])
    found = solved(replace(observed(7, poses=20, target=solid), intrinsics=None))
    assert found.fit.state.intrinsics[:4] == pytest.approx(CAMERA.vector[:4], rel=0.01)


def test_joint_offsets_are_recovered_but_for_those_that_cannot_be_seen():
    offsets = np.radians([0.1, -0.2, 0.15, 0.3, -0.1, 0.2])
    observations = arm_looks(np.random.default_rng(0), 20, board(), offsets, np.radians(0.01))
    found = solved(observations, joint_offsets=True, flange_offset=True)
    assert found.fit.free.joints == (1, 2, 3, 4)
    sd = np.sqrt(np.diag(found.left_out.parameters)[found.fit.places.joints])
    assert (np.abs(found.fit.state.offsets[1:5] - offsets[1:5]) < 3 * sd).all()
    assert (sd < np.radians(0.15)).all()
    assert set(found.arm.not_observable) == {
        "arm.flange_offset_m",
        "arm.joint_offsets_rad[0]",
        "arm.joint_offsets_rad[5]",
    }
    plain = solved(observations)
    before, after = (rms_of(s.problem, s.fit, misses_of(s.problem, s.fit.state))[1] for s in (plain, found))
    assert after < 0.7 * before


def test_joint_offsets_need_joint_angles_of_this_arm():
    with pytest.raises(InputError, match="joint angles q"):
        solved(observed(8), joint_offsets=True)
    other = arm_looks(np.random.default_rng(0), 8, board())
    views = tuple(replace(view, q=view.q + 0.1) for view in other.views)
    with pytest.raises(InputError, match="joint angles q"):
        solved(replace(other, views=views), joint_offsets=True)


def test_an_offset_that_the_poses_do_not_show_is_not_made_up():
    turned = arm_looks(np.random.default_rng(1), 12, board(), still=(0,))
    found = solved(turned, joint_offsets=True)  # joint 2's axis stands still: the target may as well turn
    assert "arm.joint_offsets_rad[1]" in found.arm.not_observable
    assert "move joints 1 and 3" in found.arm.not_observable["arm.joint_offsets_rad[1]"]
    assert 1 not in found.fit.free.joints


def test_probed_points_help_as_much_as_they_are_good():
    errors = {None: [], 1e-4: [], 3e-3: []}
    for seed in range(3):
        for sd, found in errors.items():
            observations = arm_looks(
                np.random.default_rng(seed), 5, board(), joint_sd=np.radians(0.05), probed_sd=sd
            )
            found.append(np.linalg.norm(error(solved(observations))[3:]))
    middle = {sd: float(np.median(values)) for sd, values in errors.items()}
    assert middle[1e-4] < middle[None]
    assert middle[3e-3] < 2 * middle[None]


def test_a_shape_that_is_known_only_from_probing_is_mended_by_the_views():
    observations = arm_looks(np.random.default_rng(2), 14, board(), probed_sd=1e-3)
    probed = observations.probed
    touched = {tuple(point): place for point, place in zip(probed.target_m, probed.fixed_m, strict=True)}
    views = []
    for view in observations.views:
        named = np.array([touched[tuple(point)] for point in view.positions.target_m])
        views.append(replace(view, positions=replace(view.positions, target_m=named)))
    probed = replace(probed, target_m=probed.fixed_m)
    found = solved(replace(observations, views=tuple(views), probed=probed))
    assert found.problem.shape_from_probing
    assert np.linalg.norm(error(found)[3:]) < 1e-3
    moved_points = Transform("base", "target", target_pose(found)) @ found.problem.target
    assert np.linalg.norm(moved_points - found.problem.target, axis=1).max() < 3e-3
    true = {tuple(place): point for point, place in touched.items()}
    shape = np.array([true[tuple(point)] for point in found.problem.target])
    sides, truth, stated = (
        np.linalg.norm(points[:, None] - points[None], axis=2)
        for points in (found.fit.state.target, shape, found.problem.target)
    )
    assert np.abs(sides - truth).max() < 0.3 * np.abs(stated - truth).max()


def test_proposed_poses_reduce_the_uncertainty_as_they_promise():
    observations = observed(9, poses=6, turns=(0.3, 0.3, 0.5))
    found = solved(observations)
    proposals = propose(found.problem, found.fit, observations)
    assert len(proposals) == 3
    assert proposals[0].gain > 0.2
    assert "target" in proposals[0].words
    camera = Transform("base", "flange", proposals[0].base_T_flange) @ FLANGE_T_CAMERA
    seen = camera.inverse @ (BASE_T_TARGET @ board())
    assert (seen[:, 2] > 0.2).all()


def test_the_joint_fit_predicts_left_out_real_poses_better_than_every_closed_form(shared):
    told = np.array(json.loads((shared / "data/hand_eye_pairs/pose_samples.json").read_text()))
    views = [
        View(
            str(number),
            Transform("base", "flange", flange),
            positions=virtual_points(Transform("camera", "target", target)),
            sizeless=True,
        )
        for number, (flange, target) in enumerate(told)
    ]
    found = solved(Observations("eye_to_hand", tuple(views)))
    assert found.fit.state.x[:3, 3] == pytest.approx([0.659, -0.249, 0.830], abs=0.005)
    ours = rms_of(found.problem, found.fit, found.left_out.misses)[1]
    theirs = {name: form.left_out[1] for name, form in compare(found.problem, found.fit).items()}
    assert len(theirs) == 5
    assert ours < min(theirs.values())


def spread(seeds, **world):
    found = [solved(observed(1000 + seed, **world)) for seed in range(seeds)]
    errors = np.array([error(one) for one in found])
    return errors, np.array([one.sd for one in found])


@pytest.mark.parametrize(
    ("seeds", "kind", "poses"),
    [
        (12, "pixels", 8),
        pytest.param(100, "pixels", 14, marks=pytest.mark.slow),
        pytest.param(100, "positions", 14, marks=pytest.mark.slow),
        pytest.param(100, "both", 8, marks=pytest.mark.slow),
    ],
)
def test_reported_uncertainty_is_the_sampled_one(seeds, kind, poses):
    errors, sd = spread(seeds, poses=poses, **WORLDS[kind])
    ratio = np.sqrt((sd**2).mean(axis=0)) / errors.std(axis=0)
    slack = 1 if seeds >= 100 else 1.35  # of a spread that is itself sampled
    assert (ratio < 1.5 * slack).all()
    assert (ratio > 1 / 1.5 / slack).all()
    inside = (np.abs(errors) < 3 * sd).all(axis=1)
    assert inside.mean() >= 0.95
    bias = errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(seeds))
    assert np.abs(bias).max() < 4
