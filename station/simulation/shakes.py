"""What comes and goes: gusts that shake the mount, jerks from which it creeps back, the day it is knocked.

Each is a function of seconds since the first scan began, drawn hour by hour, so that a longer series begins
like a shorter one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats, Ints
from station.simulation.randomness import Wander, stream, wander

HOUR_S = 3600.0
GUST_S = (20.0, 120.0)
LULL_S = (20.0, 200.0)
GUST_PERIOD_S = (1.5, 12.0)
GUST_EDGE_S = 4.0  # in which a gust rises and dies
CREEP_S = (20.0, 200.0)  # time constants with which a jerk fades


@dataclass(frozen=True)
class Gusts:
    """Sway in bursts, nothing between them; both axes of the mount feel the same gusts."""

    seed: int
    sway: Wander  # as it would be in an endless gust of mean strength

    def __call__(self, series_s: Floats) -> Floats:
        """Return the lean from the wind [rad]."""
        return np.asarray(self.sway(series_s) * self.strength(series_s))

    def strength(self, series_s: Floats) -> Floats:
        """Return how strongly it blows: 0 between the gusts, 0.6 to 1.4 within them [1]."""
        series_s = np.asarray(series_s, dtype=np.float64)
        strength = np.zeros_like(series_s)
        hour = _hour(series_s)
        for one in np.unique(hour):
            mine = hour == one
            at_s = series_s[mine] - one * HOUR_S
            for begin_s, end_s, height in _gusts(self.seed, int(one)):
                inward = np.minimum(at_s - begin_s, end_s - at_s) / GUST_EDGE_S
                strength[mine] += height * np.clip(inward, 0, 1)
        return strength


@dataclass(frozen=True)
class Jerks:
    """Sudden steps of one axis, each of which fades exponentially."""

    seed: int
    axis: int
    sigma_rad: float
    per_s: float  # how many on average

    def __call__(self, series_s: Floats) -> Floats:
        """Return what is left of all jerks so far [rad]."""
        series_s = np.asarray(series_s, dtype=np.float64)
        lean = np.zeros_like(series_s)
        hour = _hour(series_s)
        for one in np.unique(hour):
            mine = hour == one
            for earlier in (int(one) - 1, int(one)):  # an hour is 18 times the longest time constant
                for begin_s, creep_s, size in self._drawn(earlier):
                    since_s = series_s[mine] - begin_s
                    lean[mine] += np.where(since_s >= 0, size * np.exp(-np.maximum(since_s, 0) / creep_s), 0)
        return lean

    def _drawn(self, hour: int) -> list[tuple[float, float, float]]:
        """Return start, time constant and size of each jerk of one hour; axes jerk together."""
        rng = stream(self.seed, 37, hour + 2)
        count = int(rng.poisson(self.per_s * HOUR_S))
        begin_s = (hour + rng.uniform(0, 1, count)) * HOUR_S
        shortest_s, longest_s = CREEP_S
        creep_s = shortest_s * (longest_s / shortest_s) ** rng.uniform(0, 1, count)
        size = self.sigma_rad * rng.standard_normal((2, count))[self.axis]
        return list(zip(begin_s.tolist(), creep_s.tolist(), size.tolist(), strict=True))


@dataclass(frozen=True)
class Knock:
    """A lean that is there for good from one moment on."""

    from_s: float
    size_rad: float

    def __call__(self, series_s: Floats) -> Floats:
        """Return the lean it left [rad]."""
        return np.where(np.asarray(series_s) >= self.from_s, self.size_rad, 0.0)


def gusty_sway(seed: int, axis: int, sigma_rad: float) -> Gusts:
    """Draw one axis' sway, whose standard deviation is sigma within gusts of mean strength."""
    return Gusts(seed, wander(stream(seed, 36, 0, axis), sigma_rad, *GUST_PERIOD_S))


def _gusts(seed: int, hour: int) -> list[tuple[float, float, float]]:
    """Return begin, end [s into the hour] and strength of the gusts of one hour."""
    rng = stream(seed, 36, 1, hour + 2)
    found: list[tuple[float, float, float]] = []
    end_s = 0.0
    while True:
        begin_s = end_s + rng.uniform(*LULL_S)
        end_s = begin_s + rng.uniform(*GUST_S)
        if end_s > HOUR_S:
            return found
        found.append((begin_s, end_s, float(rng.uniform(0.6, 1.4))))


def _hour(series_s: Floats) -> Ints:
    return np.floor(series_s / HOUR_S).astype(np.int64)
