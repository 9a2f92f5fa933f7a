"""Learned process noise and error shares: against explicit weights, and simulated seasons with a truth."""

import numpy as np
import pytest

from station.science.time_series.cell_filter import INITIAL_RATE_M_D, CellFilter, ProcessNoise
from station.science.time_series.class_filter import SAMPLE_CELLS, ClassFilter
from station.science.time_series.error_shares import CORRELATION_D, ErrorShares
from station.science.time_series.filter_errors import day_rates, filter_errors

HOUR_D = 1 / 24
RNG = np.random.default_rng


def test_shares_are_those_of_the_weights_of_each_scan():
    noise, random_m2, systematic_m2, count = ProcessNoise(1e-5, 1e-4), 4e-4, 1e-4, 30
    shares, weights = ErrorShares.first(random_m2, systematic_m2), np.zeros((2, count))
    weights[0, 0] = 1.0  # of each scan in level and rate
    for index in range(1, count):
        moved = shares.moved(HOUR_D, noise)
        gain = moved.total[:2, 0] / (moved.total[0, 0] + random_m2 + systematic_m2)
        weights = np.array([[1.0, HOUR_D], [0.0, 1.0]]) @ weights
        weights -= np.outer(gain, weights[0])
        weights[:, index] += gain
        shares = moved.updated(random_m2, systematic_m2)
    lag_d = HOUR_D * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    random, process, systematic, total = (
        matrix[:2, :2] for matrix in (shares.random, shares.process, shares.systematic, shares.total)
    )
    assert random == pytest.approx(random_m2 * weights @ weights.T)
    assert systematic == pytest.approx(weights @ np.exp(-lag_d / CORRELATION_D) @ weights.T)
    assert random + process + systematic_m2 * weights @ weights.T == pytest.approx(total)


def test_errors_of_the_rate_of_a_day_are_those_of_simulated_surfaces():
    noise, random_m2, count = ProcessNoise(2e-4, 3e-4), 4e-4, 20_000
    rng, step = RNG(7), np.array([[1.0, HOUR_D], [0.0, 1.0]])
    level_m, rate_m_d = np.zeros(count), INITIAL_RATE_M_D * rng.standard_normal(count)
    estimate = np.stack([np.sqrt(random_m2) * rng.standard_normal(count), np.zeros(count)])
    shares = ErrorShares.first(random_m2, 0.0)
    for hour in range(1, 55):
        if hour == 31:
            begin_m, begin_estimate_m, shares = level_m, estimate[0], shares.begun()
        fine_d = HOUR_D / 20
        for _ in range(20):
            level_m = level_m + rate_m_d * fine_d
            level_m = level_m + np.sqrt(noise.level_m2_d * fine_d) * rng.standard_normal(count)
            rate_m_d = rate_m_d + np.sqrt(noise.rate_m2_d3 * fine_d) * rng.standard_normal(count)
        moved = shares.moved(HOUR_D, noise)
        gain = moved.total[:2, :1] / (moved.total[0, 0] + random_m2)
        observed_m = level_m + np.sqrt(random_m2) * rng.standard_normal(count)
        estimate = step @ estimate
        estimate = estimate + gain * (observed_m - estimate[0])
        shares = moved.updated(random_m2, 0.0)
    errors = np.stack([estimate[1], estimate[0] - begin_estimate_m]) - (level_m - begin_m)
    assert shares.elapsed_d == pytest.approx(1.0)
    expected = shares.rate_variances(shares.total)
    assert np.cov(errors) == pytest.approx(expected, rel=0.04)
    assert shares.rate_variances(shares.random + shares.process) == pytest.approx(expected)
    assert expected[0, 0] < 0.5 * shares.total[1, 1]  # of the rate at the end of the day


def advanced(course_m, random_m=0.03):
    """A class of cells that do the same (t,), after hourly scans; the day begins with the first."""
    rng, ground = RNG(3), ClassFilter(SAMPLE_CELLS)
    for index, level_m in enumerate(course_m):
        change_m = level_m + random_m * rng.standard_normal(SAMPLE_CELLS)
        random_m2 = np.full(SAMPLE_CELLS, random_m**2)
        ground.advance(HOUR_D if index else 0.0, change_m, random_m2, 0.01 * random_m2)
        if index == 0:
            ground.begin_day()
    return ground


