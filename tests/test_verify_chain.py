"""The whole chain checked again on the simulated cell: the truth passes, and what is wrong is named."""

import dataclasses

import numpy as np
import pytest

from calibration.gates import VerifyGates
from calibration.outcome import RefusedError
from calibration.source import Source
from calibration.verify.card import block_means, variation
from calibration.verify.command import VerifyOptions, verify
from calibration.verify.discs import DiscErrors, explain
from drivers.recordings import Recording, RecordingWriter
from drivers.recordings.board import Board
from drivers.sim import truth
from drivers.sim.views import Look, reach
from drivers.sim.world import SimWorld
from surfclass.errors import InputError
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState

SCALE = 0.5
PLAN = {"reflector_discs": "hand_eye", "grey_card": "response", "checkerboard": "board"}
BOARD = "columns = 9\nrows = 6\nsquare_m = 0.025\n"
GATES = VerifyGates()


def quiet(sentence):
    pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A recording of discs, card and board at the true rig."""
    folder = tmp_path_factory.mktemp("verify")
    path = folder / "fresh.mcap"
    worlds = {scene: SimWorld(scene, seed=2, scale=SCALE) for scene in PLAN}
    rig, plate = truth.rig(worlds["grey_card"]), truth.plate_toml(worlds["reflector_discs"])
    with RecordingWriter(path, rig, truth.classes_toml(), plate_text=plate, board_text=BOARD) as writer:
        for scene, role in PLAN.items():
            world = worlds[scene]
            for number, view in enumerate(chosen(world, scene)):
                writer.write(seen(world, role, number, view.q))
    return path


def chosen(world, scene):
    """Some views of the discs, the card from near, far and aside, and the board from where depth sees it."""
    if scene == "checkerboard":
        target = (1.46, 0.0, 0.69)
        looks = (Look("one", target, 0.65, 18, 8), Look("other", target, 0.75, -22, -10, 5))
        return reach(looks, world.scene.surfaces)
    order = sorted(world.viewpoints, key=lambda view: abs(view.distance_m - 0.9))
    if scene == "reflector_discs":
        return order[:3]
    return [world.viewpoints[0], order[-1], max(order, key=lambda view: view.angle_rad)]


def seen(world, role, number, q):
    depth_mm, ir = world.render_depth(q, number)
    colour = None if role == "hand_eye" else ColourFrame(1, 1, 0.01, world.render_colour(q, 1.0, number))
    frame = DepthFrame(1, 1, None, depth_mm, None if role == "response" else ir)
    return Capture(f"{role}_{number}", role, frame, colour, joints=JointState(1, 0, q))


def checked(site, values=None, note=quiet, **options):
    source = Source.open(site)
    source = source if values is None else source.with_values(values)
    return verify(source, VerifyOptions(**options), GATES, note)


def verdicts(outcome):
    return {key: told["verdict"] for key, told in outcome.result["parts"].items()}


def moved(site, table, key, by):
    """The rig's value with some numbers added; of a transform to its translation."""
    rig = Source.open(site).rig
    value = np.array(getattr(getattr(rig, table), key), np.float64)
    if value.ndim == 2:
        value[:3, 3] += by
    else:
        value += by
    return {table: {key: value.tolist()}}


def test_the_true_rig_passes_with_room(site):
    outcome = checked(site)
    assert outcome.verdict == "pass"
    assert verdicts(outcome) == {
        "cameras": "pass", "discs": "pass", "grey_card": "pass", "boards": "not checked",
    }  # fmt: skip
    parts = outcome.result["parts"]
    assert parts["discs"]["point_rms_m"] < 0.0012
    assert parts["grey_card"]["k_d_variation"] < 0.006
    assert parts["cameras"]["rgb_rms_px"] < 0.8
    assert set(outcome.pictures) == {"verify-cameras", "verify-discs", "verify-grey-card"}


