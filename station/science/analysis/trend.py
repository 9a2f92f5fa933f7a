"""Rate and acceleration of a series whose errors are correlated, by generalised least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from station.quantities import Floats
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S

MAX_CORRELATION = 0.999  # a scan has noise of its own
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


def error_correlation(lag_s: Floats, correlation: Floats) -> tuple[float, float]:
    """Return the parts of the error variance that all epochs share, and that those of six hours share [1].

    They are fitted to the correlation (n,) of errors of epochs that are `lag_s` (n,) apart; neither is
    negative and the rest is white, so that it is the correlation of a covariance at every lag. Source:
    equations.md, 6.10.
    """
    if not len(lag_s):
        return 0.0, 0.0
    design = np.stack([np.ones_like(lag_s), np.exp(-lag_s / REFRACTION_CORRELATION_S)], axis=1)
    common, weather = optimize.nnls(design, np.clip(correlation, 0.0, 1.0))[0]
    scale = min(1.0, MAX_CORRELATION / max(common + weather, 1e-9))
    return float(common * scale), float(weather * scale)


def error_covariance(time_s: Floats, sigma_m: Floats, correlation: tuple[float, float]) -> Floats:
    """Return the covariance (n, n) of errors with sigma (n,) [m²], by the parts of `error_correlation`.

    Source: equations.md, 6.10.
    """
    common, weather = correlation
    lag_s = np.abs(np.subtract.outer(time_s, time_s))
    shared = common + weather * np.exp(-lag_s / REFRACTION_CORRELATION_S)
    np.fill_diagonal(shared, 1.0)
    return np.asarray(sigma_m[:, None] * shared * sigma_m)


def fit_trend(time_s: Floats, change_m: Floats, covariance_m2: Floats) -> Trend:
    """Return rate and acceleration of a change (n,) with an error covariance (n, n).

    The rate is that of the straight line, whatever the series does between its ends, and its sigma is that of
    the measurement. Raises ValueError for fewer than `MIN_EPOCHS` epochs. Source: equations.md, 6.10.
    """
    if len(time_s) < MIN_EPOCHS:
        raise ValueError(f"a rate needs {MIN_EPOCHS} epochs, there are {len(time_s)}")
    day = (time_s - time_s.mean()) / 86_400
    whitener = linalg.cholesky(covariance_m2, lower=True)

    def last_coefficient(degree: int) -> tuple[float, float]:
        design = np.stack([day**power for power in range(degree + 1)], axis=1)
        whitened = linalg.solve_triangular(whitener, np.column_stack([design, change_m]), lower=True)
        factor = np.asarray(np.linalg.qr(whitened, mode="r"))  # last row: coefficient over sigma
        corner = factor[degree, degree]
        return float(factor[degree, degree + 1] / corner), float(1 / abs(corner))

    rate_m_d, rate_sigma_m_d = last_coefficient(1)
    if len(time_s) <= MIN_EPOCHS:
        return Trend(rate_m_d, rate_sigma_m_d, np.nan, np.nan)
    half_m_d2, half_sigma_m_d2 = last_coefficient(2)
    return Trend(rate_m_d, rate_sigma_m_d, 2 * half_m_d2, 2 * half_sigma_m_d2)
