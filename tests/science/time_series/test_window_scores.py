"""Whether the cells of a window changed together: against scipy's t-test, and its spread in noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from station.science.time_series.window_scores import MIN_CELLS, agreement_sigmas

SIGMA_M = 0.05
BEFORE, AFTER = 6, 2


def scans(rng, cells, change_m=0.0):
    """Scans before and after a change of cells (n,), with random errors."""
    before_m = rng.normal(0, SIGMA_M, (BEFORE, cells))
    return before_m, rng.normal(0, SIGMA_M, (AFTER, cells)) + change_m


def sigmas(before_m, after_m, around_m=0.0):
    return agreement_sigmas(before_m, after_m, np.full(before_m.shape[1], SIGMA_M), around_m)


@pytest.mark.parametrize("around_m", [0.0, -0.2])
def test_cells_of_equal_sigma_have_the_probability_of_a_t_test(around_m):
    before_m, after_m = scans(np.random.default_rng(1), 9, 0.08)
    differences_m = after_m.mean(axis=0) - np.median(before_m, axis=0)
    expected = stats.ttest_1samp(differences_m, around_m, alternative="greater").pvalue
    assert stats.norm.sf(sigmas(before_m, after_m, around_m)) == pytest.approx(expected)
    assert sigmas(-before_m, -after_m, -around_m) == pytest.approx(-sigmas(before_m, after_m, around_m))


@pytest.mark.parametrize(("cells", "ratio"), [(4, 1.0), (16, 3.0), (60, 3.0)])
def test_noise_is_normal_also_where_sigma_differs(cells, ratio):
    rng = np.random.default_rng(2)
    sigma_m = SIGMA_M * np.geomspace(1.0, ratio, cells)
    values = [
        agreement_sigmas(sigma_m / SIGMA_M * before_m, sigma_m / SIGMA_M * after_m, sigma_m, 0.0)
        for before_m, after_m in (scans(rng, cells) for _ in range(1500))
    ]
    assert 0.9 < np.std(values) < 1.1
    assert 0.03 < np.mean(np.abs(values) > 1.96) < 0.07


def test_debris_changes_most_cells_and_an_edge_few():
    rng = np.random.default_rng(3)
    for _ in range(50):
        debris_m = np.where(np.arange(16) < 12, 0.3, 0.0)
        edge_m = np.where(np.arange(16) < 3, rng.uniform(0.5, 2.0, 16), 0.0)
        assert sigmas(*scans(rng, 16, debris_m)) > 3.5
        assert abs(sigmas(*scans(rng, 16, edge_m))) < 2.3


def test_a_precise_cell_that_jumps_is_no_change_of_all():
    before_m, after_m = scans(np.random.default_rng(4), 12)
    after_m[:, 0] += 1.5
    sigma_m = np.full(12, SIGMA_M)
    sigma_m[0] = 0.005
    assert agreement_sigmas(before_m, after_m, sigma_m, 0.0) < 2


def test_cells_that_were_not_seen_do_not_count():
    before_m, after_m = scans(np.random.default_rng(5), 12, 0.3)
    expected = sigmas(before_m[:, :8], after_m[:, :8])
    before_m[:4, 8:10] = after_m[0, 10:] = np.nan
    assert sigmas(before_m, after_m) == pytest.approx(expected)
    assert sigmas(before_m[:, : MIN_CELLS - 1], after_m[:, : MIN_CELLS - 1]) == 0.0


def test_cells_that_changed_alike_to_the_last_bit_are_as_significant_as_can_be():
    constant = np.zeros((BEFORE, 16)), np.full((AFTER, 16), 0.3)
    assert 10 < sigmas(*constant) < np.inf
