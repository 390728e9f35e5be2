"""A folder with all that a simulated service needs; for tests that run the real one."""

from functools import cache

import numpy as np

from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.classifiers import naive_bayes
from surfclass.model import Model
from surfclass.rig import parse_classes
from surfclass.routes import ColourRoute, TextureRoute

SCALE = 0.1  # images of 128 × 96: what is tested here is the wiring

CONFIG = """
robot = "test"
rig = "rig.toml"
model = "model.npz"
map = "map.npz"
[trigger.rest]
[recording]
directory = "recordings"
min_free_mb = 1
[zenoh]
listen = ["ENDPOINT"]
[colour]
backend = "sim"
[depth]
backend = "sim"
[light]
backend = "sim"
[arm]
backend = "sim"
[sim]
scale = SCALE
viewpoints = 2
"""


def any_classifier(dimensions):
    """A classifier that rejects next to nothing; what it says does not matter here."""
    draw = np.random.default_rng(0)
    x = draw.random((500, dimensions))
    return naive_bayes.train(x, np.arange(500) % 5, rejected_share=1e-9)


@cache
def parts():
    """Returns the text of a rig and the bytes of a model that fits it."""
    world = SimWorld("cell", 0, scale=SCALE)
    rig = truth.rig(world).replace('colour = "K_d"', 'colour = "RGB"')
    classes = parse_classes(truth.classes_toml(), "classes")
    colour = ColourRoute("RGB", "thesis", None, any_classifier(3), None)
    model = Model(classes, {"RGB": colour}, TextureRoute("LBP", 20, any_classifier(59)))
    return rig, model.to_bytes()


def build_site(tmp_path):
    """Fills a folder and returns it."""
    rig, model = parts()
    (tmp_path / "rig.toml").write_text(rig)
    (tmp_path / "model.npz").write_bytes(model)
    endpoint = f"unixsock-stream/{tmp_path}/z"
    text = CONFIG.replace("ENDPOINT", endpoint).replace("SCALE", str(SCALE))
    (tmp_path / "surfclass.toml").write_text(text)
    return tmp_path
