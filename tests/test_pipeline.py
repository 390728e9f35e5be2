"""Captures of the simulated cell become a map: training, classification, evidence, evaluation, bad input."""

import dataclasses

import numpy as np
import pytest

from drivers.sensor_package import SensorPackage
from drivers.sim import truth
from drivers.sim.devices import SimArm, SimColourCamera, SimDepthCamera, SimLight
from drivers.sim.world import SimWorld
from surfclass.errors import ConfigurationError, InputError, MissingCalibrationError
from surfclass.evaluation import evaluate
from surfclass.frames import ColourFrame, DepthFrame
from surfclass.map_file import to_npz_bytes
from surfclass.model import Model
from surfclass.pipeline import (
    EVIDENCE_FLOOR,
    THESIS,
    Pipeline,
    cell_of_pixel,
    focus_planes,
    log_likelihood,
    texture_limits,
)
from surfclass.rig import Lens, Response, TextureLimits, parse_classes, parse_rig
from surfclass.training import TrainingSettings, response_samples, train

SCALE = 0.25
SMALL = TrainingSettings(
    pixels_per_class=300, windows_per_class=200, window_px=10, place_px=20, C=1.0, gamma=1.0
)


def captured(world, name, role, dark=False):
    devices = SimColourCamera(world), SimDepthCamera(world), SimLight(world), SimArm(world)
    with SensorPackage(world.clock, *devices) as package:
        return package.capture(name, role, with_dark=dark)


def labelled(world, name, role):
    capture = captured(world, name, role)
    return dataclasses.replace(capture, label=truth.label_image(world, capture.joints.q))


@pytest.fixture(scope="module")
def cell():
    """Rig, classes, training boards, and two views of the cell; small images."""
    world = SimWorld("cell", scale=SCALE)
    rig = parse_rig(truth.rig(world), "rig")
    classes = parse_classes(truth.classes_toml(), "classes")
    boards = [
        labelled(SimWorld(f"board:{name}", number + 1, scale=SCALE), f"train_{name}", "train")
        for number, name in enumerate(classes.names)
    ]
    views = []
    for number in (0, 5):
        world.place(world.viewpoints[number].q)
        views.append(labelled(world, f"view_{number}", "test"))
    return rig, classes, boards, views


@pytest.fixture(scope="module")
def model(cell):
    rig, classes, boards, _ = cell
    return train(boards, [], rig, classes, SMALL)


def test_the_cell_is_classified(cell, model):
    rig, _, _, views = cell
    result = evaluate(views, Pipeline(rig, model), ["rgb", "ab", "kd", "texture", "combined"])
    fused = {route: figures["fused"] for route, figures in result["routes"].items()}
    assert fused["kd"]["overall"] > 0.6
    assert fused["combined"]["overall"] > 0.6
    assert fused["combined"]["voxels"] == sum(map(sum, fused["combined"]["confusion"])) + round(
        fused["combined"]["rejected"] * fused["combined"]["voxels"]
    )
    assert set(result["routes"]["kd"]["views"]) == {view.name for view in views}
    assert result["routes"]["kd"]["pixels"]["view_0"]["pixels"] > 1000


def test_replaying_gives_the_same_bytes(cell, model):
    rig, _, _, views = cell
    maps = []
    for _ in range(2):
        pipeline = Pipeline(rig, Model.from_bytes(model.to_bytes(), "model"))
        for view in views:
            pipeline.process(view)
        maps.append(to_npz_bytes(pipeline.map))
    assert maps[0] == maps[1]


def test_training_gives_the_same_bytes(cell, model):
    rig, classes, boards, _ = cell
    assert train(boards, [], rig, classes, SMALL).to_bytes() == model.to_bytes()


def test_every_stage_is_timed(cell, model):
    rig, _, _, views = cell
    stages = Pipeline(rig, model).process(views[0]).stage_ms
    assert list(stages) == ["geometry", "colour", "texture", "probability map", "evidence", "map"]
    assert all(ms > 0 for ms in stages.values())


def test_the_observation_says_what_the_routes_said(cell, model):
    rig, _, _, views = cell
    pipeline = Pipeline(rig, model)
    classified = pipeline.classify(views[0], ("K_d",))
    observation = pipeline.observe(classified, "K_d")
    pixel = np.argwhere(classified.view.has_point & classified.colour["K_d"].valid)[40]
    row = np.flatnonzero(classified.view.has_point.ravel()).searchsorted(
        np.ravel_multi_index(pixel, classified.view.has_point.shape)
    )
    p = np.maximum(classified.colour["K_d"].probability[tuple(pixel)], EVIDENCE_FLOOR)
    prior = model.colour["K_d"].classifier.prior
    np.testing.assert_allclose(observation.colour[row], np.log(p) - np.log(prior), atol=1e-5)
    cell_row, cell_col = pixel // model.texture.window_px
    t = np.maximum(classified.texture.probability[cell_row, cell_col], EVIDENCE_FLOOR)
    prior = model.texture.classifier.prior
    np.testing.assert_allclose(observation.texture[row], np.log(t) - np.log(prior), atol=1e-5)
    assert observation.weight[row] == classified.weight[tuple(pixel)]
    point = classified.base_T_rgb @ classified.view.point[:, pixel[0], pixel[1]]
    np.testing.assert_allclose(observation.point_base[row], point, atol=1e-6)


