"""Significance of the difference of two surfaces."""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats, Floats32

SIGNIFICANT_SIGMAS = 1.959964  # two-sided 95 % of a normal distribution


def significant(change_m: Floats | Floats32, uncertainty_m: Floats | Floats32) -> Bools:
    """Return True for changes (ny, nx) that exceed their uncertainty at the 95 % level.

    NaN is not significant.
    """
    return np.abs(change_m) > SIGNIFICANT_SIGMAS * uncertainty_m
