"""Change detection in an area mean: rate of false alarms and power, from simulated series."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from station.science.analysis.change_detection import detect_changes, threshold_sigmas

HOUR_S = 3600.0
SCANS_PER_YEAR = 8766  # hourly scans
RULE = {"within_s": 6 * HOUR_S, "scans": 2, "min_change_m": 0.0}


def errors(rng, hours, *, shared_m, daily_m, slow_m, random_m):
    """Errors of a series: constant, a diurnal wave, correlated over hours, and independent by scan."""
    hour = np.arange(hours)
    slow = np.empty(hours)
    slow[0] = rng.normal()
    correlation = np.exp(-1 / 5)
    for index in range(1, hours):
        slow[index] = correlation * slow[index - 1] + np.sqrt(1 - correlation**2) * rng.normal()
    wave = rng.normal(size=2) @ [np.cos(hour * np.pi / 12), np.sin(hour * np.pi / 12)]
    total = shared_m * rng.normal() + daily_m * wave + slow_m * slow + random_m * rng.normal(size=hours)
    sigma_m = np.full(hours, np.sqrt(shared_m**2 + daily_m**2 + slow_m**2 + random_m**2))
    return hour * HOUR_S, total, sigma_m


def count_alarms(detected):
    """Count runs of detections: an alarm lasts until it is over."""
    return int(np.count_nonzero(detected & ~np.concatenate([[False], detected[:-1]])))


def test_threshold_for_one_false_alarm_per_year():
    """Two-sided tail of the normal distribution, from scipy.stats."""
    assert threshold_sigmas(1.0, SCANS_PER_YEAR) == pytest.approx(stats.norm.isf(1 / SCANS_PER_YEAR / 2))
    assert threshold_sigmas(1.0, 3 * SCANS_PER_YEAR) == pytest.approx(4.117, abs=0.005)
    assert threshold_sigmas(20 * SCANS_PER_YEAR, SCANS_PER_YEAR) == 0.0


@pytest.mark.integration
def test_false_alarm_rate_is_close_to_the_limit_for_independent_errors():
    """With one scan on either side and no shared errors, Boole's bound is nearly reached."""
    rng = np.random.default_rng(3)
    rule = RULE | {"scans": 1, "sigmas": threshold_sigmas(200.0, SCANS_PER_YEAR)}
    counts = []
    for _ in range(10):
        result = detect_changes(
            *errors(rng, SCANS_PER_YEAR, shared_m=0, daily_m=0, slow_m=0, random_m=0.02), **rule
        )
        counts.append(np.count_nonzero(result.detected))
    assert 0.85 * 200 < np.mean(counts) < 1.12 * 200


@pytest.mark.integration
@pytest.mark.parametrize(
    "sigmas_m",
    [
        {"shared_m": 0.03, "daily_m": 0.0, "slow_m": 0.0, "random_m": 0.01},
        {"shared_m": 0.01, "daily_m": 0.03, "slow_m": 0.0, "random_m": 0.01},
        {"shared_m": 0.01, "daily_m": 0.01, "slow_m": 0.03, "random_m": 0.005},
        {"shared_m": 0.0, "daily_m": 0.0, "slow_m": 0.0, "random_m": 0.02},
    ],
    ids=["constant", "diurnal", "hours", "independent"],
)
def test_false_alarm_rate_is_within_the_limit_for_correlated_errors(sigmas_m):
    rng = np.random.default_rng(5)
    rule = RULE | {"sigmas": threshold_sigmas(50.0, SCANS_PER_YEAR)}
    years = 2
    counts = [
        count_alarms(detect_changes(*errors(rng, SCANS_PER_YEAR, **sigmas_m), **rule).detected)
        for _ in range(years)
    ]
    assert sum(counts) <= 50 * years + 3 * np.sqrt(50 * years)


def test_no_false_alarm_in_4000_hours():
    """Twenty stations of 200 h each: at most 0.46 alarms are expected."""
    rng = np.random.default_rng(7)
    rule = RULE | {"sigmas": threshold_sigmas(1.0, SCANS_PER_YEAR)}
    sigmas_m = {"shared_m": 0.01, "daily_m": 0.01, "slow_m": 0.01, "random_m": 0.01}
    assert not any(detect_changes(*errors(rng, 200, **sigmas_m), **rule).detected.any() for _ in range(20))


def test_a_step_is_detected_at_the_second_scan_after_it_and_while_it_is_in_the_window():
    rng = np.random.default_rng(11)
    time_s, change_m, sigma_m = errors(rng, 48, shared_m=0.01, daily_m=0, slow_m=0, random_m=0.01)
    change_m[24:] += 0.3
    result = detect_changes(time_s, change_m, sigma_m, sigmas=threshold_sigmas(1.0, SCANS_PER_YEAR), **RULE)
    assert np.flatnonzero(result.detected).tolist() == list(range(25, 29))
    assert result.change_m[26] == pytest.approx(0.3, abs=3 * 0.01)
    assert result.sigma_m[26] == pytest.approx(0.02)
    assert np.isnan(result.change_m[2])
    assert not detect_changes(
        time_s, change_m, sigma_m, sigmas=4.0, **(RULE | {"min_change_m": 0.5})
    ).detected.any()


@pytest.mark.integration
def test_detection_power_for_steps_of_three_six_and_eight_sigmas():
    """At the second scan after the step."""
    rng = np.random.default_rng(13)
    power = {}
    for size in (3, 6, 8):
        detections = []
        for _ in range(400):
            time_s, change_m, sigma_m = errors(rng, 12, shared_m=0, daily_m=0, slow_m=0, random_m=0.01)
            change_m[10:] += size * np.hypot(0.01, 0.01)
            detections.append(detect_changes(time_s, change_m, sigma_m, sigmas=4.117, **RULE).detected[11])
        power[size] = np.mean(detections)
    assert power[3] < 0.05
    assert 0.85 < power[6] < 0.97
    assert power[8] > 0.99


@pytest.mark.parametrize("outlier", [20, 24, 25])
def test_one_outlier_is_no_change(outlier):
    """An outlier of 100 sigma, as the newest scan or as the oldest of the window."""
    change_m = np.zeros(48)
    change_m[outlier] = 2.0
    time_s = np.arange(48) * HOUR_S
    assert not detect_changes(time_s, change_m, np.full(48, 0.01), sigmas=4.0, **RULE).detected.any()
    single_scan = RULE | {"scans": 1}
    assert detect_changes(time_s, change_m, np.full(48, 0.01), sigmas=4.0, **single_scan).detected[outlier]


def test_slow_change_is_measured_over_the_window():
    time_s = np.arange(48) * HOUR_S
    melt_m = -0.02 * np.arange(48)
    melt = detect_changes(time_s, melt_m, np.full(48, 0.001), sigmas=4.0, **RULE)
    assert melt.detected[10:].all()
    assert melt.change_m[20] == pytest.approx(-0.02 * 5)  # 6 h with two scans at each end
    assert not detect_changes(
        time_s, melt_m, np.full(48, 0.001), sigmas=4.0, **(RULE | {"min_change_m": 0.2})
    ).detected.any()
