"""Variance of the points of a cell: the model's, or that of the points if they reject it."""

import numpy as np
import pytest
from scipy import stats

from station.science.gridding.significance import supported_variance

CELLS = 100_000
MODEL_M2 = 0.01


def drawn(count, factor=1.0, seed=0):
    """Return mean [m], standard deviation [m] and supported variance [m²] of cells with `count` points."""
    points_m = 0.1 * np.sqrt(factor) * np.random.default_rng(seed).standard_normal((CELLS, count))
    spread_m = points_m.std(axis=1, ddof=1).astype(np.float32)
    model_m2 = np.full(CELLS, MODEL_M2, np.float32)
    return points_m.mean(axis=1), supported_variance(model_m2, spread_m, np.full(CELLS, count, np.int32))


@pytest.mark.parametrize("count", [2, 3, 6, 30])
def test_right_model_stays_except_for_one_cell_in_a_thousand(count):
    mean_m, variance_m2 = drawn(count)
    assert np.mean(variance_m2 != np.float32(MODEL_M2)) == pytest.approx(1e-3, rel=0.5)
    assert variance_m2.mean() == pytest.approx(MODEL_M2, rel=0.02)
    assert np.std(mean_m / np.sqrt(variance_m2 / count)) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("count", [6, 30])
def test_observed_variance_replaces_a_model_that_is_too_small(count):
    """Points that scatter ten times as much: σ of the model would be ten times too small."""
    mean_m, variance_m2 = drawn(count, factor=100.0)
    assert np.mean(variance_m2 > MODEL_M2) > 0.98
    assert np.sqrt(np.median(variance_m2)) == pytest.approx(1.0, rel=0.1)
    assert 0.9 < np.std(mean_m / np.sqrt(variance_m2 / count)) < 1.4


def test_exact_quantile_decides():
    """Against scipy's chi-squared: the approximation is within 4 % of the limit."""
    for count in (2, 3, 5, 10, 100):
        limit = stats.chi2.isf(1e-3, count - 1) / (count - 1)
        spread_m = np.sqrt(MODEL_M2 * limit * np.array([0.96, 1.04])).astype(np.float32)
        model_m2, counts = np.full(2, MODEL_M2, np.float32), np.full(2, count, np.int32)
        below, above = supported_variance(model_m2, spread_m, counts)
        assert below == np.float32(MODEL_M2)
        assert above == spread_m[1] ** 2


def test_single_points_and_unknown_spread_have_the_variance_of_the_model():
    model_m2 = np.full(2, MODEL_M2, np.float32)
    spread_m = np.array([np.nan, np.nan], np.float32)
    assert (supported_variance(model_m2, spread_m, np.array([1, 0], np.int32)) == model_m2).all()
