"""Change of an area at a stated rate of false alarms: simulated series with a known truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from station.science.onset import onsets, threshold_sigmas

HOUR_S = 3600.0
YEAR = 8766  # hourly scans
RULE = {"within_s": 6 * HOUR_S, "scans": 2, "least_m": 0.0}


def errors(rng, hours, *, shared_m, daily_m, slow_m, random_m):
    """One reference's error for all; a daily wave; what lasts for hours; what each scan has alone."""
    hour = np.arange(hours)
    slow = np.empty(hours)
    slow[0] = rng.normal()
    keeps = np.exp(-1 / 5)
    for index in range(1, hours):
        slow[index] = keeps * slow[index - 1] + np.sqrt(1 - keeps**2) * rng.normal()
    wave = rng.normal(size=2) @ [np.cos(hour * np.pi / 12), np.sin(hour * np.pi / 12)]
    total = shared_m * rng.normal() + daily_m * wave + slow_m * slow + random_m * rng.normal(size=hours)
    sigma_m = np.full(hours, np.sqrt(shared_m**2 + daily_m**2 + slow_m**2 + random_m**2))
    return hour * HOUR_S, total, sigma_m


def begun(found):
    """Count alarms: runs of epochs, as one lasts until it is over."""
    return int(np.count_nonzero(found & ~np.concatenate([[False], found[:-1]])))


def test_threshold_of_one_a_year():
    """Two-sided tail of the normal distribution, by another function than the code's."""
    assert threshold_sigmas(1.0, YEAR) == pytest.approx(stats.norm.isf(1 / YEAR / 2))
    assert threshold_sigmas(1.0, 3 * YEAR) == pytest.approx(4.117, abs=0.005)
    assert threshold_sigmas(20 * YEAR, YEAR) == 0.0


def test_the_stated_rate_is_about_the_true_one_where_errors_are_independent():
    """One scan each side and no shared error: Boole's bound is nearly reached, and not passed."""
    rng = np.random.default_rng(3)
    rule = RULE | {"scans": 1, "sigmas": threshold_sigmas(200.0, YEAR)}
    counts = []
    for _ in range(10):
        told = onsets(*errors(rng, YEAR, shared_m=0, daily_m=0, slow_m=0, random_m=0.02), **rule)
        counts.append(np.count_nonzero(told.found))
    assert 0.85 * 200 < np.mean(counts) < 1.12 * 200


@pytest.mark.parametrize(
    "sizes",
    [
        {"shared_m": 0.03, "daily_m": 0.0, "slow_m": 0.0, "random_m": 0.01},
        {"shared_m": 0.01, "daily_m": 0.03, "slow_m": 0.0, "random_m": 0.01},
        {"shared_m": 0.01, "daily_m": 0.01, "slow_m": 0.03, "random_m": 0.005},
        {"shared_m": 0.0, "daily_m": 0.0, "slow_m": 0.0, "random_m": 0.02},
    ],
    ids=["reference", "daily wave", "hours", "independent"],
)
def test_no_more_false_alarms_than_stated_whatever_errors_share(sizes):
    rng = np.random.default_rng(5)
    rule = RULE | {"sigmas": threshold_sigmas(50.0, YEAR)}
    years = 2
    counts = [begun(onsets(*errors(rng, YEAR, **sizes), **rule).found) for _ in range(years)]
    assert sum(counts) <= 50 * years + 3 * np.sqrt(50 * years)


def test_200_quiet_hours_at_one_a_year_are_quiet():
    """Twenty stations: 4000 h, of which 0.46 alarms may be expected at most."""
    rng = np.random.default_rng(7)
    rule = RULE | {"sigmas": threshold_sigmas(1.0, YEAR)}
    sizes = {"shared_m": 0.01, "daily_m": 0.01, "slow_m": 0.01, "random_m": 0.01}
    assert not any(onsets(*errors(rng, 200, **sizes), **rule).found.any() for _ in range(20))


def test_a_step_is_told_with_the_second_scan_after_it_and_for_as_long_as_it_is_within():
    rng = np.random.default_rng(11)
    time_s, change_m, sigma_m = errors(rng, 48, shared_m=0.01, daily_m=0, slow_m=0, random_m=0.01)
    change_m[24:] += 0.3
    told = onsets(time_s, change_m, sigma_m, sigmas=threshold_sigmas(1.0, YEAR), **RULE)
    assert np.flatnonzero(told.found).tolist() == list(range(25, 29))
    assert told.change_m[26] == pytest.approx(0.3, abs=3 * 0.01)
    assert told.sigma_m[26] == pytest.approx(0.02)
    assert np.isnan(told.change_m[2])
    assert not onsets(time_s, change_m, sigma_m, sigmas=4.0, **(RULE | {"least_m": 0.5})).found.any()


def test_a_step_of_six_sigmas_is_told_in_most_cases_and_of_three_in_few():
    """By the second scan after it; what the README promises."""
    rng = np.random.default_rng(13)
    told = {}
    for size in (3, 6, 8):
        found = []
        for _ in range(400):
            time_s, change_m, sigma_m = errors(rng, 12, shared_m=0, daily_m=0, slow_m=0, random_m=0.01)
            change_m[10:] += size * np.hypot(0.01, 0.01)
            found.append(onsets(time_s, change_m, sigma_m, sigmas=4.117, **RULE).found[11])
        told[size] = np.mean(found)
    assert told[3] < 0.05
    assert 0.85 < told[6] < 0.97
    assert told[8] > 0.99


@pytest.mark.parametrize("wrong", [20, 24, 25])
def test_one_wrong_scan_is_no_change(wrong):
    """Off by 100 sigma: as the newest, or as the oldest that others are set against."""
    change_m = np.zeros(48)
    change_m[wrong] = 2.0
    time_s = np.arange(48) * HOUR_S
    assert not onsets(time_s, change_m, np.full(48, 0.01), sigmas=4.0, **RULE).found.any()
    alone = RULE | {"scans": 1}
    assert onsets(time_s, change_m, np.full(48, 0.01), sigmas=4.0, **alone).found[wrong]


def test_slow_change_counts_by_what_it_is_within_the_time():
    time_s = np.arange(48) * HOUR_S
    melt_m = -0.02 * np.arange(48)
    quick = onsets(time_s, melt_m, np.full(48, 0.001), sigmas=4.0, **RULE)
    assert quick.found[10:].all()
    assert quick.change_m[20] == pytest.approx(-0.02 * 5)  # 6 h and 2 scans at each end
    assert not onsets(time_s, melt_m, np.full(48, 0.001), sigmas=4.0, **(RULE | {"least_m": 0.2})).found.any()
