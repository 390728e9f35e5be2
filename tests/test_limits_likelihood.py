"""Limits of texture by maximum likelihood: known sigmoids are recovered from right and wrong windows."""

import numpy as np
import pytest
from limits_world import PLATEAU, TRUE, probability, windows

from calibration.gates import LimitsGates
from calibration.limits.cells import Cells, balance, cells_of
from calibration.limits.command import check_span
from calibration.limits.likelihood import NAMES, Fit, fit, log_likelihood, span_of, weak_prior
from calibration.limits.solution import solve
from calibration.limits.windows import Windows
from calibration.outcome import RefusedError
from surfclass.quality import viewing_probability
from surfclass.rig import TextureLimits

DEFAULT = (TextureLimits(),) * 4
TRUTH = np.array([*(TRUE[name] for name in NAMES[:-1]), PLATEAU])


def fitted(found):
    cells = cells_of(found, np.ones(len(found.right)), None)
    span = span_of(cells)
    return fit(cells, weak_prior(span), span, 0.25), cells


def test_the_fit_is_the_probability_map_of_the_pipeline():
    found, _ = fitted(windows(0))
    d, angle = np.linspace(0.4, 1.2, 50), np.linspace(0, 1, 50)
    share = viewing_probability(d, angle, found.limits)
    np.testing.assert_allclose(found.probability(d, angle), 0.25 + (found.plateau - 0.25) * share, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_known_limits_are_recovered(seed):
    found, _ = fitted(windows(seed, captures=120, each=60))
    limits = found.limits
    assert limits.near_m == pytest.approx(TRUE["near_m"], abs=0.02)
    assert limits.far_m == pytest.approx(TRUE["far_m"], abs=0.02)
    assert limits.angle_rad == pytest.approx(TRUE["angle_rad"], abs=0.05)
    assert limits.slope_per_m == pytest.approx(TRUE["slope_per_m"], rel=0.4)
    assert limits.slope_per_rad == pytest.approx(TRUE["slope_per_rad"], rel=0.4)
    assert found.plateau == pytest.approx(PLATEAU, abs=0.02)


def test_no_parameter_nearby_is_more_probable():
    found, cells = fitted(windows(1))
    best = log_likelihood(found, cells)
    for place, step in enumerate((0.03, 0.03, 0.4, 0.08, 0.4, 0.3)):
        for sign in (-1, 1):
            moved = np.array(found.x)
            moved[place] += sign * step
            assert log_likelihood(Fit(moved, found.chance, 1.0), cells) < best + 0.5


@pytest.mark.slow
def test_uncertainties_from_resampled_captures_hold_the_truth():
    away = []
    for seed in range(20):
        pooled = solve(windows(seed, captures=60, each=30, classes=2), 2, DEFAULT[:2], 20, 0).pooled
        x = np.array(pooled.fit.x)
        x[[2, 4]], x[5] = np.exp(x[[2, 4]]), pooled.fit.plateau
        away.append((x - TRUTH) / pooled.sd)
    away = np.array(away)
    assert (np.abs(away) < 3).mean() >= 0.93
    assert 0.4 < np.median(np.abs(away)) / 0.6745 < 1.7


def test_captures_that_differ_are_noticed_and_widen_the_uncertainty():
    even = windows(3, each=50)
    random = np.random.default_rng(0)
    bad = np.isin(even.capture, random.choice(40, 8, replace=False))  # nothing is right there
    spoilt = Windows(
        even.distance_m,
        even.angle_rad,
        even.result,
        np.where(bad, (even.result + 1) % 4, even.truth),
        even.capture,
        even.names,
    )
    dispersion = [fitted(found)[0].dispersion for found in (even, spoilt)]
    assert dispersion[0] < 1.8
    assert dispersion[1] > 3
    uncertainty = [solve(found, 4, DEFAULT, 5, 0).pooled.sd[[0, 1, 3]] for found in (even, spoilt)]
    assert uncertainty[1].sum() > 1.5 * uncertainty[0].sum()


def test_a_perfect_separation_stays_finite():
    distance = np.linspace(0.4, 1.3, 400)
    right = (distance > 0.6) & (distance < 0.9)
    cells = Cells(distance, np.full(400, 0.1), 10.0 * right, np.full(400, 10.0), np.arange(400) // 20)
    span = span_of(cells)
    found = fit(cells, weak_prior(span), span, 0.25)
    assert np.isfinite(found.x).all()
    assert found.limits.near_m == pytest.approx(0.6, abs=0.02)
    assert found.limits.far_m == pytest.approx(0.9, abs=0.02)
    assert found.limits.slope_per_m <= 500 * 1.001


def test_accuracy_that_never_falls_ends_a_little_beyond_the_captures_and_says_so():
    found = solve(windows(0, distances=(0.55, 0.85), angles=(0.0, 0.4)), 4, DEFAULT, 3, 0).pooled
    assert set(found.ends) == {"near_m", "far_m", "angle_rad"}
    assert found.span.distance_m[1] < found.fit.limits.far_m < found.span.distance_m[1] + 0.06
    assert found.fit.limits.angle_rad < found.span.angle_rad[1] + np.radians(6)


def test_each_class_gets_the_limits_of_windows_that_were_given_to_it():
    """What is far away is taken for class 0, which is then always right about itself, and worth nothing."""
    random = np.random.default_rng(0)
    base = windows(0, classes=2)
    far = base.distance_m > 0.9
    truth = random.integers(2, size=len(base.truth))
    result = np.where(far, 0, truth)
    found = Windows(base.distance_m, base.angle_rad, result, truth, base.capture, base.names)
    assert (found.right[truth == 0]).all()
    limits = solve(found, 2, DEFAULT[:2], 3, 0).classes[0].fit.limits
    assert limits.far_m == pytest.approx(0.9, abs=0.04)


def test_a_class_that_no_window_was_given_keeps_the_common_limits():
    found = windows(0)
    others = np.flatnonzero((found.result != 3) | (np.arange(len(found.result)) % 997 == 0))
    some = Windows(
        *(getattr(found, name)[others] for name in ("distance_m", "angle_rad", "result", "truth", "capture")),
        found.names,
    )
    assert set(solve(some, 4, DEFAULT, 2, 0).classes) == {0, 1, 2}


def test_new_limits_predict_left_out_captures_better_than_wrong_ones_and_no_better_than_the_true():
    found = windows(2, captures=30, each=50)
    against_wrong = solve(found, 4, DEFAULT, 2, 0).held_out
    assert against_wrong.gain > 2 * against_wrong.gain_sd > 0
    true = TextureLimits(**TRUE)
    against_true = solve(found, 4, (true,) * 4, 2, 0).held_out
    assert -0.03 < against_true.gain < 2 * against_true.gain_sd + 0.002


def test_every_true_class_counts_alike():
    truth = np.array([0] * 90 + [1] * 10)
    found = Windows(np.ones(100), np.zeros(100), truth, truth, np.zeros(100, int), ("a",))
    weight = balance(found, 3)
    assert weight[truth == 0].sum() == pytest.approx(weight[truth == 1].sum())
    assert weight.mean() == pytest.approx(1)


def test_cells_count_every_window_once():
    found = windows(5, captures=6)
    cells = cells_of(found, np.ones(len(found.right)), None)
    assert cells.total.sum() == len(found.right)
    assert cells.right.sum() == found.right.sum()
    assert (cells.total * cells.distance_m).sum() == pytest.approx(found.distance_m.sum())
    assert len(cells_of(found, np.ones(len(found.right)), 7).total) == 0


@pytest.mark.parametrize(
    ("of", "said"),
    [
        ({"distances": (0.6, 0.62)}, "nearer and from farther"),
        ({"angles": (0.1, 0.12)}, "capture the boards turned"),
        ({"captures": 3}, "labelled captures"),
    ],
)
def test_captures_that_do_not_span_enough_are_refused_naming_what_is_missing(of, said):
    with pytest.raises(RefusedError, match=said):
        check_span(windows(0, **of), LimitsGates())
    check_span(windows(0), LimitsGates())


def test_the_model_of_the_tests_is_the_one_that_is_fitted():
    x = np.append([TRUE["near_m"], TRUE["far_m"], np.log(40), 0.7, np.log(20)], np.log(0.67 / 0.08))
    d, angle = np.linspace(0.4, 1.2, 30), np.linspace(0, 1, 30)
    plateau = Fit(x, 0.25, 1.0).plateau
    np.testing.assert_allclose(
        Fit(x, 0.25, 1.0).probability(d, angle), probability(d, angle, 4, plateau=plateau), atol=1e-9
    )
