"""The support vector machine against scikit-learn and libsvm, and what its sigmoids are fitted on."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from overlapping_clusters import clusters
from sklearn.metrics import log_loss
from sklearn.svm import SVC

from surfclass.classifiers import svm
from surfclass.classifiers.folds import deal_folds, thin_out
from surfclass.errors import InputError


@pytest.fixture(scope="module")
def machine() -> svm.Svm:
    return svm.train(*clusters(2000, 0))


@pytest.mark.parametrize("kernel", ["rbf", "linear"])
@pytest.mark.parametrize("k", [2, 3, 5])
def test_decision_is_scikit_learns(kernel: svm.Kernel, k: int) -> None:
    x, y, place = clusters(600, 1, k)
    ours = svm.train(x, y, place, kernel=kernel, C=3.0, gamma=0.7)
    theirs = SVC(kernel=kernel, C=3.0, gamma=0.7, decision_function_shape="ovo")
    theirs.fit((x - ours.mean) / ours.scale, y)
    test = clusters(3000, 2, k)[0]
    expected = theirs.decision_function((test - ours.mean) / ours.scale)
    if k == 2:
        expected = -expected[:, None]  # its positive side is the second class, libsvm's the first
    assert np.abs(ours.decision(test) - expected).max() < 1e-9


def test_a_linear_machine_is_one_weight_matrix() -> None:
    x, y, place = clusters(600, 1, 3)
    ours = svm.train(x, y, place, kernel="linear")
    assert ours.support.shape == (0, 3)
    assert ours.coefficient.shape == (3, 3)


@pytest.mark.parametrize("k", [3, 4, 5])
def test_posterior_is_libsvms_with_its_own_sigmoids(k: int) -> None:
    x, y, place = clusters(2000, 3, k)
    ours = svm.train(x, y, place)
    test = clusters(2000, 4, k)[0]
    z, z_test = (x - ours.mean) / ours.scale, (test - ours.mean) / ours.scale
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # deprecated in 1.9, removed in 1.11
            libsvm = SVC(C=10.0, gamma=1.0, probability=True, random_state=0).fit(z, y)
            A, B = libsvm.probA_, libsvm.probB_
            theirs = libsvm.predict_proba(z_test)
    except (TypeError, AttributeError):
        pytest.skip("this scikit-learn no longer has libsvm's probabilities")
    ours = replace(ours, A=A, B=B)
    apart = np.abs(ours.posterior(test) - theirs)
    # The gap is libsvm's own: it stops iterating where Q p is within 0.005 / k of a constant.
    assert apart.max() < 4e-3
    assert np.quantile(apart, 0.99) < 2e-3
    assert apart.mean() < 3e-4
    assert stationarity(ours, test, theirs) < 0.005 / k
    assert stationarity(ours, test, ours.posterior(test)) < 1e-12


def stationarity(machine: svm.Svm, x: np.ndarray, p: np.ndarray) -> float:
    """Largest |(Q p)ᵢ − pᵀ Q p|, which is 0 at the minimum of the coupling's objective."""
    k = p.shape[1]
    r = np.zeros((len(x), k, k))
    r[:, *np.triu_indices(k, 1)] = np.clip(
        1 / (1 + np.exp(machine.A * machine.decision(x) + machine.B)), 1e-7, 1 - 1e-7
    )
    r += np.tril(1 - r.swapaxes(1, 2), -1)
    Q = -r * r.swapaxes(1, 2)
    Q[:, range(k), range(k)] = (r**2).sum(axis=1)
    Qp = np.einsum("nij,nj->ni", Q, p)
    return float(np.abs(Qp - (p * Qp).sum(axis=1, keepdims=True)).max())


def test_posteriors_are_calibrated_on_new_places(machine: svm.Svm) -> None:
    x, y, _ = clusters(20_000, 5)
    p = machine.posterior(x)
    sure = p.max(axis=1)
    right = p.argmax(axis=1) == y
    bins = np.minimum((sure * 10).astype(int), 9)
    error = sum(abs(sure[bins == b].sum() - right[bins == b].sum()) for b in range(10)) / len(y)
    assert error < 0.03
    assert log_loss(y, p) < 0.30
    assert p.sum(axis=1) == pytest.approx(1, abs=1e-12)


