"""What a filter of level and rate makes of random errors, of those that a scan's cells share, and of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S
from station.science.time_series.cell_filter import ProcessNoise, first_estimate

CORRELATION_D = REFRACTION_CORRELATION_S / 86_400


@dataclass(frozen=True)
class ErrorShares:
    """Covariance matrices (2, 2) of level and rate [m, m/d] of a cell that every scan observes.

    `systematic` and `cross` (2,), its covariance with the present error, are for a systematic error of 1 m.
    """

    total: Floats
    random: Floats
    process: Floats
    systematic: Floats
    cross: Floats

    @classmethod
    def first(cls, random_m2: float, systematic_m2: float) -> ErrorShares:
        """Return the matrices after the first scan."""
        first = first_estimate(np.zeros(1), np.full(1, random_m2 + systematic_m2))
        unit = np.diag([1.0, 0.0])
        rate = np.diag([0.0, first.rate_m2_d2[0]])
        total = np.diag([first.level_m2[0], first.rate_m2_d2[0]])
        return cls(total, unit * random_m2, rate, unit, np.array([1.0, 0.0]))

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
        total, random, process, systematic = values[:16].reshape(4, 2, 2)
        return cls(total, random, process, systematic, values[16:])

    def moved(self, days: float, noise: ProcessNoise) -> ErrorShares:
        """Return the matrices some days later, without an observation."""
        step = np.array([[1.0, days], [0.0, 1.0]])
        level, rate = float(noise.level_m2_d), float(noise.rate_m2_d3)
        wander = np.array([[level * days + rate * days**3 / 3, rate * days**2 / 2], [0, rate * days]])
        wander[1, 0] = wander[0, 1]
        return ErrorShares(
            step @ self.total @ step.T + wander,
            step @ self.random @ step.T,
            step @ self.process @ step.T + wander,
            step @ self.systematic @ step.T,
            step @ self.cross * np.exp(-days / CORRELATION_D),
        )

    def updated(self, random_m2: float, systematic_m2: float) -> ErrorShares:
        """Return the matrices after an observation.

        Source: equations.md, 6.12.
        """
        gain = self.total[:, :1] / (self.total[0, 0] + random_m2 + systematic_m2)
        kept = np.eye(2) - gain @ np.array([[1.0, 0.0]])
        shared = kept @ self.cross[:, None] @ gain.T
        return ErrorShares(
            kept @ self.total,
            kept @ self.random @ kept.T + gain @ gain.T * random_m2,
            kept @ self.process @ kept.T,
            kept @ self.systematic @ kept.T + shared + shared.T + gain @ gain.T,
            kept @ self.cross + gain[:, 0],
        )
