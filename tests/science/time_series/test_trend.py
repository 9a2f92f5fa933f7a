"""Rates and accelerations: their errors against their sigma, for errors that last for hours or do not."""

import numpy as np
import pytest

from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S
from station.science.time_series.trend import fit_trend

HOUR_S = 3600.0
DAYS_S = 1.7e9 + HOUR_S * np.delete(np.arange(60.0), [7, 8, 30, 41])  # hourly, with gaps
HOURS_S = 1.7e9 + HOUR_S * np.arange(5.0)


def drawn_errors(time_s, sigma_m, common, *, lasting, count=2000):
    """Errors (count, n) that epochs have in common, and others that last for hours or for one scan."""
    rng = np.random.default_rng(1)
    errors = rng.standard_normal((count, len(time_s)))
    if lasting:  # an autoregressive process
        for index, kept in enumerate(np.exp(-np.diff(time_s) / REFRACTION_CORRELATION_S), 1):
            errors[:, index] = kept * errors[:, index - 1] + np.sqrt(1 - kept**2) * errors[:, index]
    shared = np.sqrt(common) * rng.standard_normal((count, 1)) + np.sqrt(1 - common) * errors
    return sigma_m * shared


@pytest.mark.integration
@pytest.mark.parametrize("common", [0.0, 0.6])
@pytest.mark.parametrize(
    ("time_s", "lasting", "low", "high"),
    [
        (DAYS_S, True, 0.95, 1.05),
        (HOURS_S, False, 0.95, 1.05),
        (DAYS_S, False, 0.2, 0.6),  # of two days, errors that last for hours would be larger
        (HOURS_S, True, 0.2, 0.9),  # of four hours, those that do not last
    ],
)
def test_errors_of_rate_and_acceleration_have_the_larger_sigma(time_s, lasting, low, high, common):
    sigma_m = 0.01 + 0.02 * np.random.default_rng(0).random(len(time_s)) * (common == 0)
    day = (time_s - time_s.mean()) / 86_400
    z = []
    for errors_m in drawn_errors(time_s, sigma_m, common, lasting=lasting):
        trend = fit_trend(time_s, 0.3 - 0.12 * day + errors_m, sigma_m, common)
        bent = fit_trend(time_s, 0.3 - 0.12 * day + 0.05 * day**2 / 2 + errors_m, sigma_m, common)
        z_rate = (trend.rate_m_d + 0.12) / trend.rate_sigma_m_d
        z.append((z_rate, (bent.acceleration_m_d2 - 0.05) / bent.acceleration_sigma_m_d2))
    assert np.mean(z, axis=0) == pytest.approx(0, abs=0.08)
    assert (np.std(z, axis=0) > low).all()
    assert (np.std(z, axis=0) < high).all()


def test_trend_is_that_of_plain_polynomials_also_of_a_step():
    """Weights by sigma would give another rate, for which a step at a precise epoch counts more."""
    rng = np.random.default_rng(3)
    change_m = rng.normal(0, 0.01, len(DAYS_S)) + np.where(DAYS_S[20] < DAYS_S, 2.0, 0.0)
    day = (DAYS_S - DAYS_S.mean()) / 86_400
    trend = fit_trend(DAYS_S, change_m, rng.uniform(0.01, 0.1, len(DAYS_S)), 0.3)
    assert trend.rate_m_d == pytest.approx(np.polyfit(day, change_m, 1)[0])
    assert trend.acceleration_m_d2 == pytest.approx(2 * np.polyfit(day, change_m, 2)[0])


def test_errors_in_common_do_not_change_a_rate():
    sigma_m = np.full(len(DAYS_S), 0.03)
    assert fit_trend(DAYS_S, sigma_m, sigma_m, 1.0).rate_sigma_m_d == pytest.approx(0, abs=1e-9)


def test_two_epochs_have_no_rate_and_three_no_acceleration():
    sigma_m = np.full(3, 0.02)
    with pytest.raises(ValueError, match="a rate needs 3 epochs, there are 2"):
        fit_trend(DAYS_S[:2], np.zeros(2), sigma_m[:2], 0.0)
    assert np.isnan(fit_trend(DAYS_S[:3], np.zeros(3), sigma_m, 0.0).acceleration_m_d2)
