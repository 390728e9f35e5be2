"""The sigmoid fit against a general minimiser and against its failure modes."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from surfclass.classifiers.platt import fit_sigmoid, sigmoid
from surfclass.errors import InputError


def scores(seed: int, n: int, share: float, gap: float) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    positive = random.random(n) < share
    positive[:2] = True, False
    return random.normal(size=n) + gap * np.where(positive, 1, -1), positive


def softened(positive: np.ndarray) -> np.ndarray:
    up, down = positive.sum(), (~positive).sum()
    return np.where(positive, (up + 1) / (up + 2), 1 / (down + 2))


def entropy(ab: np.ndarray, f: np.ndarray, target: np.ndarray) -> float:
    z = ab[0] * f + ab[1]
    return float((target * np.logaddexp(0, z) + (1 - target) * np.logaddexp(0, -z)).sum())


@given(st.integers(0, 999), st.integers(20, 300), st.floats(0.1, 0.9), st.floats(0, 2))
@example(72, 249, 0.51953125, 0.515625)  # the loss is flat to its last bit before the slope is
@settings(deadline=None, max_examples=20)
def test_the_fit_is_where_a_general_minimiser_ends(seed: int, n: int, share: float, gap: float) -> None:
    f, positive = scores(seed, n, share, gap)
    A, B = fit_sigmoid(f, positive)
    target = softened(positive)
    best = minimize(entropy, [0.0, 0.0], args=(f, target), method="BFGS", options={"gtol": 1e-9})
    assert entropy(np.array([A, B]), f, target) <= best.fun + 1e-9
    slope = target - 1 / (1 + np.exp(A * f + B))
    assert abs(slope @ f) < 1e-6
    assert abs(slope.sum()) < 1e-6


def test_separable_classes_have_a_finite_sigmoid_because_of_the_softened_targets() -> None:
    f = np.array([-1.0, -1.0, 1.0, 1.0])
    positive = f > 0
    A, B = fit_sigmoid(f, positive)
    p = 1 / (1 + np.exp(A * f + B))
    assert p[positive] == pytest.approx(3 / 4, abs=1e-6)  # (n₊ + 1) / (n₊ + 2), not 1
    assert p[~positive] == pytest.approx(1 / 4, abs=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_unit_of_the_decision_values_does_not_matter(unit: float) -> None:
    f, positive = scores(0, 200, 0.3, 1.0)
    A, B = fit_sigmoid(f, positive)
    scaled = fit_sigmoid(f * unit, positive)
    assert scaled == pytest.approx((A / unit, B), rel=1e-9)


def test_decision_values_that_say_nothing_give_the_share_of_the_class() -> None:
    positive = np.arange(100) < 30
    A, B = fit_sigmoid(np.zeros(100), positive)
    assert 1 / (1 + np.exp(B)) == pytest.approx(softened(positive).mean(), abs=1e-9)
    assert abs(A) < 1e-9


def test_the_sigmoid_does_not_overflow() -> None:
    z = np.array([-1e30, -800.0, 0.0, 800.0, 1e30])
    assert sigmoid(z).tolist() == pytest.approx([0, 0, 0.5, 1, 1])
    assert sigmoid(np.float32([3.0])).dtype == np.float32


@pytest.mark.parametrize(
    ("f", "positive", "said"),
    [
        ([1.0, 2.0], [True, True], "0 negative"),
        ([1.0, np.nan], [True, False], "not finite"),
        ([1.0], [True, False], r"must be \(n,\)"),
    ],
)
def test_what_cannot_be_fitted_is_refused(f: list[float], positive: list[bool], said: str) -> None:
    with pytest.raises(InputError, match=said):
        fit_sigmoid(np.array(f), np.array(positive))
