"""Response, light and lens on captures of an independent renderer, whose light is known."""

import numpy as np
import pytest

from calibration.gates import LightGates, ResponseGates
from calibration.light.command import LightOptions, calibrate
from calibration.response.command import ResponseOptions
from calibration.response.command import calibrate as calibrate_response
from calibration.source import Source

LIGHT = np.array([-0.084, 0.037, -0.006])


def silent(text):
    pass


@pytest.fixture(scope="module")
def rendered(shared):
    return Source.open(shared / "data" / "rendered")


@pytest.fixture(scope="module")
def calibrated(rendered):
    """The rendered set with its response, found from its exposure series."""
    outcome = calibrate_response(rendered, ResponseOptions(), ResponseGates(), silent)
    assert outcome.verdict == "pass", outcome.reasons
    return rendered.with_values(outcome.rig), outcome


def run(source, **options):
    return calibrate(source, LightOptions(**options), LightGates(), silent)


def off_m(outcome):
    return np.linalg.norm(np.array(outcome.result["position_rgb_m"]) - LIGHT)


def test_a_left_out_exposure_is_predicted(calibrated):
    _, outcome = calibrated
    assert outcome.result["held_out"]["rms"] < 0.001
    assert outcome.result["left_out"] == ["exposure_7 is overexposed in 100% of its pixels"]


def test_four_boards_alone_give_the_light_within_10_mm(calibrated):
    outcome = run(calibrated[0], use="boards")
    assert off_m(outcome) < 0.010
    assert off_m(outcome) < 3 * outcome.result["sd"]["position_worst_m"]
    assert outcome.result["thesis"]["from_full_model_m"] > 0.050


@pytest.mark.slow
def test_with_the_lambertian_series_it_is_5_mm_and_k_d_is_constant(calibrated):
    outcome = run(calibrated[0])
    assert outcome.verdict == "pass", outcome.reasons
    assert off_m(outcome) < 0.005
    assert outcome.result["k_d_variation"] <= 0.015
    assert outcome.result["k_d_variation_smooth"] < 0.002
    assert outcome.result["k_d_variation_thesis"] > 3 * outcome.result["k_d_variation"]


@pytest.mark.slow
def test_the_lambertian_series_alone_is_enough(calibrated):
    outcome = run(calibrated[0], use="lambertian")
    assert off_m(outcome) < 0.010
    assert off_m(outcome) < 3 * outcome.result["sd"]["position_worst_m"]
