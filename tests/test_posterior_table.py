"""The tabulated posteriors against the exact ones."""

import numpy as np
import pytest
from overlapping_clusters import clusters

from surfclass.classifiers import svm
from surfclass.classifiers.table import PosteriorTable
from surfclass.errors import InputError


@pytest.fixture(scope="module")
def machine() -> svm.Svm:
    return svm.train(*clusters(3000, 0))


@pytest.fixture(scope="module")
def table(machine: svm.Svm) -> PosteriorTable:
    x = clusters(3000, 0)[0]
    return PosteriorTable.build(machine.posterior_on_grid, x.min(axis=0), x.max(axis=0))


def planes(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x.T, dtype=np.float32)


def test_it_agrees_with_the_exact_posteriors(machine: svm.Svm, table: PosteriorTable) -> None:
    x = np.clip(clusters(40_000, 1)[0], table.low, table.high)
    exact, found = machine.posterior(x), table.lookup(planes(x))
    assert found.dtype == np.float32
    assert (found.argmax(axis=1) == exact.argmax(axis=1)).mean() >= 0.995
    assert np.abs(found - exact).mean() <= 3e-3
    assert np.abs(found.sum(axis=1) - 1).max() < 4 / 32767


def test_features_outside_are_clipped_to_the_box(machine: svm.Svm, table: PosteriorTable) -> None:
    far = np.array([table.low - 5, table.high + 5, [table.low[0] - 1, *table.high[1:]]])
    exact = machine.posterior(np.clip(far, table.low, table.high))
    assert np.abs(table.lookup(planes(far)) - exact).max() < 0.05
    assert np.array_equal(
        table.lookup(planes(far)), table.lookup(planes(np.clip(far, table.low, table.high)))
    )


def test_two_reads_are_twice_as_fine_as_the_nearest_cell() -> None:
    ramp = PosteriorTable.build(
        lambda axes: (
            np.stack(np.broadcast_arrays(axes[0][:, None], 1 - axes[0][:, None]), -1).astype("f4")
            * np.ones((1, len(axes[1]), 1), "f4")
        ),
        np.zeros(2),
        np.ones(2),
        bins=16,
    )
    x = np.linspace(0.05, 0.95, 1000)
    found = ramp.lookup(planes(np.stack([x, x], axis=1)))[:, 0]
    assert np.abs(found - x).max() == pytest.approx(1 / 64, rel=0.1)  # the nearest cell's is 1/32


def test_two_features_have_a_finer_table(machine: svm.Svm) -> None:
    x, y, place = clusters(1500, 0)
    flat = svm.train(x[:, :2], y, place)
    table = PosteriorTable.build(flat.posterior_on_grid, x[:, :2].min(axis=0), x[:, :2].max(axis=0))
    assert table.probability.shape == (512, 512, 4)
    test = np.clip(clusters(20_000, 1)[0][:, :2], table.low, table.high)
    exact = flat.posterior(test)
    assert (table.lookup(planes(test)).argmax(axis=1) == exact.argmax(axis=1)).mean() >= 0.998


def test_arrays_bring_the_table_back(table: PosteriorTable) -> None:
    x = planes(clusters(1000, 2)[0])
    back = PosteriorTable.from_arrays(table.to_arrays())
    assert np.array_equal(back.lookup(x), table.lookup(x))
    assert back.lookup(x[:, :0]).shape == (0, 4)


@pytest.mark.parametrize("k", [2, 3, 5, 9])
def test_any_number_of_classes_fits(k: int) -> None:
    random = np.random.default_rng(0)
    stored = (random.dirichlet(np.ones(k), size=(6, 6, 6)) * 32767).astype(np.uint16)
    table = PosteriorTable(np.zeros(3), np.ones(3), stored)
    assert np.array_equal(table.probability, stored)
    middle = np.indices((6, 6, 6)).reshape(3, -1) / 6 + 1 / 12
    assert table.lookup(middle.astype(np.float32)) == pytest.approx(stored.reshape(-1, k) / 32767, abs=1e-6)


def test_what_cannot_be_looked_up_is_refused(table: PosteriorTable) -> None:
    with pytest.raises(InputError, match=r"must be \(3, n\)"):
        table.lookup(np.zeros((2, 5), np.float32))
    with pytest.raises(InputError, match="NaN"):
        table.lookup(np.full((3, 5), np.nan, np.float32))


def test_a_table_that_does_not_fit_is_refused(table: PosteriorTable) -> None:
    arrays = table.to_arrays()
    for change, said in [
        ({"low": arrays["high"]}, "empty"),
        ({"low": np.zeros(4), "high": np.ones(4)}, r"must be \(2,\) or \(3,\)"),
        ({"probability": arrays["probability"].astype(np.float32)}, "uint16"),
        ({"probability": arrays["probability"][..., 0]}, "one of classes"),
        ({"probability": np.full((2, 2, 2, 3), 40_000, np.uint16)}, "40000 exceeds"),
    ]:
        with pytest.raises(InputError, match=said):
            PosteriorTable.from_arrays(arrays | change)
    with pytest.raises(InputError, match="high missing"):
        PosteriorTable.from_arrays({"low": arrays["low"], "probability": arrays["probability"]})
    with pytest.raises(InputError, match="1 bins"):
        PosteriorTable.build(lambda axes: np.zeros((1, 1, 1, 2), np.float32), np.zeros(3), np.ones(3), bins=1)
