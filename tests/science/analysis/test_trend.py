"""Rates and accelerations: their errors against their sigma, for errors that epochs share."""

import numpy as np
import pytest
from scipy import optimize

from station.science.analysis.trend import error_correlation, error_covariance, fit_trend
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S

HOUR_S = 3600.0
TIME_S = 1.7e9 + HOUR_S * np.delete(np.arange(60.0), [7, 8, 30, 41])  # hourly, with gaps
SIGMA_M = 0.01 + 0.02 * np.random.default_rng(0).random(len(TIME_S))


def drawn_errors(correlation, count, seed=1):
    """Errors (count, n) as the reference, the weather and the scans themselves make them."""
    rng = np.random.default_rng(seed)
    common, weather = correlation
    step = np.exp(-np.diff(TIME_S, prepend=-np.inf) / REFRACTION_CORRELATION_S)  # an autoregressive process
    air = np.zeros((count, len(TIME_S)))
    for index, kept in enumerate(step):
        before = air[:, index - 1] if index else 0.0
        air[:, index] = kept * before + np.sqrt(1 - kept**2) * rng.standard_normal(count)
    own = rng.standard_normal((count, len(TIME_S)))
    shared = np.sqrt(common) * rng.standard_normal((count, 1)) + np.sqrt(weather) * air
    return SIGMA_M * (shared + np.sqrt(1 - common - weather) * own)


@pytest.mark.parametrize("correlation", [(0.0, 0.0), (0.6, 0.0), (0.2, 0.7), (0.0, 0.9)])
def test_errors_of_rate_and_acceleration_have_their_sigma(correlation):
    covariance = error_covariance(TIME_S, SIGMA_M, correlation)
    day = (TIME_S - TIME_S.mean()) / 86_400
    z = []
    for errors in drawn_errors(correlation, 2000):
        trend = fit_trend(TIME_S, 0.3 - 0.12 * day + errors, covariance)
        bent = fit_trend(TIME_S, 0.3 - 0.12 * day + 0.05 * day**2 / 2 + errors, covariance)
        z_rate = (trend.rate_m_d + 0.12) / trend.rate_sigma_m_d
        z.append((z_rate, (bent.acceleration_m_d2 - 0.05) / bent.acceleration_sigma_m_d2))
    assert np.mean(z, axis=0) == pytest.approx(0, abs=0.08)
    assert np.std(z, axis=0) == pytest.approx(1, abs=0.05)


def test_trend_equals_that_of_scipy():
    """Its covariance is only scaled by sigma, as here; what all epochs share does not change a rate."""
    values_m = np.random.default_rng(3).normal(0, SIGMA_M)
    day = (TIME_S - TIME_S.mean()) / 86_400
    covariance = error_covariance(TIME_S, SIGMA_M, (0.0, 0.5))
    line, line_cov = optimize.curve_fit(
        lambda t, a, b: a + b * t, day, values_m, sigma=covariance, absolute_sigma=True
    )
    arc, arc_cov = optimize.curve_fit(
        lambda t, a, b, c: a + b * t + c * t**2 / 2, day, values_m, sigma=covariance, absolute_sigma=True
    )
    trend = fit_trend(TIME_S, values_m, covariance)
    assert (trend.rate_m_d, trend.rate_sigma_m_d) == pytest.approx(
        (line[1], np.sqrt(line_cov[1, 1])), rel=1e-5
    )
    expected = arc[2], np.sqrt(arc_cov[2, 2])
    assert (trend.acceleration_m_d2, trend.acceleration_sigma_m_d2) == pytest.approx(expected, rel=1e-5)


def test_two_epochs_have_no_rate_and_three_no_acceleration():
    covariance = np.diag(SIGMA_M[:3] ** 2)
    with pytest.raises(ValueError, match="a rate needs 3 epochs, there are 2"):
        fit_trend(TIME_S[:2], np.zeros(2), covariance[:2, :2])
    assert np.isnan(fit_trend(TIME_S[:3], np.zeros(3), covariance).acceleration_m_d2)


@pytest.mark.parametrize("correlation", [(0.0, 0.0), (0.5, 0.0), (0.1, 0.6), (0.0, 0.95)])
def test_parts_of_the_correlation_are_found(correlation):
    lag_s = HOUR_S * np.repeat(2.0 ** np.arange(10), 3)
    values = correlation[0] + correlation[1] * np.exp(-lag_s / REFRACTION_CORRELATION_S)
    noise = np.random.default_rng(4).normal(0, 0.02, len(lag_s))
    assert error_correlation(lag_s, values + noise) == pytest.approx(correlation, abs=0.04)


@pytest.mark.parametrize(("lag_s", "values"), [([], []), ([3600.0], [-0.5]), ([3600.0, 7200.0], [1.4, 1.2])])
def test_any_correlation_gives_a_valid_covariance(lag_s, values):
    parts = error_correlation(np.array(lag_s), np.array(values))
    covariance = error_covariance(TIME_S, SIGMA_M, parts)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.diag(covariance) == pytest.approx(SIGMA_M**2)
