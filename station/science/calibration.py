"""Whether the stated sigma matches what stable ground shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse, special

from station.quantities import Bools, Floats, Ints, Shared
from station.science.shared import GLOBAL, Basis, Sensitivities, leans_between, line_variances

LIMIT_95 = 1.959964  # of a normal variable
NEAR_ONE = 1.1  # a factor within that of 1 is left alone
LEAST = 1e-6  # a spread, of errors that are nought
FEWEST = 20  # values that say anything of a spread
FEWEST_EPOCHS = 8  # that say anything of how it will go on
SCALES_M = (10.0, 100.0)


@dataclass(frozen=True)
class Fit:
    """How errors compare with their sigma: spread of z, a robust one, share within 95 %, how many."""

    z_std: float
    z_robust: float
    inside_95: float
    count: int


def fit(z: Floats) -> Fit:
    """Compare errors in units of their sigma with a standard normal; NaN is passed over.

    Spreads are about nought: what all errors have in common counts.
    """
    z = z[np.isfinite(z)]
    if len(z) < FEWEST:
        return Fit(np.nan, np.nan, np.nan, len(z))
    return Fit(_rms(z), _robust(z), float(np.mean(np.abs(z) < LIMIT_95)), len(z))


def _rms(z: Floats) -> float:
    return float(np.sqrt(np.mean(z**2)))


def _robust(z: Floats) -> float:
    return float(np.median(np.abs(z)) / special.ndtri(0.75))


@dataclass(frozen=True)
class Scale:
    """By what to multiply sigma so that it matches, its 95 % interval, whether that is advised."""

    factor: float
    low: float
    high: float
    advised: bool


def scale(z_of_epochs: list[Floats]) -> Scale:
    """Return by what to multiply sigma, from the z of each epoch.

    The spread of all z, robust where epochs have many; its interval by leaving out one epoch after the other,
    as errors within an epoch go together. It is advised where the interval leaves out 1 and the factor is
    more than a tenth from it.
    """
    known = [z[np.isfinite(z)] for z in z_of_epochs if np.isfinite(z).any()]
    count = len(known)
    if count < FEWEST_EPOCHS:
        return Scale(np.nan, np.nan, np.nan, advised=False)
    spread = _robust if np.mean([len(z) for z in known]) >= FEWEST else _rms
    log = np.log(max(spread(np.concatenate(known)), LEAST))
    without = [
        np.log(max(spread(np.concatenate(known[:at] + known[at + 1 :])), LEAST)) for at in range(count)
    ]
    error = np.sqrt((count - 1) * np.var(without))
    reach = special.stdtrit(count - 1, 0.975) * error
    factor, low, high = (float(np.exp(one)) for one in (log, log - reach, log + reach))
    away = max(factor, 1 / factor) > NEAR_ONE
    return Scale(factor, low, high, advised=bool(away and not low <= 1 <= high))


def range_bands(range_m: Floats) -> list[tuple[float, float]]:
    """Return four or five bands of range between round numbers that hold every cell [m]."""
    farthest = max(float(np.max(range_m)), 1.0)
    step = 10 ** np.floor(np.log10(farthest / 4))
    width = float(step * next(nice for nice in (1, 2, 2.5, 5, 10) if nice * step * 5 > farthest))
    return [(low * width, (low + 1) * width) for low in range(int(farthest / width) + 1)]


def blocks(x_m: Floats, y_m: Floats, size_m: float) -> sparse.csr_array:
    """Weights (blocks, n) that take the mean of the cells (n,) in each square of the map."""
    place = np.stack([np.floor(x_m / size_m), np.floor(y_m / size_m)]).astype(np.int64)
    _, block = np.unique(place, axis=1, return_inverse=True)
    return means(np.ravel(block))


def means(of: Ints) -> sparse.csr_array:
    """Weights (groups, n) that take the mean of the cells of each group, by the number of its group (n,)."""
    count = np.bincount(of)
    shape = len(count), len(of)
    return sparse.csr_array((1 / count[of], (of, np.arange(len(of)))), shape=shape)


@dataclass(frozen=True)
class Sums:
    """Weighted sums (m,) of the same cells, many at once; one at a time they are `aggregate_variance`."""

    weights: sparse.csr_array  # (m, n)
    of: Basis
    effect: Floats  # (m, p) of the shared parameters
    own: Floats  # (m, lines) of what lines have of their own

    def variance(self, random_m2: Floats, unknown: Shared) -> Floats:
        """Variance of each sum [m²], with the random variance of each cell (n,).

        Source: EQUATIONS 6.2.
        """
        shared_m2 = np.sum((self.effect @ unknown.covariance) * self.effect, axis=1)
        shared_m2 += self.own**2 @ line_variances(self.of, unknown)
        return np.asarray(self.weights.power(2) @ random_m2 + shared_m2)


class Felt:
    """What cells (n,) feel, as matrices, ready for many sums of them."""

    def __init__(self, felt: Sensitivities) -> None:
        self._of = felt.of
        self._design, self._lines = matrices(felt)

    def sums(self, weights: sparse.csr_array) -> Sums:
        """Return weighted sums (m, n) of the cells."""
        own = (weights @ self._lines).toarray() @ leans_between(self._of).left
        return Sums(weights, self._of, (weights @ self._design).toarray(), own)


def renormalised(weights: sparse.csr_array, seen: Bools) -> tuple[sparse.csr_array, Floats]:
    """Return weights (m, n) over the cells seen (n,) alone, and the share of each sum that was seen (m,)."""
    kept = weights @ sparse.diags_array(seen.astype(np.float64))
    share = np.asarray(kept.sum(axis=1)).ravel()
    even = sparse.csr_array(sparse.diags_array(1 / np.maximum(share, 1e-12)) @ kept)
    return even, np.asarray(share, dtype=np.float64)


def pairs(x_m: Floats, y_m: Floats, edges_m: Floats, each: int, seed: int) -> tuple[Ints, Ints, Ints]:
    """Return pairs of cells drawn at random, `each` for a class of distance: first, second, class (k,)."""
    random = np.random.default_rng(seed)
    found: list[Ints] = []
    count, classes = len(x_m), len(edges_m) - 1
    have: Ints = np.zeros(classes, np.int64)
    for _ in range(20 if count > 1 else 0):
        first, second = random.integers(0, count, (2, 20 * each))
        away_m = np.hypot(x_m[first] - x_m[second], y_m[first] - y_m[second])
        of = np.searchsorted(edges_m, away_m, side="right") - 1
        ok = (first != second) & (of >= 0) & (of < classes)
        found.append(np.stack([first[ok], second[ok], of[ok]]))
        have += np.bincount(of[ok], minlength=classes)
        if (have >= each).all():
            break
    drawn = np.concatenate(found, axis=1) if found else np.zeros((3, 0), np.int64)
    kept = np.concatenate([np.flatnonzero(drawn[2] == of)[:each] for of in range(classes)])
    return drawn[0][kept], drawn[1][kept], drawn[2][kept]


def differences(first: Ints, second: Ints, count: int) -> sparse.csr_array:
    """Weights (pairs, count) that take the difference of the cells of each pair."""
    number = np.arange(len(first))
    values = np.concatenate([np.ones(len(first)), -np.ones(len(first))])
    place = np.concatenate([number, number]), np.concatenate([first, second])
    return sparse.csr_array((values, place), shape=(len(first), count))


def matrices(felt: Sensitivities) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Effect of the parameters (n, p) and of the lines' own lean (n, lines) on heights."""
    of, count = felt.of, len(felt)
    cells, first = np.arange(count), len(GLOBAL)
    rows = [np.tile(cells, len(felt.globals_))]
    columns = [np.repeat(np.arange(first), count)]
    values = [felt.globals_.ravel()]
    for effect, (before, after, share), start in (
        (felt.lean, felt.lean_knot(), first),
        (felt.refraction, felt.refraction_knot(), first + of.lean_count),
        (felt.across, felt.refraction_knot(), first + of.lean_count + of.refraction_count),
    ):
        rows += [cells, cells]
        columns += [start + before, start + after]
        values += [effect * (1 - share), effect * share]
    total = first + of.lean_count + 2 * of.refraction_count
    place = np.concatenate(rows), np.concatenate(columns)
    design = sparse.csr_array((np.concatenate(values), place), shape=(count, total))
    return design, sparse.csr_array((felt.lean, (cells, felt.line)), shape=(count, of.line_count))
