"""The voxel map: Eq. 3.9 to 3.11 to the letter, the calibrated update, and state that merges in any order."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_samples import CLASSES, COLUMNS, SIZE_M, K, assert_same, observe, one_voxel

from surfclass.errors import ConfigurationError, InputError
from surfclass.types import MapUpdate, Observation
from surfclass.voxel_index import BrickDirectory, pack, unpack
from surfclass.voxel_map import VoxelMap, centre_of, fuse, softmax, voxel_of

few = settings(deadline=None, max_examples=25)
indices = st.lists(
    st.tuples(*[st.integers(-(2**20) + 1, 2**20 - 1)] * 3), min_size=1, max_size=30, unique=True
)


def sure_of(k: int, of: float = 0.99) -> np.ndarray:
    p = np.full(K, (1 - of) / (K - 1))
    p[k] = of
    return np.log(p)[None].astype(np.float32)


# Where a point belongs


def test_a_voxel_is_the_floor_and_not_what_the_printed_example_says() -> None:
    """(13, 18, 35) with voxels of 10 is in the voxel whose lower corner is (10, 10, 30), not (10, 20, 30)."""
    printed = np.array([10, 20, 30])
    point = np.array([13.0, 18.0, 35.0])
    corner = voxel_of(point, 10.0) * 10
    assert corner.tolist() == [10, 10, 30]
    # No single rounding rule gives what is printed: the example contradicts itself.
    for rule in (np.floor, np.ceil, np.rint):
        assert (rule(point / 10) * 10 != printed).any()


def test_negative_coordinates_round_down_and_centres_lie_half_a_voxel_in() -> None:
    point = np.array([[-0.001, 0.001, -0.011], [-0.0100001, 0.0, 0.0199999]])
    index = voxel_of(point, 0.01)
    assert index.dtype == np.int32
    assert index.tolist() == [[-1, 0, -2], [-2, 0, 1]]
    np.testing.assert_allclose(centre_of(index, 0.01), [[-0.005, 0.005, -0.015], [-0.015, 0.005, 0.015]])


@few
@given(indices, st.sampled_from([0.001, 0.01, 0.0137, 1.0]))
def test_the_centre_of_a_voxel_lies_in_it(index: list[tuple[int, int, int]], size_m: float) -> None:
    wanted = np.array(index, np.int32)
    np.testing.assert_array_equal(voxel_of(centre_of(wanted, size_m), size_m), wanted)
    np.testing.assert_array_equal(unpack(pack(wanted)), wanted)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 2.0**20 * 0.01, -(2.0**20) * 0.01])
def test_a_point_beyond_the_map_is_refused(bad: float) -> None:
    with pytest.raises(InputError, match=r"not finite or lies beyond ±10485\.8 m"):
        voxel_of(np.array([[0.0, bad, 0.0]]), 0.01)


@pytest.mark.parametrize("size_m", [0.0, -0.01, np.nan, np.inf])
def test_a_voxel_needs_a_size(size_m: float) -> None:
    for call in (lambda: voxel_of(np.zeros((1, 3)), size_m), lambda: VoxelMap(size_m, CLASSES)):
        with pytest.raises(ConfigurationError, match="voxel_size_m"):
            call()


@few
@given(indices)
def test_the_directory_numbers_voxels_in_the_order_of_their_first_coming(
    index: list[tuple[int, int, int]],
) -> None:
    keys = pack(np.array(index, np.int32))
    directory = BrickDirectory()
    first = len(keys) // 2
    assert directory.find_or_add(keys[:first]).tolist() == list(range(first))
    assert directory.find(keys).tolist() == [*range(first), *[-1] * (len(keys) - first)]
    assert directory.find_or_add(keys).tolist() == list(range(len(keys)))
    assert len(directory) == len(keys)


# What evidence does


def literal_bayes(
    observation: Observation, log_likelihood: np.ndarray, has: np.ndarray
) -> dict[bytes, np.ndarray]:
    """Eq. 3.9 and 3.10 pixel by pixel: multiply, normalise, in float64."""
    p: dict[bytes, np.ndarray] = {}
    for point, log, seen in zip(observation.point_base, log_likelihood, has, strict=True):
        if seen:
            voxel = np.floor(point.astype(np.float64) / SIZE_M).astype(np.int32).tobytes()
            product = p.get(voxel, np.full(K, 1 / K)) * np.exp(log.astype(np.float64))
            p[voxel] = product / product.sum()
    return p


def test_independent_is_the_literal_product_of_every_pixel() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES, "independent")
    frames = [observe(400, seed, extent_m=0.02) for seed in (1, 2)]
    whole = Observation(*[np.concatenate(parts) for parts in zip(*map(columns_of, frames), strict=True)])
    for t_ns, frame in enumerate(frames):
        voxels.add(frame, t_ns)
    layers = voxels.fused()
    colour = literal_bayes(whole, whole.colour, whole.has_colour)
    texture = literal_bayes(whole, whole.texture, whole.has_texture)
    assert {index.tobytes() for index in layers.index} == colour.keys() | texture.keys()
    uniform = np.full(K, 1 / K)
    for row, index in enumerate(layers.index):
        for layer, wanted in ((layers.p_colour, colour), (layers.p_texture, texture)):
            np.testing.assert_allclose(
                layer[row], wanted.get(index.tobytes(), uniform), rtol=2e-5, atol=1e-30
            )


def columns_of(observation: Observation) -> list[np.ndarray]:
    return [getattr(observation, name) for name in Observation.__slots__]


@pytest.mark.parametrize("pixels", [1, 7, 138])
def test_a_frame_is_one_observation_however_many_pixels_it_has(pixels: int) -> None:
    once = VoxelMap(SIZE_M, CLASSES, "frame")
    once.add(one_voxel(sure_of(2, 0.6)), 0)
    many = VoxelMap(SIZE_M, CLASSES, "frame")
    delta = many.add(one_voxel(np.repeat(sure_of(2, 0.6), pixels, axis=0)), 0)
    np.testing.assert_allclose(many.fused().p, once.fused().p, rtol=1e-5)
    assert delta.colour_count.tolist() == [1]
    assert delta.texture_count.tolist() == [0]


def test_literal_pixels_saturate_a_voxel_in_one_frame_and_the_frame_update_does_not() -> None:
    weak = np.repeat(sure_of(2, 0.4), 138, axis=0)
    p = {}
    for update in ("independent", "frame"):
        voxels = VoxelMap(SIZE_M, CLASSES, update)
        voxels.add(one_voxel(weak), 0)
        p[update] = voxels.fused().p[0, 2]
    assert p["independent"] > 0.999999
    assert p["frame"] == pytest.approx(0.4, abs=1e-4)


def test_a_frame_tempers_texture_by_its_weight_and_averages() -> None:
    """Three windows in a voxel: texture adds the mean of w·ll, the weight the mean of w."""
    log = np.log(np.random.default_rng(0).dirichlet(np.ones(K), 3)).astype(np.float32)
    w = np.array([0.0, 0.5, 1.0], np.float32)
    voxels = VoxelMap(SIZE_M, CLASSES, "frame")
    voxels.add(one_voxel(texture=log, weight=w), 0)
    layers = voxels.fused()
    tempered = (w[:, None] * log).sum(axis=0) / 3
    np.testing.assert_allclose(layers.p_texture[0], np.exp(tempered) / np.exp(tempered).sum(), rtol=1e-5)
    assert layers.weight.tolist() == [0.5]
    assert layers.count.tolist() == [1]


def test_dividing_by_the_training_prior_is_the_callers_doing() -> None:
    """The map multiplies what it gets: undivided posteriors would count the prior once a frame."""
    prior = np.array([0.6, 0.1, 0.1, 0.1, 0.1])
    posterior = prior[None]  # a pixel that says nothing: its posterior is the prior
    divided, undivided = (VoxelMap(SIZE_M, CLASSES) for _ in range(2))
    for t_ns in range(5):
        divided.add(one_voxel(np.log(posterior / prior)), t_ns)
        undivided.add(one_voxel(np.log(posterior)), t_ns)
    np.testing.assert_allclose(divided.fused().p[0], 1 / K, rtol=1e-6)
    assert undivided.fused().p[0, 0] > 0.99


def test_no_class_ever_reaches_zero_and_a_voxel_can_change_its_mind() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES, "independent")
    strong = np.repeat(sure_of(0, 0.999), 500, axis=0)
    for t_ns in range(4):
        voxels.add(one_voxel(strong, strong, 1.0), t_ns)
    # Eq. 3.9 as a product of float64 probabilities: what is 0 once stays 0 whatever comes later.
    assert np.prod(np.exp(strong[:, 3].astype(np.float64))) == 0
    for pool in ("linear", "log-linear"):
        layers = voxels.fused(pool)
        for p in (layers.p_colour, layers.p_texture, layers.p):
            assert p.min() > 0
            np.testing.assert_allclose(p.sum(axis=1), 1, rtol=1e-5)
    for t_ns in range(5):
        voxels.add(one_voxel(np.repeat(sure_of(3, 0.999), 500, axis=0)), t_ns)
    assert voxels.fused().p_colour[0].argmax() == 3


def test_points_that_no_route_speaks_of_make_no_voxel() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES)
    delta = voxels.add(observe(50, 0, missing=1.1), 0)
    assert len(voxels) == len(delta.index) == 0
    assert delta.sequence == voxels.sequence == 1
    assert len(voxels.add(observe(0, 0), 1).index) == 0


def test_pixels_may_come_in_any_order() -> None:
    frame = observe(3000, 5)
    order = np.random.default_rng(1).permutation(3000)
    shuffled = Observation(*[column[order] for column in columns_of(frame)])
    for update in ("frame", "independent"):
        left, right = VoxelMap(SIZE_M, CLASSES, update), VoxelMap(SIZE_M, CLASSES, update)
        a, b = left.add(frame, 0), right.add(shuffled, 0)
        np.testing.assert_array_equal(a.index, b.index)
        np.testing.assert_array_equal(a.texture_count, b.texture_count)
        np.testing.assert_allclose(a.colour, b.colour, atol=1e-4)
        np.testing.assert_allclose(a.texture, b.texture, atol=1e-4)


# How layers are fused


def test_the_linear_pool_is_equation_3_11_with_the_mean_weight_of_the_pixels() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES, "independent")
    random = np.random.default_rng(3)
    colour, texture = np.log(random.dirichlet(np.ones(K), (2, 4))).astype(np.float32)
    w = np.array([0.1, 0.2, 0.3, 0.9], np.float32)
    voxels.add(one_voxel(colour, texture, w), 0)
    p_c = np.exp(colour.astype(np.float64)).prod(axis=0)
    p_t = np.exp(texture.astype(np.float64)).prod(axis=0)
    p_c, p_t = p_c / p_c.sum(), p_t / p_t.sum()
    combined = p_c + w.mean() * p_t
    layers = voxels.fused("linear")
    np.testing.assert_allclose(layers.p[0], combined / combined.sum(), rtol=1e-4)
    logarithmic = p_c * p_t ** w.mean()
    np.testing.assert_allclose(voxels.fused("log-linear").p[0], logarithmic / logarithmic.sum(), rtol=1e-4)
    assert layers.weight[0] == pytest.approx(w.mean())
    assert layers.label().tolist() == [1 + combined.argmax()]


@pytest.mark.parametrize("update", ["frame", "independent"])
@pytest.mark.parametrize("pool", ["linear", "log-linear"])
def test_a_voxel_seen_by_one_route_alone_keeps_that_routes_distribution(update: str, pool: str) -> None:
    for route in ("colour", "texture"):
        voxels = VoxelMap(SIZE_M, CLASSES, update)
        voxels.add(one_voxel(**{route: sure_of(1, 0.7)}, weight=0.25), 0)
        layers = voxels.fused(pool)
        own, other = (layers.p_colour, layers.p_texture)[:: 1 if route == "colour" else -1]
        np.testing.assert_array_equal(layers.p, own)
        np.testing.assert_allclose(other, 1 / K)
        assert layers.p[0].argmax() == 1
        assert layers.p[0, 1] > 1 / K + 0.05


@few
@given(st.floats(0.5001, 1.0), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_texture_never_outvotes_a_sure_colour_in_the_linear_pool(sure: float, w: float, seed: int) -> None:
    """P_c > 1/2 + 1/2 · w is more than texture can add; a sure colour keeps its label at any w ≤ 1."""
    colour = sure_of(0, 1 - 1e-12)
    texture = np.log(np.random.default_rng(seed).dirichlet(np.full(K, 0.05), 1) + 1e-9).astype(np.float32)
    yes = np.ones(1, bool)
    p = fuse(colour, texture, yes, yes, np.array([w], np.float32), "linear")
    assert p[0, 0] >= p[0, 1:].max()


def test_texture_can_outvote_a_sure_colour_in_the_log_linear_pool() -> None:
    colour, texture = sure_of(0, 0.99), sure_of(1, 0.9999)
    label = {}
    for pool in ("linear", "log-linear"):
        voxels = VoxelMap(SIZE_M, CLASSES, "independent")
        voxels.add(one_voxel(colour, texture, 0.9), 0)
        label[pool] = voxels.fused(pool).p[0].argmax()
    assert label == {"linear": 0, "log-linear": 1}


def test_the_weight_enters_once() -> None:
    """With update "frame" it is in the evidence, with "independent" it is the pool's exponent."""
    colour, texture = sure_of(0, 0.7), sure_of(1, 0.9)
    p = []
    for update in ("frame", "independent"):
        voxels = VoxelMap(SIZE_M, CLASSES, update)
        voxels.add(one_voxel(colour, texture, 0.5), 0)
        p.append(voxels.fused("log-linear").p)
    np.testing.assert_allclose(p[0], p[1], rtol=1e-5)


