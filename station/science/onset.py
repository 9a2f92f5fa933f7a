"""Whether the mean of an area has changed, told from a series at a stated rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from station.quantities import Bools, Floats


@dataclass(frozen=True)
class Onsets:
    """What each epoch of a series tells: (n,) all, NaN and False where there are too few epochs."""

    found: Bools
    change_m: Floats  # mean of the newest epochs less that of the oldest
    sigma_m: Floats  # one sigma of it, at most


def threshold_sigmas(false_alarms_per_year: float, tests_per_year: float) -> float:
    """How many sigmas a difference must exceed so that so many tests a year give so few false alarms.

    Two-sided and normal. By Boole's inequality the expected number of false alarms is at most the sum of
    their chances, however much the tests depend on each other.
    """
    return float(-ndtri(min(false_alarms_per_year / tests_per_year, 1.0) / 2))


def onsets(
    time_s: Floats,
    change_m: Floats,
    sigma_m: Floats,
    *,
    within_s: float,
    scans: int,
    least_m: float,
    sigmas: float,
) -> Onsets:
    """Tell at which epochs an area has changed within the time before.

    `time_s` (n,) ascends, `change_m` and `sigma_m` (n,) are the mean against the reference and its one sigma.
    The newest `scans` epochs are set against the oldest `scans` of the last `within_s`; each pair must differ
    the same way, by more than `least_m` and by `sigmas` of its uncertainty. A single wrong epoch, new or old,
    thus raises no alarm where `scans` is above 1, and the chance of a false one is at most that of one pair.

    The variance of a difference is taken as the sum of both: that is no less than it is as long as errors of
    two epochs are not anticorrelated. The shared reference makes them positively so; a daily wave is not
    against itself within 6 hours.
    """
    told = Onsets(np.zeros(len(time_s), dtype=bool), *(np.full(len(time_s), np.nan) for _ in range(2)))
    first = np.searchsorted(time_s, time_s - within_s)
    for index, oldest in enumerate(first):
        if index + 1 - oldest < 2 * scans:
            continue
        old, new = slice(oldest, oldest + scans), slice(index + 1 - scans, index + 1)
        apart_m = change_m[new][:, None] - change_m[old][None, :]
        needed_m = np.maximum(sigmas * np.hypot(sigma_m[new][:, None], sigma_m[old][None, :]), least_m)
        told.found[index] = bool(np.all(apart_m > needed_m) or np.all(apart_m < -needed_m))
        told.change_m[index] = apart_m.mean()
        told.sigma_m[index] = np.hypot(sigma_m[new].mean(), sigma_m[old].mean())
    return told
