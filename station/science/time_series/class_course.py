"""The course of a class of cells: how its ground moves from scan to scan, such as melt by day only.

It is known far better than the motion of a cell, so it is followed within the hour, and the cells are
filtered relative to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from station.quantities import Floats
from station.science.time_series.cell_filter import (
    STEP_SIGMAS,
    LevelRate,
    Motion,
    first_estimate,
    predict,
    update,
)
from station.science.time_series.error_shares import LEVEL, ErrorShares
from station.science.time_series.noise_candidates import NoiseCandidates

LEVEL_NOISES_M2_D = (1e-9, 1e-6, 1e-5, 1e-4)
STABLE_RATE_NOISES_M2_D3 = (1e-9, 1e-7)
MOVING_RATE_NOISES_M2_D3 = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # the sun may let melt begin within hours
LEAST_CELLS = 20  # of a class, for its course
LEAST_SCANS, LEAST_SPAN_D = 6, 0.25  # within a day, for a daily wave
MEDIAN_VARIANCE = np.pi / 2  # of the median over that of the mean, for normal errors


@dataclass(frozen=True)
class CourseErrors:
    """Variances of the level [m²] or mean rate [m²/d²] of a class: what it did unseen, and measurement."""

    process: float
    random: float
    systematic: Floats  # at each cell (n,)


class ClassCourse:
    """Filter of the level of a class, from the median change of its cells since the last scan."""

    def __init__(self, *, stable: bool) -> None:
        self._has_wave = not stable
        rate_noises = STABLE_RATE_NOISES_M2_D3 if stable else MOVING_RATE_NOISES_M2_D3
        self._candidates = NoiseCandidates(LEVEL_NOISES_M2_D, rate_noises, len(rate_noises) // 2)
        unknown = np.zeros(len(self._candidates))
        self._states = first_estimate(unknown, unknown)
        self._day = np.zeros((2, 1))  # times [d] before now, and levels [m], of the last day and before it
        self.mean_rate_m_d = 0.0  # over the last day; 0 if there is no daily wave
        self._ahead_m = 0.0  # of the levels of its cells, most of which have followed it
        self.shares: ErrorShares | None = None

    def to_arrays(self) -> dict[str, Floats]:
        """Return everything that the next scan is filtered with, by name."""
        return {
            "course_states": np.stack(list(vars(self._states).values())),
            "course_noise": self._candidates.to_array(),
            "course_scalars": np.array([self.mean_rate_m_d, self._ahead_m]),
            "course_day": self._day,
            "course_shares": ErrorShares.to_array(self.shares),
        }

    def restore(self, arrays: Mapping[str, Floats]) -> None:
        """Continue from what `to_arrays` returned."""
        self._states = LevelRate(*arrays["course_states"])
        self._candidates.restore(arrays["course_noise"])
        self.mean_rate_m_d, self._ahead_m = arrays["course_scalars"].tolist()
        self._day = arrays["course_day"]
        self.shares = ErrorShares.from_array(arrays["course_shares"])

    def advance(self, days: float, moved_m: Floats, random_m2: float, systematic_m2: float) -> Motion:
        """Take the changes (n,) of cells since the last scan, some days ago, and return what the class did.

        The variances are those of a cell in this scan. With too few cells the class goes on as before.
        """
        states = predict(self._states, days, self._candidates.all)
        shares, surge_m, common_error_m = self.shares, 0.0, 0.0
        if len(moved_m) >= LEAST_CELLS:
            median_m2 = MEDIAN_VARIANCE * random_m2 / len(moved_m)
            variance_m2 = np.full(len(self._candidates), median_m2 + systematic_m2)
            observed_m = np.full_like(variance_m2, np.median(moved_m) - self._ahead_m)
            innovation_m, expected_m2 = observed_m - states.level_m, states.level_m2 + variance_m2
            if shares is not None:
                self._candidates.learn(days, innovation_m[:, None], expected_m2[:, None])
                shares = shares.moved(days, self._candidates.likeliest)
            best = self._candidates.best
            if shares is None or innovation_m[best] ** 2 > STEP_SIGMAS**2 * expected_m2[best]:
                states = replace(
                    states, level_m=observed_m, level_m2=variance_m2, covariance_m2_d=0 * variance_m2
                )
                if shares is None:
                    shares = ErrorShares.first(median_m2, systematic_m2)
                else:
                    surge_m = float(innovation_m[best])
                    shares = shares.replaced(median_m2, systematic_m2)
            else:
                states = update(states, observed_m, variance_m2)
                common_error_m = float(observed_m[0] - states.level_m[best])
                shares = shares.updated(median_m2, systematic_m2)
        elif shares is not None:
            shares = shares.moved(days, self._candidates.likeliest)
        went_m = float(states.level_m[self._candidates.best])
        wave_m, mean_rate_m_d = self._remember(days, went_m, surge_m)
        before_m_d, rate_m_d = self.mean_rate_m_d, mean_rate_m_d
        motion = Motion(
            anomaly_m=wave_m,
            surge_m=surge_m,
            mean_rate_m_d=rate_m_d,
            faster_m_d=rate_m_d - before_m_d if before_m_d and rate_m_d else 0.0,
            common_error_m=common_error_m,
        )
        self._ahead_m += went_m
        self._states = replace(states, level_m=states.level_m - went_m)
        self.mean_rate_m_d, self.shares = rate_m_d, shares
        return motion

    def follow(self, moved_m: Floats) -> None:
        """Note how the levels of the cells (n,) moved with the scan that was taken last [m]."""
        if len(moved_m):
            self._ahead_m -= float(np.median(moved_m))

    def _remember(self, days: float, went_m: float, surge_m: float) -> tuple[float, float]:
        """Return the daily wave since the last scan [m], and the mean rate of the last day [m/d].

        The wave is the level less its mean over the last day; on the first day, less the line to its start.
        Both are 0 at the beginning, with few scans in a day, and of stable ground.
        """
        before_m = self._mean_of_day()
        age_d, level_m = self._day
        level_m = np.append(level_m + surge_m, level_m[-1] + went_m)
        age_d = np.append(age_d + days, 0.0)
        first = max(int(np.searchsorted(-age_d, -1.0, side="right")) - 1, 0)  # the last one before the day
        self._day = age_d, level_m = np.stack([age_d[first:], level_m[first:]])
        wave_m = went_m - (self._mean_of_day() - before_m)  # a surge moves both
        span_d = min(float(age_d[0]), 1.0)
        if not self._has_wave or len(age_d) < LEAST_SCANS or span_d < LEAST_SPAN_D:
            return 0.0, 0.0
        rate_m_d = float(level_m[-1] - np.interp(-span_d, -age_d, level_m)) / span_d
        return wave_m if age_d[0] >= 1 else went_m - surge_m - rate_m_d * days, rate_m_d

    def _mean_of_day(self) -> float:
        """Return the mean level of the last day [m], or of the time since the first scan."""
        age_d, level_m = self._day
        span_d = min(float(age_d[0]), 1.0)
        if span_d <= 0:
            return float(level_m[-1])
        inside = age_d < span_d
        time_d = np.concatenate([[-span_d], -age_d[inside]])
        levels_m = np.concatenate([[np.interp(-span_d, -age_d, level_m)], level_m[inside]])
        return float(np.trapezoid(levels_m, time_d)) / span_d

    def begin_day(self) -> None:
        """Let the day begin whose rates are given."""
        if self.shares is not None:
            self.shares = self.shares.begun()

    def level_errors(self, systematic_m2: Floats) -> CourseErrors:
        """Return the variances of the level of the class, at cells (n,) of it.

        `systematic_m2` is that of a scan at these cells.
        """
        if self.shares is None:
            return CourseErrors(0.0, 0.0, np.zeros_like(systematic_m2))
        process, random, systematic = (
            float(matrix[LEVEL, LEVEL])
            for matrix in (self.shares.process, self.shares.random, self.shares.systematic)
        )
        return CourseErrors(process, random, systematic * systematic_m2)

    def rate_errors(self, systematic_m2: Floats) -> CourseErrors:
        """Return the variances of the mean rate of the class since the day began, at cells (n,) of it.

        It is the difference of two levels. On stable ground the rates of the cells do not follow the course.
        """
        if self.shares is None or not self._has_wave:
            return CourseErrors(0.0, 0.0, np.zeros_like(systematic_m2))
        process, random, systematic = (
            float(self.shares.rate_variances(matrix)[1, 1])
            for matrix in (self.shares.process, self.shares.random, self.shares.systematic)
        )
        return CourseErrors(process, random, systematic * systematic_m2)
