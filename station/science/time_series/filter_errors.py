"""Level and rate of a day, and the random and systematic errors of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from station.quantities import Bools, Floats
from station.science.time_series.cell_filter import LevelRate
from station.science.time_series.class_course import CourseErrors
from station.science.time_series.class_filter import ClassFilter
from station.science.time_series.error_shares import LEVEL, RATE

TINY_M2 = 1e-12  # against division by zero
OWN_PROCESS = 0.5  # share of what a cell does besides class and patch that cells around do not do


@dataclass(frozen=True)
class FilterErrors:
    """Variances of the errors of level [m²] and rate [m²/d²] of cells (n,), without those of the reference.

    Random errors are independent between cells. Systematic ones are taken as the same in all of them: errors
    that a scan's cells share, and what the surface did since that the scans do not show. Errors that last are
    learned as process noise too, and are in the course as in the cells: the largest of the three counts. What
    stable ground seems to do is such an error. What patches do besides their class is not.
    """

    level_random_m2: Floats
    level_systematic_m2: Floats
    rate_random_m2_d2: Floats
    rate_systematic_m2_d2: Floats


@dataclass(frozen=True)
class _Parts:
    """Variances of the errors of cells (n,): random, process, patches in it, a systematic error of 1 m."""

    random: Floats
    process: Floats
    patches: Floats
    systematic: Floats


def day_rates(state: LevelRate, moved_m: Floats, ground: ClassFilter) -> Floats:
    """Return the mean rate (n,) of cells of a class since the day began, without steps [m/d].

    `moved_m` is how far the levels moved since, NaN where that is not known.

    Source: equations.md, 6.12.
    """
    filtered_m_d = state.rate_m_d + ground.missing_rate[0]
    if ground.shares is None or not ground.shares.elapsed_d:
        return filtered_m_d
    weight = _weights(moved_m, ground)
    difference_m_d = np.nan_to_num(moved_m) / ground.shares.elapsed_d
    return np.asarray(weight * difference_m_d + (1 - weight) * filtered_m_d)


def filter_errors(
    state: LevelRate,
    moved_m: Floats,
    unseen_d: Floats,
    random_m2: Floats,
    systematic_m2: Floats,
    ground: ClassFilter,
) -> FilterErrors:
    """Return the errors of levels and day rates of cells (n,) of a class, last seen some days ago.

    `random_m2` and `systematic_m2` are the variances of the last observation. A cell that is as certain as
    the class has the shares of the class. One that was first seen lately, or stepped, has those of a single
    scan, as far as it is less certain.

    Source: equations.md, 6.12.
    """
    shares, course = ground.shares, ground.course
    if shares is None:  # no cell of the class was seen yet
        unknown = np.full_like(unseen_d, np.nan)
        return FilterErrors(unknown, unknown, unknown, unknown)
    weight, is_seen = _weights(moved_m, ground), unseen_d == 0
    single = random_m2 / np.maximum(random_m2 + systematic_m2, TINY_M2)
    kinds = shares.total, shares.random, shares.process, shares.patches, shares.systematic

    level_m2, *levels = (np.full_like(single, matrix[LEVEL, LEVEL]) for matrix in kinds)
    none = np.zeros_like(single)
    first = _Parts(single, none, none, np.ones_like(single))
    seen = _seen(state.level_m2, level_m2, _Parts(*levels), first, ground)
    later = _unseen(
        state.level_m2, _moved(shares.random, unseen_d), levels[2], _moved(shares.systematic, unseen_d)
    )
    level = _chosen(is_seen, seen, later)

    rate_m2_d2, *rates = (_combined(shares.rate_variances(matrix), weight) for matrix in kinds)
    settled_m2_d2 = shares.total[RATE, RATE]
    uncertainty = weight * state.level_m2 / level_m2 + (1 - weight) * state.rate_m2_d2 / settled_m2_d2
    variance_m2_d2 = rate_m2_d2 * uncertainty
    first = _Parts(weight * single, 1 - weight, none, weight)
    seen = _seen(variance_m2_d2, rate_m2_d2, _Parts(*rates), first, ground)
    rate = _chosen(is_seen, seen, _unseen(variance_m2_d2, rates[0], rates[2], rates[3]))
    missing_m2_d2 = (1 - weight) ** 2 * ground.missing_rate[1]
    rate = replace(rate, process=rate.process + missing_m2_d2)
    return FilterErrors(
        *_random_and_systematic(level, course.level_errors(systematic_m2), systematic_m2, ground),
        *_random_and_systematic(rate, course.rate_errors(systematic_m2), systematic_m2, ground),
    )


def _weights(moved_m: Floats, ground: ClassFilter) -> Floats:
    return np.where(np.isfinite(moved_m), ground.weight_of_difference, 0.0)


def _combined(variances: Floats, weight: Floats) -> Floats:
    """Return the variance (n,) of a weighted mean of two estimates with a covariance (2, 2)."""
    (filtered, covariance), (_, difference) = variances
    return np.asarray(
        (1 - weight) ** 2 * filtered + weight**2 * difference + 2 * weight * (1 - weight) * covariance
    )


def _seen(variance: Floats, total: Floats, of_class: _Parts, first: _Parts, ground: ClassFilter) -> _Parts:
    """Return the parts of a variance (n,) as in the class; what exceeds its total as in a first scan."""
    settled = np.minimum(total / np.maximum(variance, TINY_M2), 1.0)
    process = np.zeros_like(total) if ground.is_stable else of_class.process
    return _Parts(
        (settled * of_class.random / total + (1 - settled) * first.random) * variance,
        (settled * process / total + (1 - settled) * first.process) * variance,
        settled * of_class.patches + (1 - settled) * first.patches,
        settled * of_class.systematic + (1 - settled) * first.systematic,
    )


def _unseen(variance: Floats, random: Floats, patches: Floats, systematic: Floats) -> _Parts:
    """Return the parts of a variance (n,) in cells that the last scan did not see."""
    random = np.minimum(random, variance)
    return _Parts(random, variance - random, patches, systematic)


def _chosen(is_seen: Bools, seen: _Parts, unseen: _Parts) -> _Parts:
    pairs = zip(vars(seen).values(), vars(unseen).values(), strict=True)
    return _Parts(*(np.where(is_seen, *pair) for pair in pairs))


def _random_and_systematic(
    parts: _Parts, course: CourseErrors, systematic_m2: Floats, ground: ClassFilter
) -> tuple[Floats, Floats]:
    """Return the variances of random and of systematic errors of cells (n,)."""
    process = np.maximum(parts.process - parts.patches, 0)
    shared = (
        (1 - OWN_PROCESS) * process + (0.0 if ground.is_stable else course.process),
        parts.systematic * systematic_m2,
        course.systematic,
    )
    systematic = np.maximum.reduce(shared) + parts.patches + course.random
    return parts.random + OWN_PROCESS * process, systematic


def _moved(matrix: Floats, days: Floats) -> Floats:
    """Return the variance of the level some days (n,) after the error covariance of level and rate."""
    covariance, rate = matrix[LEVEL, RATE], matrix[RATE, RATE]
    return np.asarray(matrix[LEVEL, LEVEL] + days * (2 * covariance + days * rate))