def test_sigmoids_from_places_that_were_trained_on_are_over_confident() -> None:
    """With places that differ much, holding out samples instead of places hides the difference."""
    random = np.random.default_rng(0)
    y = np.arange(1200) % 3
    place = (np.arange(1200) // 3) % 8 * 3 + y
    x = np.eye(3)[y] + 0.7 * random.normal(size=(24, 3))[place] + 0.1 * random.normal(size=(1200, 3))
    new = np.eye(3)[y] + 0.7 * random.normal(size=(1200, 3)) + 0.1 * random.normal(size=(1200, 3))
    by_place = svm.train(x, y, place)
    by_sample = svm.train(x, y, np.arange(1200))
    assert by_place.held_out == by_sample.held_out == "groups"
    assert log_loss(y, by_place.posterior(new)) < 0.7 * log_loss(y, by_sample.posterior(new))


def test_grid_is_the_posterior_at_its_nodes(machine: svm.Svm) -> None:
    linear = svm.train(*clusters(400, 0), kernel="linear")
    axes = [np.linspace(-0.2, 1.2, 11), np.linspace(0, 0.8, 12), np.linspace(0, 0.7, 13)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    for one in (machine, linear):
        expected = one.posterior(nodes.reshape(-1, 3)).reshape(11, 12, 13, 4)
        assert np.abs(one.posterior_on_grid(axes) - expected).max() < 1e-3
    flat = svm.train(clusters(400, 0)[0][:, :2], *clusters(400, 0)[1:])
    nodes = np.stack(np.meshgrid(*axes[:2], indexing="ij"), axis=-1).reshape(-1, 2)
    assert np.abs(flat.posterior_on_grid(axes[:2]).reshape(-1, 4) - flat.posterior(nodes)).max() < 1e-3
    with pytest.raises(InputError, match="2 axes"):
        machine.posterior_on_grid(axes[:2])


def test_arrays_bring_the_machine_back_and_training_repeats(machine: svm.Svm) -> None:
    x = clusters(100, 7)[0]
    arrays = machine.to_arrays()
    assert all(array.dtype != object for array in arrays.values())
    assert np.array_equal(svm.Svm.from_arrays(arrays).posterior(x), machine.posterior(x))
    again = svm.train(*clusters(2000, 0)).to_arrays()
    assert all(np.array_equal(again[name], arrays[name]) for name in arrays)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"A": np.ones(5)}, r"A is \(5,\), must be \(6,\)"),
        ({"support": np.full((3, 3), np.nan)}, "support holds"),
        ({"scale": np.zeros(3)}, "positive scales"),
        ({"kernel": np.array("poly")}, "'poly'"),
        ({"mean": np.array(["a", "b", "c"])}, "SVM"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    machine: svm.Svm, change: dict[str, np.ndarray], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        svm.Svm.from_arrays(machine.to_arrays() | change)
    without = machine.to_arrays()
    del without["B"]
    with pytest.raises(InputError, match="B missing"):
        svm.Svm.from_arrays(without)


def test_a_class_without_samples_is_named() -> None:
    x, y, place = clusters(90, 0, 3)
    with pytest.raises(InputError, match="class timber has 0 samples"):
        svm.train(x[y != 1], y[y != 1], place[y != 1], names=["paint", "timber", "rust"])
    with pytest.raises(InputError, match="class 1 has 0 samples"):
        svm.train(x[y != 1], y[y != 1], place[y != 1])
    with pytest.raises(InputError, match="labels of int64 from 0 to 2"):
        svm.train(x, y, place, names=["paint", "timber"])
    with pytest.raises(InputError, match="not finite"):
        svm.train(np.where(y[:, None] == 2, np.nan, x), y, place)
    with pytest.raises(InputError, match="at least 2 folds"):
        svm.train(x, y, place, folds=1)


def test_features_of_another_size_are_refused(machine: svm.Svm) -> None:
    with pytest.raises(InputError, match=r"must be \(n, 3\)"):
        machine.decision(np.zeros((5, 2)))
    with pytest.raises(InputError, match="not finite"):
        machine.posterior(np.full((1, 3), np.inf))


def test_a_feature_that_never_varies_is_harmless() -> None:
    x, y, place = clusters(400, 0)
    constant = np.hstack([x, np.full((400, 1), 0.1)])
    with_it = svm.train(constant, y, place).posterior(constant)
    assert with_it == pytest.approx(svm.train(x, y, place).posterior(x), abs=1e-9)


def test_the_prior_is_what_was_trained_on() -> None:
    x, y, place = clusters(400, 0)
    keep = (y != 0) | (np.arange(400) < 100)
    ours = svm.train(x[keep], y[keep], place[keep])
    assert ours.prior == pytest.approx(np.bincount(y[keep]) / keep.sum())


def test_groups_are_dealt_whole_and_each_class_is_left_in_every_training_set() -> None:
    _, y, place = clusters(2000, 0)
    fold, held_out = deal_folds(y, place, 5, 0)
    assert held_out == "groups"
    assert all(len(set(fold[place == g])) == 1 for g in np.unique(place))
    for part in range(5):
        assert set(y[fold != part]) == set(y[fold == part]) == {0, 1, 2, 3}


def test_a_class_with_two_groups_is_still_held_out_by_groups() -> None:
    y = np.repeat([0, 1], [200, 40])
    place = np.concatenate([np.arange(200) % 10, 100 + np.arange(40) % 2])
    fold, held_out = deal_folds(y, place, 5, 0)
    assert held_out == "groups"
    assert len(set(fold[y == 1])) == 2


def test_a_class_with_one_group_falls_back_to_samples_and_says_so() -> None:
    x, y, place = clusters(400, 0)
    single = np.where(y == 2, 999, place)
    fold, held_out = deal_folds(y, single, 5, 0)
    assert held_out == "samples"
    assert all((np.bincount(fold[y == k]) == 20).all() for k in range(4))
    assert svm.train(x, y, single).held_out == "samples"


def test_thinning_keeps_shares_and_small_classes() -> None:
    y = np.repeat([0, 1, 2], [6000, 3900, 100])
    groups = np.where(y == 0, np.arange(10_000) % 4, 10)
    chosen = thin_out(y, groups, 2000, 0)
    assert np.bincount(y[chosen]).tolist() == [1200, 780, 100]
    assert np.bincount(groups[chosen][y[chosen] == 0]).tolist() == [300] * 4
    assert np.array_equal(chosen, np.unique(chosen))
    assert np.array_equal(thin_out(y[:50], groups[:50], 100, 0), np.arange(50))
    most = svm.train(*clusters(3000, 0), most_samples=800)
    assert most.support.shape[0] < svm.train(*clusters(3000, 0)).support.shape[0]
