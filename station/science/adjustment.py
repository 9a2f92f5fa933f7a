"""The joint estimate of one scan: pose, lean line by line, refraction and ranges, with their covariance.

Stable ground, the inclination log, the weather and what is known beforehand are observations of the same
unknowns. So is the ground that moves, as far as its change since the reference is smooth: how much it changed
is chosen by what makes the scan most likely, a millimetre on a calm day, decimetres after snowfall.
Source: EQUATIONS 6.3, ADJUSTMENT.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from station.quantities import Bools, Floats, Shared
from station.science.patches import CHI2_MEDIAN, Kind, Patches
from station.science.shared import GLOBAL, Basis, Sensitivities, by_knots, lines_from_knots

ROUNDS = 8
SETTLED_M = 0.0001  # a round that moves the patches by less is the last
ROUNDS_TRUSTING = 2  # until the scatter is known: else whole lines are left out that moving ground pulls away
TRUSTED = 0.1  # weight of a patch that has not been left out
TUKEY = 4.685  # 95 % efficient for normal errors
SCATTER_M = (0.002, 0.02)  # least and most that stable patches differ by beyond their cells' random errors
SCATTER_MOST_M = 1.0  # the same of moving ones
TOGETHER_MOST = 40.0  # patches of moving ground that are wrong as one
CHANGE_AZIMUTH_KNOTS = 4  # knots of the lean, between knots of the change
CHANGE_STRETCHES = 3  # of range, between knots of the change
CHANGE_STEPS_M = tuple(float(step) for step in np.geomspace(0.5 / 2**14, 0.5, 15))
UNIFORM_CHANGE = 1.0  # one sigma of what all the moving ground changes by, in steps of a knot's
# The same of what neighbours change by alike, and after how many knots in azimuth and range it no longer is.
ALIKE_CHANGES = (0.0, 1.0, 3.0, 10.0)
# Log odds against the same: smooth errors of the air look like it too, but speak for it with tens at most, a
# smooth snowfall with hundreds.
ALIKE_ODDS = (0.0, 0.0, 12.0, 24.0)
ALIKE_AZIMUTH_KNOTS, ALIKE_RANGE_KNOTS = 10.0, 6.0


@dataclass(frozen=True)
class LineLog:
    """What the inclination log says of each group of lines, and what it may get wrong."""

    lean_rad: Floats  # (lines,) along the line of sight
    weight: Floats  # (lines,) 1 / rad², nought where there is none
    faults: Floats  # (lines, f) effect of one sigma of each of its common errors [rad]


@dataclass(frozen=True)
class Adjustment:
    """The scanner's state against the SOP: nine globals, the lean of each group of lines, knots of the rest.

    `change_step_m` is one sigma of the change between its knots that the moving ground shows;
    `stable_weight` (patches,) how far each stable patch was trusted.
    """

    of: Basis
    estimate: Floats  # (u,)
    covariance: Floats  # (u, u)
    change_step_m: float
    stable_weight: Floats

    def effect(self, felt: Sensitivities) -> Floats:
        """Effect of the estimated state on heights (n,) [m], to be taken off."""
        first, last = len(GLOBAL), len(GLOBAL) + self.of.line_count
        before, after, share = felt.refraction_knot()
        bend, across_rad = np.split(self.estimate[last:], 2)
        return np.asarray(
            self.estimate[:first] @ felt.globals_
            + self.estimate[first:last][felt.line] * felt.lean
            + (bend[before] * (1 - share) + bend[after] * share) * felt.refraction
            + (across_rad[before] * (1 - share) + across_rad[after] * share) * felt.across
        )

    @property
    def refused(self) -> float:
        """Share of the stable patches that fit nothing else; nought where there is none."""
        return float(np.mean(self.stable_weight < TRUSTED)) if len(self.stable_weight) else 0.0

    def shared(self) -> Shared:
        """The same by knots, for the store."""
        return by_knots(self.of, self.estimate, self.covariance)


def turned(felt: Sensitivities, assumed_rad: Floats) -> Floats:
    """Effect on heights (n,) [m] of lines turned about east, north and up by (3, lines)."""
    east, north, up = assumed_rad[:, felt.line]
    return np.asarray(felt.globals_[0] * east + felt.globals_[1] * north - felt.globals_[2] * up)


def prior_of_difference(of: Basis, prior: Floats, reference: Shared | None) -> Floats:
    """Covariance of a scan's state against that of the reference, which is wrong itself."""
    if reference is None:
        return prior
    if reference.names != of.names:  # the scanner has been moved: the reference is as unsure as a scan
        return 2 * prior
    return prior + lines_from_knots(of, reference.covariance)


