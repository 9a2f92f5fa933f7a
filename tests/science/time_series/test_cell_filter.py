"""The filter of level and rate against generalised least squares, and steps."""

import numpy as np
import pytest

from station.science.time_series.cell_filter import (
    CELL_DTYPE,
    INITIAL_RATE_M_D,
    CellFilter,
    Motion,
    ProcessNoise,
    first_estimate,
    predict,
    update,
)

HOUR_D = 1 / 24
NOISE = ProcessNoise(np.array([1e-5]), np.array([1e-4]))
DAYS = np.cumsum([0.0, 0.04, 0.04, 0.5, 0.01, 1.3, 0.04])
SIGMA_M = 0.01 * np.array([3.0, 2.0, 3.0, 1.0, 5.0, 2.0, 2.0])


def batch_estimate(change_m):
    """Level and rate at the end by GLS on the whole series, and their covariance.

    Unknown are the level (free) and the rate (with its prior) at the end; before, the surface deviates from
    the line through them by integrals of the noise, whose covariance is integrated numerically.
    """
    before_d = DAYS[-1] - DAYS
    fine = (np.arange(20_000) + 0.5) / 20_000 * before_d[0]  # time before the end
    step_d = before_d[0] / len(fine)
    rate_response = np.maximum(before_d[:, None] - fine, 0.0) * (fine < before_d[:, None])
    level_response = fine < before_d[:, None]
    covariance = step_d * (
        NOISE.rate_m2_d3 * rate_response @ rate_response.T
        + NOISE.level_m2_d * level_response.astype(float) @ level_response.T
    )
    # the prior, of the rate at the first scan, observes the rate at the end but for the noise since
    rows = np.column_stack([np.ones(len(DAYS)), -before_d])
    cross = -step_d * NOISE.rate_m2_d3 * rate_response.sum(axis=1)
    prior_variance = INITIAL_RATE_M_D**2 + NOISE.rate_m2_d3 * before_d[0]
    design = np.vstack([rows, [0.0, 1.0]])
    weights = np.zeros((len(DAYS) + 1, len(DAYS) + 1))
    weights[:-1, :-1] = covariance + np.diag(SIGMA_M**2)
    weights[-1, :-1] = weights[:-1, -1] = cross
    weights[-1, -1] = prior_variance[0]
    inverse = np.linalg.inv(weights)
    posterior = np.linalg.inv(design.T @ inverse @ design)
    return posterior @ design.T @ inverse @ np.append(change_m, 0.0), posterior


def test_estimate_is_generalised_least_squares_on_the_whole_series():
    change_m = 0.1 + 0.05 * DAYS + SIGMA_M * np.random.default_rng(1).standard_normal(len(DAYS))
    state = first_estimate(change_m[:1], SIGMA_M[:1] ** 2)
    for index in range(1, len(DAYS)):
        state = update(
            predict(state, DAYS[index] - DAYS[index - 1], NOISE),
            change_m[index : index + 1],
            SIGMA_M[index] ** 2,
        )
    estimate, posterior = batch_estimate(change_m)
    assert [state.level_m[0], state.rate_m_d[0]] == pytest.approx(estimate.tolist(), rel=1e-3)
    covariance = [state.level_m2[0], state.covariance_m2_d[0], state.rate_m2_d2[0]]
    assert covariance == pytest.approx(posterior[[0, 0, 1], [0, 1, 1]].tolist(), rel=1e-3)


def advance_all(cells, series_m, sigma_m=0.03):
    """Take hourly scans (t, n) and return the levels after each (t, n)."""
    levels = []
    for index, change_m in enumerate(series_m):
        random_m2 = np.full(len(change_m), sigma_m**2)
        cells.advance(HOUR_D if index else 0.0, NOISE, Motion(), change_m, random_m2, 0 * random_m2)
        levels.append(cells.estimates().level_m)
    return np.array(levels)


def test_stored_state_of_20_bytes_is_as_good_as_the_filter_in_full_precision():
    assert CELL_DTYPE.itemsize == 20
    series_m = 0.03 * np.random.default_rng(2).standard_normal((500, 50))
    cells = CellFilter.empty(50)
    advance_all(cells, series_m)
    state = first_estimate(series_m[0], np.full(50, 0.03**2))
    for change_m in series_m[1:]:
        state = update(predict(state, HOUR_D, NOISE), change_m, np.full(50, 0.03**2))
    stored = cells.estimates()
    sigma_m = np.sqrt(state.level_m2)
    assert np.abs(stored.level_m - state.level_m).max() < 0.01 * sigma_m.max()
    assert np.abs(stored.rate_m_d - state.rate_m_d).max() < 0.01 * np.sqrt(state.rate_m2_d2).max()
    assert stored.level_m2 == pytest.approx(state.level_m2, rel=0.01)


def test_step_is_there_in_its_second_scan_and_not_at_the_first_outlier():
    rng = np.random.default_rng(3)
    truth_m = np.zeros((60, 400))
    truth_m[50:] = 0.3
    levels_m = advance_all(CellFilter.empty(400), truth_m + 0.03 * rng.standard_normal(truth_m.shape))
    assert abs(np.median(levels_m[50])) < 0.02
    assert np.median(levels_m[51]) == pytest.approx(0.3, abs=0.015)
    assert np.mean(levels_m[51] > 0.2) > 0.99


def test_single_outliers_are_left_out():
    rng = np.random.default_rng(4)
    series_m = 0.03 * rng.standard_normal((100, 200))
    disturbed_m = series_m.copy()
    disturbed_m[50] += 1.0
    disturbed_m[70], disturbed_m[71] = series_m[70] + 2.0, series_m[71] + 1.0  # two that differ
    with_outliers, without = (
        advance_all(CellFilter.empty(200), disturbed_m),
        advance_all(CellFilter.empty(200), series_m),
    )
    assert np.abs(with_outliers[-1] - without[-1]).max() < 0.01


def test_error_grows_in_a_gap_as_the_change_of_the_surface_does():
    rng = np.random.default_rng(5)
    hours, count = 96, 3000
    rate_m_d = np.cumsum(np.sqrt(NOISE.rate_m2_d3 * HOUR_D) * rng.standard_normal((hours, count)), axis=0)
    level_noise_m = np.sqrt(NOISE.level_m2_d * HOUR_D) * rng.standard_normal((hours, count))
    truth_m = np.cumsum(rate_m_d * HOUR_D + level_noise_m, axis=0)
    series_m = truth_m + 0.03 * rng.standard_normal(truth_m.shape)
    series_m[60:] = np.nan
    cells = CellFilter.empty(count)
    levels_m = advance_all(cells, series_m)
    state = cells.estimates()
    assert np.std((levels_m[-1] - truth_m[-1]) / np.sqrt(state.level_m2)) == pytest.approx(1.0, abs=0.07)
    assert np.std((state.rate_m_d - rate_m_d[-1]) / np.sqrt(state.rate_m2_d2)) == pytest.approx(1.0, abs=0.07)
    assert np.all(cells.cells["unseen_min"] == 36 * 60)


def test_scans_out_of_order_are_an_error():
    with pytest.raises(ValueError, match="in order of time"):
        CellFilter.empty(1).advance(-0.1, NOISE, Motion(), np.zeros(1), np.ones(1), np.zeros(1))
