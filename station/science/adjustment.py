"""The joint estimate of one scan: pose, lean line by line, refraction and ranges, with their covariance.

Stable ground, the inclination log, the weather and what is known beforehand are observations of the same
unknowns. So is the ground that moves, as far as its change since the reference is smooth: how much it changed
is chosen by what makes the scan most likely, a millimetre on a calm day, decimetres after snowfall.
Source: EQUATIONS 6.3, ADJUSTMENT.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from station.quantities import Bools, Floats, Reals, Shared
from station.science import likeness
from station.science.held import slacks
from station.science.normals import (
    Beforehand,
    Factored,
    LineLog,
    Normals,
    Reduced,
    Unknown,
    log_determinant,
    root_of,
)
from station.science.patches import CHI2_MEDIAN, STRETCH_M, Kind, Patches
from station.science.shared import (
    GLOBAL,
    LEAN_KNOT_RAD,
    Basis,
    Sensitivities,
    rows_at_lines,
    tilt_along,
)

ROUNDS = 8
SETTLED_M = 0.0003  # a round that moves the patches by less, root mean square, is the last
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
ALIKE_CHANGES = (0.0, 3.0, 10.0)
# Log odds against the same: smooth errors of the air look like it too, but speak for it with tens at most, a
# smooth snowfall with hundreds.
ALIKE_ODDS = (0.0, 12.0, 24.0)
ALIKE_AZIMUTH_KNOTS, ALIKE_RANGE_KNOTS = 4.0, 2.5
# Where other ground rises, stable ground may lie under snow too thin to be told by its brightness.
THIN_SNOW_M = 0.005  # one sigma, no more than of the change of other ground
NO_SNOW_M = 1e-6
SNOW_STEEPEST = tuple(np.tan(np.radians((40.0, 50.0))))  # of ground that holds snow, and that holds some


@dataclass(frozen=True)
class Adjustment:
    """The scanner's state against the SOP: nine globals, the lean of each group of lines, knots of the rest.

    `change_step_m` is one sigma of the change between its knots that the moving ground shows;
    `stable_weight` (patches,) how far each stable patch was trusted; `slack_m2` how loosely moving and stable
    cells hold it (see `held`); `log` is what was held to it, `logged_rad` (lines,) what that should have said
    but for its own faults.
    """

    of: Basis
    estimate: Floats  # (u,)
    unknown: Unknown
    change_step_m: float
    stable_weight: Floats
    slack_m2: tuple[float, float]
    log: LineLog | None
    logged_rad: Floats

    def effect(self, felt: Sensitivities) -> Reals:
        """Effect of the estimated state on heights (n,) [m], to be taken off."""
        first, last = len(GLOBAL), len(GLOBAL) + self.of.line_count
        before, after, share = felt.refraction_knot()
        estimate = self.estimate.astype(felt.lean.dtype)
        bend, across_rad = np.split(estimate[last:], 2)
        return np.asarray(
            estimate[:first] @ felt.globals_
            + estimate[first:last][felt.line] * felt.lean
            + (bend[before] * (1 - share) + bend[after] * share) * felt.refraction
            + (across_rad[before] * (1 - share) + across_rad[after] * share) * felt.across
        )

    @property
    def refused(self) -> float:
        """Share of the stable patches that fit nothing else; nought where there is none."""
        return float(np.mean(self.stable_weight < TRUSTED)) if len(self.stable_weight) else 0.0

    @property
    def covariance(self) -> Floats:
        """Covariance (u, u) of the estimate."""
        return self.unknown.by_line()

    def shared(self) -> Shared:
        """The same by knots, for the store."""
        return self.unknown.by_knots(self.estimate)


def turned(felt: Sensitivities, assumed_rad: Floats) -> Reals:
    """Effect on heights (n,) [m] of lines turned about east, north and up by (3, lines)."""
    east, north, up = assumed_rad.astype(felt.lean.dtype).take(felt.line, axis=1)
    return np.asarray(felt.globals_[0] * east + felt.globals_[1] * north - felt.globals_[2] * up)


def adjust(patches: Patches, assumed_rad: Floats, before: Beforehand, log: LineLog | None) -> Adjustment:
    """Estimate the scanner's state from patches, the log and what is known beforehand.

    `assumed_rad` (3, lines) is the lean that the points were already turned by, about east, north and up.
    Withheld patches are left out.
    """
    of = patches.felt.of
    patches = patches.some(patches.kind <= Kind.STABLE)
    moving = patches.kind == Kind.MOVING
    wanted_m = patches.residual_m + turned(patches.felt, assumed_rad)
    field, changes = _change_field(patches, moving)
    normals = Normals(patches.felt, field, wanted_m, before, log)
    scatter_m2 = np.full(len(patches), SCATTER_M[0] ** 2)
    trust = np.ones(len(patches))
    left_m = wanted_m
    solved: _Solved | None = None
    for round_ in range(ROUNDS):
        last, last_m = solved, left_m
        weight = trust / (patches.variance_m2 + scatter_m2)
        reduced = normals.weighted(weight)
        solved = _solve(reduced, normals.size, changes, last.place if last else None)
        changes = replace(changes, rises=solved.rise_m(field, moving) > 0)
        left_m = wanted_m - normals.effect(solved.estimate, reduced.own_rad(solved.estimate))
        scatter_m2 = _scatter(patches, left_m, moving)
        if round_ >= ROUNDS_TRUSTING:
            ratio = left_m / np.sqrt(patches.variance_m2 + scatter_m2) / TUKEY
            trust = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
            moved_m = np.linalg.norm(left_m - last_m)
            settled = last is not None and last.place == solved.place and round_ > ROUNDS_TRUSTING + 1
            if settled and moved_m <= SETTLED_M * np.sqrt(len(left_m)):
                break
    assert solved is not None  # noqa: S101 - there is a first round
    reduced = solved.reduced
    pattern = _pattern(patches.some(moving), solved.change_m(field)[moving] / solved.step_m)
    heights = normals.heights(len(of.names))
    unknown = Unknown(of, reduced.own, reduced.felt, solved.whole(), solved.precision, heights, pattern)
    held_by = slacks(patches, weight, normals, unknown)
    state, logged_rad = solved.by_line(of), solved.logged_rad(of, log)
    return Adjustment(of, state, unknown, solved.step_m, trust[~moving], held_by, log, logged_rad)


@dataclass(frozen=True)
class _Changes:
    """Priors of the change at its knots, for a step of one, by how alike neighbours are.

    After the knots come thicknesses of thin snow on stable ground, if other ground `rises`.
    """

    precision: list[Floats]  # (knots, knots)
    log_determinant: list[float]  # of the covariance
    thin: int  # how many thicknesses
    rises: bool = True

    def at(self, place: tuple[int, int]) -> tuple[Floats, float]:
        """Precision (knots + thin,) * 2 of all at a place, and the log determinant of its covariance."""
        alike, step = place
        step_m, knots = CHANGE_STEPS_M[step], len(self.precision[alike])
        thin_m = min(_step_m(place), THIN_SNOW_M) if self.rises else NO_SNOW_M
        precision = np.zeros((knots + self.thin,) * 2)
        precision[:knots, :knots] = self.precision[alike] / step_m**2
        precision[range(knots, knots + self.thin), range(knots, knots + self.thin)] = 1 / thin_m**2
        spread = 2 * (knots * np.log(step_m) + self.thin * np.log(thin_m))
        return precision, float(self.log_determinant[alike] + spread)


def _step_m(place: tuple[int, int]) -> float:
    """One sigma of the change between its knots at a place among priors."""
    alike, step = place
    return CHANGE_STEPS_M[step] * float(np.hypot(1.0, ALIKE_CHANGES[alike]))


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
    thin = _thin_snow(patches, moving) if len(knots) else sparse.csr_array((len(u), 0))
    across, out = np.divmod(knots, along)
    apart = np.abs(np.subtract.outer(across, across)) / ALIKE_AZIMUTH_KNOTS
    apart += np.abs(np.subtract.outer(out, out)) / ALIKE_RANGE_KNOTS
    own = np.eye(len(knots)) + UNIFORM_CHANGE**2
    covariances = [Factored(own + alike**2 * np.exp(-apart)) for alike in ALIKE_CHANGES]
    changes = _Changes(
        [one.inverse() for one in covariances],
        [one.log_determinant() for one in covariances],
        thin.shape[1],
    )
    return sparse.hstack([field, thin], format="csr"), changes


def _pattern(patches: Patches, change: Floats) -> Floats:
    """Return a change of patches (n,) by sector round the scanner."""
    azimuth_rad = patches.felt.of.start_rad + LEAN_KNOT_RAD * patches.felt.passed
    return likeness.pattern(azimuth_rad, (patches.stretch + 0.5) * STRETCH_M, change)


def _thin_snow(patches: Patches, moving: Bools) -> sparse.csr_array:
    """Which stable patches (n, 2) may hold snow, and which may hold some."""
    tan_slope = np.hypot(*patches.felt.globals_[3:5])
    holds = np.digitize(tan_slope, SNOW_STEEPEST)
    return sparse.csr_array(np.stack([(holds == kind) & ~moving for kind in range(2)], axis=1) * 1.0)


@dataclass(frozen=True)
class _Solved:
    """Solution of normal equations whose last unknowns have the prior that makes the data most likely."""

    reduced: Reduced
    estimate: Floats  # (m,)
    place: tuple[int, int]  # of the change's prior
    precision: Floats  # (changes, changes) of that

    @property
    def step_m(self) -> float:
        """One sigma of the change between its knots."""
        return _step_m(self.place)

    def change_m(self, field: sparse.csr_array) -> Floats:
        """Change of the patches (n,)."""
        return np.asarray(field @ self.estimate[len(self.estimate) - len(self.precision) :])

    def rise_m(self, field: sparse.csr_array, moving: Bools) -> float:
        """Mean change of the moving patches."""
        return float(self.change_m(field)[moving].mean()) if moving.any() else 0.0

    def by_line(self, of: Basis) -> Floats:
        """State (u,) with the leans of the lines."""
        state = rows_at_lines(of, self.estimate[: len(of.names), None])[:, 0]
        state[len(GLOBAL) : len(GLOBAL) + of.line_count] += self.reduced.own_rad(self.estimate)
        return np.asarray(state)

    def logged_rad(self, of: Basis, log: LineLog | None) -> Floats:
        """What a log should say of each line (lines,) [rad], but for its own faults."""
        state = self.by_line(of)
        felt = tilt_along(of.line_azimuth_rad) @ state[:2]
        felt += state[len(GLOBAL) : len(GLOBAL) + of.line_count]
        if log is not None and log.apart is not None:
            felt += log.apart.lean_rad @ self.estimate[log.beside(of)]
        return np.asarray(felt)

    def whole(self) -> Factored:
        """Return the normal equations with the prior that was chosen."""
        normal, first = self.reduced.normal.copy(), len(self.estimate) - len(self.precision)
        normal[first:, first:] += self.precision
        return Factored(normal)


def _solve(reduced: Reduced, size: int, changes: _Changes, near: tuple[int, int] | None) -> _Solved:
    """Solve; how much the moving ground changed, and how smoothly, is chosen by the likelihood.

    With a prior chosen before, neighbours are taken to be about as alike as then.
    """
    normal, right = reduced.normal, reduced.right
    state = Factored(normal[:size, :size])
    half = state.half(normal[:size, size:])
    left = normal[size:, size:] - half.T @ half
    told = right[size:] - half.T @ state.half(right[:size, None])[:, 0]
    tried: dict[tuple[int, int], tuple[float, Floats]] = {}

    def odds(place: tuple[int, int]) -> float:
        if place not in tried:
            tried[place] = _likelihood(left, told, changes, place)
        return tried[place][0]

    size_m = _step_m(near or (0, len(CHANGE_STEPS_M) // 2))  # about the same, however alike neighbours are
    for alike in range(len(ALIKE_CHANGES)):
        if near is None or abs(alike - near[0]) <= 1:
            sizes_m = [_step_m((alike, step)) for step in range(len(CHANGE_STEPS_M))]
            step = int(np.argmin(np.abs(np.log(np.divide(sizes_m, size_m)))))
            size_m = sizes_m[_climbed(odds, alike, step)]
    place = max(tried, key=odds)
    change_m = tried[place][1]
    estimate = np.concatenate([state.solve(right[:size] - normal[:size, size:] @ change_m), change_m])
    return _Solved(reduced, estimate, place, changes.at(place)[0])


def _climbed(odds: Callable[[tuple[int, int]], float], alike: int, step: int) -> int:
    """Return the place among CHANGE_STEPS_M from which the odds fall to either side."""
    while True:
        beside = [(alike, s) for s in (step - 1, step, step + 1) if 0 <= s < len(CHANGE_STEPS_M)]
        _, best = max(beside, key=odds)
        if best == step:
            return step
        step = best


def _likelihood(
    left: Floats, told: Floats, changes: _Changes, place: tuple[int, int]
) -> tuple[float, Floats]:
    """Log likelihood of a prior of the change, and the change (knots,) [m] with it."""
    against = ALIKE_ODDS[place[0]]
    if not len(told):
        return -against, told
    precision, determinant = changes.at(place)
    root = root_of(left + precision)
    change_m = linalg.cho_solve((root, True), told, check_finite=False)
    spread = (log_determinant(root) + determinant) / 2
    return float(told @ change_m / 2 - spread) - against, change_m


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
    apart_m2 = left_m**2 / CHI2_MEDIAN - variance_m2
    for _ in range(30):
        middle = float(np.sqrt(low * high))
        if np.count_nonzero(apart_m2 > middle) > len(apart_m2) / 2:
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