def adjust(patches: Patches, assumed_rad: Floats, prior: Floats, log: LineLog | None) -> Adjustment:
    """Estimate the scanner's state from patches, the log and a prior covariance (u, u).

    `assumed_rad` (3, lines) is the lean that the points were already turned by, about east, north and up.
    Withheld patches are left out.
    """
    of = patches.felt.of
    patches = patches.some(patches.kind <= Kind.STABLE)
    moving = patches.kind == Kind.MOVING
    wanted_m = patches.residual_m + turned(patches.felt, assumed_rad)
    field, changes = _change_field(patches, moving)
    aside = _Aside(of, prior, log)
    columns = [_design(patches.felt), sparse.csr_array((len(patches), aside.faults)), field]
    whole = sparse.csr_array(sparse.hstack(columns))
    normal, right = (np.zeros((whole.shape[1],) * n) for n in (2, 1))
    normal[: aside.size, : aside.size], right[: aside.size] = aside.normal, aside.right
    scatter_m2 = np.full(len(patches), SCATTER_M[0] ** 2)
    trust = np.ones(len(patches))
    solved: _Solved | None = None
    for round_ in range(ROUNDS):
        before = solved
        weight = trust / (patches.variance_m2 + scatter_m2)
        sums = (whole.T @ sparse.csr_array(whole.multiply(weight[:, None]))).toarray()
        near = changes if before is None else changes.near(before.place)
        solved = _solve(normal + sums, right + whole.T @ (weight * wanted_m), aside.size, near)
        left_m = wanted_m - whole @ solved.estimate
        scatter_m2 = _scatter(patches, left_m, moving)
        if round_ >= ROUNDS_TRUSTING:
            ratio = left_m / np.sqrt(patches.variance_m2 + scatter_m2) / TUKEY
            trust = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
            if before is not None and before.place == solved.place and round_ > ROUNDS_TRUSTING + 1:
                moved_m = whole @ (solved.estimate - before.estimate)
                if np.linalg.norm(moved_m) <= SETTLED_M * np.sqrt(len(moved_m)):
                    break
    assert solved is not None  # noqa: S101 - there is a first round
    states = slice(len(prior))
    covariance = solved.covariance()[states, states]
    return Adjustment(of, solved.estimate[states], covariance, solved.step_m, trust[~moving])


class _Aside:
    """What prior and log alone say: normal equations of the state and the log's own faults."""

    def __init__(self, of: Basis, prior: Floats, log: LineLog | None) -> None:
        self.faults = 0 if log is None else log.faults.shape[1]
        state = len(prior)
        self.size = state + self.faults
        self.normal = np.eye(self.size)
        self.normal[:state, :state] = _Factored(prior).inverse()
        self.right = np.zeros(self.size)
        if log is None:
            return
        felt = np.zeros((of.line_count, self.size))
        azimuth_rad = of.line_azimuth_rad
        felt[:, 0], felt[:, 1] = np.cos(azimuth_rad), -np.sin(azimuth_rad)
        felt[:, len(GLOBAL) : len(GLOBAL) + of.line_count] = np.eye(of.line_count)
        felt[:, state:] = log.faults
        weighted = felt * log.weight[:, None]
        self.normal += felt.T @ weighted
        self.right = weighted.T @ log.lean_rad


