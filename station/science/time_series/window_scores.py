"""Change summed over windows of blocks, its z, and whether the cells of a window changed together.

Source: equations.md, 6.11.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special

from station.quantities import Bools, Floats
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL
from station.science.time_series.surroundings import SURROUNDING_TILES, TILE, nanmedian, surroundings

MIN_OBSERVED = 0.5  # share of the blocks of a window
TAIL_QUANTILE, TAIL_SIGMAS = 0.99, 2.576  # two-sided, of a normal distribution
OUTLIER_SIGMAS = 6.0  # beyond, a window has changed, and is no sample of the errors
SCATTER_VARIANCE = 1.3  # of a scan less the median of six, over that of a scan
SCATTER_QUANTILE, SCATTER_SIGMAS = 0.9, 1.645  # of absolute values, two-sided
MIN_VARIANCE = 0.25  # of a block or cell, for its weight, over the usual variance around it
LEAST_BEFORE = 3  # of the scans before must have seen a block or cell
MIN_CELLS = 3
MIN_VARIANCE_M2 = 1e-12
MIN_TAIL = 1e-304  # of what numbers can represent
TINY = 1e-9


@dataclass(frozen=True)
class BlockChange:
    """Change of a scan against those before (by, bx) [m], NaN where not observed, and its variances [m²].

    The systematic errors of blocks nearby are taken as fully correlated.
    """

    change_m: Floats
    random_m2: Floats
    systematic_m2: Floats


def scan_differences(history_m: Floats) -> Floats:
    """Return how consecutive scans (n, by, bx) differ (n - 1, by, bx) [m], less what surrounds a block."""
    differences_m = np.diff(history_m, axis=0)
    observed = np.isfinite(differences_m)
    extent = 1, TILE * SURROUNDING_TILES, TILE * SURROUNDING_TILES
    around_m, share = (
        ndimage.uniform_filter(np.where(observed, values, 0.0), extent) for values in (differences_m, 1.0)
    )
    return differences_m - around_m / np.maximum(share, TINY)


def block_weights(changes: Sequence[BlockChange], rock: Bools) -> Floats:
    """Return the weights of blocks (by, bx) in the mean of a window: inverse to their random variance.

    On rough rock it differs a hundredfold. No block counts as better than half of the sigma that is usual
    around it, so that none is most of a window.
    """
    random_m2 = np.mean([change.random_m2 for change in changes], axis=0)
    random_m2[random_m2 == 0] = np.nan
    least_m2 = MIN_VARIANCE * surroundings(random_m2, rock)
    return np.nan_to_num(least_m2 / np.maximum(random_m2, least_m2))


def window_scatter(differences_m: Floats, size: int, weights: Floats) -> Floats:
    """Return the variance of the weighted means of windows in one scan [m²], as consecutive scans differ.

    The shape is (by - size + 1, bx - size + 1). The tenth largest of a hundred differences is used: one event
    does not raise it, but an edge does, which beams hit in some scans only. Its neighbours are on the same
    edge, so that a window has at least the mean variance of those around it.
    """
    means_m = []
    for difference_m in differences_m:
        seen = _Windows(np.isfinite(difference_m), size, weights)
        means_m.append(np.abs(seen.mean(difference_m)))
    ordered = np.sort(means_m, axis=0)  # NaN last
    pairs = np.isfinite(ordered).sum(axis=0)
    rank = np.maximum(np.ceil(SCATTER_QUANTILE * pairs).astype(np.int64) - 1, 0)
    typical_m = np.nan_to_num(np.take_along_axis(ordered, rank[None], 0)[0])
    variance_m2 = typical_m**2 / (2 * SCATTER_SIGMAS**2)
    return np.asarray(np.maximum(variance_m2, ndimage.uniform_filter(variance_m2, 3)))


def may_exceed(
    changes: Sequence[BlockChange], size: int, weights: Floats, sigmas: float, depth_m: float
) -> bool:
    """Return True if windows exceed both thresholds by their stated errors, in both scans: few scans do."""
    means, variances = zip(*(_window_means(change, size, weights) for change in changes), strict=True)
    mean_m = np.abs(smaller_of_both(*means))
    return bool(((mean_m > depth_m) & (mean_m > sigmas * np.sqrt(np.fmin(*variances)))).any())


def window_scores(
    changes: Sequence[BlockChange], size: int, weights: Floats, differences_m: Floats, rock: Bools
) -> tuple[Floats, Floats]:
    """Return mean [m] and z of the windows (by - size + 1, bx - size + 1) that both scans confirm, else 0.

    The variance is that of the errors, or what the window scattered before, if that is more. If windows
    around it have a larger z than normal errors, so has this one.
    """
    scatter_m2 = SCATTER_VARIANCE * window_scatter(differences_m, size, weights)
    height, width = scatter_m2.shape
    middle = size // 2
    ground = rock[middle : middle + height, middle : middle + width]
    means, scores = [], []
    for change in changes:
        mean_m, variance_m2 = _window_means(change, size, weights)
        z = mean_m / np.sqrt(np.maximum(variance_m2, scatter_m2))
        z /= np.fmax(surroundings(np.abs(z), ground) / MEDIAN_ABSOLUTE_NORMAL, 1.0)
        for kind in (ground, ~ground):
            z[kind] /= _tail_factor(np.abs(z[kind]))
        means.append(mean_m)
        scores.append(z)
    return smaller_of_both(*means), smaller_of_both(*scores)


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
    tail = special.stdtr(freedom, -abs(mean_m) / np.sqrt(max(mean_m2, MIN_VARIANCE_M2)))
    return float(-np.sign(mean_m) * special.ndtri(max(tail, MIN_TAIL)))


class _Windows:
    """Windows of size × size blocks (by, bx) with weights, of which some are observed."""

    def __init__(self, observed: Bools, size: int, weights: Floats) -> None:
        self._weights, self._size = np.where(observed, weights, 0.0), size
        self._total = _window_sums(self._weights, size)
        self._total[_window_sums(observed, size) < MIN_OBSERVED * size**2] = np.nan
        self._total[self._total < TINY] = np.nan

    def mean(self, values: Floats) -> Floats:
        """Return the weighted means of blocks (by, bx), NaN where a window is hardly observed."""
        return self._sum(values) / self._total

    def variance_of_mean(self, variances: Floats) -> Floats:
        """Return the variance of the weighted means of blocks with independent errors."""
        return self._sum(self._weights * variances) / self._total**2

    def _sum(self, values: Floats) -> Floats:
        return _window_sums(np.where(self._weights > 0, self._weights * values, 0.0), self._size)


def _window_means(change: BlockChange, size: int, weights: Floats) -> tuple[Floats, Floats]:
    """Return the weighted mean [m] and its variance of all windows, NaN where a window is hardly observed."""
    seen = _Windows(np.isfinite(change.change_m) & (change.random_m2 > 0), size, weights)
    variance_m2 = seen.variance_of_mean(change.random_m2) + seen.mean(change.systematic_m2)
    return seen.mean(change.change_m), variance_m2


def _tail_factor(absolute_z: Floats) -> float:
    """Return by how much the tail of z is larger than of normal errors, at least 1.

    Outliers are left out: they may be events.
    """
    errors = absolute_z[absolute_z < OUTLIER_SIGMAS]
    return max(float(np.quantile(errors, TAIL_QUANTILE)) / TAIL_SIGMAS, 1.0) if len(errors) else 1.0


def _window_sums(values: Floats | Bools, size: int) -> Floats:
    """Return the sums over all windows of size × size."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1, out=total[1:, 1:])
    return np.asarray(
        total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]
    )


def smaller_of_both(first: Floats, second: Floats) -> Floats:
    """Return the value with the smaller magnitude where both have the same sign, else 0."""
    return np.where(first * second > 0, np.sign(first) * np.fmin(np.abs(first), np.abs(second)), 0.0)
