"""Response and light in the simulated cell, whose optics are none of the solver's code."""

import numpy as np
import pytest
from light_world import source_of

from calibration.gates import LightGates, ResponseGates
from calibration.light.command import LightOptions, calibrate
from calibration.response.command import ResponseOptions
from calibration.response.command import calibrate as calibrate_response
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.frames import Capture, ColourFrame, DepthFrame
from surfclass.rig import parse_rig

EXPOSURES = (0.0003, 0.000625, 0.00125, 0.0025, 0.005, 0.010, 0.020)


def captured(world, view, name, role, raw, exposure_s=0.010):
    render = world.render_raw if raw else world.render_colour
    key = sum(map(ord, name))
    image = render(view.q, 1.0, key, exposure_s=exposure_s)
    depth_mm, _ = world.render_depth(view.q, key)
    return Capture(name, role, DepthFrame(0, 0, None, depth_mm), ColourFrame(0, 0, exposure_s, image))


@pytest.mark.slow
@pytest.mark.parametrize("raw", [False, True])
def test_default_poses_give_the_light_within_2_mm(raw):
    card, board = SimWorld("grey_card", 3, scale=0.5), SimWorld("highlight_board", 3, scale=0.5)
    captures = [captured(board, view, view.name, "light", raw) for view in board.viewpoints]
    captures += [captured(card, view, view.name, "response", raw) for view in card.viewpoints]
    middle = card.viewpoints[3]
    captures += [
        captured(card, middle, f"exposure_{index}", "exposure", raw, time)
        for index, time in enumerate(EXPOSURES)
    ]
    full = parse_rig(truth.rig(card, raw), "truth")
    told = full.model_dump(by_alias=True, exclude_unset=True)
    for unknown in ("light", "response"):
        told.pop(unknown)
    told["rgb"].pop("vignetting")
    source = source_of(captures, type(full).model_validate(told))

    response = calibrate_response(source, ResponseOptions(), ResponseGates(), lambda text: None)
    assert response.verdict == "pass", response.reasons
    assert response.result["linear"] == [raw] * 3
    assert response.result["noise"]["full_well_e"][1] == pytest.approx(12000, rel=0.05)

    source = source.with_values(response.rig)
    outcome = calibrate(source, LightOptions(), LightGates(), lambda text: None)
    assert outcome.verdict == "pass", outcome.reasons
    away = np.array(outcome.result["position_rgb_m"]) - full.light.position_rgb_m
    assert np.linalg.norm(away) < 0.002
    assert (np.abs(away) < 3 * np.array(outcome.result["sd"]["position_m"])).all()
    assert outcome.result["axis_rgb"] == pytest.approx(full.light.axis_rgb, abs=0.003)
    assert outcome.result["falloff_exponent"] == pytest.approx(full.light.falloff_exponent, abs=0.05)
    assert outcome.result["k_d_variation_smooth"] < 0.003