def _design(felt: Sensitivities) -> sparse.csr_array:
    """Matrix J (n, u)."""
    of, count = felt.of, len(felt)
    before, after, share = felt.refraction_knot()
    last = len(GLOBAL) + of.line_count
    rows = np.tile(np.arange(count), len(GLOBAL) + 5)
    columns = [np.repeat(np.arange(len(GLOBAL)), count), len(GLOBAL) + felt.line]
    values = [felt.globals_.ravel(), felt.lean]
    for effect, first in ((felt.refraction, last), (felt.across, last + of.refraction_count)):
        columns += [first + before, first + after]
        values += [effect * (1 - share), effect * share]
    placed = np.concatenate(values), (rows, np.concatenate(columns))
    return sparse.csr_array(placed, shape=(count, last + 2 * of.refraction_count))


@dataclass(frozen=True)
class _Changes:
    """Priors of the change at its knots, for a step of one, by how alike neighbours are; which are tried."""

    precision: list[Floats]  # (knots, knots)
    log_determinant: list[float]  # of the covariance
    tried: list[tuple[int, int]]  # places among ALIKE_CHANGES and CHANGE_STEPS_M

    def near(self, place: tuple[int, int]) -> _Changes:
        """Return the same with only those tried that lie next to a place."""
        around = [p for p in self.tried if max(abs(p[0] - place[0]), abs(p[1] - place[1])) <= 1]
        return replace(self, tried=around)


def _change_field(patches: Patches, moving: Bools) -> tuple[sparse.csr_array, _Changes]:
    """Smooth change of the moving ground: matrix (n, knots), and what is thought of it beforehand.

    Knots lie in azimuth and range, the change is bilinear between them.
    """
    u, v = patches.felt.passed / CHANGE_AZIMUTH_KNOTS, (patches.stretch + 0.5) / CHANGE_STRETCHES
    i, j = u.astype(np.int64), v.astype(np.int64)
    u, v = u - i, v - j
    along = int(j.max(initial=0)) + 2
    corners = [(a, b) for a in (0, 1) for b in (0, 1)]
    columns = np.concatenate([(i + a) * along + j + b for a, b in corners])
    values = np.concatenate(
        [np.where(moving, (u if a else 1 - u) * (v if b else 1 - v), 0) for a, b in corners]
    )
    rows = np.tile(np.arange(len(u)), len(corners))
    held = values > 0
    knots, columns = np.unique(columns[held], return_inverse=True)
    field = sparse.csr_array((values[held], (rows[held], columns)), shape=(len(u), len(knots)))
    across, out = np.divmod(knots, along)
    apart = np.abs(np.subtract.outer(across, across)) / ALIKE_AZIMUTH_KNOTS
    apart += np.abs(np.subtract.outer(out, out)) / ALIKE_RANGE_KNOTS
    own = np.eye(len(knots)) + UNIFORM_CHANGE**2
    covariances = [_Factored(own + alike**2 * np.exp(-apart)) for alike in ALIKE_CHANGES]
    tried = [(alike, step) for alike in range(len(ALIKE_CHANGES)) for step in range(len(CHANGE_STEPS_M))]
    return field, _Changes(
        [one.inverse() for one in covariances], [one.log_determinant() for one in covariances], tried
    )


class _Factored:
    """A covariance or normal matrix (n, n), factored; its unknowns may have units of very different size."""

    def __init__(self, matrix: Floats) -> None:
        self._scale = 1 / np.sqrt(np.diag(matrix))
        scaled = matrix * self._scale[:, None] * self._scale
        self._root, _ = linalg.cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, right: Floats) -> Floats:
        """Solution for right sides (n,) or (n, k)."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        return np.asarray(linalg.cho_solve((self._root, True), right * scale, check_finite=False) * scale)

    def inverse(self) -> Floats:
        """Inverse (n, n)."""
        if not len(self._scale):
            return np.empty((0, 0))
        half = np.tril(linalg.lapack.dpotri(self._root, lower=True)[0])
        whole = half + np.tril(half, -1).T
        return np.asarray(whole * self._scale[:, None] * self._scale)

    def log_determinant(self) -> float:
        """Logarithm of the determinant."""
        return float(2 * (np.log(np.diag(self._root)).sum() - np.log(self._scale).sum()))


@dataclass(frozen=True)
class _Solved:
    """Solution of normal equations whose last unknowns have the prior that makes the data most likely."""

    estimate: Floats
    place: tuple[int, int]  # of the change's prior
    step_m: float
    state: _Factored  # the block of the state and the log's faults
    across: Floats  # what a unit of change does to these
    change: _Factored

    def covariance(self) -> Floats:
        """Covariance of the state and the log's faults."""
        return self.state.inverse() + self.across @ self.change.solve(self.across.T)


