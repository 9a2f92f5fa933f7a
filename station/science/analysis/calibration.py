"""Calibration of the stated sigma against the errors observed on stable ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse, special

from station.quantities import Bools, Floats, Ints, Reals, SharedParameters
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL
from station.science.gridding.significance import SIGNIFICANT_SIGMAS
from station.science.uncertainty.jacobian import HeightJacobian, line_tilt_variance
from station.science.uncertainty.parameters import ParameterLayout, knot_interpolation

FACTOR_TOLERANCE = 1.1  # a factor closer to 1 is not applied
MIN_SPREAD = 1e-6  # of a spread, if all errors are zero
MIN_VALUES = 20  # values for a spread
MIN_EPOCHS = 8  # for a factor
SCALES_M = (10.0, 100.0)


@dataclass(frozen=True)
class ZStatistics:
    """Statistics of standardised errors: standard deviation, robust spread, share within 95 %, count."""

    z_std: float
    z_robust: float
    inside_95: float
    count: int


def z_statistics(z: Floats) -> ZStatistics:
    """Return statistics of standardised errors; NaN is ignored, too few values give NaN.

    Spreads are about zero: an error common to all values counts.
    """
    z = z[np.isfinite(z)]
    if len(z) < MIN_VALUES:
        return ZStatistics(np.nan, np.nan, np.nan, len(z))
    return ZStatistics(_rms(z), _robust_spread(z), float(np.mean(np.abs(z) < SIGNIFICANT_SIGMAS)), len(z))


def _rms(z: Floats) -> float:
    return float(np.sqrt(np.mean(z**2)))


def _robust_spread(z: Floats) -> float:
    return float(np.median(np.abs(z)) / MEDIAN_ABSOLUTE_NORMAL)


@dataclass(frozen=True)
class SigmaScale:
    """Factor by which to multiply sigma to match the errors, its 95 % interval, and whether to apply it."""

    factor: float
    low: float
    high: float
    advised: bool


def sigma_scale(z_of_epochs: list[Floats]) -> SigmaScale:
    """Return the factor for sigma from the standardised errors of each epoch.

    The factor is the spread of all errors, robust if epochs have many. Its interval is a jackknife over
    epochs, because errors within an epoch are correlated. It is advised if the interval excludes 1 and the
    factor differs from 1 by more than a tenth.
    """
    known = [z[np.isfinite(z)] for z in z_of_epochs if np.isfinite(z).any()]
    count = len(known)
    if count < MIN_EPOCHS:
        return SigmaScale(np.nan, np.nan, np.nan, advised=False)
    spread = _robust_spread if np.mean([len(z) for z in known]) >= MIN_VALUES else _rms
    log = np.log(max(spread(np.concatenate(known)), MIN_SPREAD))
    leave_one_out = [
        np.log(max(spread(np.concatenate(known[:index] + known[index + 1 :])), MIN_SPREAD))
        for index in range(count)
    ]
    error = np.sqrt((count - 1) * np.var(leave_one_out))
    half_width = special.stdtrit(count - 1, 0.975) * error
    factor, low, high = (float(np.exp(value)) for value in (log, log - half_width, log + half_width))
    differs = max(factor, 1 / factor) > FACTOR_TOLERANCE
    return SigmaScale(factor, low, high, advised=bool(differs and not low <= 1 <= high))


def range_bands(range_m: Reals) -> list[tuple[float, float]]:
    """Return four or five range bands [m] between round numbers that cover all cells."""
    farthest = max(float(np.max(range_m)), 1.0)
    step = 10 ** np.floor(np.log10(farthest / 4))
    width = float(step * next(nice for nice in (1, 2, 2.5, 5, 10) if nice * step * 5 > farthest))
    return [(low * width, (low + 1) * width) for low in range(int(farthest / width) + 1)]


def block_means(x_m: Floats, y_m: Floats, size_m: float) -> sparse.csr_array:
    """Weights (blocks, n) that average the cells (n,) in each square of the map."""
    square = np.stack([np.floor(x_m / size_m), np.floor(y_m / size_m)]).astype(np.int64)
    _, block = np.unique(square, axis=1, return_inverse=True)
    return group_means(np.ravel(block))


def group_means(group: Ints) -> sparse.csr_array:
    """Weights (groups, n) that average the cells of each group, given the index of each cell's group (n,)."""
    count = np.bincount(group)
    shape = len(count), len(group)
    return sparse.csr_array((1 / count[group], (group, np.arange(len(group)))), shape=shape)