def test_weights_of_the_rate_of_a_day_have_the_smallest_variance():
    ground = advanced(np.zeros(25))
    filtered, difference, covariance = ground.shares.rate_variances(ground.shares.total)[[0, 1, 0], [0, 1, 1]]
    filtered += ground.missing_rate[1]
    weight = np.linspace(0, 1, 10_001)
    variance = (1 - weight) ** 2 * filtered + weight**2 * difference + 2 * weight * (1 - weight) * covariance
    assert ground.weight_of_difference == pytest.approx(weight[np.argmin(variance)], abs=1e-3)
    assert 0 < ground.weight_of_difference < 1


def test_what_a_class_gained_at_once_is_in_the_rate_of_the_day():
    ground = advanced(np.where(np.arange(13) < 9, 0.0, 0.4))
    assert ground.shares.elapsed_d == pytest.approx(0.5)
    assert ground.missing_rate[0] == pytest.approx(0.4 / 0.5, rel=0.03)
    ground.begin_day()
    assert ground.missing_rate[0] == 0


def season(kind, random_m, systematic_m, seed, *, lasting=False, cells=600, days=12):
    """True levels (t, n), true mean rates over the last day, and hourly observations with gaps."""
    rng = RNG(seed)
    day = HOUR_D * np.arange(24 * days)
    factor = rng.uniform(0.7, 1.3, cells)
    sun = np.maximum(0, 2.4 * np.sin(2 * np.pi * (day - 0.3)))
    weather = np.interp(day, np.arange(days + 1), 1 + 0.3 * rng.standard_normal(days + 1))
    settling_m = -0.04 * (1 - np.exp(-np.maximum(day - 4.4, 0) / 2))
    course_m = {
        "stable": np.zeros(len(day)),
        "creep": 0.01 * day,
        "melt": np.cumsum(-0.06 * weather * sun) * HOUR_D,
        "snow": settling_m,
    }[kind]
    fall_m = 0.3 * np.clip((day - 4.0) / 0.4, 0, 1) if kind == "snow" else 0.0
    level_m = (course_m + fall_m)[:, None] * factor
    rate_m_d = level_m - np.roll(level_m, 24, axis=0)
    shared = rng.standard_normal(len(day))
    if lasting:
        kept = np.exp(-HOUR_D / CORRELATION_D)
        for index in range(1, len(day)):
            shared[index] = kept * shared[index - 1] + np.sqrt(1 - kept**2) * shared[index]
    change_m = level_m + random_m * rng.standard_normal(level_m.shape) + systematic_m * shared[:, None]
    change_m[rng.random(change_m.shape) < 0.1] = np.nan
    change_m[170:178] = np.nan
    return level_m, rate_m_d, change_m


def filtered(change_m, random_m, systematic_m, *, stable=False):
    """Yield level, rate of the day so far, and errors after each hourly scan (t, n)."""
    count = change_m.shape[1]
    sample = np.linspace(0, count - 1, SAMPLE_CELLS).astype(int)
    cells, ground = CellFilter.empty(count), ClassFilter(SAMPLE_CELLS, stable=stable)
    random_m2, systematic_m2 = np.full(count, random_m**2), np.full(count, systematic_m**2)
    for index, scan_m in enumerate(change_m):
        days = HOUR_D if index else 0.0
        noise, motion = ground.advance(days, scan_m[sample], random_m2[sample], systematic_m2[sample])
        cells.advance(days, noise, motion, scan_m, random_m2, systematic_m2)
        state, moved_m = cells.estimates(), cells.moved_m
        errors = filter_errors(state, moved_m, cells.unseen_d, random_m2, systematic_m2, ground)
        yield state.level_m, day_rates(state, moved_m, ground), errors
        if index % 24 == 0:
            cells.begin_day()
            ground.begin_day()


