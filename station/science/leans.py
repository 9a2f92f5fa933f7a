"""The lean that each group of lines has for itself, beyond that at knots: what is known of it, and solved.

It is a motion that neighbours share for some seconds (an Ornstein-Uhlenbeck process: its inverse covariance
is tridiagonal in the order in which the head passed the lines) and one that they do not share. So there is an
unknown for each group of lines, but no matrix of that size needs to be factored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from station.quantities import Floats, Ints

CHUNK_LINES = 100
FADED = 1e-14  # of the largest: what lines far away take part in, below rounding


@dataclass(frozen=True)
class OwnLeans:
    """What is known beforehand of the own leans of lines."""

    order: Ints  # (lines,) in which the head passed them
    likeness: Floats  # (lines - 1,) correlation of the motion that neighbours share, from one to the next
    alike_rad2: float  # its variance
    alone_rad2: Floats  # (lines,) variance of the rest

    def covariance(self) -> Floats:
        """Covariance (lines, lines) [rad²]."""
        faded = np.concatenate([[0.0], np.cumsum(np.log(self.likeness))])
        passed = np.empty_like(faded)
        passed[self.order] = faded
        alike = np.exp(-np.abs(np.subtract.outer(passed, passed)))
        return np.asarray(self.alike_rad2 * alike + np.diag(self.alone_rad2))

    def twice(self) -> OwnLeans:
        """Return the same with twice the variance."""
        return replace(self, alike_rad2=2 * self.alike_rad2, alone_rad2=2 * self.alone_rad2)

    def given(self, told: Floats) -> KnownLeans:
        """Return what is known once each line's lean is told with so much weight (lines,) [1 / rad²]."""
        lent = 1 / (1 + told * self.alone_rad2)
        fresh = 1 - self.likeness**2
        diagonal = np.ones(len(told))
        diagonal[:-1] += self.likeness**2 / fresh
        diagonal[1:] += 1 / fresh - 1
        beside = -self.likeness / fresh
        diagonal = diagonal / self.alike_rad2 + (told * lent)[self.order]
        band = np.stack([diagonal, np.append(beside / self.alike_rad2, 0.0)])
        root = linalg.cholesky_banded(band, lower=True, check_finite=False)
        return KnownLeans(self.order, self.alone_rad2 * lent, lent, root)


@dataclass(frozen=True)
class KnownLeans:
    """Covariance G of the own leans of lines if all else were known: diag(alone) + D T⁻¹ D, T = L Lᵀ."""

    order: Ints
    alone_rad2: Floats  # (lines,)
    lent: Floats  # (lines,) the diagonal of D
    root: Floats  # (2, lines) L, which is bidiagonal, by its diagonals and in the order passed

    def times(self, right: Floats) -> Floats:
        """Return G times a matrix (lines, k)."""
        alike = np.empty_like(right)
        lent = (self.lent[:, None] * right)[self.order]
        alike[self.order] = linalg.cho_solve_banded((self.root, True), lent, check_finite=False)
        return np.asarray(self.alone_rad2[:, None] * right + self.lent[:, None] * alike)

    def variance(self) -> Floats:
        """Return the diagonal of G (lines,)."""
        diagonal, beside = self.root
        alike = 1 / diagonal**2
        for line in range(len(alike) - 2, -1, -1):
            alike[line] += (beside[line] / diagonal[line]) ** 2 * alike[line + 1]
        variance_rad2 = self.alone_rad2.copy()
        variance_rad2[self.order] += self.lent[self.order] ** 2 * alike
        return variance_rad2

    def between(self, right: sparse.csr_array) -> Floats:
        """Return Rᵀ G R (k, k) for a matrix R (lines, k) whose columns hold few lines each.

        Some lines after the other: what neighbours share fades, so that few columns take part at a time.
        """
        right = right[self.order]
        total = np.zeros((right.shape[1],) * 2)
        carried, largest = np.zeros(right.shape[1]), np.zeros(right.shape[1])
        tie = 0.0
        for first in range(0, right.shape[0], CHUNK_LINES):
            lines = slice(first, first + CHUNK_LINES)
            place = self.order[lines]
            part = right[lines]
            taking_part = np.abs(carried) > FADED * largest
            taking_part[part.indices] = True
            used = np.flatnonzero(taking_part)
            here = part.toarray()[:, used]
            alike = self.lent[place, None] * here
            alike[0] -= tie * carried[used]
            alike = linalg.solve_banded((1, 0), self.root[:, lines], alike, check_finite=False)
            carried[:] = 0.0
            carried[used] = alike[-1]
            largest[used] = np.maximum(largest[used], np.abs(alike).max(axis=0))
            tie = self.root[1, lines][-1]
            whole = np.concatenate([alike, np.sqrt(self.alone_rad2[place, None]) * here])
            total[np.ix_(used, used)] += whole.T @ whole
        return total
