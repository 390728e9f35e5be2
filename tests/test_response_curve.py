"""The response from an exposure series: made, spoilt, found again."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from light_world import World, inverse_of, linear, power, source_of, srgb

from calibration.gates import ResponseGates
from calibration.outcome import RefusedError, plain
from calibration.response import curve as curves
from calibration.response.command import ResponseOptions, calibrate
from calibration.response.curve import Readings
from calibration.response.exposures import response_of
from surfclass.errors import InputError
from surfclass.frames import ColourFrame, DepthFrame
from surfclass.rig import Response

LEVEL = np.linspace(0, 1, 256)


def pedestal(light):
    return 0.06 + 0.94 * light


def readings(response, seed=0, sd=3e-4):
    """Two hundred places of one scene at seven exposures, in one channel."""
    rng, times = np.random.default_rng(seed), 2.0 ** np.arange(-4, 3)
    light = np.linspace(0.2, 0.5, 200) * times[:, None]
    level = np.minimum(response(light), 1.0) + rng.normal(0, sd, light.shape)
    return Readings(level, np.full_like(level, sd), (level < 0.98) & (level > 0.005), times)


def relative_error(found, response, low, high):
    """Greatest relative error of g⁻¹ between two intensities, its scale taken in the middle."""
    true, between = inverse_of(response)[0], np.logical_and(low < LEVEL, high > LEVEL)
    ratio = found[between] / true[between]
    return np.abs(ratio / np.median(ratio) - 1).max()


@pytest.mark.parametrize("response", [srgb, power])
def test_curve_is_found(response):
    found = curves.fit(readings(response), None)
    assert relative_error(found.samples(), response, found.low + 0.01, found.high) < 0.004
    assert found.dark == 0


def test_curve_goes_on_sensibly_where_nothing_was_seen():
    found = curves.fit(readings(srgb), None)
    assert found.low > 0.1
    assert relative_error(found.samples(), srgb, 0.05, 1.0) < 0.10
    assert relative_error(found.samples(), srgb, found.high, 1.0) < 0.005


def test_a_linear_camera_comes_out_linear():
    found = curves.fit(readings(linear), None)
    assert found.bend is None
    assert found.samples() == pytest.approx(LEVEL, abs=1e-8)


def test_a_pedestal_is_found_without_unlit_frames():
    found = curves.fit(readings(pedestal), None)
    assert found.bend is None
    assert found.dark == pytest.approx(0.06, abs=3e-4)
    assert found.samples()[16:] == pytest.approx((LEVEL[16:] - 0.06) / 0.94, abs=1e-3)


@given(
    exponent=st.floats(0.3, 1.2),
    bump=st.floats(-0.15, 0.15),
    seed=st.integers(0, 1000),
)
@settings(max_examples=8, deadline=None)
def test_every_curve_is_one_that_a_rig_accepts(exponent, bump, seed):
    def response(light):
        light = np.clip(light, 1e-9, 1)
        return np.clip(light**exponent + bump * light * (1 - light), 0, 1)

    found = curves.fit(readings(response, seed), None).samples()
    as_text = tuple(float(value) for value in found)
    assert Response(inverse=(as_text, as_text, as_text)).inverse is not None


@pytest.mark.slow
def test_spread_over_seeds_is_what_the_jackknife_says():
    worlds = [response_of(World().exposures(seed)) for seed in range(6)]
    middle = np.argmin(np.abs(LEVEL - 0.35))
    logs = []
    for world in worlds:
        curve = world.curves[1]
        logs.append(curve.log_irradiance(LEVEL[60:240]) - curve.log_irradiance(LEVEL[middle]))
    sampled = np.sqrt(np.mean(np.var(logs, axis=0, ddof=1)))
    predicted = np.sqrt(np.mean([world.relative_sd[1, 60:240] ** 2 for world in worlds]))
    assert 1 / 6 < sampled / predicted < 1.5  # leaving out an end's exposure costs more than its noise
    true = inverse_of(srgb)[0]
    bias = np.mean(logs, axis=0) - np.log(true[60:240] / true[middle])
    assert np.ptp(bias) < 0.004


def test_noise_is_that_of_the_sensor():
    world = World(bits=16, response=linear, noise=0.01)  # variance 1e-4 of the signal, 1e-6 without
    noise = response_of(world.exposures()).noise[1]
    assert noise.gain == pytest.approx(1e-4, rel=0.05)
    assert noise.full_well_e == pytest.approx(1e4, rel=0.05)
    assert noise.read == pytest.approx(1e-3, rel=0.15)


def test_a_raw_camera_comes_out_linear_from_its_images():
    found = response_of(World(bits=16, response=linear).exposures())
    assert found.inverse == pytest.approx(np.tile(LEVEL, (3, 1)), abs=1e-6)
    assert found.held_out_rms < 1e-3


def test_unlit_frames_tell_the_dark_level():
    def raised(light):
        return 0.05 + 0.95 * srgb(light)

    world = World(response=raised)
    captures = []
    for capture in world.exposures():
        unlit = np.full_like(capture.colour.rgb, round(255 * 0.05))
        captures.append(replace(capture, dark=ColourFrame(0, 0, capture.colour.exposure_s, unlit)))
    found = response_of(captures)
    assert found.dark_from == "dark frames"
    assert [curve.dark for curve in found.curves] == pytest.approx([0.05] * 3, abs=1 / 255)
    assert relative_error(found.inverse[1], raised, *found.seen) < 0.03


def test_light_from_elsewhere_is_no_dark_level():
    found = response_of(World().exposures(ambient=0.02))
    assert found.dark_from == "assumed"
    assert relative_error(found.inverse[1], srgb, found.seen[0] + 0.02, found.seen[1]) < 0.01


def test_long_exposures_that_are_saturated_are_left_out_and_named():
    found = response_of(World().exposures(times=(0.0006, 0.00125, 0.0025, 0.005, 0.010, 0.030, 0.100)))
    assert found.series.left_out[-1] == "exposure_6 is overexposed in 100% of its pixels"
    assert found.held_out["exposure_6"] is None
    assert relative_error(found.inverse[1], srgb, *found.seen) < 0.01


def refused(captures, match):
    with pytest.raises(RefusedError, match=match):
        response_of(captures)


def test_an_overexposed_card_is_refused_with_the_share_of_each_exposure():
    captures = World().exposures(times=(0.02, 0.04, 0.08, 0.16), albedo=(0.9, 0.9, 0.9))
    refused(captures, r"exposures are of use, needed are 3: .*exposure_3 is overexposed in 100%")


def test_an_underexposed_card_is_refused():
    captures = World().exposures(times=(1e-7, 2e-7, 4e-7))
    refused(captures, r"0 exposures are of use.*exposure_0 is underexposed in \d+% of its area")


def test_exposures_that_are_unknown_or_too_few_are_refused():
    captures = World().exposures()
    blind = replace(captures[2].colour, exposure_s=None)
    refused([*captures[:2], replace(captures[2], colour=blind)], "exposure time of exposure_2 is not known")
    refused(captures[:2], "2 captures at 2 exposure times, needed are 3")
    refused([], "0 captures")


def test_a_camera_that_sets_its_exposure_itself_is_refused():
    world, times = World(), (0.001, 0.002, 0.004, 0.008)
    captures = []
    for number, time in enumerate(times):
        capture = world.capture(f"exposure_{number}", "exposure", (0.7, 0, 0), exposure_s=0.004)
        captures.append(replace(capture, colour=replace(capture.colour, exposure_s=time)))
    refused(captures, r"does not become brighter between exposure_0 \(1 ms\) and exposure_1 \(2 ms\)")


def test_a_target_that_moved_is_refused_by_name():
    world = World()
    captures = world.exposures()
    captures[4] = world.capture("exposure_4", "exposure", (0.72, 0, 0), exposure_s=0.005)
    refused(captures, "moved between exposure_3 and exposure_4")


def test_a_light_that_changed_is_refused_by_name():
    captures = World().exposures()
    captures[3] = replace(World(gain=1.0).exposures()[3], depth=captures[3].depth)
    refused(captures, r"exposure_\d .* cannot be told from the other exposures by any response")


def test_other_sizes_of_image_are_an_error():
    captures = World().exposures()
    small = ColourFrame(0, 0, 0.001, np.zeros((60, 80, 3), np.uint8))
    depth = DepthFrame(0, 0, None, captures[0].depth.depth_mm)
    odd = replace(captures[0], colour=small, depth=depth)
    with pytest.raises(InputError, match="differ in size"):
        response_of([*captures[1:], odd])


def test_result_says_all_that_it_promises():
    world = World()
    outcome = calibrate(
        source_of(world.exposures()), ResponseOptions(), ResponseGates(), note=lambda text: None
    )
    result = plain(outcome.result)
    assert outcome.verdict == "pass", outcome.reasons
    assert {"schema", "verdict", "reasons", "a2_a1_a0", "dark_level", "noise", "rms", "held_out"} <= set(
        result
    )
    assert result["source"] == "exposure"
    assert np.shape(result["inverse"]) == (3, 256)
    assert world.rig.with_values(outcome.rig).response.inverse is not None


def test_gates_fail_a_result_and_say_by_how_much():
    gates = ResponseGates(held_out=1e-5, curve_sd=1e-6, least_range=0.99)
    outcome = calibrate(source_of(World().exposures()), ResponseOptions(), gates, note=lambda text: None)
    assert outcome.verdict == "fail"
    assert len(outcome.reasons) == 3
    assert outcome.result["verdict"] == "fail"


def test_distances_give_the_response_where_there_are_no_exposures():
    told = []
    outcome = calibrate(source_of(World().cards()), ResponseOptions(), ResponseGates(), note=told.append)
    assert outcome.result["source"] == "distance"
    assert any("no exposure series" in text for text in told)
    low, high = outcome.result["seen"]
    assert relative_error(np.array(outcome.result["inverse"])[1], srgb, low, high) < 0.10
    assert outcome.result["curve_sd"] > 0.002  # an exposure series is known ten times better


def test_distances_refuse_a_burnt_card_and_a_single_distance():
    world = World()
    burnt = world.cards(albedo=(4.0, 4.0, 4.0), distances=(0.6, 0.7, 0.8, 0.9))
    with pytest.raises(
        RefusedError, match=r"0 views of the grey card are of use.*card_600 is overexposed in"
    ):
        calibrate(source_of(burnt), ResponseOptions(), ResponseGates(), note=lambda text: None)
    alike = world.cards(distances=(0.70, 0.71, 0.72, 0.73))
    with pytest.raises(RefusedError, match=r"must be 1\.3 times as far"):
        calibrate(source_of(alike), ResponseOptions(), ResponseGates(), note=lambda text: None)


def test_thesis_mode_sets_the_polynomial_alone():
    world = World()
    rig = world.rig.with_values({"light": {"position_rgb_m": world.light.tolist()}})
    options = ResponseOptions(thesis=True)
    outcome = calibrate(source_of(world.cards(), rig), options, ResponseGates(), note=lambda text: None)
    assert set(outcome.rig["response"]) == {"a2_a1_a0"}
    assert np.shape(outcome.result["a2_a1_a0"]) == (3, 3)
    with pytest.raises(RefusedError, match=r"Eq\. 4\.4 cannot be fitted"):
        calibrate(source_of(world.cards()), options, ResponseGates(), note=lambda text: None)
