"""Robust estimates of a standard deviation from the median absolute deviation (MAD)."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats, Floats32

MEDIAN_ABSOLUTE_NORMAL = 0.6744897501960817  # median absolute value of a standard normal variable
NORMAL_MAD = 1.4826  # its reciprocal, rounded as is customary: converts a MAD to a sigma in thresholds


def nmad(values: Floats | Floats32) -> float:
    """Return the normalised median absolute deviation, which for normal errors is their standard deviation.

    The unit is that of the values.
    """
    return float(np.median(np.abs(values - np.median(values))) / MEDIAN_ABSOLUTE_NORMAL)
