"""Light and lens from boards: made, spoilt, found again; what cannot be found is refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from light_world import DISTANCES, LIGHT, POSES, RIG, World, inverse_of, known, source_of, srgb

from calibration.gates import LightGates
from calibration.light import near_light
from calibration.light.command import LightOptions, calibrate
from calibration.light.estimate import estimate_light, starting_position
from calibration.light.guide import LightGuide
from calibration.light.near_light import Observed
from calibration.light.photometry import photometry_from
from calibration.light.samples import board_plane, sample_board
from calibration.light.thresholds import thresholds
from calibration.outcome import RefusedError, plain
from calibration.response.guide import ResponseGuide
from calibration.rotations import rotation_matrix
from surfclass.colour import as_fraction
from surfclass.errors import InputError
from surfclass.frames import ColourFrame

WORLD = World()


def views_of(captures, world=WORLD):
    return [sample_board(capture, world.rig, inverse_of(world.response), 0.010) for capture in captures]


def off_mm(estimate):
    return 1e3 * np.linalg.norm(estimate.fit.position - LIGHT)


def run(captures, rig=None, **options):
    source = source_of(captures, rig or known(WORLD))
    return calibrate(source, LightOptions(**options), LightGates(), note=lambda text: None)


@pytest.fixture(scope="module")
def boards():
    return views_of(WORLD.boards())


@pytest.fixture(scope="module")
def cards():
    return views_of(WORLD.cards())


def test_derivatives_are_those_of_the_model(boards, cards):
    observed = Observed.of([boards[0].of(np.arange(len(boards[0].ray)) % 9 == 0), cards[0], boards[3]])
    parameters = near_light.starting_point(observed, LIGHT)
    parameters[3:6] = 0.05, 0.03, 1.3
    _, _, matrix = near_light.with_jacobian(parameters, observed)
    for index in range(observed.size):
        step = np.zeros(observed.size)
        step[index] = 1e-6
        high, low = (sum(near_light.emitted(parameters + sign * step, observed)) for sign in (1, -1))
        slope = (high - low) / 2e-6
        assert matrix[:, index] == pytest.approx(slope, abs=2e-4 * np.abs(slope).max()), index


@pytest.mark.parametrize("coat", [0.0, 1.0])
def test_boards_alone_give_light_and_lens(coat):
    world = World(coat=coat)
    estimate = estimate_light(views_of(world.boards(), world))
    assert off_mm(estimate) < 2.0
    assert estimate.fit.exponent == pytest.approx(1.3, abs=0.1)
    axis = np.array(world.axis) / np.linalg.norm(world.axis)
    assert estimate.fit.axis == pytest.approx(axis, abs=0.005)
    r2 = 0.2
    v2, v4, v6 = estimate.fit.vignetting - np.array(world.vignetting)
    assert abs(v2 * r2 + v4 * r2**2 + v6 * r2**3) < 0.01
    assert estimate.position_sd < 0.004
    assert estimate.fit.parameters[near_light.COAT] == pytest.approx(coat, abs=0.3)


def turned(views, about):
    """The boards as somebody has them whose `rgb_T_depth` is turned by the rotation vector `about`."""
    planes = [replace(view.plane, normal=rotation_matrix(about) @ view.plane.normal) for view in views]
    return [replace(view, plane=plane) for view, plane in zip(views, planes, strict=True)]


def test_what_is_between_the_cameras_counts_since_no_view_shows_its_error(boards):
    sd = 8e-4
    unaware = estimate_light(boards)
    aware = estimate_light(boards, between_sd=(sd, sd, sd, 0, 0, 0))
    assert aware.fit.position == pytest.approx(unaware.fit.position)
    off = np.zeros(3)
    for about in np.diag([sd, sd, sd]):
        off += (estimate_light(turned(boards, about)).fit.position - unaware.fit.position) ** 2
    added = np.diag(aware.covariance)[:3] - np.diag(unaware.covariance)[:3]
    assert np.sqrt(added) == pytest.approx(np.sqrt(off), rel=0.3, abs=3e-4)
    assert np.sqrt(added).max() > 2e-4


def test_cards_make_it_better(boards, cards):
    both, alone = estimate_light([*boards, *cards]), estimate_light(boards)
    assert off_mm(both) < 0.5
    assert both.position_sd < 0.5 * alone.position_sd
    assert both.held_out_rms < 0.003


def test_order_of_the_views_does_not_matter(boards, cards):
    some = [*boards, *cards[::3]]
    mixed = [some[index] for index in np.random.default_rng(0).permutation(len(some))]
    one, other = estimate_light(some), estimate_light(mixed)
    assert other.fit.position == pytest.approx(one.fit.position, abs=1e-8)
    assert other.covariance == pytest.approx(one.covariance, rel=1e-2, abs=1e-12)


def test_truth_is_inside_three_sd_and_the_spread_is_no_more_than_reported():
    estimates = [estimate_light(views_of(WORLD.boards(seed))) for seed in range(3)]
    away = np.array([estimate.fit.position - LIGHT for estimate in estimates])
    sd = np.array([np.sqrt(np.diag(estimate.covariance)[:3]) for estimate in estimates])
    assert (np.abs(away) < 3 * sd).all()
    assert (away.std(axis=0, ddof=1) < 1.5 * np.sqrt((sd**2).mean(axis=0))).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["boards", "all"])
def test_truth_is_inside_three_sd_over_many_seeds(kind):
    away, sd = [], []
    for seed in range(40):
        captures = WORLD.boards(seed) + (WORLD.cards(seed, DISTANCES[::2]) if kind == "all" else [])
        estimate = estimate_light(views_of(captures))
        away.append(estimate.fit.position - LIGHT)
        sd.append(np.sqrt(np.diag(estimate.covariance)[:3]))
    away, sd = np.array(away), np.array(sd)
    assert (np.abs(away) < 3 * sd).all(axis=1).mean() >= 0.95
    reported = np.sqrt((sd**2).mean(axis=0))
    assert (away.std(axis=0, ddof=1) < 1.5 * reported).all()
    assert (np.abs(away.mean(axis=0)) < reported).all()


def test_dirt_on_a_board_does_little():
    captures = WORLD.boards()
    image = captures[1].colour.rgb.copy()
    image[20:50, 20:60] = image[20:50, 20:60] // 2
    captures[1] = replace(captures[1], colour=replace(captures[1].colour, rgb=image))
    assert off_mm(estimate_light(views_of(captures))) < 5.0


def test_a_board_that_does_not_fill_the_image_is_cut_out():
    capture = WORLD.boards()[0]
    depth, image = capture.depth.depth_mm.copy(), capture.colour.rgb.copy()
    depth[:, :55] = 1900  # the wall behind
    image[:, :43] = 30
    small = replace(
        capture,
        depth=replace(capture.depth, depth_mm=depth),
        colour=replace(capture.colour, rgb=image),
    )
    whole, part = board_plane(capture, RIG), board_plane(small, RIG)
    assert part.normal == pytest.approx(whole.normal, abs=2e-3)
    assert part.offset == pytest.approx(whole.offset, abs=1e-3)
    views = views_of([small])
    assert 0.4 < len(views[0].ray) / len(views_of([capture])[0].ray) < 0.95
    assert views[0].level.min() > 0.25  # no place of the wall is among them


def test_no_plane_is_an_error_that_names_the_capture():
    capture = WORLD.boards()[0]
    rough = np.random.default_rng(0).integers(500, 2500, capture.depth.depth_mm.shape).astype(np.uint16)
    clutter = replace(capture, depth=replace(capture.depth, depth_mm=rough))
    with pytest.raises(InputError, match=r"board_0: only \d+% of the depth readings lie on one plane"):
        board_plane(clutter, RIG)


def test_mirrored_rays_start_the_search_near_the_light(boards):
    assert np.linalg.norm(starting_position(boards) - LIGHT) < 0.15
    assert np.linalg.norm(starting_position([])) == 0


def test_unlit_frames_take_ambient_light_off():
    lit = [WORLD.capture(f"b{k}", "light", pose, gloss=0.5, ambient=0.02) for k, pose in enumerate(POSES)]
    assert off_mm(estimate_light(views_of(lit))) < 3.0
    left = estimate_light(views_of([replace(capture, dark=None) for capture in lit]))
    assert off_mm(left) > 10.0


def test_other_exposures_are_scaled():
    captures = [
        WORLD.capture(f"card_{k}", "response", (distance, 0, 0), exposure_s=0.010 * distance)
        for k, distance in enumerate((0.6, 0.75, 0.9, 1.1))
    ]
    assert off_mm(estimate_light([*views_of(WORLD.boards()), *views_of(captures)])) < 1.0


@pytest.mark.parametrize("level", [0.7, 1.4])
def test_thresholds_follow_the_image(level):
    """The same board, darker or lighter: 0.7 of full scale would miss the one and swallow the other."""
    captures = World(gain=0.75 * level).boards()
    image = as_fraction(captures[2].colour.rgb).mean(axis=0)
    search = thresholds(image, np.ones(image.shape, bool))
    corner = image[:20, :20].mean()
    assert search.diffuse_below > corner
    share = (image > search.specular_above).mean()
    assert 0.002 < share < 0.15
    assert search.diffuse_below <= search.specular_above < 1


def test_a_board_without_highlight_has_no_thresholds():
    image = as_fraction(WORLD.cards()[4].colour.rgb).mean(axis=0)
    with pytest.raises(InputError, match="there is no highlight"):
        thresholds(image, np.ones(image.shape, bool))


def test_result_says_all_that_it_promises(boards):
    outcome = run(WORLD.boards() + WORLD.cards(distances=(0.7, 0.9, 1.1)))
    assert outcome.verdict == "pass", outcome.reasons
    result = plain(outcome.result)
    promised = {
        "verdict",
        "position_rgb_m",
        "axis_rgb",
        "falloff_exponent",
        "vignetting",
        "sd",
        "k_d_variation",
    }
    assert promised | {"schema", "reasons", "boards", "held_out", "thesis", "correlations"} <= set(result)
    assert result["position_rgb_m"] == pytest.approx(LIGHT, abs=1e-3)
    assert result["k_d_variation"] < 0.02 < result["k_d_variation_thesis"]
    assert result["k_d_variation_smooth"] < 0.003
    rig = known(WORLD).with_values(outcome.rig)
    assert rig.light.falloff_exponent == result["falloff_exponent"]
    assert rig.rgb.vignetting == tuple(result["vignetting"])
    assert len(result["boards"]) == 7
    assert np.shape(result["correlations"]["matrix"]) == (10, 10)


def test_thesis_mode_gives_the_position_alone_and_a_worse_one():
    outcome = run(WORLD.boards(), thesis=True)
    assert set(outcome.rig) == {"light"}
    assert set(outcome.rig["light"]) == {"position_rgb_m"}
    away = np.linalg.norm(np.array(outcome.result["position_rgb_m"]) - LIGHT)
    assert 0.005 < away < 0.6


def test_a_gate_fails_the_result_with_the_figure():
    gates = LightGates(position_sd_m=1e-6, k_d_variation=1e-4, held_out=1e-6)
    captures = WORLD.boards() + WORLD.cards(distances=(0.7, 0.9, 1.1))
    outcome = calibrate(source_of(captures, known(WORLD)), LightOptions(), gates, note=lambda text: None)
    assert outcome.verdict == "fail"
    assert "allowed are 0.001 mm" in outcome.reasons[0]
    assert "most within card_1100" in outcome.reasons[1]


def refused(captures, match, **options):
    with pytest.raises(RefusedError, match=match):
        run(captures, **options)


def test_no_board_at_all_is_refused():
    refused([], "no capture of role 'light' or 'response'")
    refused(WORLD.cards()[:3], "no capture of role 'light'", use="boards")


def test_too_few_views_are_refused_with_what_is_needed():
    refused(
        WORLD.boards()[:2], "2 boards and 0 views of a grey card .* needed are 3 differently turned boards"
    )
    refused(WORLD.cards(distances=(0.70, 0.72, 0.74, 0.76)), r"farthest over nearest: 1\.09")


def test_an_overexposed_grey_card_is_refused_with_its_share():
    burnt = WORLD.cards(albedo=(3.0, 3.0, 3.0), distances=(0.6, 0.7, 0.8, 0.9))
    refused(burnt, r"4 of 4 views of the grey card are badly exposed: card_600 is overexposed in \d+% of")


def test_one_burnt_view_is_left_out_and_named(boards, cards):
    burnt = views_of(WORLD.cards(albedo=(3.0, 3.0, 3.0), distances=(0.5,)))
    estimate = estimate_light([*boards, *cards[3:6], *burnt])
    assert estimate.left_out == ("card_500 is overexposed in 100% of the board",)
    assert off_mm(estimate) < 1.0


def test_missing_response_is_found_first_or_asked_for():
    captures = WORLD.boards() + WORLD.exposures()
    told = []
    outcome = calibrate(source_of(captures, RIG), LightOptions(), LightGates(), note=told.append)
    assert outcome.result["response_calibrated_here"] is True
    assert len(outcome.rig["response"]["inverse"]) == 3
    assert "the rig has no response: found it from the exposure series" in told[0]
    assert outcome.result["position_rgb_m"] == pytest.approx(LIGHT, abs=3e-3)
    with pytest.raises(RefusedError, match=r"response\.inverse is missing"):
        calibrate(source_of(WORLD.boards(), RIG), LightOptions(), LightGates(), note=told.append)


def test_photometry_gives_what_is_lacking_and_keeps_what_is_known():
    captures = WORLD.boards() + WORLD.cards(distances=(0.7, 1.0))
    near = [*(LIGHT[:2] + 0.001), LIGHT[2]]
    told = []
    found = photometry_from(source_of(captures, known(WORLD, position_rgb_m=near)), told.append)
    assert found["light"]["position_rgb_m"] == near
    assert any("kept the rig's position" in text for text in told)
    assert found["light"]["falloff_exponent"] == pytest.approx(1.3, abs=0.05)
    assert "response" not in found
    complete = known(WORLD, position_rgb_m=near).with_values(found)
    assert photometry_from(source_of([], complete), told.append) == {}


def test_photometry_says_when_the_rigs_position_is_wrong():
    told = []
    far = [0.05, 0.037, -0.006]
    found = photometry_from(source_of(WORLD.boards(), known(WORLD, position_rgb_m=far)), told.append)
    assert found["light"]["position_rgb_m"] == pytest.approx(LIGHT, abs=3e-3)
    assert any("from where the rig has it" in text for text in told)


def test_photometry_refuses_what_the_captures_cannot_give():
    with pytest.raises(RefusedError, match="no capture of role"):
        photometry_from(source_of([], known(WORLD, position_rgb_m=LIGHT.tolist())), lambda text: None)


def test_light_guide_takes_new_views_with_a_highlight():
    guide = LightGuide(RIG, views=4)
    assert guide.role == "light"
    captures = WORLD.boards()
    for capture in captures:
        look = guide.look(capture)
        assert look.accepted, look.reasons
        assert look.picture.shape == (*RIG.rgb.shape, 3)
    assert guide.progress() == (4, 4)
    assert "enough views" in guide.next_step()
    assert np.sum(guide.coverage()["highlights"]) == 4
    again = guide.look(captures[0])
    assert not again.accepted
    assert "too like view 1" in again.reasons[0]


def test_light_guide_refuses_what_is_of_no_use():
    guide = LightGuide(RIG)
    assert "no highlight" in guide.look(WORLD.cards()[4]).reasons[0]
    burnt = World(gain=6.0).boards()[0]
    assert "of the board is saturated" in guide.look(burnt).reasons[0]
    edge = WORLD.capture("edge", "light", (0.7, 12, 0), gloss=0.5)
    assert any("border" in reason for reason in guide.look(edge).reasons)
    assert guide.progress()[0] == 0


def test_response_guide_takes_exposures_and_refuses_a_burnt_card():
    guide = ResponseGuide(RIG, views=5)
    captures = WORLD.exposures()
    for capture in captures[:5]:
        assert guide.look(capture).accepted
    assert guide.progress() == (5, 5)
    assert "has been taken" in guide.look(captures[0]).reasons[0]
    burnt = WORLD.capture("long", "exposure", (0.7, 0, 0), exposure_s=0.5)
    assert "overexposed: 100%" in guide.look(burnt).reasons[0]
    unknown = replace(captures[0], colour=replace(captures[0].colour, exposure_s=None))
    assert "does not tell its exposure" in guide.look(unknown).reasons[0]
    assert guide.coverage()["span of exposures"] > 0.7


def test_response_guide_takes_distances():
    guide = ResponseGuide(RIG, "distance", views=3)
    assert guide.role == "response"
    assert "0.60 m" in guide.next_step()
    for capture in WORLD.cards(distances=(0.7, 1.0)):
        assert guide.look(capture).accepted
    assert "has been taken" in guide.look(WORLD.cards(distances=(1.01,))[0]).reasons[0]


def test_pictures_are_drawn(tmp_path):
    outcome = run(WORLD.boards() + WORLD.cards(distances=(0.7, 0.9, 1.1)))
    assert set(outcome.pictures) == {"light", "k_d", "light_residuals"}
    for name, draw in outcome.pictures.items():
        draw(tmp_path / f"{name}.png")
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 5


def test_deep_linear_images_do_as_well():
    world = World(bits=16, response=lambda light: light, gain=0.5)
    estimate = estimate_light(views_of(world.boards(), world))
    assert off_mm(estimate) < 2.0
    frame = world.boards()[0].colour
    assert isinstance(frame, ColourFrame)
    assert frame.rgb.dtype == np.uint16


def test_srgb_world_is_what_the_others_are_compared_with():
    level = np.linspace(0, 1, 11)
    assert np.interp(srgb(level), np.linspace(0, 1, 256), inverse_of(srgb)[0]) == pytest.approx(
        level, abs=1e-4
    )