def test_a_voxel_that_was_seen_but_says_nothing_has_no_label() -> None:
    """Texture whose weight is 0 counts as seen; its class is not guessed."""
    voxels = VoxelMap(SIZE_M, CLASSES)
    voxels.add(one_voxel(texture=sure_of(1, 0.9), weight=0.0), 0)
    layers = voxels.fused()
    assert layers.count.tolist() == [1]
    assert layers.label().tolist() == [0]
    voxels.add(one_voxel(sure_of(1, 0.9)), 1)
    assert voxels.fused().label().tolist() == [2]


def test_softmax_is_shift_free_and_never_zero() -> None:
    log = np.array([[0, -5000, -1], [1e6, 1e6 - 1, -1e6]], np.float32)
    p = softmax(log)
    np.testing.assert_array_equal(p, softmax(log - log.max(axis=1, keepdims=True)))
    assert p.min() > 0
    assert p.dtype == np.float32


def test_at_gives_what_fused_gives_in_the_order_asked_and_uniform_where_nothing_was_seen() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES)
    voxels.add(observe(500, 2), 0)
    layers = voxels.fused()
    asked = np.concatenate([layers.index[::-1], [[5000, -5000, 7]]])
    found = voxels.at(asked)
    for name in ("p_colour", "p_texture", "p", "weight", "count"):
        np.testing.assert_array_equal(getattr(found, name)[:-1], getattr(layers, name)[::-1])
    np.testing.assert_allclose(found.p[-1], 1 / K)
    assert found.count[-1] == found.label()[-1] == 0
    np.testing.assert_array_equal(found.index, asked)