def _solve(normal: Floats, right: Floats, size: int, changes: _Changes) -> _Solved:
    """Solve; how much the moving ground changed, and how smoothly, is chosen by the likelihood."""
    state = _Factored(normal[:size, :size])
    across = -state.solve(normal[:size, size:])
    reduced = normal[size:, size:] + normal[size:, :size] @ across
    told = right[size:] + across.T @ right[:size]
    found = []
    for alike, step in changes.tried:
        step_m = CHANGE_STEPS_M[step]
        change = _Factored(reduced + changes.precision[alike] / step_m**2)
        change_m = change.solve(told)
        spread = (change.log_determinant() + changes.log_determinant[alike]) / 2 + len(told) * np.log(step_m)
        odds = float(told @ change_m / 2 - spread) - ALIKE_ODDS[alike]
        found.append((odds, (alike, step), change_m, change))
    _, place, change_m, change = max(found, key=lambda one: one[0])
    estimate = np.concatenate([state.solve(right[:size]) + across @ change_m, change_m])
    step_m = CHANGE_STEPS_M[place[1]] * float(np.hypot(1.0, ALIKE_CHANGES[place[0]]))
    return _Solved(estimate, place, step_m, state, across, change)


def _scatter(patches: Patches, left_m: Floats, moving: Bools) -> Floats:
    """Variance (n,) [m²] of what patches have wrong beyond their cells' random errors.

    What a smooth change cannot follow is wrong over several patches: these count as one.
    """
    scatter_m2 = np.empty(len(patches))
    for chosen, most_m in ((moving, SCATTER_MOST_M), (~moving, SCATTER_M[1])):
        if chosen.any():
            found_m2 = _excess(left_m[chosen], patches.variance_m2[chosen], most_m)
            spread = np.sqrt(patches.variance_m2[chosen] + found_m2)
            scatter_m2[chosen] = found_m2 * _together(patches.some(chosen), left_m[chosen] / spread)
    return scatter_m2


def _excess(left_m: Floats, variance_m2: Floats, most_m: float) -> float:
    """Variance that residuals have beyond their random errors [m²], robustly: by their median."""
    low, high = SCATTER_M[0] ** 2, most_m**2
    for _ in range(30):
        middle = float(np.sqrt(low * high))
        if np.median(left_m**2 / (variance_m2 + middle)) > CHI2_MEDIAN:
            low = middle
        else:
            high = middle
    return low


def _together(patches: Patches, ratio: Floats) -> float:
    """How many patches are wrong as one: the sum of the correlation over lines, times that over stretches."""
    table = np.full((patches.felt.of.line_count, int(patches.stretch.max()) + 1), np.nan)
    table[patches.felt.line, patches.stretch] = np.clip(ratio, -3, 3)
    return min(_correlation_length(table, 20) * _correlation_length(table.T, 3), TOGETHER_MOST)


def _correlation_length(table: Floats, furthest: int) -> float:
    """Sum of the correlation between rows of a table, to either side, until it has died away."""
    power = float(np.nanmean(table**2))
    total = 1.0
    if power == 0.0:
        return total
    for lag in range(1, min(furthest, len(table) - 1) + 1):
        pairs = table[lag:] * table[:-lag]
        like = float(np.nanmean(pairs) / power) if np.isfinite(pairs).any() else 0.0
        if like < 0.05:
            break
        total += 2 * like
    return total
