"""Process noise of a class of cells, learned from its series, and what the filter makes of shared errors.

A class is cells of like ground and like noise. A fixed sample of its cells is filtered with each candidate of
the process noise; the likeliest so far is used for the next scan, so that a series gives the same result live
and reprocessed. What the class does as a whole is its course.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from station.quantities import Bools, Floats
from station.science.time_series.cell_filter import (
    LevelRate,
    Motion,
    ProcessNoise,
    contradicts,
    first_estimate,
    predict,
    shifted,
    step_estimate,
    update,
)
from station.science.time_series.class_course import ClassCourse
from station.science.time_series.error_shares import LEVEL, RATE, ErrorShares
from station.science.time_series.noise_candidates import NoiseCandidates

LEVEL_NOISES_M2_D = (1e-9, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
STABLE_RATE_NOISES_M2_D3 = (1e-9, 1e-7, 1e-6, 1e-5)
MOVING_RATE_NOISES_M2_D3 = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # relative to the class
SAMPLE_CELLS = 300  # per class
MEDIAN_CHI2 = 0.4549  # of the square of a standard normal variable
MOVED_EXCESS = 2.0  # times the expected median of 100 squares of innovations: four sigma
PATCH_SHARE = 0.25  # of what a class does, that a patch does more or less; one sigma, before it is known
TINY_M2_D2 = 1e-12  # against division by zero
SYSTEMATIC_SIGMAS = 3.0  # what the error that a scan's cells share may be, before the ground has moved


class ClassFilter:
    """Process noise and error shares of a class, from a sample (n,) of its cells in order of time.

    `stable` is for classes of stable ground, whose rate hardly changes.
    """

    def __init__(self, sample_count: int, *, stable: bool = False) -> None:
        self.is_stable = stable
        rate_noises = STABLE_RATE_NOISES_M2_D3 if stable else MOVING_RATE_NOISES_M2_D3
        self._candidates = NoiseCandidates(LEVEL_NOISES_M2_D, rate_noises, 0)
        empty = np.full((len(self._candidates), sample_count), np.nan)
        self._states = LevelRate(empty, empty, empty, empty, empty)
        self._outlier_m = empty
        self._used = self._candidates.best
        self.course = ClassCourse(stable=stable)
        self._surges = np.zeros(3)  # of the day: gained at once [m], scatter [m], its square [m²]
        self.shares: ErrorShares | None = None  # None before the first scan with a cell of the sample

    def to_arrays(self) -> dict[str, Floats]:
        """Return everything that the next scan is filtered with, by name."""
        return {
            "states": np.stack(list(vars(self._states).values())),
            "outlier_m": self._outlier_m,
            "noise": np.append(self._candidates.to_array(), self._used),
            "shares": ErrorShares.to_array(self.shares),
            "surges": self._surges,
        } | self.course.to_arrays()

    def restore(self, arrays: Mapping[str, Floats]) -> None:
        """Continue from what `to_arrays` returned."""
        self._states = LevelRate(*arrays["states"])
        self._outlier_m = arrays["outlier_m"]
        self._candidates.restore(arrays["noise"][:-1])
        self._used = int(arrays["noise"][-1])
        self.shares = ErrorShares.from_array(arrays["shares"])
        self._surges = arrays["surges"]
        self.course.restore(arrays)

    @property
    def learned(self) -> ProcessNoise:
        """The likeliest process noise so far; both are numbers."""
        return self._candidates.likeliest

    def begin_day(self) -> None:
        """Let the day begin whose rates are given."""
        self._surges = np.zeros(3)
        if self.shares is not None:
            self.shares = self.shares.begun()
        self.course.begin_day()

    @property
    def missing_rate(self) -> tuple[float, float]:
        """What the filtered rates lack of the mean rate of the day [m/d], and its variance [m²/d²].

        It is the height that the class gained at once, as by snowfall. What the cells lag behind its course
        is in the variance. Snow that drifts lies in the same places all day. A lag differs from cell to cell
        by as much as it is, and the course itself may lag by as much. Source: equations.md, 6.12.
        """
        lag_m_d = self._lag_m_d(self.course.mean_rate_m_d)
        if self.shares is None or not self.shares.elapsed_d:
            return 0.0, 2 * lag_m_d**2
        height_m, scatter_m, scatter_m2 = self._surges.tolist()
        elapsed_d = self.shares.elapsed_d
        return height_m / elapsed_d, (scatter_m**2 - scatter_m2) / elapsed_d**2 + 2 * lag_m_d**2

    @property
    def weight_of_difference(self) -> float:
        """The weight of the difference of levels in the rate of a day; that of the filtered rate is the rest.

        It is that with the smallest variance, between 0 and 1; of stable ground, without that of the process.
        Source: equations.md, 6.12.
        """
        if self.shares is None or not self.shares.elapsed_d:
            return 0.0
        shares = self.shares
        counted = shares.total - shares.process if self.is_stable else shares.total
        (filtered, covariance), (_, difference) = shares.rate_variances(counted + shares.patches)
        filtered += self.missing_rate[1]
        disagreement = max(filtered + difference - 2 * covariance, TINY_M2_D2)
        return float(np.clip((filtered - covariance) / disagreement, 0.0, 1.0))

    def _lag_m_d(self, mean_rate_m_d: float) -> float:
        """Return what the rates of the cells lack of the mean rate of the class; 0 if that is not known."""
        rate_m_d = self._states.rate_m_d[self._candidates.best]
        known = np.isfinite(rate_m_d)
        return mean_rate_m_d - float(np.median(rate_m_d[known])) if mean_rate_m_d and known.any() else 0.0

    def advance(
        self, days: float, change_m: Floats, random_m2: Floats, systematic_m2: Floats
    ) -> tuple[ProcessNoise, Motion]:
        """Take the next scan of the sample (n,), NaN where it has none; return noise and motion up to it.

        The noise is what was learned before, and more if the cells have scattered further: drifting snow.
        What the scan tells about it applies from the next one on.
        """
        noise, before_m = self._noise(days), self._states.level_m[self._candidates.best]
        observed = np.isfinite(change_m) & np.isfinite(random_m2 + systematic_m2)
        motion = self._motion(days, observed, change_m, random_m2, systematic_m2)
        further, patch_m2 = self._further_in_a_patch(motion), 0.0
        if self.shares is not None and days > 0:
            patch_m2 = self.shares.patch_growth(days, further)
            noise = replace(noise, level_m2_d=noise.level_m2_d + patch_m2 / days)
        change_m, variance_m2 = change_m - motion.common_error_m, random_m2 + systematic_m2
        noises = ProcessNoise(*(noise[:, None] for noise in vars(self._candidates.all).values()))
        states = shifted(predict(self._states, days, noises), motion)
        states = replace(states, level_m2=states.level_m2 + patch_m2)
        known = observed & np.isfinite(states.level_m[0])
        innovation_m = (change_m - states.level_m)[:, known]
        expected_m2 = (states.level_m2 + variance_m2)[:, known]
        scatter_m2 = 0.0
        if known.any():
            best, more = self._candidates.best, SYSTEMATIC_SIGMAS**2 - 1
            allowed_m2 = expected_m2[best] + more * systematic_m2[known]
            excess = np.median(innovation_m[best] ** 2 / allowed_m2) / MEDIAN_CHI2
            if excess > MOVED_EXCESS and days > 0:
                scatter_m2 = (excess - 1) * float(np.median(allowed_m2))
                noise = replace(noise, level_m2_d=noise.level_m2_d + scatter_m2 / days)
                states = replace(states, level_m2=states.level_m2 + scatter_m2)
            else:
                self._candidates.learn(days, innovation_m, expected_m2)
        self._surges += [motion.surge_m, np.sqrt(scatter_m2), scatter_m2]
        self._update(states, observed, np.where(observed, change_m, 0.0), variance_m2)
        moved_m = self._states.level_m[self._candidates.best] - before_m
        self.course.follow(moved_m[np.isfinite(moved_m)])
        shares = None if self.shares is None else self.shares.moved(days, noise, further)
        self._update_shares(shares, random_m2[observed], systematic_m2[observed])
        return noise, motion

    def _noise(self, days: float) -> ProcessNoise:
        """Return the learned noise; when it has become another one, with what its states are less certain."""
        noise, best = self.learned, self._candidates.best
        changed, self._used = best != self._used, best
        if not changed or self.is_stable or self.shares is None or days <= 0:
            return noise
        level_m2, rate_m2_d2 = self._states.level_m2[best], self._states.rate_m2_d2[best]
        known = np.isfinite(level_m2)
        more_m2 = float(np.median(level_m2[known])) - self.shares.total[LEVEL, LEVEL]
        more_m2_d2 = float(np.median(rate_m2_d2[known])) - self.shares.total[RATE, RATE]
        return ProcessNoise(
            noise.level_m2_d + max(more_m2, 0.0) / days, noise.rate_m2_d3 + max(more_m2_d2, 0.0) / days
        )

    def _further_in_a_patch(self, motion: Motion) -> Floats:
        """Return what a patch of cells did more than the class (2,), one sigma: level [m] and rate [m/d].

        It is a share of what cells did as their class because their own share is not known: snow falls in
        patches. Source: equations.md, 6.12.
        """
        if self.is_stable or self.shares is None:
            return np.zeros(2)
        uncertain = self.shares.total[RATE, RATE] + float(motion.lag_m_d) ** 2
        typical_m_d = float(motion.mean_rate_m_d) - float(motion.lag_m_d)
        share = PATCH_SHARE * np.sqrt(uncertain / (typical_m_d**2 + uncertain))
        return np.asarray(share * np.array([motion.anomaly_m + motion.surge_m, motion.faster_m_d]))

    def _motion(
        self, days: float, observed: Bools, change_m: Floats, random_m2: Floats, systematic_m2: Floats
    ) -> Motion:
        """Return what the class did, from the cells that were known before; all of them in the first scan."""
        level_m = self._states.level_m[self._candidates.best]
        is_first = self.course.shares is None
        chosen = observed if is_first else observed & np.isfinite(level_m)
        moved_m = np.zeros(np.count_nonzero(chosen)) if is_first else (change_m - level_m)[chosen]
        variances_m2 = (
            float(np.median(values[chosen])) if chosen.any() else 0.0 for values in (random_m2, systematic_m2)
        )
        motion = self.course.advance(days, moved_m, *variances_m2)
        return replace(motion, lag_m_d=self._lag_m_d(float(motion.mean_rate_m_d)))

    def _update_shares(self, shares: ErrorShares | None, random_m2: Floats, systematic_m2: Floats) -> None:
        if len(random_m2):
            variances_m2 = float(np.median(random_m2)), float(np.median(systematic_m2))
            shares = ErrorShares.first(*variances_m2) if shares is None else shares.updated(*variances_m2)
        self.shares = shares

    def _update(self, states: LevelRate, observed: Bools, change_m: Floats, variance_m2: Floats) -> None:
        """Update the states (candidates, n) with a scan, as those of other cells."""
        variance_m2 = np.where(observed, variance_m2, 1.0)
        is_outlier, is_step = contradicts(states, change_m, variance_m2, self._outlier_m)
        stepped = step_estimate(states, change_m, variance_m2, self._outlier_m)
        first = first_estimate(
            *(np.broadcast_to(values, states.level_m.shape) for values in (change_m, variance_m2))
        )
        choices = (
            (observed & ~is_outlier, update(states, change_m, variance_m2)),
            (observed & is_step, stepped),
            (observed & np.isnan(states.level_m), first),
        )
        masks = [mask for mask, _ in reversed(choices)]
        values = zip(
            vars(states).values(),
            *(vars(choice).values() for _, choice in reversed(choices)),
            strict=True,
        )
        self._states = LevelRate(*(np.select(masks, of, kept) for kept, *of in values))
        outlier_m = np.where(is_outlier & ~is_step, change_m, np.nan)
        self._outlier_m = np.where(observed, outlier_m, self._outlier_m)
