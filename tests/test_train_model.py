"""What a model knows of its rig, what its card says, and the gates that it is judged by."""

import dataclasses
import io
import json

import numpy as np
import pytest

from calibration.training.card import assess, limits_of_use
from calibration.training.pictures import draw_confusions, draw_features, draw_reliability
from surfclass.classifiers import naive_bayes
from surfclass.errors import ConfigurationError
from surfclass.model import Model, completed
from surfclass.rig import SurfaceClasses, parse_rig
from surfclass.routes import ColourRoute, TextureRoute
from surfclass.sampling import Samples
from surfclass.training import HeldOut

RIG = parse_rig(
    """
schema = 1
name = "bare"
voxel_size_m = 0.01
[rgb]
size = [64, 48]
fx = 60.0
fy = 60.0
cx = 31.5
cy = 23.5
[depth]
size = [64, 48]
fx = 60.0
fy = 60.0
cx = 31.5
cy = 23.5
[transforms]
rgb_T_depth = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
[light]
position_rgb_m = [0.1, 0.0, 0.0]
""",
    "rig",
)
CLASSES = SurfaceClasses(names=("rust", "paint"), colours=("#b7410e", "#3f8f6f"))
VALUES = {
    "light": {"position_rgb_m": [0.11, 0.0, 0.0], "axis_rgb": [0.0, 0.0, 1.0], "falloff_exponent": 1.0},
    "rgb": {"vignetting": [-0.5, 0.1, 0.0]},
    "response": {"inverse": [[0.0, 0.3, 1.0]] * 3},
}


def model(values=None):
    random = np.random.default_rng(0)
    x, label = random.random((40, 2)), np.arange(40) % 2
    bayes = naive_bayes.train(x + label[:, None], label)
    return Model(
        CLASSES,
        {"a*b*": ColourRoute("a*b*", "full", 0.01, bayes, None)},
        TextureRoute("LBP", 20, bayes),
        values or {},
        {"captures": ["one"]},
    )


def test_a_rig_is_completed_by_what_it_lacks():
    found = model(VALUES).complete(RIG)
    assert found.rgb.vignetting == (-0.5, 0.1, 0.0)
    assert found.response.inverse[0] == (0.0, 0.3, 1.0)
    assert found.rgb.fx == RIG.rgb.fx
    assert model().complete(RIG) is RIG


def test_a_direction_comes_with_the_position_that_it_was_fitted_with():
    assert model(VALUES).complete(RIG).light.position_rgb_m == (0.11, 0.0, 0.0)


def test_what_the_rig_says_stays():
    own = {
        "light": {"position_rgb_m": [0.2, 0.0, 0.0], "axis_rgb": [0.0, 0.6, 0.8], "falloff_exponent": 2.0},
        "rgb": {"vignetting": [0.0, 0.0, 0.0]},
    }
    found = completed(RIG.with_values(own).whole(), VALUES)
    assert found.light.position_rgb_m == (0.2, 0.0, 0.0)
    assert found.light.falloff_exponent == 2.0
    assert found.rgb.vignetting == (0.0, 0.0, 0.0)
    assert found.response.inverse is not None


def test_a_polynomial_goes_beside_a_curve():
    polynomial = {"response": {"a2_a1_a0": [[1.0, 0.0, 0.0]] * 3}}
    with_curve = RIG.with_values({"response": VALUES["response"]}).whole()
    found = completed(with_curve, polynomial)
    assert found.response.inverse is not None
    assert found.response.a2_a1_a0 == ((1.0, 0.0, 0.0),) * 3


def test_the_values_survive_the_file_and_equal_models_give_equal_bytes():
    data = model(VALUES).to_bytes()
    found = Model.from_bytes(data, "m")
    assert found.rig_values == VALUES
    assert found.to_bytes() == data


