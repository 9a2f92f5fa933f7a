"""Level and rate of the change of each cell, updated with each scan: a Kalman filter with detection of steps.

The surface is a level that moves with a rate; both wander by the process noise of the cell's class. What the
filter does with errors of measurement that a scan's cells share is propagated in `class_filter`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.quantities import Bools, Floats

INITIAL_RATE_M_D = 0.1  # one sigma of the rate before the second scan: fast melt
STEP_SIGMAS = 4.5  # an innovation beyond is an outlier, and a step once the next scan confirms it
CONFIRMED_SIGMAS = 3.0  # the largest difference of two scans after a step
MAX_CORRELATION = 0.999  # below 1 after rounding to half precision
MAX_UNSEEN_MIN = 65_535
MAX_SHARE = 2.0  # of the daily wave of the class, in a cell

CELL_DTYPE = np.dtype(  # 20 bytes per cell
    [
        ("level_m", "f4"),
        ("rate_m_d", "f4"),
        ("level_sigma_m", "f2"),
        ("rate_sigma_m_d", "f2"),
        ("correlation", "f2"),  # of the errors of level and rate
        ("unseen_min", "u2"),  # since the last scan in which the cell was seen
        ("random_sigma_m", "f2"),  # of the cell in that scan
        ("systematic_sigma_m", "f2"),
    ]
)


@dataclass(frozen=True)
class LevelRate:
    """Estimates of level [m] and rate [m/d] with their covariance; arrays of any one shape."""

    level_m: Floats
    rate_m_d: Floats
    level_m2: Floats
    covariance_m2_d: Floats
    rate_m2_d2: Floats

    def take(self, index: Bools) -> LevelRate:
        """Return the estimates of some cells."""
        return LevelRate(*(values[index] for values in vars(self).values()))


@dataclass(frozen=True)
class ProcessNoise:
    """Variance that the surface gains per day: of its level [m²/d] and of its rate [m²/d³]."""

    level_m2_d: Floats
    rate_m2_d3: Floats


@dataclass(frozen=True)
class Motion:
    """What the class of cells did since the last scan [m]; numbers, or arrays (n,) of cells."""

    anomaly_m: Floats | float = 0.0  # in excess of its mean rate: the daily wave
    surge_m: Floats | float = 0.0  # all at once, such as snowfall
    mean_rate_m_d: Floats | float = 0.0  # over the last day
    faster_m_d: Floats | float = 0.0  # change of the mean rate
    common_error_m: Floats | float = 0.0  # of the scan, in all cells of the class
    lag_m_d: Floats | float = 0.0  # of the rates of its cells behind its own mean rate


def first_estimate(change_m: Floats, variance_m2: Floats) -> LevelRate:
    """Return level and rate after the first observation of a cell."""
    zero = np.zeros_like(change_m)
    return LevelRate(change_m, zero, variance_m2, zero, np.full_like(change_m, INITIAL_RATE_M_D**2))


def predict(state: LevelRate, days: float, noise: ProcessNoise) -> LevelRate:
    """Return level and rate some days later. Source: equations.md, 6.12."""
    wander = noise.rate_m2_d3 * days
    return LevelRate(
        state.level_m + state.rate_m_d * days,
        state.rate_m_d,
        state.level_m2
        + days * (2 * state.covariance_m2_d + days * state.rate_m2_d2)
        + days * (noise.level_m2_d + wander * days / 3),
        state.covariance_m2_d + days * (state.rate_m2_d2 + wander / 2),
        state.rate_m2_d2 + wander,
    )


def shifted(state: LevelRate, motion: Motion) -> LevelRate:
    """Return the state after what the class did: the cell has as much of its daily wave as of its mean rate.

    Where the class moves more slowly than the rate of the cell is uncertain, or otherwise than its cells did
    so far, as when snow begins to fall, the cell moves as the class. Source: equations.md, 6.12.
    """
    uncertain = state.rate_m2_d2 + motion.lag_m_d**2
    typical_m_d = motion.mean_rate_m_d - motion.lag_m_d
    with np.errstate(invalid="ignore"):
        share = (typical_m_d * state.rate_m_d + uncertain) / (typical_m_d**2 + uncertain)
    share = np.clip(share, 0.0, MAX_SHARE)
    return replace(
        state,
        level_m=state.level_m + share * motion.anomaly_m + motion.surge_m,
        rate_m_d=state.rate_m_d + share * motion.faster_m_d,
    )


def update(state: LevelRate, change_m: Floats, variance_m2: Floats) -> LevelRate:
    """Return level and rate after an observation of the level with its variance.

    Source: equations.md, 6.12.
    """
    innovation_m = change_m - state.level_m
    innovation_m2 = state.level_m2 + variance_m2
    gain = state.level_m2 / innovation_m2
    rate_gain_d = state.covariance_m2_d / innovation_m2
    return LevelRate(
        state.level_m + gain * innovation_m,
        state.rate_m_d + rate_gain_d * innovation_m,
        variance_m2 * gain,  # never negative, unlike the difference
        variance_m2 * rate_gain_d,
        state.rate_m2_d2 - rate_gain_d * state.covariance_m2_d,
    )


def contradicts(
    state: LevelRate, change_m: Floats, variance_m2: Floats, outlier_m: Floats
) -> tuple[Bools, Bools]:
    """Return where an observation contradicts the level, and where it confirms the outlier before as a step.

    `outlier_m` is the observation before where that contradicted the level, else NaN.

    Source: equations.md, 6.12.
    """
    innovation_m = change_m - state.level_m
    with np.errstate(invalid="ignore"):
        is_outlier = innovation_m**2 > STEP_SIGMAS**2 * (state.level_m2 + variance_m2)
        is_step = is_outlier & ((change_m - outlier_m) ** 2 < CONFIRMED_SIGMAS**2 * 2 * variance_m2)
        is_step &= np.sign(outlier_m - state.level_m) == np.sign(innovation_m)
    return np.asarray(is_outlier), np.asarray(is_step)


def step_estimate(state: LevelRate, change_m: Floats, variance_m2: Floats, outlier_m: Floats) -> LevelRate:
    """Return level and rate after a step that two observations of like variance show."""
    mean_m = (change_m + outlier_m) / 2
    return replace(state, level_m=mean_m, level_m2=variance_m2 / 2, covariance_m2_d=np.zeros_like(mean_m))


class CellFilter:
    """Level and rate of cells (n,), of which a scan observes some.

    `cells` is the state, 20 bytes per cell, with NaN levels where a cell was never seen. `outlier_m` is the
    last observation of the cells where it contradicted the level, else NaN: only few cells have one.
    `begin_m` is the level at the begin of the day, and the steps since; NaN in cells that were first seen
    later. All are changed in place.
    """

    def __init__(
        self, cells: NDArray[np.void], outlier_m: NDArray[np.float32], begin_m: NDArray[np.float32]
    ) -> None:
        self.cells, self.outlier_m, self.begin_m = cells, outlier_m, begin_m

    @classmethod
    def empty(cls, count: int) -> CellFilter:
        """Return the filter of cells that were never seen."""
        cells = np.zeros(count, CELL_DTYPE)
        cells["level_m"] = np.nan
        return cls(cells, *np.full((2, count), np.nan, np.float32))

    def begin_day(self) -> None:
        """Let the day begin of which `moved_m` tells."""
        self.begin_m[:] = self.cells["level_m"]

    @property
    def moved_m(self) -> Floats:
        """How far each cell (n,) moved since the day began, without steps [m]; NaN if that is not known."""
        return np.asarray(self.cells["level_m"].astype(np.float64) - self.begin_m)

    def estimates(self) -> LevelRate:
        """Return level and rate of the cells (n,)."""
        level_m, rate_m_d, level_sigma_m, rate_sigma_m_d = (
            self.cells[name].astype(np.float64)
            for name in ("level_m", "rate_m_d", "level_sigma_m", "rate_sigma_m_d")
        )
        covariance_m2_d = self.cells["correlation"] * level_sigma_m * rate_sigma_m_d
        return LevelRate(level_m, rate_m_d, level_sigma_m**2, covariance_m2_d, rate_sigma_m_d**2)

    @property
    def unseen_d(self) -> Floats:
        """Time since each cell (n,) was last seen [d]."""
        return np.asarray(self.cells["unseen_min"] / 1440)

    def last_variances(self) -> tuple[Floats, Floats]:
        """Return random and systematic variance (n,) of the last observation of each cell [m²]."""
        random_m, systematic_m = (
            self.cells[name].astype(np.float64) for name in ("random_sigma_m", "systematic_sigma_m")
        )
        return random_m**2, systematic_m**2

    def advance(
        self,
        days: float,
        noise: ProcessNoise,
        motion: Motion,
        change_m: Floats,
        random_m2: Floats,
        systematic_m2: Floats,
    ) -> Bools:
        """Take the next scan, some days after the last one, and return the cells where a step is confirmed.

        Change and its variances (n,) are NaN where the scan has none. An observation beyond `STEP_SIGMAS` is
        left out. If the next one contradicts the level too and agrees with it, the level becomes the mean of
        both and forgets what was before. Raises ValueError if the scan is not later than the last one.
        """
        if days < 0:
            raise ValueError(f"a scan {-days:g} d before the last one: scans must be in order of time")
        state = shifted(predict(self.estimates(), days, noise), motion)
        change_m = change_m - motion.common_error_m
        variance_m2 = random_m2 + systematic_m2
        observed = np.isfinite(change_m) & np.isfinite(variance_m2)
        is_first = observed & np.isnan(state.level_m)
        before_m = self.outlier_m.astype(np.float64)
        is_outlier, is_step = contradicts(state, change_m, variance_m2, before_m)
        usual = update(state, change_m, variance_m2)
        stepped = step_estimate(state, change_m, variance_m2, before_m)
        choices = (
            (observed & ~is_outlier, usual),
            (is_step, stepped),
            (is_first, first_estimate(change_m, variance_m2)),
        )
        self._store(state, choices)
        self.begin_m[is_step] += (stepped.level_m - state.level_m)[is_step]
        unseen_min = self.cells["unseen_min"] + days * 1440
        self.cells["unseen_min"] = np.where(observed, 0, np.minimum(np.rint(unseen_min), MAX_UNSEEN_MIN))
        for name, last_m2 in (("random_sigma_m", random_m2), ("systematic_sigma_m", systematic_m2)):
            self.cells[name] = np.where(observed, np.sqrt(last_m2), self.cells[name])
        outlier_m = np.where(is_outlier & ~is_step, change_m, np.nan)
        np.copyto(self.outlier_m, outlier_m, where=observed, casting="same_kind")
        return np.asarray(is_step)

    def _store(self, state: LevelRate, choices: tuple[tuple[Bools, LevelRate], ...]) -> None:
        """Store the state, and instead of it each choice where its mask is set."""

        def chosen(name: str) -> NDArray[Any]:
            values = np.array(getattr(state, name))
            for mask, choice in choices:
                np.copyto(values, getattr(choice, name), where=mask)
            return values

        level_sigma_m, rate_sigma_m_d = np.sqrt(chosen("level_m2")), np.sqrt(chosen("rate_m2_d2"))
        with np.errstate(invalid="ignore", divide="ignore"):
            correlation = chosen("covariance_m2_d") / (level_sigma_m * rate_sigma_m_d)
        self.cells["level_m"] = chosen("level_m")
        self.cells["rate_m_d"] = chosen("rate_m_d")
        self.cells["level_sigma_m"] = level_sigma_m
        self.cells["rate_sigma_m_d"] = rate_sigma_m_d
        self.cells["correlation"] = np.clip(np.nan_to_num(correlation), -MAX_CORRELATION, MAX_CORRELATION)
