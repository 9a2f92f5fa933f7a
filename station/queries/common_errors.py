"""How much of the errors of an area is the same in all epochs: those of the reference above all."""

from __future__ import annotations

import numpy as np

from station.archive.epochs import EpochRef
from station.quantities import Bools
from station.queries.aggregates import Aggregates

PAIRS = 8  # of consecutive epochs, spread over the series


def common_error_share(aggregates: Aggregates, cells: Bools, epochs: list[EpochRef]) -> float:
    """Return the share of the variance of the mean change over cells (ny, nx) that epochs have in common [1].

    It is the median correlation of the errors of pairs of epochs, from the variances of both and of their
    difference; 0 for a single epoch. Source: equations.md, 6.10.
    """
    shares = []
    for first in np.unique(np.linspace(0, len(epochs) - 2, PAIRS).astype(int)).tolist() if epochs[1:] else ():
        pair = epochs[first], epochs[first + 1]
        variances = [aggregates.variance(cells, epoch) for epoch in pair]
        covariance = (sum(variances) - aggregates.variance(cells, pair[1], pair[0])) / 2
        if np.isfinite(covariance) and min(variances) > 0:
            shares.append(covariance / np.sqrt(variances[0] * variances[1]))
    return float(np.clip(np.median(shares), 0.0, 1.0)) if shares else 0.0
