"""Robust estimates of a standard deviation from the median absolute deviation (MAD)."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats, Floats32

MEDIAN_ABSOLUTE_NORMAL = 0.6744897501960817  # median absolute value of a standard normal variable
NORMAL_95 = 1.959964  # absolute value that a standard normal variable does not exceed in 95 % of cases
NORMAL_MAD = 1.4826  # its reciprocal, rounded as is customary: converts a MAD to a sigma in thresholds


def nmad(values: Floats | Floats32) -> float:
    """Return the normalised median absolute deviation, which for normal errors is their standard deviation.

    The unit is that of the values.
    """
    return float(np.median(np.abs(values - np.median(values))) / MEDIAN_ABSOLUTE_NORMAL)


def robust_scale(values: Floats | Floats32) -> float:
    """Return the scale of values (n,) about zero, which for normal errors is their standard deviation.

    It is the geometric mean of two: from the median of the absolute values, and from the value that 95 % of
    them do not exceed. So it covers the tails of real errors more than the middle alone would.
    """
    median, tail = np.quantile(np.abs(values), (0.5, 0.95))
    return float(np.sqrt(median / MEDIAN_ABSOLUTE_NORMAL * tail / NORMAL_95))