@pytest.mark.parametrize(
    ("table", "key", "by", "failing", "says"),
    [
        ("transforms", "flange_T_depth", (0.005, 0, 0), "discs", "hand-eye transform"),
        ("light", "position_rgb_m", (0.030, 0, 0), "grey_card", "light's position"),
        ("transforms", "rgb_T_depth", (0.003, 0, 0), "cameras", "rgb_T_depth are wrong"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_else(site, table, key, by, failing, says):
    outcome = checked(site, moved(site, table, key, by))
    assert outcome.verdict == "fail"
    assert [part for part, verdict in verdicts(outcome).items() if verdict == "fail"] == [failing]
    assert says in outcome.reasons[0]


def test_a_plate_that_was_moved_is_not_taken_for_a_wrong_hand_eye(site):
    source = Source.open(site)
    plate = source.plate.model_copy(
        update={"positions_base_m": tuple((x, y + 0.006, z) for x, y, z in source.plate.positions_base_m)}
    )
    source = dataclasses.replace(source, plate=plate)
    outcome = verify(source, VerifyOptions(), GATES, quiet)
    assert "the plate was moved" in outcome.reasons[0]


def test_what_cannot_be_checked_is_said_with_the_reason_and_the_rest_is(site, tmp_path):
    outcome = checked(site, {"light": None})
    told = outcome.result["parts"]
    assert "calibrate light first" in told["grey_card"]["not_checked"]
    assert "no labelled capture" in told["boards"]["not_checked"]
    assert outcome.verdict == "pass"
    boardless = rewritten(site, tmp_path, lambda one: one, ("board", "response"), board=None)
    outcome = checked(boardless, require=("cameras", "boards"))
    assert "board.toml" in outcome.result["parts"]["cameras"]["not_checked"]
    assert outcome.verdict == "fail"
    assert len(outcome.reasons) == 2


def test_a_rig_without_hand_eye_or_response_says_which_calibration_is_missing(site):
    source = Source.open(site)
    transforms = source.rig.transforms.model_copy(update={"flange_T_depth": None})
    bare = source.rig.model_copy(update={"transforms": transforms, "response": None})
    told = verify(dataclasses.replace(source, rig=bare), VerifyOptions(), GATES, quiet).result["parts"]
    assert "response.inverse" in told["grey_card"]["not_checked"]
    assert "calibrate hand-eye first" in told["discs"]["not_checked"]


def rewritten(site, tmp_path, change, roles, board=BOARD):
    """The recording's captures of some roles, each changed."""
    recording = Recording.open(site)
    path = tmp_path / "changed.mcap"
    with RecordingWriter(
        path, recording.rig_text, None, plate_text=recording.plate_text, board_text=board
    ) as writer:
        for capture in recording.captures(roles):
            writer.write(change(capture))
    return path


def test_nothing_to_check_is_refused_with_every_reason(site, tmp_path):
    empty = rewritten(site, tmp_path, lambda capture: dataclasses.replace(capture, role="map"), "board")
    with pytest.raises(RefusedError) as refused:
        checked(empty)
    assert len(refused.value.reasons) == 4
    assert "role hand_eye" in refused.value.reasons[1]


def test_an_overexposed_card_is_left_out_with_a_note_and_does_not_decide(site, tmp_path):
    def burnt(capture):
        rgb = np.minimum(capture.colour.rgb.astype(int) * 4, 255).astype(np.uint8)
        return dataclasses.replace(capture, colour=dataclasses.replace(capture.colour, rgb=rgb))

    notes = []
    changed = rewritten(
        site, tmp_path, lambda one: burnt(one) if one.name == "response_0" else one, "response"
    )
    outcome = checked(changed, note=notes.append)
    assert set(outcome.result["parts"]["grey_card"]["k_d"]) == {"response_1", "response_2"}
    assert any("response_0 is left out" in note and "over- or" in note for note in notes)


def test_a_wrong_board_or_a_blind_image_leaves_the_cameras_unchecked(site, tmp_path):
    outcome = checked(site, board=Board(columns=9, rows=6, square_m=0.030))
    assert "the board's squares have another size" in outcome.reasons[0] or "depth" in outcome.reasons[0]
    blind = rewritten(
        site,
        tmp_path,
        lambda one: dataclasses.replace(one, depth=dataclasses.replace(one.depth, ir=None)),
        ("board", "response"),
    )
    told = checked(blind).result["parts"]["cameras"]
    assert "in IR" in told["not_checked"]


def errors_of(base_by_view, depth_by_view):
    rng = np.random.default_rng(0)
    views = tuple(f"v{i}" for i in range(len(base_by_view)) for _ in range(9))
    noise = 0.0004 * rng.standard_normal((len(views), 3))
    return DiscErrors(
        views, np.repeat(base_by_view, 9, axis=0) + noise, np.repeat(depth_by_view, 9, axis=0) + noise
    )


def test_the_errors_pattern_tells_camera_plate_and_arm_apart():
    rng = np.random.default_rng(1)
    turned = rng.standard_normal((6, 3))
    turned *= 0.005 / np.linalg.norm(turned, axis=1, keepdims=True)
    same = np.tile([0.0, 0.005, 0.0], (6, 1))
    assert "hand-eye transform (or" in explain(errors_of(turned, same))
    assert "the plate was moved" in explain(errors_of(same, turned))
    assert "differs from view to view" in explain(errors_of(turned, -turned[::-1]))
    assert "differs from view to view" in explain(errors_of(same[:1], same[:1]))


def test_blocks_are_means_of_what_can_be_used_and_nothing_where_that_is_little():
    planes = np.zeros((3, 120, 160), np.float32)
    planes[:] = np.arange(160, dtype=np.float32)
    usable = np.ones((120, 160), bool)
    usable[:, :80] = False
    usable[0, 80] = False
    planes[:, 0, 80] = 1e9
    blocks = block_means(planes, usable)
    assert blocks.shape == (60, 80, 3)
    assert np.isnan(blocks[:, :40]).all()
    assert blocks[0, 40, 0] == pytest.approx((81 + 80 + 81) / 3)
    assert blocks[5, 50].tolist() == [100.5] * 3


def test_variation_is_over_all_places_and_between_captures():
    flat = np.full((10, 10, 3), 2.0)
    assert variation([flat, flat]) == (0, 0)
    over_all, between = variation([flat, 1.1 * flat])
    assert over_all == pytest.approx(0.05 / 1.05)
    assert between == pytest.approx(np.sqrt(2) * 0.05 / 1.05)
    striped = flat * np.where(np.arange(10) % 2, 1.02, 0.98)[:, None]
    over_all, between = variation([striped, striped])
    assert over_all == pytest.approx(0.02)
    assert between == pytest.approx(0)


def test_labelled_captures_are_classified_by_the_model_class_by_class(commissioned):
    source = Source.open(commissioned.recording)
    outcome = verify(source, VerifyOptions(model=commissioned.model), GATES, quiet)
    told = outcome.result["parts"]["boards"]
    assert told["accuracy"] > 0.8
    assert told["worst_class_accuracy"] == min(told["class_accuracy"].values())
    assert np.sum(told["confusion"]) > 10_000
    strict = VerifyGates(class_accuracy=1.0)
    failed = verify(source, VerifyOptions(model=commissioned.model), strict, quiet)
    worst = min(told["class_accuracy"], key=told["class_accuracy"].get)
    assert f"worst class ({worst})" in " ".join(failed.reasons)


def test_a_model_of_other_classes_or_none_leaves_labels_unchecked(commissioned, tmp_path):
    source = Source.open(commissioned.recording)
    with pytest.raises(RefusedError, match="no model was given"):
        verify(source, VerifyOptions(), GATES, quiet)
    bad = tmp_path / "model.npz"
    bad.write_bytes(b"no model")
    with pytest.raises(InputError, match=r"model\.npz"):
        verify(source, VerifyOptions(model=bad), GATES, quiet)
