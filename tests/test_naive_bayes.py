"""Naive Bayes against scikit-learn, the reject option, and the forms as printed."""

import numpy as np
import pytest
from overlapping_clusters import clusters
from sklearn.naive_bayes import GaussianNB

from surfclass.classifiers import naive_bayes
from surfclass.classifiers.naive_bayes import NaiveBayes
from surfclass.errors import InputError


@pytest.fixture(scope="module")
def bayes() -> NaiveBayes:
    return naive_bayes.train(*clusters(2000, 0)[:2])


def test_posterior_is_scikit_learns(bayes: NaiveBayes) -> None:
    x, y, _ = clusters(2000, 0)
    test = clusters(500, 1)[0]
    theirs = GaussianNB(priors=np.full(4, 0.25), var_smoothing=0).fit(x, y)
    assert bayes.posterior(test) == pytest.approx(theirs.predict_proba(test), abs=1e-9)


def test_the_prior_enters_once_not_once_for_each_feature() -> None:
    prior = np.array([0.9, 0.1])
    bayes = NaiveBayes(np.zeros((2, 3)), np.ones((2, 3)), np.stack([np.eye(3)] * 2), prior, 4.0)
    assert bayes.posterior(np.ones((1, 3)))[0] == pytest.approx(prior, abs=1e-12)
    printed = prior**3 / (prior**3).sum()  # Eq. C.3 with P(M) inside the product
    assert abs(bayes.posterior(np.ones((1, 3)))[0] - printed).max() > 0.09


def test_the_label_is_the_best_class_not_its_probability(bayes: NaiveBayes) -> None:
    """As printed, Eq. C.4 gives the largest probability itself."""
    x, y, _ = clusters(500, 1)
    kept = ~bayes.rejects(x)
    assert kept.mean() > 0.98
    assert np.array_equal(bayes.label(x)[kept], bayes.posterior(x).argmax(axis=1)[kept] + 1)
    assert (bayes.label(x)[kept] == y[kept] + 1).mean() > 0.7


def test_what_is_far_from_every_class_is_unknown_however_sure_the_posterior_is(bayes: NaiveBayes) -> None:
    far = np.array([[5.0, 5.0, 5.0], [0.0, 0.9, 0.0], [-1.0, 0.2, 0.2]])
    assert (bayes.posterior(far).max(axis=1) > 0.99).all()
    assert bayes.rejects(far).all()
    assert (bayes.label(far) == 0).all()


@pytest.mark.parametrize("share", [0.001, 0.05])
@pytest.mark.parametrize("d", [2, 3, 8])
def test_the_chi_square_quantile_rejects_its_share_of_a_correlated_gaussian(d: int, share: float) -> None:
    random = np.random.default_rng(0)
    mixing = np.eye(d) + 0.5 * random.normal(size=(d, d))
    x = random.normal(size=(60_000, d)) @ mixing
    y = np.arange(60_000) % 2
    x[y == 1] += 1000
    bayes = naive_bayes.train(x[:30_000], y[:30_000], rejected_share=share)
    assert bayes.rejects(x[30_000:]).mean() == pytest.approx(share, rel=0.35)


def test_distance_is_mahalanobis() -> None:
    random = np.random.default_rng(1)
    x = random.normal(size=(4000, 2)) @ np.array([[2.0, 0.5], [0.0, 1.0]]) + 3
    y = np.arange(4000) % 2
    bayes = naive_bayes.train(x, y)
    first = x[y == 0]
    away = np.array([[5.0, 1.0]]) - first.mean(axis=0)
    expected = np.sqrt(away @ np.linalg.inv(np.cov(first.T)) @ away.T).item()
    assert bayes.distance(np.array([[5.0, 1.0]]))[0, 0] == pytest.approx(expected, rel=0.01)


def test_histograms_whose_bins_are_empty_or_sum_to_one_can_be_trained_on() -> None:
    random = np.random.default_rng(0)
    x = np.concatenate([random.dirichlet([5, 3, 2], 300), random.dirichlet([2, 3, 5], 300)])
    x = np.hstack([x, np.zeros((600, 1)), np.where(np.arange(600) < 300, 0, x[:, 0])[:, None]])
    y = np.repeat([0, 1], 300)
    bayes = naive_bayes.train(x, y)
    assert np.isfinite(bayes.posterior(x)).all()
    assert (bayes.posterior(x).argmax(axis=1) == y).mean() > 0.9
    assert bayes.rejects(x).mean() < 0.1


def test_arrays_bring_it_back_and_those_that_do_not_fit_are_refused(bayes: NaiveBayes) -> None:
    x = clusters(50, 3)[0]
    arrays = bayes.to_arrays()
    back = NaiveBayes.from_arrays(arrays)
    assert np.array_equal(back.posterior(x), bayes.posterior(x))
    assert np.array_equal(back.rejects(x), bayes.rejects(x))
    for change, said in [
        ({"prior": np.ones(3)}, r"prior is \(3,\), must be \(4,\)"),
        ({"variance": np.zeros((4, 3))}, "must be positive"),
        ({"mean": np.full((4, 3), np.nan)}, "mean holds"),
        ({"mean": np.zeros(4)}, r"must be \(k, d\)"),
        ({"reject_distance": np.array("far")}, "naive Bayes"),
    ]:
        with pytest.raises(InputError, match=said):
            NaiveBayes.from_arrays(arrays | change)
    with pytest.raises(InputError, match="mean missing"):
        NaiveBayes.from_arrays({name: array for name, array in arrays.items() if name != "mean"})


def test_samples_that_cannot_be_trained_on_are_refused() -> None:
    x, y, _ = clusters(90, 0, 3)
    with pytest.raises(InputError, match="class timber has 0 samples"):
        naive_bayes.train(x[y != 1], y[y != 1], names=["paint", "timber", "rust"])
    with pytest.raises(InputError, match="between 0 and 1"):
        naive_bayes.train(x, y, rejected_share=0.0)
    with pytest.raises(InputError, match=r"must be \(n, d\)"):
        naive_bayes.train(x, y[:5])
    with pytest.raises(InputError, match=r"must be \(n, 3\)"):
        naive_bayes.train(x, y).posterior(x[:, :2])
