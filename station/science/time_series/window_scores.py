"""Change summed over windows of blocks, and its z. Source: equations.md, 6.11."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Ints
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL
from station.science.time_series.surroundings import SURROUNDING_TILES, TILE, surroundings

MIN_OBSERVED = 0.5  # share of the blocks of a window
TAIL_QUANTILE, TAIL_SIGMAS = 0.99, 2.576  # two-sided, of a normal distribution
OUTLIER_SIGMAS = 6.0  # beyond, a window has changed, and is no sample of the errors
SCATTER_VARIANCE = 1.3  # of a scan less the median of six, over that of a scan
MIN_PAIRS = 12  # of scans that show how a window scatters
SCATTER_QUANTILE, SCATTER_SIGMAS = 0.9, 1.645  # of absolute values, two-sided
TINY = 1e-9

Windows = tuple[Any, ...]  # rows and columns: indices or slices
EVERYWHERE: Windows = (slice(None), slice(None))


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


class WindowScatter:
    """How the means of windows scattered from scan to scan, by a history of scans (n, by, bx) [m]."""

    def __init__(self, history_m: Floats) -> None:
        self._history_m = history_m

    @cached_property
    def _integrals(self) -> tuple[Floats, Floats]:
        """Those of the number and of the sum of differences: most scans need none."""
        differences_m = scan_differences(self._history_m)
        observed = np.isfinite(differences_m)
        return _integrals(observed), _integrals(np.where(observed, differences_m, 0.0))

    def variances(self, size: int, windows: Windows = EVERYWHERE) -> tuple[Floats, Ints]:
        """Return the variance in one scan [m²], and in how many differences each window was observed.

        Both are those of some windows, or of all, (by - size + 1, bx - size + 1). The tenth largest of a
        hundred differences is used: one event does not raise it, but an edge does, which beams hit in some
        scans only.
        """
        observed, total_m = self._integrals
        count = _sums(observed, size, windows)
        count[count < MIN_OBSERVED * size**2] = np.nan
        means_m = np.sort(np.abs(_sums(total_m, size, windows)) / count, axis=0)  # NaN last
        pairs = np.isfinite(means_m).sum(axis=0)
        rank = np.maximum(np.ceil(SCATTER_QUANTILE * pairs).astype(np.int64) - 1, 0)
        typical_m = np.nan_to_num(np.take_along_axis(means_m, rank[None], 0)[0])
        return typical_m**2 / (2 * SCATTER_SIGMAS**2), pairs


def may_exceed(
    changes: Sequence[BlockChange], size: int, sigmas: float, depth_m: float, scatter: WindowScatter
) -> bool:
    """Return True if windows exceed both thresholds in both scans by what is least of their errors."""
    means, _, systematic_m2 = zip(*(_window_means(change, size) for change in changes), strict=True)
    mean_m, least_m2 = np.abs(smaller_of_both(*means)), np.fmin(*systematic_m2)
    windows = np.nonzero((mean_m > depth_m) & (mean_m**2 > sigmas**2 * least_m2))
    if not len(windows[0]):
        return False
    own_m2, _ = scatter.variances(size, windows)
    return bool((mean_m[windows] ** 2 > sigmas**2 * SCATTER_VARIANCE * own_m2).any())


def window_scores(
    changes: Sequence[BlockChange], size: int, scatter: WindowScatter, rock: Bools
) -> tuple[Floats, Floats]:
    """Return mean [m] and z of the windows (by - size + 1, bx - size + 1) that both scans confirm, else 0.

    The variance is what the window scattered before, and its systematic one; or what both its stated errors
    and the windows around it say at least. Where few scans show how it scatters it is the largest of all:
    neighbours may lie on the same edge. If windows around it have a larger z than normal errors, so has this
    one.
    """
    own_m2, pairs = scatter.variances(size)
    own_m2 *= SCATTER_VARIANCE
    around_m2 = ndimage.maximum_filter(own_m2, 3)
    height, width = own_m2.shape
    middle = size // 2
    ground = rock[middle : middle + height, middle : middle + width]
    means, scores = [], []
    for change in changes:
        mean_m, random_m2, systematic_m2 = _window_means(change, size)
        stated_m2 = random_m2 + systematic_m2
        variance_m2 = np.where(
            pairs >= MIN_PAIRS,
            np.maximum(own_m2 + systematic_m2, np.minimum(stated_m2, around_m2)),
            np.maximum(stated_m2, around_m2),
        )
        z = mean_m / np.sqrt(variance_m2)
        z /= np.fmax(surroundings(np.abs(z), ground) / MEDIAN_ABSOLUTE_NORMAL, 1.0)
        for kind in (ground, ~ground):
            z[kind] /= _tail_factor(np.abs(z[kind]))
        means.append(mean_m)
        scores.append(z)
    return smaller_of_both(*means), smaller_of_both(*scores)


def _window_means(change: BlockChange, size: int) -> tuple[Floats, Floats, Floats]:
    """Return the mean [m] and its variances of all windows, NaN where a window is hardly observed."""
    observed = np.isfinite(change.change_m) & (change.random_m2 > 0)
    count = _window_sums(observed, size)
    count[count < MIN_OBSERVED * size**2] = np.nan
    mean_m, random_m2, systematic_m2 = (
        _window_sums(np.where(observed, values, 0.0), size) / count
        for values in (change.change_m, change.random_m2, change.systematic_m2)
    )
    return mean_m, random_m2 / count, systematic_m2


def _tail_factor(absolute_z: Floats) -> float:
    """Return by how much the tail of z is larger than of normal errors, at least 1.

    Outliers are left out: they may be events.
    """
    errors = absolute_z[absolute_z < OUTLIER_SIGMAS]
    return max(float(np.quantile(errors, TAIL_QUANTILE)) / TAIL_SIGMAS, 1.0) if len(errors) else 1.0


def _window_sums(values: Floats | Bools, size: int) -> Floats:
    """Return the sums over all windows of size × size."""
    return _sums(_integrals(values), size)


def _integrals(values: Floats | Bools) -> Floats:
    """Return the sums (..., by + 1, bx + 1) over all that is above and to the left of each corner."""
    total = np.zeros((*values.shape[:-2], values.shape[-2] + 1, values.shape[-1] + 1))
    np.cumsum(np.cumsum(values, axis=-2, dtype=np.float64), axis=-1, out=total[..., 1:, 1:])
    return total


def _sums(integrals: Floats, size: int, windows: Windows = EVERYWHERE) -> Floats:
    """Return the sums over windows of size × size, by their first row and column; over all by default."""
    first, last = integrals[..., :-size, :], integrals[..., size:, :]
    corners = last[..., size:], first[..., :-size], first[..., size:], last[..., :-size]
    whole, above_left, above, left = (corner[(..., *windows)] for corner in corners)
    return np.asarray(whole + above_left - above - left)


def smaller_of_both(first: Floats, second: Floats) -> Floats:
    """Return the value with the smaller magnitude where both have the same sign, else 0."""
    return np.where(first * second > 0, np.sign(first) * np.fmin(np.abs(first), np.abs(second)), 0.0)
