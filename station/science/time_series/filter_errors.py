"""Random and systematic errors of the filtered level and rate of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.science.time_series.cell_filter import LevelRate
from station.science.time_series.class_filter import ClassFilter

TINY_M2 = 1e-12  # against division by zero
OWN_PROCESS = 0.5  # share of what a cell does besides its class that the cells around it do not do


@dataclass(frozen=True)
class FilterErrors:
    """Variances of the errors of level [m²] and rate [m²/d²] of cells (n,), without those of the reference.

    Random errors are independent between cells. Systematic ones are taken as the same in all of them: errors
    that a scan's cells share, and what the surface did since that the scans do not show. Errors that last are
    learned as process noise too, and are in the course as in the cells: the largest of the three counts. What
    stable ground seems to do is such an error.
    """

    level_random_m2: Floats
    level_systematic_m2: Floats
    rate_random_m2_d2: Floats
    rate_systematic_m2_d2: Floats


def filter_errors(
    state: LevelRate, unseen_d: Floats, random_m2: Floats, systematic_m2: Floats, ground: ClassFilter
) -> FilterErrors:
    """Return the errors of the estimates of cells (n,) of a class, last seen some days ago.

    `random_m2` and `systematic_m2` are the variances of the last observation. A cell that is as certain as
    the class has the shares of the class. One that was first seen lately, or stepped, has those of a single
    scan, as far as it is less certain.

    Source: equations.md, 6.12.
    """
    shares = ground.shares
    if shares is None:  # no cell of the class was seen yet
        unknown = np.full_like(unseen_d, np.nan)
        return FilterErrors(unknown, unknown, unknown, unknown)
    random, systematic = (_moved(matrix, unseen_d) for matrix in (shares.random, shares.systematic))
    single = random_m2 / np.maximum(random_m2 + systematic_m2, TINY_M2)
    is_seen = unseen_d == 0
    parts: list[Floats] = []
    one, zero = np.ones_like(single), np.zeros_like(single)
    for index, (variance, first_random, first_process, first_shared) in enumerate(
        ((state.level_m2, single, zero, one), (state.rate_m2_d2, zero, one, zero))
    ):
        total = shares.total[index, index]
        settled = np.minimum(total / np.maximum(variance, TINY_M2), 1.0)

        def share(part: float, first: Floats, settled: Floats = settled) -> Floats:
            return np.asarray(settled * part + (1 - settled) * first)

        process = 0.0 if ground.is_stable else shares.process[index, index] / total
        random_part = np.where(
            is_seen,
            share(shares.random[index, index] / total, first_random) * variance,
            np.minimum(random[index], variance),
        )
        process_part = np.where(is_seen, share(process, first_process) * variance, variance - random_part)
        process_part += ground.missing_rate[1] * index  # of the rate
        shared = np.where(is_seen, share(shares.systematic[index, index], first_shared), systematic[index])
        course = ground.course.errors(index, systematic_m2)
        course_process = 0.0 if ground.is_stable else course.process
        parts += [
            random_part + OWN_PROCESS * process_part,
            np.maximum.reduce(
                [
                    (1 - OWN_PROCESS) * process_part + course_process,
                    shared * systematic_m2,
                    course.systematic,
                ]
            )
            + course.random,
        ]
    return FilterErrors(*parts)


def _moved(matrix: Floats, days: Floats) -> tuple[Floats, Floats]:
    """Return the variances of level and rate some days (n,) after an error covariance (2, 2)."""
    return matrix[0, 0] + days * (2 * matrix[0, 1] + days * matrix[1, 1]), matrix[1, 1] + 0 * days