def calibration(kind, random_m, systematic_m, **options):
    """Root mean square of z of level and rate, and the error of 12 hours over that of a single difference."""
    level_z, rate_z, error_m = [], [], []
    for seed in range(2):
        level_m, rate_m_d, change_m = season(kind, random_m, systematic_m, seed, **options)
        scans = filtered(change_m, random_m, systematic_m, stable=kind == "stable")
        for index, (filtered_m, filtered_m_d, errors) in enumerate(scans):
            error_m.append(filtered_m - level_m[index])
            if index < 72:
                continue
            level_sigma_m = np.sqrt(errors.level_random_m2 + errors.level_systematic_m2)
            level_z.append(error_m[-1] / level_sigma_m)
            if index % 24 == 0:
                rate_sigma_m_d = np.sqrt(errors.rate_random_m2_d2 + errors.rate_systematic_m2_d2)
                rate_z.append((filtered_m_d - rate_m_d[index]) / rate_sigma_m_d)
        drop = len(error_m) - len(change_m) + 72
        change_error_m = np.subtract(error_m[drop + 12 :], error_m[drop:-12])
    rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (level_z, rate_z, change_error_m)]
    return rms[0], rms[1], rms[2] / np.sqrt(2 * (random_m**2 + systematic_m**2))


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["stable", "creep", "melt", "snow"])
def test_sigma_of_level_and_rate_and_error_of_twelve_hours(kind):
    levels, rates, change = calibration(kind, 0.03, 0.003)
    assert 0.8 < levels < 1.25
    # Cells move at a rate that is constant but for their class: rates are better than their sigma says.
    assert 0.6 < rates < 1.25
    assert change < 1 / 3


@pytest.mark.integration
def test_errors_that_last_for_hours_are_in_the_systematic_part():
    levels, rates, _ = calibration("stable", 0.02, 0.02, lasting=True)
    assert 0.8 < levels < 1.25
    assert 0.65 < rates < 1.25  # of two stations


def test_live_equals_reprocessed_and_a_longer_series_changes_nothing_before():
    change_m = season("melt", 0.03, 0.003, 1, days=4)[2]
    live = [level_m for level_m, _, _ in filtered(change_m[:60], 0.03, 0.003)]
    again = [level_m for level_m, _, _ in filtered(change_m, 0.03, 0.003)]
    assert np.array_equal(live, again[:60], equal_nan=True)


def test_errors_of_a_patch_are_those_of_cells_that_move_further_than_their_class():
    further = np.array([[0.003, 0.0], [0.004, 0.02], [-0.001, 0.05], [0.0, -0.06], [0.002, 0.0], [0.0, 0.0]])
    noise, variance_m2 = ProcessNoise(1e-4, 1e-3), 4e-4
    shares = ErrorShares.first(variance_m2, 0.0)
    true_m = true_m_d = level_m = rate_m_d = 0.0  # besides the class
    for hour in range(1, 43):
        if hour == 19:
            begin_m, true_begin_m, shares = level_m, true_m, shares.begun()
        more_m, more_m_d = more = further[hour % 6]
        level_m, true_m = level_m + HOUR_D * rate_m_d, true_m + HOUR_D * true_m_d + more_m
        true_m_d += more_m_d
        errors_m = level_m - true_m + more_m, level_m - true_m
        growth_m2 = shares.patch_growth(HOUR_D, more)
        assert growth_m2 == pytest.approx(max(errors_m[1] ** 2 - errors_m[0] ** 2, 0.0), abs=1e-12)
        moved = shares.moved(HOUR_D, noise, more)
        gain, rate_gain_d = moved.total[:2, 0] / (moved.total[0, 0] + variance_m2)
        innovation_m = true_m - level_m
        level_m, rate_m_d = level_m + gain * innovation_m, rate_m_d + rate_gain_d * innovation_m
        shares = moved.updated(variance_m2, 0.0)
    assert shares.patch[:2] == pytest.approx([level_m - true_m, rate_m_d - true_m_d])
    mean_m_d = true_m - true_begin_m  # of one day
    errors_m_d = np.array([rate_m_d, level_m - begin_m]) - mean_m_d
    assert shares.elapsed_d == pytest.approx(1.0)
    assert shares.rate_variances(shares.patches) == pytest.approx(np.outer(errors_m_d, errors_m_d))
    assert np.abs(errors_m_d).min() > 0.001
