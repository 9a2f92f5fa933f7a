"""Significance of the difference of two surfaces."""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats, Floats32, Ints32, Reals
from station.science.geometry.robust_statistics import NORMAL_95

SIGNIFICANT_SIGMAS = NORMAL_95
REJECTION_SIGMAS = 3.090232  # one-sided 0.1 % of a normal distribution


def significant(change_m: Floats | Floats32, uncertainty_m: Floats | Floats32) -> Bools:
    """Return True for changes (ny, nx) that exceed their uncertainty at the 95 % level.

    NaN is not significant.
    """
    return np.abs(change_m) > SIGNIFICANT_SIGMAS * uncertainty_m


def supported_variance(model_m2: Reals, spread_m: Floats32, count: Ints32) -> Reals:
    """Return the variance of a point in cells (n,) [m²]: the modelled one, or the observed one if larger.

    Larger means that `spread_m`, the standard deviation of `count` points, rejects the model at 0.1 %: an
    observed variance that always counted would be too large in half of the cells whose model is right.

    Source: equations.md, 6.6; quantile of chi-squared by Wilson and Hilferty (1931).
    """
    observed_m2 = spread_m * spread_m
    larger = np.flatnonzero(observed_m2 > model_m2)  # all others cannot reject it
    part = 2 / (9 * (count.take(larger) - 1).astype(np.float32))
    limit = (1 - part + np.float32(REJECTION_SIGMAS) * np.sqrt(part)) ** 3
    rejects = larger[observed_m2.take(larger) > limit * model_m2.take(larger)]
    variance_m2 = model_m2.copy()
    variance_m2[rejects] = observed_m2[rejects]
    return variance_m2
