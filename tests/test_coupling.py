"""Pairwise coupling against an independent solution of its optimality conditions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surfclass.classifiers.coupling import couple
from surfclass.errors import InputError


def pairwise(seed: int, n: int, k: int, sureness: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    upper = np.triu(1 / (1 + np.exp(-sureness * random.normal(size=(n, k, k)))), 1)
    return upper + np.tril(1 - upper.swapaxes(1, 2), -1)


def optimality(r: np.ndarray) -> np.ndarray:
    """Solves [Q 1; 1ᵀ 0] [p; λ] = [0; 1] for one sample, Q from the objective's second derivatives."""
    k = len(r)
    Q = np.zeros((k, k))
    for i in range(k):
        for j in range(k):
            if i != j:
                row = np.zeros(k)
                row[i], row[j] = r[j, i], -r[i, j]
                Q += np.outer(row, row) / 2  # each pair is met twice
    bordered = np.block([[Q, np.ones((k, 1))], [np.ones((1, k)), np.zeros((1, 1))]])
    return np.linalg.solve(bordered, np.append(np.zeros(k), 1))[:k]


@given(st.integers(0, 999), st.integers(2, 7), st.floats(0.1, 6))
@settings(deadline=None, max_examples=30)
def test_posteriors_solve_the_optimality_conditions(seed: int, k: int, sureness: float) -> None:
    r = pairwise(seed, 20, k, sureness)
    p = couple(r)
    assert p == pytest.approx(np.array([optimality(one) for one in r]), abs=1e-9)
    assert p.min() >= 0
    assert p.sum(axis=1) == pytest.approx(1, abs=1e-12)


def test_two_classes_keep_their_pairwise_probability() -> None:
    r = pairwise(0, 50, 2, 3.0)
    assert couple(r)[:, 0] == pytest.approx(r[:, 0, 1], abs=1e-12)


def test_probabilities_that_a_distribution_explains_give_it_back() -> None:
    p = np.random.default_rng(0).dirichlet(np.ones(5), size=30)
    r = p[:, :, None] / (p[:, :, None] + p[:, None, :])
    assert couple(r) == pytest.approx(p, abs=1e-9)


def test_sure_pairs_stay_finite() -> None:
    r = np.full((1, 3, 3), 1e-7)
    r[0, 0, 1:] = 1 - 1e-7
    r[0, 1, 2] = 1 - 1e-7
    assert couple(r)[0] == pytest.approx([1, 0, 0], abs=1e-6)


def test_the_diagonal_is_not_read_and_chunks_do_not_matter() -> None:
    r = pairwise(1, 9000, 3, 2.0)
    p = couple(r)
    r[:, range(3), range(3)] = np.nan
    assert np.array_equal(couple(r), p)
    assert couple(r[8999:]) == pytest.approx(p[8999:], abs=1e-15)


@pytest.mark.parametrize("shape", [(3, 3), (5, 3, 4), (5, 1, 1)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="pairwise coupling"):
        couple(np.full(shape, 0.5))
