"""Line tilt: the tilt of each scan-line group about the interpolated knots, its prior and its posterior.

It is the sum of a motion correlated over a few seconds and of white noise. The motion is an
Ornstein-Uhlenbeck process, whose inverse covariance is tridiagonal in the order in which the head passed the
lines. There is one unknown per line group, but no dense matrix of that size has to be factored.
Source: equations.md, 6.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from station.quantities import Floats, Ints

CHUNK_LINES = 100
NEGLIGIBLE = 1e-14  # of the largest element: contributions of distant lines below rounding error


@dataclass(frozen=True)
class LineTiltPrior:
    """Prior of the line tilts: an Ornstein-Uhlenbeck process plus white noise."""

    order: Ints  # (lines,) in which the head passed the line groups
    lag_correlation: Floats  # (lines - 1,) correlation of the motion from each line group to the next
    correlated_variance_rad2: float  # variance of that motion
    white_variance_rad2: Floats  # (lines,) variance of the white noise

    def covariance(self) -> Floats:
        """Covariance (lines, lines) [rad²]."""
        log_correlation = np.concatenate([[0.0], np.cumsum(np.log(self.lag_correlation))])
        log_correlation_by_line = np.empty_like(log_correlation)
        log_correlation_by_line[self.order] = log_correlation
        correlation = np.exp(-np.abs(np.subtract.outer(log_correlation_by_line, log_correlation_by_line)))
        return np.asarray(self.correlated_variance_rad2 * correlation + np.diag(self.white_variance_rad2))

    def doubled(self) -> LineTiltPrior:
        """Return this prior with twice the variance."""
        return replace(
            self,
            correlated_variance_rad2=2 * self.correlated_variance_rad2,
            white_variance_rad2=2 * self.white_variance_rad2,
        )

    def condition_on(self, weight: Floats) -> LineTiltPosterior:
        """Return the posterior after observing the line tilts with weights (lines,) [1 / rad²]."""
        gain = 1 / (1 + weight * self.white_variance_rad2)
        innovation = 1 - self.lag_correlation**2
        diagonal = np.ones(len(weight))
        diagonal[:-1] += self.lag_correlation**2 / innovation
        diagonal[1:] += 1 / innovation - 1
        off_diagonal = -self.lag_correlation / innovation
        diagonal = diagonal / self.correlated_variance_rad2 + (weight * gain)[self.order]
        band = np.stack([diagonal, np.append(off_diagonal / self.correlated_variance_rad2, 0.0)])
        cholesky = linalg.cholesky_banded(band, lower=True, check_finite=False)
        return LineTiltPosterior(self.order, self.white_variance_rad2 * gain, gain, cholesky)


@dataclass(frozen=True)
class LineTiltPosterior:
    """Covariance G of the line tilts given all other unknowns: G = diag(w) + D T⁻¹ D, with T = L Lᵀ.

    w is `white_variance_rad2`, D = diag(`gain`), L is `cholesky`.
    """

    order: Ints
    white_variance_rad2: Floats  # (lines,)
    gain: Floats  # (lines,) the diagonal of D
    cholesky: Floats  # (2, lines) the two diagonals of L, in the order of passing

    def apply(self, rhs: Floats) -> Floats:
        """Return G B for a matrix B (lines, k)."""
        correlated = np.empty_like(rhs)
        scaled = (self.gain[:, None] * rhs)[self.order]
        correlated[self.order] = linalg.cho_solve_banded((self.cholesky, True), scaled, check_finite=False)
        return np.asarray(self.white_variance_rad2[:, None] * rhs + self.gain[:, None] * correlated)

    def variance(self) -> Floats:
        """Return the diagonal of G (lines,)."""
        diagonal, off_diagonal = self.cholesky
        correlated_rad2 = 1 / diagonal**2
        for line in range(len(correlated_rad2) - 2, -1, -1):
            correlated_rad2[line] += (off_diagonal[line] / diagonal[line]) ** 2 * correlated_rad2[line + 1]
        variance_rad2 = self.white_variance_rad2.copy()
        variance_rad2[self.order] += self.gain[self.order] ** 2 * correlated_rad2
        return variance_rad2

    def quadratic_form(self, matrix: sparse.csr_array) -> Floats:
        """Return Rᵀ G R (k, k) for a sparse matrix R (lines, k) with few lines in each column.

        Lines are processed in chunks: correlation decays with distance, so few columns are active at a time.
        """
        matrix = matrix[self.order]
        total = np.zeros((matrix.shape[1],) * 2)
        carried, largest = np.zeros(matrix.shape[1]), np.zeros(matrix.shape[1])
        coupling = 0.0
        for first in range(0, matrix.shape[0], CHUNK_LINES):
            lines = slice(first, first + CHUNK_LINES)
            order = self.order[lines]
            rows = matrix[lines]
            active = np.abs(carried) > NEGLIGIBLE * largest
            active[rows.indices] = True
            columns = np.flatnonzero(active)
            dense = rows.toarray()[:, columns]
            solved = self.gain[order, None] * dense
            solved[0] -= coupling * carried[columns]
            solved = linalg.solve_banded((1, 0), self.cholesky[:, lines], solved, check_finite=False)
            carried[:] = 0.0
            carried[columns] = solved[-1]
            largest[columns] = np.maximum(largest[columns], np.abs(solved).max(axis=0))
            coupling = self.cholesky[1, lines][-1]
            factor = np.concatenate([solved, np.sqrt(self.white_variance_rad2[order, None]) * dense])
            total[np.ix_(columns, columns)] += factor.T @ factor
        return total
