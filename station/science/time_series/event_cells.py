"""Whether the cells of a place changed together, or few of them by much. Source: equations.md, 6.11."""

from __future__ import annotations

import numpy as np
from scipy import stats

from station.quantities import Floats
from station.science.time_series.surroundings import nanmedian

LEAST_BEFORE = 3  # scans before that must have seen a cell
MIN_CELLS = 3
MIN_VARIANCE = 0.25  # of a cell, for its weight, over the median of all
MIN_VARIANCE_M2 = 1e-12
MIN_LOG_TAIL = -700.0  # of what numbers can represent


def agreement_sigmas(before_m: Floats, after_m: Floats, random_m: Floats, around_m: float) -> float:
    """Return how many sigma the mean change of cells (n,) is from that of their surroundings [m].

    `before_m` (k, n) and `after_m` (2, n) are the changes of the cells against the reference [m], NaN where a
    scan did not observe them; `random_m` (n,) is sigma of their random errors. The error of the mean is that
    by which the cells differ: where beams hit an edge otherwise, a cell jumps by many of its sigma, and those
    beside it stay. The statistic is Student's t, given as the value of a normal variable that is exceeded as
    rarely. Zero for fewer than three cells.
    """
    known = (np.isfinite(before_m).sum(axis=0) >= LEAST_BEFORE) & np.isfinite(after_m).all(axis=0)
    if np.count_nonzero(known) < MIN_CELLS:
        return 0.0
    change_m = after_m[:, known].mean(axis=0) - nanmedian(before_m[:, known], 0) - around_m
    variance_m2 = random_m[known] ** 2
    weights = 1 / np.maximum(variance_m2, MIN_VARIANCE * np.median(variance_m2))
    weights /= weights.sum()
    mean_m, freedom = weights @ change_m, 1 / (weights @ weights) - 1
    mean_m2 = weights**2 @ (change_m - mean_m) ** 2 * (freedom + 1) / freedom
    log_tail = stats.t.logsf(abs(mean_m) / np.sqrt(max(mean_m2, MIN_VARIANCE_M2)), freedom)
    return float(np.sign(mean_m) * stats.norm.isf(np.exp(max(log_tail, MIN_LOG_TAIL))))
