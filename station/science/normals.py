"""The normal equations of one scan: what its patches, its log and what is known beforehand say of its state.

The unknowns that remain are those by knots, the log's own faults and the change of the moving ground; each
line's own lean is taken out before and found again after. Source: EQUATIONS 6.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from station.quantities import ChangeErrors, Floats, Shared
from station.science import likeness
from station.science.leans import KnownLeans, OwnLeans
from station.science.shared import (
    GLOBAL,
    Basis,
    Sensitivities,
    condensed,
    interpolated,
    leans_between,
    lines_from_knots,
    rows_at_knots,
    rows_at_lines,
    tilt_along,
)


@dataclass(frozen=True)
class Apart:
    """What a reference leans by, which no log feels: some patterns, each of one sigma."""

    lean_rad: Floats  # (lines, k) along the line of sight
    state: Floats  # (p, k) all of the reference's state that goes with it, by knots


@dataclass(frozen=True)
class LineLog:
    """What the inclination log says of each group of lines, and what it may get wrong."""

    lean_rad: Floats  # (lines,) along the line of sight
    weight: Floats  # (lines,) 1 / rad², nought where there is none
    faults: Floats  # (lines, f) effect of one sigma of each of its common errors [rad]
    apart: Apart | None = None  # where it is set against the lean from a reference

    @property
    def common(self) -> Floats:
        """Effect of one sigma of what it has in common (lines, f + k) [rad]."""
        return self.faults if self.apart is None else np.hstack([self.faults, self.apart.lean_rad])

    def beside(self, of: Basis) -> slice:
        """Which of an adjustment's unknowns are patterns of the reference's lean."""
        first = len(of.names) + self.faults.shape[1]
        return slice(first, first + (0 if self.apart is None else self.apart.lean_rad.shape[1]))

    def against(self, of: Basis, reference: Floats) -> LineLog:
        """Return the same against the state from a reference, whose own has a covariance (p, p).

        The sensor does not feel how that leans, of which the patterns count that exceed a line's noise.
        """
        values, vectors = np.linalg.eigh(reference)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        lean = interpolated(of, root[len(GLOBAL) : len(GLOBAL) + of.lean_count])
        lean += tilt_along(of.line_azimuth_rad) @ root[:2]
        patterns, sizes, turn = linalg.svd(lean, full_matrices=False)
        seen = sizes**2 * self.weight.max(initial=0.0) > 1
        return replace(self, apart=Apart(patterns[:, seen] * sizes[seen], root @ turn[seen].T))


@dataclass(frozen=True)
class Beforehand:
    """What is known of the scanner's state before a scan is looked at.

    The lean of a line is what is straight between the knots beside it, and its own.
    """

    of: Basis
    knots: Floats  # (p, p) covariance of the globals, the lean at knots, the refraction, the lean across
    own: OwnLeans

    def against(self, reference: Shared | None) -> Beforehand:
        """Return the same for the difference to the state of the reference, which is wrong itself."""
        if reference is None:
            return self
        own = self.own if reference.names == self.of.names else self.own.twice()
        return Beforehand(self.of, self.knots + self.of_reference(reference), own)

    def of_reference(self, reference: Shared) -> Floats:
        """Covariance (p, p) of the state of a reference; once the scanner has been moved that of a scan."""
        return reference.covariance if reference.names == self.of.names else self.knots

    def by_line(self) -> Floats:
        """Covariance (u, u) of globals, leans of lines, knots of refraction and lean across."""
        covariance = lines_from_knots(self.of, self.knots)
        lines = slice(len(GLOBAL), len(GLOBAL) + self.of.line_count)
        covariance[lines, lines] += self.own.covariance()
        return covariance


@dataclass(frozen=True)
class Reduced:
    """Normal equations after the own leans of the lines were taken out of them."""

    normal: Floats  # (m, m)
    right: Floats  # (m,)
    own: KnownLeans
    felt: sparse.csr_array  # (lines, m) how the own leans go with the other unknowns
    told: Floats  # (lines,) their right side

    def own_rad(self, estimate: Floats) -> Floats:
        """Own leans (lines,) that go with the other unknowns (m,)."""
        return self.own.times((self.told - self.felt @ estimate)[:, None])[:, 0]


class Normals:
    """Normal equations of the state by knots, the common errors of the log and the change: m unknowns.

    Each line's own lean is an unknown too, which is taken out at once.
    """

    def __init__(
        self,
        felt: Sensitivities,
        field: sparse.csr_array,
        wanted_m: Floats,
        before: Beforehand,
        log: LineLog | None,
    ) -> None:
        of = felt.of
        seen, state = _design(felt), len(before.knots)
        self._patches = len(felt)
        self._lean, self._line, self._wanted = felt.lean, felt.line, wanted_m
        common = 0 if log is None else log.common.shape[1]
        self.size = state + common
        self._design = sparse.hstack([seen, sparse.csr_array((len(felt), common)), field], format="csr")
        self._log_weight = np.empty(0)
        if log is not None:
            self._add(log, interpolated(of, np.eye(of.lean_count)), of.line_azimuth_rad)
        self._prior = np.zeros((self._design.shape[1],) * 2)
        self._prior[range(state, self.size), range(state, self.size)] = 1.0
        self._expect(before, log)
        self._own = before.own
        rows = np.arange(len(self._line))
        shape = of.line_count, len(rows)
        self._lines = sparse.csr_array((self._lean, (self._line, rows)), shape=shape)
        self._across = self._design.T.tocsr()

    def _expect(self, before: Beforehand, log: LineLog | None) -> None:
        """Say what is thought of the state beforehand.

        It is a difference: together with the reference's own state, which is told by patterns, it is the
        scan's, which has nothing to do with those.
        """
        knots, state = before.knots, len(before.knots)
        if log is None or (apart := log.apart) is None:
            self._prior[:state, :state] = Factored(knots).inverse()
            return
        beside = log.beside(before.of)
        left = Factored(knots - apart.state @ apart.state.T).inverse()
        tied = left @ apart.state
        self._prior[:state, :state] = left
        self._prior[:state, beside], self._prior[beside, :state] = tied, tied.T
        self._prior[beside, beside] += apart.state.T @ tied

    def _add(self, log: LineLog, knots: Floats, azimuth_rad: Floats) -> None:
        """Add what the log says of each line, as further observations."""
        felt = np.zeros((len(knots), self._design.shape[1]))
        felt[:, :2] = tilt_along(azimuth_rad)
        felt[:, len(GLOBAL) : len(GLOBAL) + knots.shape[1]] = knots
        felt[:, self.size - log.common.shape[1] : self.size] = log.common
        self._design = sparse.vstack([self._design, sparse.csr_array(felt)], format="csr")
        self._lean = np.concatenate([self._lean, np.ones(len(knots))])
        self._line = np.concatenate([self._line, np.arange(len(knots))])
        self._wanted = np.concatenate([self._wanted, log.lean_rad])
        self._log_weight = log.weight

    def weighted(self, weight: Floats) -> Reduced:
        """Return the equations for a weight of each patch (n,)."""
        weight = np.concatenate([weight, self._log_weight])
        weighted = sparse.diags_array(weight) @ self._design
        own = self._own.given(np.asarray(self._lines @ (weight * self._lean)))
        felt: sparse.csr_array = self._lines @ weighted
        told = np.asarray(self._lines @ (weight * self._wanted))
        normal = self._prior + (self._across @ weighted).toarray() - own.between(felt)
        right = self._across @ (weight * self._wanted) - felt.T @ own.times(told[:, None])[:, 0]
        return Reduced(normal, right, own, felt, told)

    def heights(self, state: int) -> Floats:
        """Products of the effects of the first unknowns on heights (state, state), mean of the patches."""
        seen = self._design[: self._patches, :state]
        return np.asarray((seen.T @ seen).toarray() / max(self._patches, 1))

    def effect(self, estimate: Floats, own_rad: Floats) -> Floats:
        """Effect of the unknowns (m,) and the own leans of the lines on the patches (n,) [m]."""
        effect = self._design @ estimate + self._lean * own_rad[self._line]
        return np.asarray(effect[: self._patches])


def _design(felt: Sensitivities) -> sparse.csr_array:
    """Matrix J (n, p), by knots."""
    of, count = felt.of, len(felt)
    row = np.arange(count)
    rows, columns, values = (
        [np.tile(row, len(GLOBAL))],
        [np.repeat(np.arange(len(GLOBAL)), count)],
        [felt.globals_.ravel()],
    )
    for effect, (before, after, share), first in (
        (felt.lean, felt.lean_knot(), len(GLOBAL)),
        (felt.refraction, felt.refraction_knot(), len(GLOBAL) + of.lean_count),
        (felt.across, felt.refraction_knot(), len(GLOBAL) + of.lean_count + of.refraction_count),
    ):
        rows += [row, row]
        columns += [first + before, first + after]
        values += [effect * (1 - share), effect * share]
    placed = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(placed, shape=(count, len(of.names)))


@dataclass(frozen=True)
class Unknown:
    """What an adjustment leaves unknown: own leans of the lines, given the other unknowns, and these.

    The last unknowns are the change of the moving ground; `pattern` is what was found of it.
    """

    of: Basis
    own: KnownLeans
    felt: sparse.csr_array  # (lines, m) how the own leans go with the other unknowns
    whole: Factored  # (m, m)
    change: Floats  # (k, k) precision of the change beforehand
    heights: Floats  # (p, p) products of the effects of the state by knots on heights
    pattern: Floats  # (sectors,)

    def by_line(self) -> Floats:
        """Covariance (u, u) of the state."""
        half = self.whole.half(self._tied().T)
        covariance = half.T @ half
        covariance[self._lines, self._lines] += self.own.times(np.eye(self.of.line_count))
        return np.asarray(covariance)

    def along_sight(self, log: LineLog) -> Floats:
        """Covariance (lines, lines) of what a log feels, its own faults aside [rad²]."""
        tied = self._tied()
        felt = tilt_along(self.of.line_azimuth_rad) @ tied[:2] + tied[self._lines]
        if log.apart is not None:
            felt[:, log.beside(self.of)] += log.apart.lean_rad
        half = self.whole.half(felt.T)
        return np.asarray(half.T @ half + self.own.times(np.eye(self.of.line_count)))

    @property
    def _lines(self) -> slice:
        return slice(len(GLOBAL), len(GLOBAL) + self.of.line_count)

    @cached_property
    def _own_felt(self) -> Floats:
        """How the own leans (lines, m) go with the unknowns."""
        return self.own.times(self.felt.toarray())

    def _tied(self) -> Floats:
        """How the state (u, m) goes with the unknowns."""
        tied = rows_at_lines(self.of, np.eye(len(self.of.names), self.felt.shape[1]))
        tied[self._lines] -= self._own_felt
        return np.asarray(tied)

    def going_with(self, at_knots: Floats, by_line: Floats) -> tuple[Floats, Floats]:
        """Covariance of the unknowns (m,) and of the own leans (lines,) with what feels the state so.

        `at_knots` (p,) and `by_line` (lines,) are the effects of the state by knots and of the lines' leans.
        """
        right = -self.felt.T @ self.own.times(by_line[:, None])[:, 0]
        right[: len(at_knots)] += at_knots
        unknowns = self.whole.solve(right)
        return unknowns, self.own.times((by_line - self.felt @ unknowns)[:, None])[:, 0]

    def by_knots(self, estimate: Floats) -> Shared:
        """Return what is known of the state (u,), condensed to knots."""
        of, own, between = self.of, self.own, leans_between(self.of)
        lean = slice(len(GLOBAL), len(GLOBAL) + of.lean_count)
        felt = self._own_felt
        narrow = between.fit @ felt
        tied = np.eye(len(of.names), self.felt.shape[1])
        tied[lean] -= narrow
        half = self.whole.half(tied.T)
        covariance = half.T @ half
        beside = own.times(between.fit.T)
        at_knots = between.fit @ beside
        covariance[lean, lean] += at_knots
        left_rad2 = own.variance() - np.einsum(
            "ij,ij->i", between.knots, 2 * beside - interpolated(of, at_knots)
        )
        left_rad2 += np.sum(self.whole.half((felt - interpolated(of, narrow)).T) ** 2, axis=0)
        known = condensed(of, rows_at_knots(of, estimate[:, None])[:, 0], covariance, left_rad2)
        return known if not len(self.change) else replace(known, change=self._change_errors(half))

    def _change_errors(self, half: Floats) -> ChangeErrors:
        """Return what of the covariance the change makes, of the half (m, p) of the state by knots."""
        with_change = self.whole.last(half, len(self.change))
        factor = np.tril(root_of(self.change.copy())).T @ with_change
        return ChangeErrors(likeness.modes(factor, self.heights), self.pattern)


class Factored:
    """A covariance or normal matrix (n, n), factored; its unknowns may have units of very different size."""

    def __init__(self, matrix: Floats) -> None:
        self._scale = 1 / np.sqrt(np.diag(matrix))
        self._root = root_of(matrix * self._scale[:, None] * self._scale)

    def half(self, right: Floats) -> Floats:
        """Return H (n, k) so that HᵀH is the right side (n, k) both sides of the inverse."""
        scaled = right * self._scale[:, None]
        return np.asarray(
            linalg.solve_triangular(self._root, scaled, lower=True, overwrite_b=True, check_finite=False)
        )

    def solve(self, right: Floats) -> Floats:
        """Solution (n,)."""
        solved = linalg.cho_solve((self._root, True), right * self._scale, check_finite=False)
        return np.asarray(solved * self._scale)

    def last(self, half: Floats, count: int) -> Floats:
        """Return the last rows (count, k) of the solution that a half (n, k) belongs to."""
        root, scale = self._root[-count:, -count:], self._scale[-count:, None]
        return np.asarray(
            linalg.solve_triangular(root, half[-count:], lower=True, trans="T", check_finite=False) * scale
        )

    def inverse(self) -> Floats:
        """Inverse (n, n)."""
        if not len(self._scale):
            return np.empty((0, 0))
        half = np.tril(linalg.lapack.dpotri(self._root, lower=True)[0])
        whole = half + np.tril(half, -1).T
        return np.asarray(whole * self._scale[:, None] * self._scale)

    def log_determinant(self) -> float:
        """Logarithm of the determinant."""
        return log_determinant(self._root) - float(2 * np.log(self._scale).sum())


def root_of(matrix: Floats) -> Floats:
    """Return the lower triangular root of a symmetric matrix (n, n), which it overwrites."""
    root, _ = linalg.cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)
    return np.asarray(root)


def log_determinant(root: Floats) -> float:
    """Logarithm of the determinant of the matrix that has a root (n, n)."""
    return float(2 * np.log(np.diag(root)).sum())
