"""Variance factors of one scan: how much more or less its residuals scatter than modelled.

Residuals of cells against a plane through the cells around show the random variance by range and roughness.
Mean residuals of blocks of stable ground show the systematic variance. Both are compared with the model and
drawn towards it where there are few; the factors are applied and stored.
Source: equations.md, 6.7.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.quantities import Bools, Floats, Floats32, Ints, Reals
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL, robust_scale

CELL_CLASSES = 256  # of the cells of a reference
COUNT_EDGES = (0.15, 0.4, 0.8)  # between classes of the difference of a number of points from its usual one
# In a scan the points of a cell may scatter as modelled or more, and be as many as usual or not.
NOISE_CLASSES = CELL_CLASSES * 2 * (len(COUNT_EDGES) + 1)
RANGE_CLASS_M = 500.0
RATIO_EDGES = (0.025, 0.05, 0.1, 0.2, 0.4, 0.8)  # between classes of the sampling ratio
RATIO_CLASSES = len(RATIO_EDGES) + 1
MIN_GROUP_CELLS = 3  # of cells whose mean is taken off
MIN_PLANE_CELLS = 12  # of cells through which a plane is laid
WEIGHT_PASSES = 3  # each weights the cells of a group by the factors that the one before found
MIN_CLASS_CELLS = 30  # in a class: fewer do not show a variance
PRIOR_CELLS = 30.0  # weight of the model against the cells of a class
# Stable cells of a class, at any number of points, from which moving ground is not used: it may have changed.
MIN_STABLE_CELLS = 200
BLOCK_M = 100.0
MIN_BLOCK_CELLS = 5
CORRELATED_BLOCKS = 9.0  # blocks that share their systematic error: it varies over some 300 m
PRIOR_BLOCKS = 3.0  # weight of the model, in independent blocks
PRIOR_PAIRS = 10.0  # weight of independent cells against pairs of neighbouring blocks
FACTOR_BOUNDS = (0.01, 100.0)  # random
# Variance of means of cells over what points within cells show: on unchanged ground it is 1.3 at most. More
# than this is change, as by drifts of snow (equations.md, 6.7).
MAX_SCATTER_RATIO = 3.0
MAX_POINT_SCATTER = 25.0  # of the points of one cell over their modelled variance; more is an edge
MAX_SYSTEMATIC_FACTOR = 100.0
BISECTIONS = 30


@dataclass(frozen=True)
class VarianceFactors:
    """Factors of the modelled variances of one scan [1]: random by noise class (4096,), and systematic.

    The first half of the random ones is that of moving ground, the second that of stable ground.
    """

    random: Floats32
    systematic: float
    median_random: float = 1.0  # of the cells of the scan

    def random_of(self, noise_class: NDArray[np.integer[Any]], stable: Bools) -> Floats32:
        """Return the factor of the random variance of cells (n,), by noise class and kind of ground."""
        return np.asarray(self.random.take(noise_class + NOISE_CLASSES * stable))


UNIT_FACTORS = VarianceFactors(np.ones(2 * NOISE_CLASSES, np.float32), 1.0)


@dataclass(frozen=True)
class Residuals:
    """Residuals of cells (n,) of an adjusted scan, with their modelled variances.

    The random variance is that of the scan and that of the reference, whose factor is its own. `scatter_m2`
    is the variance of the points within a cell, with `freedom` degrees of freedom.
    """

    x_m: Reals
    y_m: Reals
    group: Ints  # cells of about the same azimuth and range
    noise_class: NDArray[np.integer[Any]]
    stable: Bools
    residual_m: Reals
    scan_m2: Reals
    reference_m2: Reals
    systematic_m2: Reals
    scatter_m2: Reals
    freedom: Ints

    @classmethod
    def concatenate(cls, parts: list[Residuals]) -> Residuals:
        """Return the residuals of all parts."""
        return cls(
            *(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(cls))
        )


def noise_class(range_m: Reals, sampling_ratio: Reals, dense: Bools) -> Ints:
    """Return the noise class (n,) of cells, 0 to 255: range, roughness against grazing angle, sampling."""
    ratio_class = np.digitize(sampling_ratio, RATIO_EDGES)
    last = CELL_CLASSES // (2 * RATIO_CLASSES) - 1
    range_class = np.minimum((range_m / RANGE_CLASS_M).astype(np.int64), last)
    return np.asarray((range_class * RATIO_CLASSES + ratio_class) * 2 + dense)


def sampling_ratio(noise_class: NDArray[np.uint8]) -> Floats32:
    """Return the sampling ratio of cells (n,), as that of the middle of their classes."""
    edges = np.array([RATIO_EDGES[0] / 2, *RATIO_EDGES, 2 * RATIO_EDGES[-1]], np.float32)
    middle = np.sqrt(edges[1:] * edges[:-1])
    return np.asarray(middle.take(_ratio_class(noise_class)))


def _ratio_class(noise_class: NDArray[np.integer[Any]]) -> Ints:
    """Return the class (n,) of the sampling ratio alone, 0 to 6, of noise classes 0 to 255."""
    return np.asarray(noise_class // 2 % RATIO_CLASSES)


def class_in_scan(
    noise_class: NDArray[np.uint8], excess: Bools, count: Reals, usual_count: NDArray[np.float16]
) -> Ints:
    """Return the noise class (n,) of cells in a scan, 0 to 2047, by its scatter and number of points too.

    Where a shot is missing or one too many, the shots of the cell lie elsewhere than in other scans.
    """
    unusual = np.abs(count - usual_count.astype(np.float32))  # the classes are those of np.digitize, faster
    count_class = np.sum([(unusual > edge).astype(np.int16) for edge in COUNT_EDGES], axis=0, dtype=np.int16)
    return np.asarray(noise_class + CELL_CLASSES * (excess + 2 * count_class))


def estimate_variance_factors(residuals: Residuals) -> VarianceFactors:
    """Return the variance factors that the residuals of a scan show."""
    factors = UNIT_FACTORS
    for _ in range(WEIGHT_PASSES):
        of_cells = factors.random_of(residuals.noise_class, residuals.stable)
        ratio, usable = _local_deviations(residuals, of_cells)
        random = [_random_factors(residuals, ratio, usable, least) for least in (MIN_STABLE_CELLS, 0)]
        factors = replace(factors, random=np.concatenate(random))
    of_cells = factors.random_of(residuals.noise_class, residuals.stable)
    return replace(
        factors,
        systematic=_systematic_factor(residuals, of_cells),
        median_random=float(np.median(of_cells)),
    )


def _random_factors(residuals: Residuals, ratio: Floats, usable: Bools, least_stable: int) -> Floats32:
    """Return the factor of the random variance by noise class (2048,), from deviations within groups.

    Those of classes with fewer than `least_stable` stable cells come from moving ground. A class is drawn to
    the common factor of its roughness, scatter and number of points at all ranges, that to the one of any
    number of points, and that to the model. `ratio` (n,) is a deviation over its modelled sigma; only usable
    ones count.
    """
    in_scan, of_cells = np.divmod(np.arange(NOISE_CLASSES), CELL_CLASSES)
    roughness = _ratio_class(of_cells) + RATIO_CLASSES * in_scan
    factors = np.ones(NOISE_CLASSES, np.float32)
    for classes in (roughness % (2 * RATIO_CLASSES), roughness, np.arange(NOISE_CLASSES)):
        factors = _factors_by_class(residuals, ratio, usable, classes, factors, least_stable)
    return factors


def _local_deviations(residuals: Residuals, factor: Floats32) -> tuple[Floats, Bools]:
    """Return deviations (n,) from planes through groups over their modelled sigma, and which of them to use.

    Change slopes, as drifts of snow do, and ends at stable ground, which has planes of its own. Cells are
    weighted by the random variance with its factor (n,).
    """
    model_m2 = (residuals.scan_m2 + residuals.reference_m2).astype(np.float64)
    weight = 1 / (residuals.scan_m2 * factor + residuals.reference_m2)
    group = 2 * residuals.group + residuals.stable
    groups, count = int(group.max(initial=0)) + 1, np.bincount(group)
    tiny = np.finfo(float).tiny

    def total(values: Reals) -> Floats:
        return np.asarray(np.bincount(group, weight * values, groups), np.float64)

    weight_sum = np.maximum(np.bincount(group, weight, groups), tiny)
    x_m, y_m, deviation_m = (
        values - (total(values) / weight_sum)[group]
        for values in (residuals.x_m, residuals.y_m, residuals.residual_m)
    )
    # One square metre is added to the moments, so that cells in a line have no slope across it.
    xx, yy, xy = total(x_m**2) + weight_sum, total(y_m**2) + weight_sum, total(x_m * y_m)
    xd, yd = total(x_m * deviation_m), total(y_m * deviation_m)
    # Fewer cells have the mean alone: an infinite determinant makes the slopes zero.
    determinant = np.where(count >= MIN_PLANE_CELLS, np.maximum(xx * yy - xy**2, tiny), np.inf)
    x_slope, y_slope = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
    deviation_m = deviation_m - x_slope[group] * x_m - y_slope[group] * y_m
    squared = yy[group] * x_m**2 - 2 * xy[group] * x_m * y_m + xx[group] * y_m**2
    leverage = weight * (1 / weight_sum[group] + squared / determinant[group])
    others_share = np.maximum(1 - leverage, 1 / MIN_GROUP_CELLS)
    return deviation_m / np.sqrt(model_m2 * others_share), count[group] >= MIN_GROUP_CELLS


def _factors_by_class(
    residuals: Residuals, ratio: Floats, usable: Bools, classes: Ints, prior: Floats32, least_stable: int
) -> Floats32:
    """Return the factors (2048,) by noise class, common to those with the same number in `classes` (2048,).

    Where there are few cells they are drawn to a prior (2048,); see `_random_factors`.
    """
    at_any_count = classes[np.arange(NOISE_CLASSES) % (2 * CELL_CLASSES)]
    stable = residuals.noise_class[usable & residuals.stable]
    stable_count = np.bincount(at_any_count[stable], minlength=NOISE_CLASSES)[at_any_count]
    needs_moving = (stable_count < least_stable)[residuals.noise_class]
    of_cells = classes[residuals.noise_class]
    factors = prior.copy()
    of_points = _point_factors(residuals, of_cells, NOISE_CLASSES) if needs_moving.any() else np.empty(0)
    chosen = np.flatnonzero(usable & (residuals.stable | needs_moving))
    order = chosen[np.argsort(of_cells[chosen], kind="stable")]
    edges = np.searchsorted(of_cells[order], np.arange(NOISE_CLASSES + 1))
    for index in np.flatnonzero(np.diff(edges) >= MIN_CLASS_CELLS):
        members, same = order[edges[index] : edges[index + 1]], classes == index
        reference_share = float(residuals.reference_m2[members].sum() / residuals.scan_m2[members].sum())
        variance = robust_scale(ratio[members]) ** 2
        variance += (variance - 1) * reference_share
        weighted = len(members) * variance + PRIOR_CELLS * prior[same]
        factor = weighted / (len(members) + PRIOR_CELLS)
        if needs_moving[members[0]]:
            factor = np.where(factor > MAX_SCATTER_RATIO * of_points[index], of_points[index], factor)
        factors[same] = np.clip(factor, *FACTOR_BOUNDS)
    return factors


def _point_factors(residuals: Residuals, all_classes: NDArray[np.integer[Any]], class_count: int) -> Floats:
    """Return the factor (k,) of moving ground by class that the points within its cells show.

    Classes with little of it have that of all moving ground.
    """
    moving = ~residuals.stable & (residuals.freedom > 0)
    freedom, classes = residuals.freedom[moving].astype(np.float64), all_classes[moving]
    ratio = residuals.scatter_m2[moving] / (residuals.scan_m2[moving] * (freedom + 1))
    scatter = np.minimum(ratio, MAX_POINT_SCATTER) * freedom
    total = freedom.sum()
    if total < MIN_CLASS_CELLS:
        return np.full(class_count, np.inf)
    of_class, weight = (np.bincount(classes, values, class_count) for values in (scatter, freedom))
    of_all = scatter.sum() / total
    return np.asarray((of_class + MIN_CLASS_CELLS * of_all) / (weight + MIN_CLASS_CELLS))


def _systematic_factor(residuals: Residuals, factor: Floats32) -> float:
    """Return the factor of the systematic variance, from the mean residuals of blocks of stable ground.

    `factor` (n,) is that of the random variance.
    It is at least 1: little stable ground fits the state that was estimated from it, which does not make that
    state more certain.
    """
    stable = residuals.stable
    column, row = (
        np.floor(axis_m[stable] / BLOCK_M).astype(np.int64) for axis_m in (residuals.x_m, residuals.y_m)
    )
    if not len(column):
        return 1.0
    columns = int(np.ptp(column)) + 2  # so that the last block of a row has no neighbour in the next
    key = (row - row.min()) * columns + column - column.min()
    blocks_found, block, count = np.unique(key, return_inverse=True, return_counts=True)
    random_m2 = (residuals.scan_m2 * factor + residuals.reference_m2)[stable]
    weight = 1 / random_m2.astype(np.float64)
    weight_sum = np.bincount(block, weight)
    enough = count >= MIN_BLOCK_CELLS
    mean_m, systematic_m2 = (
        (np.bincount(block, weight * values[stable]) / weight_sum)[enough]
        for values in (residuals.residual_m, residuals.systematic_m2)
    )
    mean_m2, blocks = 1 / weight_sum[enough], np.count_nonzero(enough)
    if blocks < CORRELATED_BLOCKS:
        return 1.0
    mean_m2 *= _block_factor(blocks_found[enough], columns, mean_m, mean_m2)
    low, high = 0.0, float(np.log(MAX_SYSTEMATIC_FACTOR))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if robust_scale(mean_m / np.sqrt(mean_m2 + np.exp(middle) * systematic_m2)) > 1:
            low = middle
        else:
            high = middle
    # A block with far more random error tells little: its information goes with the square of this share.
    share = np.exp(low) * systematic_m2 / (mean_m2 + np.exp(low) * systematic_m2)
    independent = float(np.sum(share**2)) / CORRELATED_BLOCKS
    return float(np.exp(low * independent / (independent + PRIOR_BLOCKS)))


def _block_factor(block: Ints, columns: int, mean_m: Floats, mean_m2: Floats) -> float:
    """Return by what factor cells of a block that err alike enlarge the variance (n,) of its mean.

    Neighbouring blocks have nearly the same systematic error, so that their differences do not contain it.
    The factor is at least 1. `block` is ascending, by rows.
    """
    ratios = []
    for step in (1, columns):
        other = np.minimum(np.searchsorted(block, block + step), len(block) - 1)
        first = np.flatnonzero(block[other] == block + step)
        second = other[first]
        ratios.append((mean_m[first] - mean_m[second]) / np.sqrt(mean_m2[first] + mean_m2[second]))
    ratio = np.concatenate(ratios)
    if not len(ratio):
        return 1.0
    observed = float(np.median(ratio**2)) / MEDIAN_ABSOLUTE_NORMAL**2
    return max((len(ratio) * observed + PRIOR_PAIRS) / (len(ratio) + PRIOR_PAIRS), 1.0)
