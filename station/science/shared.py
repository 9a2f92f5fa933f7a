"""What all points of a scan have in common: parameters, their effect on heights, their covariance.

Nine global parameters, and by azimuth the lean along the line of sight (knots every 1°), the refraction and
the lean across the line of sight (every 5°) that they do not hold. The effect of each on a height is analytic
in the place of the cell and the gradient of the terrain, so that it is never stored: with these functions and
the covariance in an epoch anyone gets the uncertainty of a cell, a box, a volume, a difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np

from station.quantities import UPRIGHT, Bools, Floats, Floats32, Grid, Ints, Reals, Shared
from station.science.air import EARTH_RADIUS_M

GLOBAL = (
    ("tilt_east", "rad"),
    ("tilt_north", "rad"),
    ("heading", "rad"),
    ("translation_east", "m"),
    ("translation_north", "m"),
    ("translation_up", "m"),
    ("range_bias", "m"),
    ("range_scale", "1e-6"),
    ("refraction", "1"),
)
LEAN_KNOT_RAD = math.radians(1.0)
LEAN_PER_REFRACTION = 5  # knots of the lean for one of the refraction
LINES_A_KNOT = 5  # groups of scan lines between two knots of the lean, of 0.2° each: a second or so
MOST_LEANING_COS = math.cos(math.radians(10.0))  # beyond, a sector on the map says little of the head's


@dataclass(frozen=True)
class Basis:
    """The parameters of a station: nine, then lean, refraction, lean across, at knots from `start_rad` on.

    Azimuths are those of the scanner's head: about its axis of rotation (east, north, up), clockwise from
    grid north, so that a scan line has one, however the mount leans. `closed`: the knots go all the way
    round.
    """

    start_rad: float
    intervals: int  # between knots of the lean
    closed: bool
    axis: tuple[float, float, float] = UPRIGHT

    @property
    def lean_count(self) -> int:
        """How many knots the lean has."""
        return self.intervals + (not self.closed)

    @property
    def refraction_count(self) -> int:
        """How many knots the refraction has, and as many the lean across the line of sight."""
        return self.intervals // LEAN_PER_REFRACTION + (not self.closed)

    @property
    def line_count(self) -> int:
        """How many groups of scan lines there are."""
        return self.intervals * LINES_A_KNOT

    @property
    def line_azimuth_rad(self) -> Floats:
        """Azimuth of the middle of each group of lines (line_count,)."""
        middle = np.arange(self.line_count, dtype=np.float64) + 0.5
        return np.asarray(self.start_rad + LEAN_KNOT_RAD / LINES_A_KNOT * middle)

    @property
    def outward(self) -> Floats:
        """Direction (3, line_count) in which the head looks at each group of lines, across its axis."""
        east, north = _clockwise(self.axis)
        azimuth_rad = self.line_azimuth_rad
        return np.asarray(np.outer(east, np.sin(azimuth_rad)) + np.outer(north, np.cos(azimuth_rad)))

    @property
    def refraction_azimuth_rad(self) -> Floats:
        """Azimuth of each knot of the refraction (refraction_count,)."""
        knot = np.arange(self.refraction_count, dtype=np.float64)
        return np.asarray(self.start_rad + LEAN_KNOT_RAD * LEAN_PER_REFRACTION * knot)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each parameter."""
        lean_rad = self.start_rad + LEAN_KNOT_RAD * np.arange(self.lean_count)
        return (
            *(name for name, _ in GLOBAL),
            *(f"lean_{_degrees(a)}" for a in lean_rad),
            *(f"refraction_{_degrees(a)}" for a in self.refraction_azimuth_rad),
            *(f"lean_across_{_degrees(a)}" for a in self.refraction_azimuth_rad),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each parameter."""
        return (
            *(unit for _, unit in GLOBAL), *["rad"] * self.lean_count, *["1"] * self.refraction_count,
            *["rad"] * self.refraction_count,
        )  # fmt: skip

    def felt_after(self, knot: Ints) -> Ints:
        """Parameters (m, 15) felt after knots (m,) of the lean: the globals, of all others the two beside."""
        bend = knot // LEAN_PER_REFRACTION
        bends = bend, (bend + 1) % self.refraction_count
        first, leans = len(GLOBAL), (knot, (knot + 1) % self.lean_count)
        last, beyond = first + self.lean_count, first + self.lean_count + self.refraction_count
        parts = (first, leans), (last, bends), (beyond, bends)
        others = [start + at for start, both in parts for at in both]
        return np.stack([*np.broadcast_arrays(*range(first), *others)], axis=-1)

    def knots_before(self, offset_m: tuple[Reals, Reals, Reals]) -> Reals:
        """How many knots of the lean the head has passed when it looks there (n,), in fractions of knots."""
        clockwise = _clockwise(self.axis)
        east, north = (sum(e * p for e, p in zip(axis, offset_m, strict=True)) for axis in clockwise)
        passed: Reals = np.asarray((np.arctan2(east, north) - self.start_rad) % (2 * math.pi)) / LEAN_KNOT_RAD
        if self.closed:
            return np.minimum(passed, np.nextafter(self.intervals, 0))
        beyond = (self.intervals + 2 * math.pi / LEAN_KNOT_RAD) / 2  # nearer the first knot than the last
        return np.asarray(
            np.clip(np.where(passed > beyond, 0.0, passed), 0.0, np.nextafter(self.intervals, 0))
        )


def _degrees(azimuth_rad: float) -> str:
    return f"{math.degrees(azimuth_rad) % 360:05.1f}"


@lru_cache(maxsize=4)
def _clockwise(axis: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Directions of the head at azimuth 90° and 0°, across the axis."""
    up = np.array(axis)
    north = np.array([0.0, 1.0, 0.0]) - up[1] * up
    north /= np.linalg.norm(north)
    return np.cross(north, up), north


def basis(
    grid: Grid, position_m: tuple[float, float, float], axis: tuple[float, float, float] = UPRIGHT
) -> Basis:
    """Return the parameters for a grid seen from a scanner: knots over the sector it fills."""
    east = np.array([grid.west_m, grid.west_m + grid.nx * grid.cell_m]) - position_m[0]
    north = np.array([grid.north_m - grid.ny * grid.cell_m, grid.north_m]) - position_m[1]
    inside = east[0] <= 0 <= east[1] and north[0] <= 0 <= north[1]
    if inside or axis[2] < MOST_LEANING_COS:
        return Basis(0.0, round(2 * math.pi / LEAN_KNOT_RAD), closed=True, axis=axis)
    corners = np.array([math.atan2(e, n) for e in east for n in north])
    middle = math.atan2(east.mean(), north.mean())
    beside = (corners - middle + math.pi) % (2 * math.pi) - math.pi
    wide_rad = LEAN_KNOT_RAD * LEAN_PER_REFRACTION
    first = math.floor((middle + beside.min()) / wide_rad)
    last = math.ceil((middle + beside.max()) / wide_rad)
    return Basis(first * wide_rad, (last - first) * LEAN_PER_REFRACTION, closed=False, axis=axis)


@dataclass(frozen=True)
class Sensitivities:
    """Effect of a unit of each parameter on the heights of cells: the matrix J, without its zeros.

    A cell feels the nine globals, the lean of its line and the two knots beside it of the refraction and of
    the lean across the line of sight.
    """

    of: Basis
    globals_: Reals  # (9, n)
    lean: Reals  # (n,) per rad
    refraction: Reals  # (n,) per unit of k
    across: Reals  # (n,) per rad of turn about the direction in which the head looks
    passed: Reals  # (n,) knots of the lean before it, in fractions

    def __len__(self) -> int:
        """Return how many cells there are."""
        return len(self.lean)

    @cached_property
    def line(self) -> Ints:
        """Group of scan lines (n,) that each cell lies in."""
        return (self.passed * LINES_A_KNOT).astype(np.int64)

    def lean_knot(self) -> tuple[Ints, Ints, Reals]:
        """Knots of the lean before and after each cell (n,), and the share of the one after."""
        before = self.passed.astype(np.int64)
        return before, (before + 1) % self.of.lean_count, self.passed - before

    def refraction_knot(self) -> tuple[Ints, Ints, Reals]:
        """Knots of the refraction before and after each cell (n,), and the share of the one after.

        The lean across the line of sight has the same.
        """
        before = self.passed.astype(np.int64) // LEAN_PER_REFRACTION
        return before, (before + 1) % self.of.refraction_count, self.passed / LEAN_PER_REFRACTION - before

    def total(self, weights: Floats) -> Floats:
        """Effect of each parameter (p,) on the weighted sum of heights: g = Jᵀ a.

        Source: EQUATIONS 6.2.
        """
        parts: list[Floats] = [self.globals_ @ weights]
        for effect, (before, after, share), count in (
            (self.lean * weights, self.lean_knot(), self.of.lean_count),
            (self.refraction * weights, self.refraction_knot(), self.of.refraction_count),
            (self.across * weights, self.refraction_knot(), self.of.refraction_count),
        ):
            knots: Floats = np.zeros(count)
            np.add.at(knots, before, effect * (1 - share))
            np.add.at(knots, after, effect * share)
            parts.append(knots)
        return np.concatenate(parts)

    def by_line(self, weights: Floats) -> Floats:
        """Effect of each line's lean (line_count,) on the weighted sum of heights."""
        felt: Floats = np.zeros(self.of.line_count)
        np.add.at(felt, self.line, self.lean * weights)
        return felt

    def some(self, chosen: Bools | Ints | slice) -> Sensitivities:
        """Return those of the chosen cells."""
        singles = (one[chosen] for one in (self.lean, self.refraction, self.across, self.passed))
        return Sensitivities(self.of, self.globals_[:, chosen], *singles)

    def variance(self, unknown: Shared) -> Reals:
        """Variance of each cell's height (n,) [m²]: the diagonal of J C Jᵀ, and what its line adds.

        Fastest where cells come as the head does.
        """
        of, knot = self.of, self.passed.astype(np.int16)
        if not len(knot):
            return np.zeros_like(self.lean)
        if np.any(knot[1:] < knot[:-1]):
            variance_m2, order = np.empty_like(self.lean), np.argsort(knot, kind="stable")
            variance_m2[order] = self.some(order).variance(unknown)
            return variance_m2
        columns = self._columns()
        weighted = np.empty_like(columns)
        edges = [0, *(np.flatnonzero(knot[1:] > knot[:-1]) + 1).tolist(), len(knot)]
        felt = of.felt_after(knot[edges[:-1]].astype(np.int64))
        covariances = unknown.covariance[felt[:, :, None], felt[:, None, :]].astype(columns.dtype)
        for covariance, (first, end) in zip(covariances, pairwise(edges), strict=True):
            np.matmul(covariance, columns[:, first:end], out=weighted[:, first:end])
        # Rounding may take it below nought where the covariance is singular.
        told_m2 = np.maximum(np.einsum("ij,ij->j", columns, weighted), 0.0)
        lines = slice(int(knot[0]) * LINES_A_KNOT, (int(knot[-1]) + 1) * LINES_A_KNOT)
        own = (leans_between(of).left[lines] ** 2 @ line_variances(of, unknown)).astype(columns.dtype)
        return np.asarray(self.lean**2 * own[self.line - lines.start] + told_m2)

    def _columns(self) -> Reals:
        """Effects (15, n) of what each cell feels, as `Basis.felt_after` names them."""
        first = len(GLOBAL)
        bent = self.passed / LEAN_PER_REFRACTION
        share, bent_share = self.passed - np.floor(self.passed), bent - np.floor(bent)
        columns = np.empty((first + 6, len(self)), self.lean.dtype)
        columns[:first] = self.globals_
        for at, (effect, after) in enumerate(
            ((self.lean, share), (self.refraction, bent_share), (self.across, bent_share))
        ):
            np.multiply(effect, after, out=columns[first + 2 * at + 1])
            np.subtract(effect, columns[first + 2 * at + 1], out=columns[first + 2 * at])
        return columns


def line_variances(of: Basis, unknown: Shared) -> Floats:
    """Variance of what makes up each line's own lean (line_count,) [rad²], independent from line to line."""
    by_interval = unknown.noise_variance[len(GLOBAL) : len(GLOBAL) + of.intervals]
    return np.repeat(by_interval, LINES_A_KNOT)


def sensitivities(
    of: Basis,
    offset_m: tuple[Reals, Reals, Reals],
    east_gradient: Reals,
    north_gradient: Reals,
    passed: Reals | None = None,
) -> Sensitivities:
    """Effect of unit errors on the heights of cells at `offset_m` (each (n,)) from the scanner.

    `passed` are the knots of the lean before each, where they are known. Signs: scanner's state less the
    assumed one. Source: EQUATIONS 6.1.
    """
    x_m, y_m, z_m = offset_m
    away_m2 = x_m**2 + y_m**2  # np.hypot takes five times as long
    range_m2 = away_m2 + z_m**2
    horizontal_m = np.maximum(np.sqrt(away_m2), 1e-6)
    slope_m = east_gradient * x_m + north_gradient * y_m
    along_m = z_m - slope_m  # n_u · P
    rise_m = horizontal_m + z_m * slope_m / horizontal_m  # F
    refraction_m = horizontal_m * rise_m / (2 * EARTH_RADIUS_M)
    turns_m = (
        -(y_m + north_gradient * z_m),
        x_m + east_gradient * z_m,
        east_gradient * y_m - north_gradient * x_m,
    )
    # A turn about the way to a point leaves it there. That way is `out_m` across the head's axis and `up_m`
    # along it: what a turn about the one does, one about the other undoes.
    u = of.axis
    up_m = u[0] * x_m + u[1] * y_m + u[2] * z_m
    about_axis_m = u[0] * turns_m[0] + u[1] * turns_m[1] - u[2] * turns_m[2]
    out_m = np.sqrt(np.maximum(range_m2 - up_m**2, 1e-12))
    return Sensitivities(
        of=of,
        globals_=np.stack(
            [
                *turns_m,
                east_gradient,
                north_gradient,
                np.full_like(x_m, -1.0),
                along_m / np.sqrt(np.maximum(range_m2, 1e-12)),
                along_m * 1e-6,
                refraction_m,
            ]
        ),
        lean=-rise_m,
        refraction=refraction_m,
        across=-up_m * about_axis_m / out_m,
        passed=of.knots_before(offset_m) if passed is None else passed,
    )


def cell_sensitivities(
    of: Basis,
    grid: Grid,
    position_m: tuple[float, float, float],
    elevation_m: Floats | Floats32,
    gradient: tuple[Floats32, Floats32],
    cells: Bools,
) -> Sensitivities:
    """Effect of unit errors on the heights of the chosen cells (ny, nx) of a surface."""
    row, column = np.nonzero(cells)
    east, north = (np.nan_to_num(g[row, column].astype(np.float64)) for g in gradient)
    offset_m = (
        grid.x_m[column] - position_m[0],
        grid.y_m[row] - position_m[1],
        elevation_m[row, column].astype(np.float64) - position_m[2],
    )
    return sensitivities(of, offset_m, east, north)


def aggregate_variance(
    weights: Floats,
    random_variance_m2: Floats,
    felt: Sensitivities,
    unknown: Shared,
    held: Floats | None = None,
) -> float:
    """Variance of a weighted sum of cell heights: Σ a² σ_r² + gᵀ C g, and what lines add.

    `held` (n,) is the share of each cell's noise that is in the estimate too (`held.share`), and goes off
    twice; what is not in it stays. For a difference of two epochs add both; what a reference shares with both
    cancels. Source: EQUATIONS 6.2; Hartzell et al. (2015), Eq. 14 and 21, lack the second term.
    """
    left, own_rad2 = leans_between(felt.of).left, line_variances(felt.of, unknown)
    random_m2, free = weights**2 * random_variance_m2, np.ones(1) if held is None else 1 - held
    rest = weights * (2 * free - 1)
    shared_m2 = float(felt.total(weights) @ unknown.covariance @ felt.total(rest))
    shared_m2 += float(((felt.by_line(weights) @ left) * own_rad2) @ (felt.by_line(rest) @ left))
    return max(float(np.sum(random_m2)) + shared_m2, float(np.sum(random_m2 * free)))


@dataclass(frozen=True)
class LeansBetween:
    """Matrices between the leans of lines and those at knots."""

    knots: Floats  # (lines, knots) interpolates
    fit: Floats  # (knots, lines)
    left: Floats  # (lines, lines) what the fit leaves


@lru_cache(maxsize=4)
def leans_between(of: Basis) -> LeansBetween:
    """Return the matrices of a basis; made once."""
    knots = interpolated(of, np.eye(of.lean_count))
    fit = np.linalg.inv(knots.T @ knots) @ knots.T
    return LeansBetween(knots, fit, np.eye(of.line_count) - interpolated(of, fit))


def interpolated(of: Basis, at_knots: Floats) -> Floats:
    """Return at lines (lines, k) what is straight between the knots of the lean (knots, k)."""
    before = np.arange(of.line_count) // LINES_A_KNOT
    share = ((np.arange(of.line_count) % LINES_A_KNOT + 0.5) / LINES_A_KNOT)[:, None]
    return np.asarray(at_knots[before] * (1 - share) + at_knots[(before + 1) % of.lean_count] * share)


def tilt_along(azimuth_rad: Floats) -> Floats:
    """Lean along lines of sight (lines, 2) for a tilt of one about east, and about north."""
    return np.stack([np.cos(azimuth_rad), -np.sin(azimuth_rad)], axis=-1)


def against(unknown: Shared, common: Shared | None) -> Shared:
    """Return what a scan leaves unknown against a reference that does not know `common` itself.

    A scanner that has been moved feels other parameters; then the reference counts as unsure as the scan.
    """
    if common is None:
        return unknown
    return unknown + (common if common.names == unknown.names else unknown)


def by_names(of: Basis, unknown: Shared) -> Shared:
    """Return what is unknown by the parameters of a basis; what an older epoch lacks counts as known."""
    if unknown.names == of.names:
        return unknown
    place = {name: at for at, name in enumerate(unknown.names)}
    here = [at for at, name in enumerate(of.names) if name in place]
    there = [place[of.names[at]] for at in here]
    estimate, noise = np.zeros(len(of.names)), np.zeros(len(of.names))
    covariance = np.zeros((len(of.names),) * 2)
    estimate[here], noise[here] = unknown.estimate[there], unknown.noise_variance[there]
    covariance[np.ix_(here, here)] = unknown.covariance[np.ix_(there, there)]
    change = unknown.change
    if change is not None:
        errors = np.zeros((len(of.names), change.modes.shape[1]))
        errors[here] = change.modes[there]
        change = replace(change, modes=errors)
    return Shared(of.names, of.units, estimate, covariance, noise, change)


def lines_from_knots(of: Basis, unknown: Floats) -> Floats:
    """Covariance by line (9 + lines + knots of refraction and lean across) of one by knot (p, p)."""
    wide = rows_at_lines(of, unknown)
    return rows_at_lines(of, wide.T)


def rows_at_lines(of: Basis, rows: Floats) -> Floats:
    """Rows by line of rows by knot (p, k)."""
    first, last = len(GLOBAL), len(GLOBAL) + of.lean_count
    return np.concatenate([rows[:first], interpolated(of, rows[first:last]), rows[last:]])


def rows_at_knots(of: Basis, rows: Floats) -> Floats:
    """Rows by knot of rows by line (9 + lines + knots of refraction and lean across, k)."""
    first, last = len(GLOBAL), len(GLOBAL) + of.line_count
    return np.concatenate([rows[:first], leans_between(of).fit @ rows[first:last], rows[last:]])


def by_knots(of: Basis, estimate: Floats, covariance: Floats) -> Shared:
    """Return what is known by line (9 + lines + knots of refraction and lean across), condensed to knots."""
    lines = slice(len(GLOBAL), len(GLOBAL) + of.line_count)
    narrow = rows_at_knots(of, covariance)
    left = covariance[lines, lines] - interpolated(
        of, narrow[lines.start : lines.start + of.lean_count, lines]
    )
    own = np.einsum("ij,ij->i", left, leans_between(of).left)
    return condensed(of, rows_at_knots(of, estimate[:, None])[:, 0], rows_at_knots(of, narrow.T), own)


def condensed(of: Basis, estimate: Floats, covariance: Floats, left_rad2: Floats) -> Shared:
    """Return what is known by knots (p,), and by how much each line's lean varies about them (lines,).

    What the knots cannot hold of a line's lean is kept as the variance of independent leans from which the
    knots have taken their part; that loses less than 5 % of the sigma of boxes and areas.
    """
    # A projection: the square of each row sums up to its diagonal.
    own = np.maximum(left_rad2, 0.0) / np.diag(leans_between(of).left)
    noise = np.zeros(len(estimate))
    noise[len(GLOBAL) : len(GLOBAL) + of.intervals] = own.reshape(of.intervals, LINES_A_KNOT).mean(axis=1)
    return Shared(of.names, of.units, estimate, covariance, noise)
