"""Systematic errors of blocks against what surrounds them, as the blocks themselves show them.

Source: equations.md, 6.11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from station.quantities import Bools, Floats, Ints

OUTLIER_SIGMAS = 3.0  # of a block that shows an event, and not the errors
ITERATIONS = 3
TINY = 1e-30


@dataclass(frozen=True)
class ContrastErrors:
    """Systematic errors of the observed blocks (n,) of a difference of scans, less those around them.

    A block has the Jacobian j - g, with j its row of `design` and g that row of `around` which `group` names.
    It has the tilt of its line group as well, which the surroundings average out.
    """

    observed: Bools  # (by, bx), n of them
    design: sparse.csr_array  # (n, p)
    around: Floats  # (g, p)
    group: Ints  # (n,)
    covariance: Floats  # (p, p) of the parameters
    line_effect: Floats  # (n,) per rad of line tilt
    line: Ints  # (n,) line group
    line_rad2: Floats  # (l,) variance of the tilt of each line group

    def estimate(self, excess_m: Floats, random_m2: Floats) -> tuple[Floats, Floats]:
        """Return the errors (by, bx) [m] and the variances of what is left of them [m²].

        `excess_m` (by, bx) is the change of blocks less that of their surroundings, NaN where not observed,
        `random_m2` the variance of all else in it. The stated covariance is the prior. Blocks that differ by
        more than 3 sigma are left out.
        """
        seen = np.isfinite(excess_m)[self.observed] & (random_m2[self.observed] > 0)
        excess_m = np.where(seen, excess_m[self.observed], 0.0)
        weights = np.where(seen, 1 / np.maximum(random_m2[self.observed], TINY), 0.0)
        line_m2 = self.line_effect**2 * self.line_rad2[self.line]
        beside_lines = weights / (1 + weights * line_m2)
        error_m = np.zeros(len(excess_m))
        for _ in range(ITERATIONS):
            fits = (excess_m - error_m) ** 2 * beside_lines < OUTLIER_SIGMAS**2
            shared_m, covariance = self._shared_errors(excess_m, np.where(fits, beside_lines, 0.0))
            tilt_m, tilt_m2 = self._line_errors(excess_m - shared_m, np.where(fits, weights, 0.0))
            error_m = shared_m + tilt_m
        return self._placed(error_m), self._placed(self._variance(covariance) + tilt_m2)

    def _shared_errors(self, excess_m: Floats, weights: Floats) -> tuple[Floats, Floats]:
        """Return the errors (n,) [m] by the parameters, from least squares with the prior.

        With the covariance (p, p) of the parameters that are left.
        """
        groups = sparse.csr_array(
            (weights, (self.group, np.arange(len(self.group)))), shape=(len(self.around), len(self.group))
        )
        weighted = np.asarray((groups @ self.design).toarray())
        cross = self.around.T @ weighted
        total = np.asarray(np.bincount(self.group, weights, len(self.around)), np.float64)
        normal = (self.design.T @ (self.design * weights[:, None])).toarray()
        normal = normal - cross - cross.T + self.around.T @ (total[:, None] * self.around)
        right = self.design.T @ (weights * excess_m) - self.around.T @ (groups @ excess_m)
        posterior = self.covariance @ np.linalg.inv(np.eye(len(normal)) + normal @ self.covariance)
        posterior = (posterior + posterior.T) / 2
        estimate = posterior @ right
        error_m = self.design @ estimate - (self.around @ estimate)[self.group]
        return error_m, posterior

    def _variance(self, covariance: Floats) -> Floats:
        """Return (j - g) C (j - g)ᵀ (n,) [m²], entry by entry of j: few of them are not zero."""
        weighted = self.around @ covariance
        variance_m2 = np.sum(weighted * self.around, axis=1)[self.group]
        columns, values = self._entries
        for i, (column, value) in enumerate(zip(columns, values, strict=True)):
            effect = value * covariance[column, column] - 2 * weighted[self.group, column]
            for other, other_value in zip(columns[:i], values[:i], strict=True):
                effect += 2 * other_value * covariance[column, other]
            variance_m2 += value * effect
        return np.asarray(np.maximum(variance_m2, 0.0))

    @property
    def _entries(self) -> tuple[Ints, Floats]:
        """Columns and values (k, n) of the entries of each row of the design; zeros where it has fewer."""
        start, count = self.design.indptr[:-1], np.diff(self.design.indptr)
        row = np.repeat(np.arange(len(count)), count)
        place = np.arange(self.design.nnz) - np.repeat(start, count), row
        columns = np.zeros((int(count.max(initial=0)), len(count)), np.int64)
        values = np.zeros(columns.shape)
        columns[place], values[place] = self.design.indices, self.design.data
        return columns, values

    def _line_errors(self, excess_m: Floats, weights: Floats) -> tuple[Floats, Floats]:
        """Return the errors (n,) [m] by the line tilts, from least squares with the prior, and variances."""
        lines = len(self.line_rad2)
        known = np.bincount(self.line, weights * self.line_effect**2, lines)
        posterior_rad2 = self.line_rad2 / (1 + known * self.line_rad2)
        tilt_rad = posterior_rad2 * np.bincount(self.line, weights * self.line_effect * excess_m, lines)
        return self.line_effect * tilt_rad[self.line], self.line_effect**2 * posterior_rad2[self.line]

    def _placed(self, values: Floats) -> Floats:
        placed = np.zeros(self.observed.shape)
        placed[self.observed] = values
        return placed
