"""Which samples are drawn, how hyper-parameters are chosen, and whether posteriors mean what they say."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from overlapping_clusters import clusters

from surfclass.classifiers import svm
from surfclass.classifiers.reliability import calibration_error, reliability
from surfclass.classifiers.search import place_losses, search
from surfclass.classifiers.selection import draw, shares


@given(st.lists(st.integers(1, 50), min_size=1, max_size=12), st.integers(0, 400), st.integers(0, 9))
def test_shares_are_as_equal_as_the_groups_allow(sizes, wanted, seed):
    size = np.array(sizes)
    count = min(wanted, int(size.sum()))
    share = shares(size, count, np.random.default_rng(seed))
    assert share.sum() == count
    assert (share <= size).all()
    assert (share >= 0).all()
    open_ = share[share < size]
    assert not len(open_) or share.max() - open_.min() <= 1


@settings(max_examples=25)
@given(st.integers(1, 60), st.sampled_from(["even", "random"]), st.integers(0, 5))
def test_rows_are_drawn_once_and_no_class_exceeds_its_share(per_class, selection, seed):
    x, label, place = clusters(400, seed)
    rows = draw(x, label, place, per_class, selection, seed)
    assert len(np.unique(rows)) == len(rows)
    assert (np.bincount(label[rows]) == np.minimum(per_class, np.bincount(label))).all()
    assert np.array_equal(rows, draw(x, label, place, per_class, selection, seed))


def test_even_drawing_gives_a_small_place_the_share_of_a_large_one():
    place = np.repeat([0, 1], [5000, 200])
    x = np.random.default_rng(0).random((5200, 3))
    rows = draw(x, np.zeros(5200, int), place, 100, "even", 0)
    assert (np.bincount(place[rows]) == [50, 50]).all()
    by_chance = draw(x, np.zeros(5200, int), place, 100, "random", 0)
    assert np.bincount(place[by_chance], minlength=2)[1] < 15


def test_even_drawing_covers_the_intensities_of_a_place():
    x = np.sort(np.random.default_rng(0).random(1000))[:, None]
    rows = draw(x, np.zeros(1000, int), np.zeros(1000, int), 100, "even", 0)
    assert np.diff(rows).max() <= 11


def test_even_drawing_is_no_worse_than_random_on_other_places():
    """Places of very different size, as near and far captures have."""
    loss = {"even": [], "random": []}
    for seed in range(6):
        random = np.random.default_rng(seed)
        x, label, place = clusters(12_000, seed)
        size = random.pareto(0.7, size=80) + 0.05
        kept = random.random(len(x)) < (size / size.max())[place] + 0.01
        unseen = place // 4 >= 12
        inside = np.flatnonzero(kept & ~unseen)
        for selection, losses in loss.items():
            rows = inside[draw(x[inside], label[inside], place[inside], 60, selection, seed)]
            machine = svm.train(x[rows], label[rows], place[rows], C=1.0, gamma=0.3)
            outside = np.flatnonzero(unseen)[::3]
            losses.append(place_losses(machine.posterior(x[outside]), label[outside], place[outside]).mean())
    assert np.mean(loss["even"]) < np.mean(loss["random"]) + 0.005


def test_the_search_holds_out_places_and_prefers_the_smooth():
    x, label, place = clusters(1200, 0)
    chosen, trials = search(x, label, place, "rbf", (1.0, 10.0), (0.1, 1.0, 300.0), 3, 0)
    assert len(trials) == 6
    best = min(trials, key=lambda trial: trial.nll)
    assert chosen.nll <= best.nll + best.sd
    smoother = [t for t in trials if (t.gamma, t.C) < (chosen.gamma, chosen.C)]
    assert all(trial.nll > best.nll + best.sd for trial in smoother)
    assert chosen.gamma < 300  # which knows its own places by heart
    assert (chosen, trials) == search(x, label, place, "rbf", (10.0, 1.0), (1.0, 300.0, 0.1), 3, 0)


def test_a_linear_machine_has_no_gamma_to_search():
    x, label, place = clusters(400, 0)
    assert len(search(x, label, place, "linear", (0.1, 1.0), (0.1, 1.0), 3, 0)[1]) == 2


def test_held_out_posteriors_are_those_of_new_places_and_training_ones_are_not():
    x, label, place = clusters(4000, 1)
    seen = np.flatnonzero(place // 4 < 10)
    new = np.flatnonzero(place // 4 >= 10)
    found = svm.cross_fit(x[seen], label[seen], place[seen], C=100.0, gamma=30.0)

    def nll(posterior, truth):
        return -np.log(posterior[np.arange(len(truth)), truth]).mean()

    held_out = nll(found.posterior, label[seen][found.rows])
    assert held_out == pytest.approx(nll(found.machine.posterior(x[new]), label[new]), rel=0.25)
    assert nll(found.machine.posterior(x[seen]), label[seen]) < 0.7 * held_out


def test_a_posterior_that_is_right_as_often_as_it_says_has_no_calibration_error():
    random = np.random.default_rng(0)
    confidence = random.uniform(0.2, 1, 200_000)
    right = random.random(200_000) < confidence
    assert calibration_error(confidence, right) < 0.006
    assert calibration_error(np.sqrt(confidence), right) == pytest.approx(
        (np.sqrt(confidence) - confidence).mean(), abs=0.006
    )


def test_a_reliability_diagram_counts_every_sample_and_leaves_empty_bins_empty():
    found = reliability(np.array([0.05, 0.95, 1.0, 0.93]), np.array([True, False, True, True]), bins=10)
    assert found.count.tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 0, 3]
    assert found.accuracy[-1] == pytest.approx(2 / 3)
    assert found.confidence[0] == pytest.approx(0.05)
    assert found.accuracy[4] == 0
    assert np.isnan(reliability(np.zeros(0), np.zeros(0, bool)).error)
