"""A wrong camera makes a wrong hand-eye, and no pose shows it: the reported uncertainty has to."""

from dataclasses import replace

import numpy as np
import pytest
from hand_eye_world import CAMERA, FLANGE_T_CAMERA, observed

from calibration.hand_eye.solution import solve
from calibration.rotations import difference
from surfclass.types import Transform

SD = (0.4, 0.4, 0.5, 0.5)


def solved(observations, **options):
    return solve(observations, 0.084, lambda _: None, **options)


def believed(observations, wrong):
    """The observations as somebody has them who takes the camera for another."""
    numbers = dict(zip(("fx", "fy", "cx", "cy"), CAMERA.vector[:4] + wrong, strict=True))
    return replace(observations, intrinsics=replace(CAMERA, **numbers))


@pytest.mark.parametrize("number", range(4))
def test_the_share_of_each_number_is_what_its_error_does(number):
    wrong = np.zeros(4)
    wrong[number] = SD[number]
    seen = observed(1, 10, pixel_sd=1e-6, turn_sd=1e-9, shift_sd=1e-9)
    told = solved(seen, pinhole_sd=wrong).camera_sd
    does = solved(believed(seen, wrong)).fit.state.x
    off = difference(Transform("f", "c", does), Transform("f", "c", FLANGE_T_CAMERA.matrix))
    assert np.linalg.norm(told) > 1e-4
    np.testing.assert_allclose(told, np.abs(off), rtol=0.25, atol=2e-6)  # the weights follow the misfit


def test_with_it_the_truth_is_inside_three_reported_standard_deviations_and_without_it_not():
    rng = np.random.default_rng(5)
    inside = {True: 0, False: 0}
    for _ in range(12):
        wrong = rng.normal(0, SD)
        seen = observed(rng, 10, pixel_sd=0.02, turn_sd=2e-5, shift_sd=2e-5)
        solution = solved(believed(seen, wrong), pinhole_sd=SD)
        off = difference(
            Transform("f", "c", solution.fit.state.x), Transform("f", "c", FLANGE_T_CAMERA.matrix)
        )
        alone = np.sqrt(solution.sd**2 - solution.camera_sd**2)
        inside[True] += (np.abs(off) <= 3 * solution.sd).all()
        inside[False] += (np.abs(off) <= 3 * alone).all()
    assert inside[True] >= 11
    assert inside[False] <= 6


def test_an_unknown_camera_uncertainty_adds_nothing():
    seen = observed(2, 8)
    assert (solved(seen).camera_sd == 0).all()