@dataclass(frozen=True)
class WeightedSums:
    """Weighted sums (m,) of the same cells, evaluated together; the same as `aggregate_variance` for each."""

    weights: sparse.csr_array  # (m, n)
    params: ParameterLayout
    gradient: Floats  # (m, p) by the shared parameters
    line_effect: Floats  # (m, lines) by the independent tilt of each line

    def variance(self, random_m2: Floats, shared: SharedParameters) -> Floats:
        """Variance of each sum [m²], given the random variance of each cell (n,).

        Source: equations.md, 6.2.
        """
        shared_m2 = np.sum((self.gradient @ shared.covariance) * self.gradient, axis=1)
        shared_m2 += self.line_effect**2 @ line_tilt_variance(self.params, shared)
        return np.asarray(self.weights.power(2) @ random_m2 + shared_m2)


class SparseJacobian:
    """Sparse Jacobian of the heights of cells (n,), prepared for many weighted sums."""

    def __init__(self, jacobian: HeightJacobian) -> None:
        self._params = jacobian.params
        self._design, self._lines = jacobian.to_sparse(), jacobian.line_tilt_to_sparse()

    def sums(self, weights: sparse.csr_array) -> WeightedSums:
        """Return weighted sums (m, n) of the cells."""
        line_effect = (weights @ self._lines).toarray() @ knot_interpolation(self._params).residual_projector
        return WeightedSums(weights, self._params, (weights @ self._design).toarray(), line_effect)


def renormalise(weights: sparse.csr_array, observed: Bools) -> tuple[sparse.csr_array, Floats]:
    """Return weights (m, n) over the observed cells (n,) alone, and the observed share of each sum (m,)."""
    kept = weights @ sparse.diags_array(observed.astype(np.float64))
    share = np.asarray(kept.sum(axis=1)).ravel()
    normalised = sparse.csr_array(sparse.diags_array(1 / np.maximum(share, 1e-12)) @ kept)
    return normalised, np.asarray(share, dtype=np.float64)


def sample_pairs(
    x_m: Floats, y_m: Floats, edges_m: Floats, per_class: int, seed: int
) -> tuple[Ints, Ints, Ints]:
    """Return random pairs of cells, `per_class` for each class of distance: first, second, class (k,)."""
    random = np.random.default_rng(seed)
    batches: list[Ints] = []
    count, classes = len(x_m), len(edges_m) - 1
    counts: Ints = np.zeros(classes, np.int64)
    for _ in range(20 if count > 1 else 0):
        first, second = random.integers(0, count, (2, 20 * per_class))
        distance_m = np.hypot(x_m[first] - x_m[second], y_m[first] - y_m[second])
        distance_class = np.searchsorted(edges_m, distance_m, side="right") - 1
        usable = (first != second) & (distance_class >= 0) & (distance_class < classes)
        batches.append(np.stack([first[usable], second[usable], distance_class[usable]]))
        counts += np.bincount(distance_class[usable], minlength=classes)
        if (counts >= per_class).all():
            break
    drawn = np.concatenate(batches, axis=1) if batches else np.zeros((3, 0), np.int64)
    kept = np.concatenate(
        [np.flatnonzero(drawn[2] == distance_class)[:per_class] for distance_class in range(classes)]
    )
    return drawn[0][kept], drawn[1][kept], drawn[2][kept]


def pair_differences(first: Ints, second: Ints, count: int) -> sparse.csr_array:
    """Weights (pairs, count) that take the difference of the cells of each pair."""
    pair_index = np.arange(len(first))
    values = np.concatenate([np.ones(len(first)), -np.ones(len(first))])
    indices = np.concatenate([pair_index, pair_index]), np.concatenate([first, second])
    return sparse.csr_array((values, indices), shape=(len(first), count))
