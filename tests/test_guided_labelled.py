"""The guide for boards of one surface: from where it wants them, what it refuses, and what it labels."""

from dataclasses import replace

import numpy as np
import pytest
from guided_site import SETTINGS, Person, Site, site

from calibration.live.devices import device_metadata
from calibration.live.labelled import LIMITS_STANDS, TRAIN_STANDS, LabelledGuide, Stand
from calibration.live.loop import guided
from drivers.sim import truth
from drivers.sim.world import SimWorld
from surfclass.frames import Capture, ColourFrame, DepthFrame
from surfclass.rig import parse_rig

SCALE = 0.2
NEAR = Stand((0.0, 5.0), (0.0, 90.0), 9)


def seen(world, name):
    """A capture from a viewpoint, and its viewpoint."""
    place = next(one for one in world.viewpoints if one.name == name)
    depth, ir = world.render_depth(place.q, 1)
    colour = ColourFrame(2, 1, 0.01, world.render_colour(place.q, 1.0, 1))
    return Capture(name, "train", DepthFrame(1, 1, 0.01, depth, ir), colour), place


def guide(world, *stands, role="train", label=1):
    return LabelledGuide(role, "rusted", label, parse_rig(truth.rig(world), "rig"), stands or (NEAR,))


@pytest.fixture(scope="module")
def board():
    return SimWorld("limits:rusted", 0, scale=SCALE)


@pytest.mark.parametrize("name", ["at_0520", "at_0740", "at_1050", "oblique_20", "oblique_44"])
def test_a_board_is_labelled_where_it_is_and_nowhere_else(board, name):
    capture, place = seen(board, name)
    at = guide(board, label=3)
    look = at.look(capture)
    assert look.accepted, look.reasons
    said = look.reasons[0]
    assert float(said.split(" m")[0]) == pytest.approx(place.distance_m, abs=0.02)
    assert float(said.split(", ")[1].split("°")[0]) == pytest.approx(np.degrees(place.angle_rad), abs=2.5)
    label = at.labelled(capture).label
    true = truth.label_image(board, place.q) == 1
    assert set(np.unique(label)) <= {0, 3}
    assert true[label == 3].mean() > 0.998
    assert (label == 3)[true].mean() > 0.6  # the depth camera does not see all of it
    assert look.picture.shape == capture.colour.rgb.shape


def test_a_view_from_where_none_is_wanted_is_refused_with_the_nearest_that_is(board):
    far, oblique = Stand((0.9, 1.1), (0.0, 15.0)), Stand((0.5, 0.8), (40.0, 50.0))
    at = guide(board, far, oblique)
    look = at.look(seen(board, "at_0880")[0])
    assert not look.accepted
    assert "no view is wanted from 0.88 m" in look.reasons[0]
    assert look.reasons[0].endswith(f"the nearest that is: {far}")
    assert at.look(seen(board, "oblique_36")[0]).reasons[0].endswith(str(oblique))
    assert at.look(seen(board, "at_0960")[0]).accepted
    assert str(far) not in at.next_step()
    assert str(oblique) in at.next_step()
    assert at.progress() == (1, 2)
    assert at.coverage() == {str(far): 1.0, str(oblique): 0.0}
    assert at.look(seen(board, "oblique_44")[0]).accepted
    assert at.look(seen(board, "oblique_44")[0]).reasons == ("there are enough views",)


def test_no_depth_in_the_middle_is_refused(board):
    capture, _ = seen(board, "at_0740")
    blind = replace(capture, depth=replace(capture.depth, depth_mm=np.zeros_like(capture.depth.depth_mm)))
    look = guide(board).look(blind)
    assert not look.accepted
    assert "0% of the middle of the image has depth" in look.reasons[0]


def test_the_edge_between_two_boards_is_refused(board):
    capture, _ = seen(board, "at_0740")
    depth = capture.depth.depth_mm.copy()
    depth[:, depth.shape[1] // 2 :] += 60
    look = guide(board).look(replace(capture, depth=replace(capture.depth, depth_mm=depth)))
    assert not look.accepted
    assert "lie on one plane" in look.reasons[0]


def test_no_label_without_an_accepted_view(board):
    with pytest.raises(ValueError, match="no view has been accepted"):
        guide(board).labelled(seen(board, "at_0740")[0])


@pytest.mark.parametrize(
    ("scene", "stands", "least"), [("board:rusted", TRAIN_STANDS, 5), ("limits:rusted", LIMITS_STANDS, 9)]
)
def test_a_simulated_arm_gives_all_that_is_wanted(tmp_path, scene, stands, least):
    with site(tmp_path, scene, scale=SCALE) as at:
        assert isinstance(at, Site)
        made = guide(at.world, *stands, role="test")
        person = Person()
        taken = guided(at.package, made, at.writer, SETTINGS, person, at.world.clock, finish=made.labelled)
    assert taken >= least, [one.reasons for one in person.last.judged]
    assert all((capture.label == 1).mean() > 0.2 for capture in at.captures)


def test_the_devices_are_named_in_a_recordings_metadata(tmp_path):
    with site(tmp_path) as at:
        told = device_metadata(at.package.about())
    assert told["serial of colour"] == "SIM-COLOUR"
    assert told["model of depth"] == "simulated depth"
    assert "firmware of arm" not in told
    assert device_metadata({"colour": {"serial": "", "model": "X"}}) == {"model of colour": "X"}
