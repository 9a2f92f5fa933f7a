"""Process noise of a class of cells, learned from its series, and what the filter makes of shared errors.

A class is cells of like ground and like noise. A fixed sample of its cells is filtered with each candidate of
the process noise; the likeliest so far is used for the next scan, so that a series gives the same result live
and reprocessed. What the class does as a whole is its course.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from station.quantities import Bools, Floats
from station.science.time_series.cell_filter import (
    STEP_SIGMAS,
    LevelRate,
    Motion,
    ProcessNoise,
    first_estimate,
    predict,
    shifted,
    update,
)
from station.science.time_series.class_course import ClassCourse
from station.science.time_series.error_shares import ErrorShares

LEVEL_NOISES_M2_D = (1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3)
STABLE_RATE_NOISES_M2_D3 = (1e-9, 1e-7, 1e-6, 1e-5)
MOVING_RATE_NOISES_M2_D3 = (1e-6, 1e-5, 1e-4, 3e-4, 1e-3)  # relative to the class
MEMORY_D = 10.0  # after which the likelihood of a scan has lost 63 % of its weight
SAMPLE_CELLS = 300  # per class
MEDIAN_CHI2 = 0.4549  # of the square of a standard normal variable
MOVED_EXCESS = 2.0  # times the expected median of 100 squares of innovations: four sigma
SYSTEMATIC_SIGMAS = 3.0  # what the error that a scan's cells share may be, before the ground has moved


class ClassFilter:
    """Process noise and error shares of a class, from a sample (n,) of its cells in order of time.

    `stable` is for classes of stable ground, whose rate hardly changes.
    """

    def __init__(self, sample_count: int, *, stable: bool = False) -> None:
        self.is_stable = stable
        rate_noises = STABLE_RATE_NOISES_M2_D3 if stable else MOVING_RATE_NOISES_M2_D3
        self._candidates = np.array(list(product(LEVEL_NOISES_M2_D, rate_noises))).T
        self._shape = self._candidates.shape[1], sample_count
        empty = np.full(self._shape, np.nan)
        self._states = LevelRate(empty, empty, empty, empty, empty)
        self._likelihood = np.zeros(self._shape[0])
        self._best = LEVEL_NOISES_M2_D.index(1e-5) * len(rate_noises)
        self.course = ClassCourse(stable=stable)
        self._surges = np.zeros((3, 0))  # of the last day: age [d], height [m], scatter of the cells [m²]
        self.shares: ErrorShares | None = None  # None before the first scan with a cell of the sample

    def to_arrays(self) -> dict[str, Floats]:
        """Return everything that the next scan is filtered with, by name."""
        return {
            "states": np.stack(list(vars(self._states).values())),
            "likelihood": self._likelihood,
            "best": np.array([self._best], np.float64),
            "shares": ErrorShares.to_array(self.shares),
            "surges": self._surges,
        } | self.course.to_arrays()

    def restore(self, arrays: Mapping[str, Floats]) -> None:
        """Continue from what `to_arrays` returned."""
        self._states = LevelRate(*arrays["states"])
        self._likelihood, self._best = arrays["likelihood"], int(arrays["best"][0])
        self.shares = ErrorShares.from_array(arrays["shares"])
        self._surges = arrays["surges"]
        self.course.restore(arrays)

    @property
    def learned(self) -> ProcessNoise:
        """The likeliest process noise so far; both are numbers."""
        return ProcessNoise(*self._candidates[:, self._best])

    @property
    def missing_rate(self) -> tuple[float, float]:
        """What the rates of the cells lack of the mean rate of the last day [m/d], and its variance [m²/d²].

        It is the height that the class gained at once, as by snowfall. What the cells lag behind its course
        is in the variance. Snow that drifts lies in the same places all day. A lag differs from cell to cell
        by as much as it is, and the course itself may lag by as much. Source: equations.md, 6.12.
        """
        _, height_m, scatter_m2 = self._surges
        lag_m_d = self._lag_m_d(self.course.mean_rate_m_d)
        return float(height_m.sum()), float(np.sqrt(scatter_m2).sum() ** 2) + 2 * lag_m_d**2

    def _lag_m_d(self, mean_rate_m_d: float) -> float:
        """Return what the rates of the cells lack of the mean rate of the class; 0 if that is not known."""
        rate_m_d = self._states.rate_m_d[self._best]
        known = np.isfinite(rate_m_d)
        return mean_rate_m_d - float(np.median(rate_m_d[known])) if mean_rate_m_d and known.any() else 0.0

    def advance(
        self, days: float, change_m: Floats, random_m2: Floats, systematic_m2: Floats
    ) -> tuple[ProcessNoise, Motion]:
        """Take the next scan of the sample (n,), NaN where it has none; return noise and motion up to it.

        The noise is what was learned before, and more if the cells have scattered further: drifting snow.
        What the scan tells about it applies from the next one on.
        """
        noise, before_m = self.learned, self._states.level_m[self._best]
        observed = np.isfinite(change_m) & np.isfinite(random_m2 + systematic_m2)
        motion = self._motion(days, observed, change_m, random_m2, systematic_m2)
        change_m, variance_m2 = change_m - motion.common_error_m, random_m2 + systematic_m2
        noises = ProcessNoise(*self._candidates[:, :, None])
        states = shifted(predict(self._states, days, noises), motion)
        known = observed & np.isfinite(states.level_m[0])
        innovation_m = (change_m - states.level_m)[:, known]
        expected_m2 = (states.level_m2 + variance_m2)[:, known]
        scatter_m2 = 0.0
        if known.any():
            allowed_m2 = expected_m2[self._best] + (SYSTEMATIC_SIGMAS**2 - 1) * systematic_m2[known]
            excess = np.median(innovation_m[self._best] ** 2 / allowed_m2) / MEDIAN_CHI2
            if excess > MOVED_EXCESS and days > 0:
                scatter_m2 = (excess - 1) * float(np.median(allowed_m2))
                noise = replace(noise, level_m2_d=noise.level_m2_d + scatter_m2 / days)
                states = replace(states, level_m2=states.level_m2 + scatter_m2)
            else:
                self._learn(days, innovation_m, expected_m2)
        aged = self._surges + np.array([[days], [0.0], [0.0]])
        self._surges = np.column_stack([aged[:, aged[0] < 1], [0.0, motion.surge_m, scatter_m2]])
        self._states = _updated(states, observed, np.where(observed, change_m, 0.0), variance_m2)
        moved_m = self._states.level_m[self._best] - before_m
        self.course.follow(moved_m[np.isfinite(moved_m)])
        self._move_shares(days, noise, random_m2[observed], systematic_m2[observed])
        return noise, motion

    def _motion(
        self, days: float, observed: Bools, change_m: Floats, random_m2: Floats, systematic_m2: Floats
    ) -> Motion:
        """Return what the class did, from the cells that were known before; all of them in the first scan."""
        level_m = self._states.level_m[self._best]
        is_first = self.course.shares is None
        chosen = observed if is_first else observed & np.isfinite(level_m)
        moved_m = np.zeros(np.count_nonzero(chosen)) if is_first else (change_m - level_m)[chosen]
        variances_m2 = (
            float(np.median(values[chosen])) if chosen.any() else 0.0 for values in (random_m2, systematic_m2)
        )
        motion = self.course.advance(days, moved_m, *variances_m2)
        return replace(motion, lag_m_d=self._lag_m_d(float(motion.mean_rate_m_d)))

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