# Deltas and snapshots


@few
@given(st.lists(st.integers(0, 50), min_size=1, max_size=6), st.randoms(use_true_random=False))
def test_deltas_make_the_same_map_whatever_the_order_of_their_voxels(seeds: list[int], random) -> None:
    original = VoxelMap(SIZE_M, CLASSES)
    mirror = VoxelMap(SIZE_M, CLASSES)
    for t_ns, seed in enumerate(seeds):
        delta = original.add(observe(60, seed), t_ns)
        order = random.sample(range(len(delta.index)), len(delta.index))
        mirror.apply(replace(delta, **{name: getattr(delta, name)[order] for name in COLUMNS}))
    assert_same(mirror.snapshot(), original.snapshot())


@few
@given(st.integers(1, 6), st.data())
def test_a_snapshot_and_deltas_in_any_repetition_merge_to_the_original(frames: int, data) -> None:
    """Old deltas again, the same ones twice, a snapshot in between: state merges, it does not add up."""
    original = VoxelMap(SIZE_M, CLASSES)
    deltas, snapshots = [], []
    for t_ns in range(frames):
        deltas.append(original.add(observe(60, t_ns), t_ns))
        snapshots.append(original.snapshot())
    taken = data.draw(st.integers(0, frames - 1))
    mirror = VoxelMap(SIZE_M, CLASSES)
    assert mirror.apply(snapshots[taken])
    for delta in deltas[: taken + 1]:
        mirror.apply(delta)
    assert_same(mirror.snapshot(), snapshots[taken])
    for delta in deltas[taken + 1 :]:
        assert mirror.apply(delta)
        assert mirror.apply(delta)
    assert_same(mirror.snapshot(), original.snapshot())
    assert mirror.apply(original.snapshot())
    assert not mirror.apply(deltas[0]) or frames == 1
    assert_same(mirror.snapshot(), original.snapshot())
    assert len(mirror) == len(original)


