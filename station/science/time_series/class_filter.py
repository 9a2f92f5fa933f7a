"""Process noise of a class of cells, learned from its series, and what the filter makes of shared errors.

A class is cells of like ground and like noise. A fixed sample of its cells is filtered with each candidate of
the process noise; the likeliest so far is used for the next scan, so that a series gives the same result live
and reprocessed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from station.quantities import Bools, Floats
from station.science.gridding.reference_surface import REFRACTION_CORRELATION_S
from station.science.time_series.cell_filter import (
    STEP_SIGMAS,
    LevelRate,
    ProcessNoise,
    first_estimate,
    predict,
    update,
)

LEVEL_NOISES_M2_D = (1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3)
STABLE_RATE_NOISES_M2_D3 = (1e-9, 1e-7, 1e-6, 1e-5)
MOVING_RATE_NOISES_M2_D3 = (1e-4, 3e-4, 1e-3)  # quiet ice may melt or settle by 1 cm/d more within a day
MEMORY_D = 10.0  # after which the likelihood of a scan has lost 63 % of its weight
SAMPLE_CELLS = 100  # per class
MEDIAN_CHI2 = 0.4549  # of the square of a standard normal variable
MOVED_EXCESS = 2.0  # times the expected median of 100 squares of innovations: four sigma
SYSTEMATIC_SIGMAS = 3.0  # what the error that a scan's cells share may be, before the ground has moved
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


class ClassFilter:
    """Process noise and error shares of a class, from a sample (n,) of its cells in order of time.

    `stable` is for classes of stable ground, whose rate hardly changes.
    """

    def __init__(self, sample_count: int, *, stable: bool = False) -> None:
        rate_noises = STABLE_RATE_NOISES_M2_D3 if stable else MOVING_RATE_NOISES_M2_D3
        self._candidates = np.array(list(product(LEVEL_NOISES_M2_D, rate_noises))).T
        self._shape = self._candidates.shape[1], sample_count
        empty = np.full(self._shape, np.nan)
        self._states = LevelRate(empty, empty, empty, empty, empty)
        self._likelihood = np.zeros(self._shape[0])
        self._best = LEVEL_NOISES_M2_D.index(1e-5) * len(rate_noises)
        self.shares: ErrorShares | None = None  # None before the first scan with a cell of the sample

    def to_arrays(self) -> dict[str, Floats]:
        """Return everything that the next scan is filtered with, by name."""
        shares = () if self.shares is None else tuple(vars(self.shares).values())
        return {
            "states": np.stack(list(vars(self._states).values())),
            "likelihood": self._likelihood,
            "best": np.array([self._best], np.float64),
            "shares": np.concatenate([np.ravel(matrix) for matrix in shares] or [np.empty(0)]),
        }

    def restore(self, arrays: Mapping[str, Floats]) -> None:
        """Continue from what `to_arrays` returned."""
        self._states = LevelRate(*arrays["states"])
        self._likelihood, self._best = arrays["likelihood"], int(arrays["best"][0])
        self.shares = None
        if len(shares := arrays["shares"]):
            total, random, process, systematic = shares[:16].reshape(4, 2, 2)
            self.shares = ErrorShares(total, random, process, systematic, shares[16:])

    @property
    def learned(self) -> ProcessNoise:
        """The likeliest process noise so far; both are numbers."""
        return ProcessNoise(*self._candidates[:, self._best])

    def advance(
        self, days: float, change_m: Floats, random_m2: Floats, systematic_m2: Floats
    ) -> ProcessNoise:
        """Take the next scan of the sample (n,), NaN where it has none, and return the noise up to it.

        It is what was learned before, and more if the whole class has moved further: snowfall. What the scan
        tells about the noise applies from the next one on.
        """
        noise = self.learned
        variance_m2 = random_m2 + systematic_m2
        observed = np.isfinite(change_m) & np.isfinite(variance_m2)
        noises = ProcessNoise(*self._candidates[:, :, None])
        states = predict(self._states, days, noises)
        known = observed & np.isfinite(states.level_m[0])
        innovation_m = (change_m - states.level_m)[:, known]
        expected_m2 = (states.level_m2 + variance_m2)[:, known]
        if known.any():
            allowed_m2 = expected_m2[self._best] + (SYSTEMATIC_SIGMAS**2 - 1) * systematic_m2[known]
            excess = np.median(innovation_m[self._best] ** 2 / allowed_m2) / MEDIAN_CHI2
            surge_m2 = max(excess - 1, 0.0) * float(np.median(allowed_m2))
            if excess > MOVED_EXCESS and days > 0:
                noise = replace(noise, level_m2_d=noise.level_m2_d + surge_m2 / days)
                states = replace(states, level_m2=states.level_m2 + surge_m2)
            else:
                self._learn(days, innovation_m, expected_m2)
        self._states = _updated(states, observed, np.where(observed, change_m, 0.0), variance_m2)
        self._move_shares(days, noise, random_m2[observed], systematic_m2[observed])
        return noise

    def _learn(self, days: float, innovation_m: Floats, expected_m2: Floats) -> None:
        loss = np.minimum(innovation_m**2 / expected_m2, STEP_SIGMAS**2) + np.log(expected_m2)
        self._likelihood = self._likelihood * np.exp(-days / MEMORY_D) - loss.sum(axis=1) / 2
        self._best = int(np.argmax(self._likelihood))

    def _move_shares(
        self, days: float, noise: ProcessNoise, random_m2: Floats, systematic_m2: Floats
    ) -> None:
        shares = None if self.shares is None else self.shares.moved(days, noise)
        if len(random_m2):
            variances_m2 = float(np.median(random_m2)), float(np.median(systematic_m2))
            shares = ErrorShares.first(*variances_m2) if shares is None else shares.updated(*variances_m2)
        self.shares = shares


def _updated(states: LevelRate, observed: Bools, change_m: Floats, variance_m2: Floats) -> LevelRate:
    """Return the states (candidates, n) after a scan; outliers count as seen, but as much noisier."""
    variance_m2 = np.where(observed, variance_m2, 1.0)
    limit_m2 = STEP_SIGMAS**2 * (states.level_m2 + variance_m2)
    with np.errstate(invalid="ignore"):
        far = np.fmax((change_m - states.level_m) ** 2 / limit_m2, 1.0)
    later = update(states, change_m, variance_m2 * far)
    first = first_estimate(
        *(np.broadcast_to(values, states.level_m.shape) for values in (change_m, variance_m2))
    )
    is_first = observed & np.isnan(states.level_m)
    return LevelRate(
        *(
            np.where(is_first, begun, np.where(observed, seen, unseen))
            for begun, seen, unseen in zip(
                vars(first).values(), vars(later).values(), vars(states).values(), strict=True
            )
        )
    )
