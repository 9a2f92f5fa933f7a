"""Change detection in the mean of an area, at a given rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from station.quantities import Bools, Floats


@dataclass(frozen=True)
class ChangeDetections:
    """Result of change detection at each epoch of a series, all (n,); NaN and False if there are too few."""

    detected: Bools
    change_m: Floats  # mean of the newest epochs less that of the oldest
    sigma_m: Floats  # upper bound of its sigma


def threshold_sigmas(false_alarms_per_year: float, tests_per_year: float) -> float:
    """Return the threshold for a difference [sigma] that limits the expected false alarms per year.

    Two-sided and normal. By Boole's inequality the expected number of false alarms is at most the sum of
    their probabilities, however correlated the tests are.
    """
    return float(-ndtri(min(false_alarms_per_year / tests_per_year, 1.0) / 2))


def detect_changes(
    time_s: Floats,
    change_m: Floats,
    sigma_m: Floats,
    *,
    within_s: float,
    scans: int,
    min_change_m: float,
    sigmas: float,
) -> ChangeDetections:
    """Detect the epochs at which the mean of an area has changed within the last `within_s`.

    `time_s` (n,) ascends; `change_m` and `sigma_m` (n,) are the mean against the reference and its sigma. The
    newest `scans` epochs are compared with the oldest `scans` in the window; every pair must differ with the
    same sign, by more than `min_change_m` and by `sigmas` of its uncertainty. A single outlier, new or old,
    therefore raises no alarm if `scans` is above 1, and the false alarm probability is at most that of one
    pair.

    The variance of a difference is taken as the sum of both. That is an upper bound unless the errors of two
    epochs are anticorrelated. The shared reference correlates them positively; a diurnal wave is not
    anticorrelated with itself within 6 hours.
    """
    result = ChangeDetections(
        np.zeros(len(time_s), dtype=bool), *(np.full(len(time_s), np.nan) for _ in range(2))
    )
    first = np.searchsorted(time_s, time_s - within_s)
    for index, oldest in enumerate(first):
        if index + 1 - oldest < 2 * scans:
            continue
        old, new = slice(oldest, oldest + scans), slice(index + 1 - scans, index + 1)
        difference_m = change_m[new][:, None] - change_m[old][None, :]
        threshold_m = np.maximum(
            sigmas * np.hypot(sigma_m[new][:, None], sigma_m[old][None, :]), min_change_m
        )
        result.detected[index] = bool(
            np.all(difference_m > threshold_m) or np.all(difference_m < -threshold_m)
        )
        result.change_m[index] = difference_m.mean()
        result.sigma_m[index] = np.hypot(sigma_m[new].mean(), sigma_m[old].mean())
    return result
