"""What a filter of level and rate makes of random errors, of those that a scan's cells share, and of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S
from station.science.time_series.cell_filter import ProcessNoise, first_estimate

CORRELATION_D = REFRACTION_CORRELATION_S / 86_400
LEVEL, RATE, BEGIN, MOVED = range(4)  # rows of the matrices


@dataclass(frozen=True)
class ErrorShares:
    """Covariance matrices (4, 4) of errors in a cell that every scan observes.

    The rows are level [m], rate [m/d], the level at the begin of the day [m], and how much further than its
    rate tells the surface moved since [m]. `systematic` and `cross` (4,), its covariance with the present
    error, are for a systematic error of 1 m. `patch` (4,) are the errors of cells in a patch that does one
    sigma more than its class; the process contains them. `elapsed_d` is the time since the begin of the day.
    """

    total: Floats
    random: Floats
    process: Floats
    systematic: Floats
    cross: Floats
    patch: Floats
    elapsed_d: float

    @classmethod
    def first(cls, random_m2: float, systematic_m2: float) -> ErrorShares:
        """Return the matrices after the first scan, with which the day begins."""
        first = first_estimate(np.zeros(1), np.full(1, random_m2 + systematic_m2))
        unit, rate = np.zeros((2, 4, 4))
        unit[LEVEL, LEVEL], rate[RATE, RATE] = 1.0, first.rate_m2_d2[0]
        total = first.level_m2[0] * unit + rate
        return cls(total, random_m2 * unit, rate, unit, unit[LEVEL], np.zeros(4), 0.0).begun()

    @staticmethod
    def to_array(shares: ErrorShares | None) -> Floats:
        """Return the matrices as one array; it is empty if there are none."""
        matrices = () if shares is None else tuple(vars(shares).values())
        return np.concatenate([np.ravel(matrix) for matrix in matrices] or [np.empty(0)])

    @classmethod
    def from_array(cls, values: Floats) -> ErrorShares | None:
        """Return the matrices in an array of `to_array`."""
        if not len(values):
            return None
        total, random, process, systematic = values[:64].reshape(4, 4, 4)
        cross, patch = values[64:72].reshape(2, 4)
        return cls(total, random, process, systematic, cross, patch, float(values[72]))

    def begun(self) -> ErrorShares:
        """Return the matrices at the begin of a day."""
        begin = np.zeros((4, 4))
        begin[LEVEL, LEVEL] = begin[RATE, RATE] = begin[BEGIN, LEVEL] = 1.0
        total, random, process, systematic = (
            begin @ matrix @ begin.T for matrix in (self.total, self.random, self.process, self.systematic)
        )
        return ErrorShares(total, random, process, systematic, begin @ self.cross, begin @ self.patch, 0.0)

    def patch_growth(self, days: float, further: Floats) -> float:
        """Return what the variance of the level gains in some days in which a patch went further [m²].

        That is `further` (2,), one sigma of level [m] and rate [m/d].
        """
        level_m = self.patch[LEVEL] + days * self.patch[RATE]
        return float(max((level_m - further[0]) ** 2 - level_m**2, 0.0))

    def moved(self, days: float, noise: ProcessNoise, further: Floats | None = None) -> ErrorShares:
        """Return the matrices some days later, without an observation; a patch went `further`, if given."""
        elapsed_d = self.elapsed_d + days
        step = np.eye(4)
        step[LEVEL, RATE] = days
        level, rate = float(noise.level_m2_d), float(noise.rate_m2_d3)
        wander = np.array([[level * days + rate * days**3 / 3, rate * days**2 / 2], [0, rate * days]])
        wander[1, 0] = wander[0, 1]
        effect = np.array([[-1.0, 0.0], [0.0, -1.0], [0.0, 0.0], [1.0, -elapsed_d]])
        wander = effect @ wander @ effect.T
        patch = step @ self.patch
        return ErrorShares(
            step @ self.total @ step.T + wander,
            step @ self.random @ step.T,
            step @ self.process @ step.T + wander,
            step @ self.systematic @ step.T,
            step @ self.cross * np.exp(-days / CORRELATION_D),
            patch if further is None else patch + effect @ further,
            elapsed_d,
        )

    def updated(self, random_m2: float, systematic_m2: float) -> ErrorShares:
        """Return the matrices after an observation.

        Source: equations.md, 6.12.
        """
        variance_m2 = random_m2 + systematic_m2
        gain = np.zeros((4, 1))
        gain[: RATE + 1, 0] = self.total[: RATE + 1, LEVEL] / (self.total[LEVEL, LEVEL] + variance_m2)
        return self._corrected(gain, random_m2, systematic_m2)

    def replaced(self, random_m2: float, systematic_m2: float) -> ErrorShares:
        """Return the matrices after an observation that the level is set to."""
        return self._corrected(np.eye(4)[:, :1], random_m2, systematic_m2)

    def _corrected(self, gain: Floats, random_m2: float, systematic_m2: float) -> ErrorShares:
        kept = np.eye(4)
        kept[:, :1] -= gain
        shared = kept @ self.cross[:, None] @ gain.T
        squared = gain @ gain.T
        return ErrorShares(
            kept @ self.total @ kept.T + squared * (random_m2 + systematic_m2),
            kept @ self.random @ kept.T + squared * random_m2,
            kept @ self.process @ kept.T,
            kept @ self.systematic @ kept.T + shared + shared.T + squared,
            kept @ self.cross + gain[:, 0],
            kept @ self.patch,
            self.elapsed_d,
        )

    @property
    def patches(self) -> Floats:
        """Covariance of the errors that the cells of a patch have in common."""
        return np.outer(self.patch, self.patch)

    def rate_variances(self, matrix: Floats) -> Floats:
        """Return the covariance (2, 2) of the errors of two estimates of the mean rate of the day [m²/d²].

        They are the filtered rate, and the difference of the levels over the time between them. The part of
        their errors is that of a matrix of the shares.

        Source: equations.md, 6.12.
        """
        weights = np.zeros((2, 4))
        weights[0, RATE] = 1.0
        if self.elapsed_d > 0:
            weights[0, MOVED] = -1 / self.elapsed_d
            weights[1, LEVEL], weights[1, BEGIN] = 1 / self.elapsed_d, -1 / self.elapsed_d
        return np.asarray(weights @ matrix @ weights.T)