def test_the_posterior_is_divided_by_the_training_prior():
    """C.1: a classifier gives posteriors; the map wants likelihoods."""
    prior = np.array([0.8, 0.2])
    said = log_likelihood(np.array([[0.8, 0.2]], np.float32), prior)
    np.testing.assert_allclose(said[0, 0], said[0, 1], atol=1e-6)  # the prior alone is no evidence
    sure = log_likelihood(np.array([[1.0, 0.0]], np.float32), np.array([0.5, 0.5]))
    assert np.isfinite(sure).all()


def test_ambient_light_is_taken_off_by_the_unlit_frame(cell, model):
    rig, *_ = cell
    world = SimWorld("cell", scale=SCALE, ambient=0.15)
    with_ambient = captured(world, "both", "map", dark=True)
    clean = captured(SimWorld("cell", scale=SCALE), "clean", "map")
    pipeline = Pipeline(rig, model)

    def agreement(capture):
        wanted = pipeline.classify(clean, ("K_d",)).colour["K_d"]
        found = pipeline.classify(capture, ("K_d",)).colour["K_d"]
        both = wanted.valid & found.valid
        return (wanted.label()[both] == found.label()[both]).mean()

    without_dark = dataclasses.replace(with_ambient, dark=None)
    assert 1 - agreement(with_ambient) < 0.4 * (1 - agreement(without_dark))


def test_thesis_mode_saturates_and_the_default_does_not(cell, model):
    rig, _, _, views = cell
    certain = {}
    for settings in (THESIS, None):
        pipeline = Pipeline(rig, model, settings)
        pipeline.process(views[0])
        p = pipeline.map.fused("linear").p_colour
        certain[settings] = (p.max(axis=1) > 0.9999).mean()
    assert certain[THESIS] > 0.6
    assert certain[None] < 0.05


def test_cells_cover_whole_windows_only():
    cells = cell_of_pixel((5, 7), 2).reshape(5, 7)
    assert cells[4].tolist() == [-1] * 7
    assert cells[0].tolist() == [0, 0, 1, 1, 2, 2, -1]
    assert cells[2, 0] == 3


def test_the_depth_of_field_limits_every_class(cell):
    rig, classes, *_ = cell
    lens = Lens(focal_length_m=0.006, f_number=2.8, focus_distance_m=0.65, circle_of_confusion_m=5e-6)
    near, far = focus_planes(rig.model_copy(update={"lens": lens}), classes, texture_limits(rig, classes))
    assert 0.5 < near < 0.65 < far < 0.95
    far_limits = TextureLimits(near_m=2.0, far_m=3.0)
    limits = tuple(far_limits for _ in classes.names)
    with pytest.raises(ConfigurationError, match="rusted"):
        focus_planes(rig.model_copy(update={"lens": lens}), classes, limits)


def test_naive_bayes_rejects_what_it_never_saw(cell):
    rig, classes, boards, views = cell
    settings = dataclasses.replace(SMALL, classifier="naive_bayes")
    pipeline = Pipeline(rig, Model.from_bytes(train(boards, [], rig, classes, settings).to_bytes(), "m"))
    black = views[0].colour.rgb.copy()
    black[:] = (250, 5, 250)  # magenta: none of the surfaces
    frame = dataclasses.replace(views[0].colour, rgb=black)
    strange = dataclasses.replace(views[0], colour=frame)
    assert pipeline.classify(strange, ("a*b*",)).colour["a*b*"].rejected.mean() > 0.99
    assert pipeline.classify(views[0], ("a*b*",)).colour["a*b*"].rejected.mean() < 0.5


def test_a_route_that_is_not_wanted_is_left_out(cell):
    """With a light but no response nothing but K_d is missing, and the rig asks for another feature."""
    rig, classes, boards, _ = cell
    features = rig.features.model_copy(update={"colour": "a*b*"})
    blind = rig.model_copy(update={"response": None, "features": features})
    notes = []
    model = train(boards, [], blind, classes, SMALL, notes.append)
    assert list(model.colour) == ["RGB", "a*b*"]
    assert any("K_d route is left out" in note for note in notes)