def test_an_update_of_another_epoch_starts_from_nothing() -> None:
    old, new = VoxelMap(SIZE_M, CLASSES), VoxelMap(SIZE_M, CLASSES)
    for t_ns in range(5):
        old.add(observe(100, t_ns), t_ns)
    new.add(observe(40, 9), 3)
    assert old.epoch != new.epoch
    assert old.apply(new.snapshot())
    assert_same(old.snapshot(), new.snapshot())


def test_a_snapshot_is_a_copy() -> None:
    voxels = VoxelMap(SIZE_M, CLASSES, epoch="0" * 32)
    voxels.add(observe(100, 0), 0)
    before = voxels.snapshot()
    kept = before.colour.copy()
    voxels.add(observe(100, 0), 1)
    np.testing.assert_array_equal(before.colour, kept)
    assert (voxels.snapshot().t_ns, voxels.snapshot().sequence) == (1, 2)


def test_many_small_frames_and_one_snapshot_keep_every_voxel() -> None:
    """The directory and the rows grow many times over on the way."""
    voxels = VoxelMap(SIZE_M, CLASSES)
    seen = set()
    for seed in range(12):
        frame = observe(800, seed, extent_m=2.0, missing=0.0)
        voxels.add(frame, seed)
        seen |= {index.tobytes() for index in voxel_of(frame.point_base, SIZE_M)}
    snapshot = voxels.snapshot()
    assert {index.tobytes() for index in snapshot.index} == seen
    assert len(voxels) == len(seen)
    assert (np.diff(pack(snapshot.index)) > 0).all()