def broken(change):
    data = np.load(io.BytesIO(model(VALUES).to_bytes()))
    arrays = {name: data[name] for name in data.files}
    head = json.loads(arrays["head"].tobytes())
    change(head)
    arrays["head"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda head: head.update(schema=1), "model schema 1, allowed is 2"),
        (lambda head: head.pop("rig_values"), "not a surfclass model"),
        (lambda head: head.update(rig_values={"lamp": {}}), "tables of rig.toml"),
        (lambda head: head.update(rig_values=[1]), "tables of rig.toml"),
    ],
)
def test_a_model_of_another_layout_is_refused(change, said):
    with pytest.raises(ConfigurationError, match=said):
        Model.from_bytes(broken(change), "m.npz")


def test_values_that_no_rig_may_have_are_refused_by_their_path():
    with pytest.raises(ConfigurationError, match=r"rgb\.vignetting"):
        completed(RIG, {"rgb": {"vignetting": [1.0]}})


def held_out(right_share, places=20, each=30, seed=0, by="groups"):
    """Two classes; each place has its own share of right samples around the one given."""
    random = np.random.default_rng(seed)
    n = places * each
    place = np.repeat(np.arange(places), each)
    label = place % 2
    share = np.clip(random.normal(right_share, 0.1, places), 0, 1)[place]
    right = random.random(n) < share
    confidence = np.full(n, right_share)
    posterior = np.empty((n, 2))
    result = np.where(right, label, 1 - label)
    posterior[np.arange(n), result] = confidence
    posterior[np.arange(n), 1 - result] = 1 - confidence
    samples = Samples(
        random.random((n, 2)), label, place, np.zeros(n, int), np.full(n, 0.65), np.full(n, 0.1)
    )
    return HeldOut(samples, posterior, by, 1.0, 0.3, ())


def test_the_card_has_the_figures_of_the_held_out_samples():
    found = assess(held_out(0.8), CLASSES, 0)
    told = found.told
    confusion = np.array(told["confusion"])
    assert confusion.sum() == 600
    assert told["accuracy"] == pytest.approx(np.trace(confusion) / 600)
    assert told["per_class"]["rust"]["accuracy"] == pytest.approx(confusion[0, 0] / confusion[0].sum())
    assert told["places"] == 20
    assert found.ece == pytest.approx(abs(0.8 - told["accuracy"]), abs=1e-9)


def test_intervals_are_of_places_and_hold_the_truth():
    inside, width = 0, []
    for seed in range(60):
        low, high = assess(held_out(0.75, seed=seed), CLASSES, 0).told["interval_95"]
        inside += low <= 0.75 <= high
        width.append(high - low)
    assert inside >= 51  # 95 % of 60 but for chance, and a bootstrap of 20 places is a little narrow
    assert np.mean(width) > 1.1 * 2 * 1.96 * np.sqrt(0.75 * 0.25 / 600)


def test_one_place_alone_has_no_interval():
    single = held_out(0.8, places=2)
    assert assess(single, CLASSES, 0).told["per_class"]["paint"]["interval_95"] is None


def test_the_limits_of_use_say_what_is_not_proved():
    said = limits_of_use({"K_d": assess(held_out(0.8, by="samples"), CLASSES, 0)}, "thesis", "svm", 0.01)
    text = " ".join(said)
    for part in ("0.65 to 0.65 m", "one place only", "never trained on", "exposure of 10 ms"):
        assert part in text


def test_pictures_are_drawn(tmp_path):
    one = held_out(0.8)
    cards = {"a*b*": assess(one, CLASSES, 0), "LBP": assess(one, CLASSES, 1)}
    draw_reliability(cards, tmp_path / "r.png")
    draw_confusions(cards, CLASSES, tmp_path / "c.png")
    draw_features("a*b*", one, CLASSES, tmp_path / "f.png")
    three = dataclasses.replace(
        one, samples=dataclasses.replace(one.samples, values=np.random.default_rng(0).random((600, 3)))
    )
    draw_features("K_d", three, CLASSES, tmp_path / "k.png")
    assert all(path.stat().st_size > 5000 for path in tmp_path.glob("*.png"))
