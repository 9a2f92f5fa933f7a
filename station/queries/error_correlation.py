"""How far the errors of the epochs of an area are the same: those of the reference, and of the weather."""

from __future__ import annotations

import numpy as np

from station.archive.epochs import EpochRef
from station.quantities import Bools
from station.queries.aggregates import Aggregates
from station.science.analysis.trend import error_correlation

PAIRS_PER_LAG = 3  # spread over the series


def area_error_correlation(
    aggregates: Aggregates, cells: Bools, epochs: list[EpochRef]
) -> tuple[float, float]:
    """Return what the errors of the mean change over cells (ny, nx) have in common: see `error_correlation`.

    Of pairs of epochs at lags of 1, 2, 4 … epochs, the variances of both and of their difference tell it. So
    the cost grows with the logarithm of their number.
    """
    lag_s, correlation = [], []
    step = 1
    while step < len(epochs):
        for first in np.unique(np.linspace(0, len(epochs) - 1 - step, PAIRS_PER_LAG).astype(int)).tolist():
            pair = epochs[first], epochs[first + step]
            variances = [aggregates.variance(cells, epoch) for epoch in pair]
            covariance = (sum(variances) - aggregates.variance(cells, pair[1], pair[0])) / 2
            if np.isfinite(covariance) and min(variances) > 0:
                lag_s.append((pair[1].start - pair[0].start).total_seconds())
                correlation.append(covariance / np.sqrt(variances[0] * variances[1]))
        step *= 2
    return error_correlation(np.array(lag_s), np.array(correlation))