def test_readers_see_whole_frames_while_another_thread_adds() -> None:
    """Each frame counts every voxel once; a torn read would show two different counts."""
    voxels = VoxelMap(SIZE_M, CLASSES)
    frame = observe(4000, 1, missing=0.0)
    done = threading.Event()

    def work() -> None:
        for t_ns in range(60):
            voxels.add(frame, t_ns)
        done.set()

    thread = threading.Thread(target=work)
    thread.start()
    while not done.is_set():
        snapshot = voxels.snapshot()
        assert (snapshot.colour_count == snapshot.sequence).all()
    thread.join()
    assert voxels.sequence == 60


# What is refused


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": np.full((1, K), -np.inf, np.float32)}, "log-likelihood is not finite"),
        ({"texture": np.full((1, K), np.nan, np.float32)}, "log-likelihood is not finite"),
        ({"colour": np.zeros((1, K + 1), np.float32)}, r"colour.*shape \(1, 6\), needs float32 of \(1, 5\)"),
        ({"colour": np.zeros((1, K), np.float64)}, "colour: float64"),
        ({"has_colour": np.ones(2, bool)}, "has_colour"),
        ({"weight": np.array([1.5], np.float32)}, "weight: a value is outside"),
        ({"weight": np.array([np.nan], np.float32)}, "weight: a value is outside"),
        ({"has_texture": np.zeros(1, bool)}, "weight: not 0 where"),
        ({"point_base": np.array([[np.nan, 0, 0]], np.float32)}, "points"),
    ],
)
def test_a_bad_observation_is_refused_and_changes_nothing(
    change: dict[str, np.ndarray], message: str
) -> None:
    voxels = VoxelMap(SIZE_M, CLASSES)
    good = one_voxel(sure_of(1), sure_of(1), 0.5)
    voxels.add(good, 0)
    before = voxels.snapshot()
    with pytest.raises(InputError, match=message):
        voxels.add(replace(good, **change), 1)
    assert_same(voxels.snapshot(), before)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epoch": "elsewhere"}, "epoch"),
        ({"sequence": -1}, "sequence"),
        ({"index": np.full((1, 3), 2**20, np.int32)}, "index is outside"),
        ({"colour": np.full((1, K), np.nan, np.float32)}, "not finite"),
        ({"weight": np.full(1, -1, np.float32)}, "weight"),
        ({"texture_count": np.full(1, -1, np.int32)}, "count is negative"),
        ({"colour_count": np.zeros(2, np.int32)}, "colour_count"),
    ],
)
def test_a_bad_update_is_refused_and_changes_nothing(change: dict[str, object], message: str) -> None:
    voxels = VoxelMap(SIZE_M, CLASSES)
    good: MapUpdate = voxels.add(one_voxel(sure_of(1)), 0)
    before = voxels.snapshot()
    with pytest.raises(InputError, match=message):
        voxels.apply(replace(good, **change))
    twice = replace(good, **{name: np.repeat(getattr(good, name), 2, axis=0) for name in COLUMNS})
    with pytest.raises(InputError, match="twice"):
        voxels.apply(twice)
    assert_same(voxels.snapshot(), before)


def test_unknown_updates_and_pools_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="frame, independent"):
        VoxelMap(SIZE_M, CLASSES, "pixel")
    with pytest.raises(ConfigurationError, match="linear, log-linear"):
        VoxelMap(SIZE_M, CLASSES).fused("mean")