def test_a_capture_with_nothing_labelled_counts_for_nothing(cell, model):
    rig, classes, boards, views = cell
    blank = dataclasses.replace(views[0], name="blank", label=np.zeros_like(views[0].label))
    with_blank = evaluate([blank, views[1]], Pipeline(rig, model), ["kd"])
    alone = evaluate([views[1]], Pipeline(rig, model), ["kd"])
    assert with_blank["routes"]["kd"]["views"]["blank"]["overall"] is None
    assert with_blank["routes"]["kd"]["pixels"]["blank"]["pixels"] == 0
    found = with_blank["routes"]["kd"]["views"][views[1].name]
    assert found == alone["routes"]["kd"]["views"][views[1].name]
    blank_board = dataclasses.replace(boards[0], name="blank", label=np.zeros_like(boards[0].label))
    notes = []
    again = train([blank_board, *boards], [], rig, classes, SMALL, notes.append)
    assert again.card["captures"] == model.card["captures"]
    assert any("blank" in note for note in notes)
    with pytest.raises(InputError, match="labelled surface point"):
        evaluate([blank], Pipeline(rig, model), ["kd"])


class TestRefusals:
    def test_a_depth_image_of_the_wrong_size(self, cell, model):
        rig, _, _, views = cell
        depth = DepthFrame(1, 1, None, np.ones((10, 12), np.uint16))
        pipeline = Pipeline(rig, model)
        with pytest.raises(InputError, match="depth image is 12 × 10"):
            pipeline.process(dataclasses.replace(views[0], depth=depth))
        assert len(pipeline.map) == 0

    def test_a_colour_image_of_the_wrong_size(self, cell, model):
        rig, _, _, views = cell
        colour = ColourFrame(1, 1, None, np.ones((10, 12, 3), np.uint8))
        with pytest.raises(InputError, match="colour image is 12 × 10"):
            Pipeline(rig, model).process(dataclasses.replace(views[0], colour=colour, label=None))

    def test_a_model_trained_on_other_features(self, cell, model):
        rig, *_ = cell
        glcm = rig.model_copy(update={"features": rig.features.model_copy(update={"texture": "GLCM"})})
        with pytest.raises(ConfigurationError, match=r"LBP.*GLCM"):
            Pipeline(glcm, model)
        without = dataclasses.replace(model, colour={"RGB": model.colour["RGB"]})
        with pytest.raises(ConfigurationError, match="no colour route for K_d"):
            Pipeline(rig, without)

    def test_a_missing_light(self, cell):
        rig, classes, boards, _ = cell
        with pytest.raises(MissingCalibrationError, match=r"needs a \[light\]"):
            train(boards, [], rig.model_copy(update={"light": None}), classes, SMALL)

    def test_a_missing_response(self, cell):
        rig, classes, boards, _ = cell
        blind = rig.model_copy(update={"response": None})
        with pytest.raises(MissingCalibrationError, match=r"response\.a2_a1_a0"):
            train(boards, [], blind, classes, SMALL)
        with pytest.raises(MissingCalibrationError, match="at least 3"):
            response_samples(boards[:2], rig)

    def test_another_exposure_in_thesis_mode(self, cell):
        rig, classes, boards, views = cell
        rows = ((0.0, 1.0, 0.35),) * 3
        printed = rig.model_copy(update={"response": Response(a2_a1_a0=rows)})
        settings = dataclasses.replace(SMALL, reflectance="thesis")
        pipeline = Pipeline(printed, train(boards, [], printed, classes, settings))
        longer = dataclasses.replace(views[0].colour, exposure_s=views[0].colour.exposure_s * 2)
        with pytest.raises(InputError, match="exposure"):
            pipeline.process(dataclasses.replace(views[0], colour=longer))

    def test_no_training_capture(self, cell):
        rig, classes, *_ = cell
        with pytest.raises(InputError, match="no capture of role 'train' with a label"):
            train([], [], rig, classes, SMALL)

    def test_the_capture_is_named(self, cell, model):
        rig, _, _, views = cell
        dark = dataclasses.replace(views[0], dark=views[0].colour)
        pipeline = Pipeline(rig.model_copy(update={"response": None}), model)
        with pytest.raises(InputError, match=r"capture view_0: .*response\.inverse"):
            pipeline.process(dark)

    def test_a_class_without_samples(self, cell):
        rig, classes, boards, _ = cell
        with pytest.raises(InputError, match="rusted"):
            train(boards[1:], [], rig, classes, SMALL)

    @pytest.mark.parametrize("cut", [0, 10, 1000, -1])
    def test_a_broken_model(self, model, cut):
        with pytest.raises(ConfigurationError, match=r"m\.npz: not a surfclass model"):
            Model.from_bytes(model.to_bytes()[:cut], "m.npz")
