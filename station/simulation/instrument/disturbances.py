"""Disturbances of the mount: gusts, steps that decay, a permanent tilt, a wave over the day, a random walk.

Each is a function of seconds since the start of the first scan, drawn hour by hour, so that a longer series
starts like a shorter one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats, Ints
from station.simulation.randomness import RandomFourierSeries, random_fourier, rng_for

HOUR_S, DAY_S = 3600.0, 86_400.0
WALK_STEP_S = 60.0
GUST_S = (20.0, 120.0)
LULL_S = (20.0, 200.0)
GUST_PERIOD_S = (1.5, 12.0)
GUST_EDGE_S = 4.0  # rise and fall time of a gust
CREEP_S = (20.0, 200.0)  # time constants of the decay of a step


@dataclass(frozen=True)
class GustSway:
    """Sway in gusts, zero between them; both axes of the mount share the gusts."""

    seed: int
    sway: RandomFourierSeries  # in a continuous gust of mean strength

    def __call__(self, series_s: Floats) -> Floats:
        """Return the tilt caused by the wind [rad]."""
        return np.asarray(self.sway(series_s) * self.strength(series_s))

    def strength(self, series_s: Floats) -> Floats:
        """Return the strength of the wind: 0 between gusts, 0.6 to 1.4 within them [1]."""
        series_s = np.asarray(series_s, dtype=np.float64)
        strength = np.zeros_like(series_s)
        hour = _hour(series_s)
        for current in np.unique(hour):
            within = hour == current
            at_s = series_s[within] - current * HOUR_S
            for begin_s, end_s, height in _gusts(self.seed, int(current)):
                inward = np.minimum(at_s - begin_s, end_s - at_s) / GUST_EDGE_S
                strength[within] += height * np.clip(inward, 0, 1)
        return strength


@dataclass(frozen=True)
class StepDisturbance:
    """Sudden steps of one axis, each decaying exponentially."""

    seed: int
    axis: int
    sigma_rad: float
    per_s: float  # mean rate

    def __call__(self, series_s: Floats) -> Floats:
        """Return the sum of all steps so far, decayed [rad]."""
        series_s = np.asarray(series_s, dtype=np.float64)
        tilt = np.zeros_like(series_s)
        hour = _hour(series_s)
        for current in np.unique(hour):
            within = hour == current
            for earlier in (int(current) - 1, int(current)):  # an hour is 18 times the longest time constant
                for begin_s, creep_s, size in self._draw_steps(earlier):
                    since_s = series_s[within] - begin_s
                    tilt[within] += np.where(
                        since_s >= 0, size * np.exp(-np.maximum(since_s, 0) / creep_s), 0
                    )
        return tilt

    def _draw_steps(self, hour: int) -> list[tuple[float, float, float]]:
        """Return start, time constant and size of each step in one hour; both axes share the times."""
        rng = rng_for(self.seed, 37, hour + 2)
        count = int(rng.poisson(self.per_s * HOUR_S))
        begin_s = (hour + rng.uniform(0, 1, count)) * HOUR_S
        shortest_s, longest_s = CREEP_S
        creep_s = shortest_s * (longest_s / shortest_s) ** rng.uniform(0, 1, count)
        size = self.sigma_rad * rng.standard_normal((2, count))[self.axis]
        return list(zip(begin_s.tolist(), creep_s.tolist(), size.tolist(), strict=True))


@dataclass(frozen=True)
class PermanentTilt:
    """A permanent tilt from one moment on."""

    from_s: float
    size_rad: float

    def __call__(self, series_s: Floats) -> Floats:
        """Return the permanent tilt [rad]."""
        return np.where(np.asarray(series_s) >= self.from_s, self.size_rad, 0.0)


@dataclass(frozen=True)
class DailyWave:
    """A wave of 24 hours."""

    amplitude_rad: float
    phase_rad: float

    def __call__(self, series_s: Floats) -> Floats:
        """Return the tilt of the wave [rad]."""
        return np.asarray(self.amplitude_rad * np.sin(2 * np.pi * series_s / DAY_S + self.phase_rad))


@dataclass(frozen=True)
class RandomWalk:
    """A random walk of one axis from the start of the series on, zero before."""

    seed: int
    axis: int
    sigma_rad: float  # after a day

    def __call__(self, series_s: Floats) -> Floats:
        """Return the walk, linear between its steps [rad]."""
        series_s = np.asarray(series_s, dtype=np.float64)
        count = max(1, int(np.ceil(series_s.max() / WALK_STEP_S)))
        step = rng_for(self.seed, 43, self.axis).standard_normal(count)  # a longer walk begins like a shorter
        walk = np.concatenate(([0.0], np.cumsum(step))) * np.sqrt(WALK_STEP_S / DAY_S)
        return np.asarray(self.sigma_rad * np.interp(series_s, WALK_STEP_S * np.arange(count + 1.0), walk))


def gusty_sway(seed: int, axis: int, sigma_rad: float) -> GustSway:
    """Draw the sway of one axis; its standard deviation within gusts of mean strength is `sigma_rad`."""
    return GustSway(seed, random_fourier(rng_for(seed, 36, 0, axis), sigma_rad, *GUST_PERIOD_S))


def _gusts(seed: int, hour: int) -> list[tuple[float, float, float]]:
    """Return start, end [s into the hour] and strength of the gusts in one hour."""
    rng = rng_for(seed, 36, 1, hour + 2)
    gusts: list[tuple[float, float, float]] = []
    end_s = 0.0
    while True:
        begin_s = end_s + rng.uniform(*LULL_S)
        end_s = begin_s + rng.uniform(*GUST_S)
        if end_s > HOUR_S:
            return gusts
        gusts.append((begin_s, end_s, float(rng.uniform(0.6, 1.4))))


def _hour(series_s: Floats) -> Ints:
    return np.floor(series_s / HOUR_S).astype(np.int64)
