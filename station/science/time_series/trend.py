"""Rate and acceleration of a change whose errors are correlated in time, by least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S

MIN_EPOCHS = 3


@dataclass(frozen=True)
class Trend:
    """Mean rate and acceleration of a change, with one sigma each [m/d, m/d²].

    The acceleration is NaN for fewer than `MIN_EPOCHS` + 1 epochs.
    """

    rate_m_d: float
    rate_sigma_m_d: float
    acceleration_m_d2: float
    acceleration_sigma_m_d2: float


def fit_trend(time_s: Floats, change_m: Floats, sigma_m: Floats, common_share: float) -> Trend:
    """Return rate and acceleration of a change (n,) with errors of sigma (n,).

    All epochs have the same weight: the rate is the slope of the plain line through the change, whatever the
    surface does between its ends. Its sigma is that of the measurement. `common_share` is the share of the
    variance that all epochs have in common [1]. How long the rest lasts is not known, so sigma is the larger
    of two: independent from scan to scan, and correlated over hours as refraction is. Raises ValueError for
    fewer than `MIN_EPOCHS` epochs. Source: equations.md, 6.10.
    """
    if len(time_s) < MIN_EPOCHS:
        raise ValueError(f"a rate needs {MIN_EPOCHS} epochs, there are {len(time_s)}")
    day = (time_s - time_s.mean()) / 86_400
    lag_s = np.abs(np.subtract.outer(time_s, time_s))
    covariances_m2 = [
        np.outer(sigma_m, sigma_m) * (common_share + (1 - common_share) * correlation)
        for correlation in (np.eye(len(day)), np.exp(-lag_s / REFRACTION_CORRELATION_S))
    ]

    def last_coefficient(degree: int) -> tuple[float, float]:
        weights = np.linalg.pinv(np.vander(day, degree + 1, increasing=True))[degree]
        variance = max(float(weights @ covariance_m2 @ weights) for covariance_m2 in covariances_m2)
        return float(weights @ change_m), float(np.sqrt(max(variance, 0.0)))  # rounding

    rate_m_d, rate_sigma_m_d = last_coefficient(1)
    if len(time_s) <= MIN_EPOCHS:
        return Trend(rate_m_d, rate_sigma_m_d, np.nan, np.nan)
    half_m_d2, half_sigma_m_d2 = last_coefficient(2)
    return Trend(rate_m_d, rate_sigma_m_d, 2 * half_m_d2, 2 * half_sigma_m_d2)
