"""Random functions of time or direction, reproducible from a seed in any order of evaluation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats

WAVES = 48  # enough for a nearly normal sum of sines


def rng_for(seed: int, *key: int) -> np.random.Generator:
    """Return the random generator of one key (a kind of error, a scan), independent of all others."""
    return np.random.default_rng([seed, *key])


@dataclass(frozen=True)
class RandomFourierSeries:
    """A smooth random function of mean zero: sines of random phase, with log-uniform periods.

    It can be evaluated anywhere in any order; its covariance is not the exponential an estimator would
    assume.
    """

    rate: Floats  # (w,) radians per unit of the argument
    phase: Floats  # (w,)
    amplitude: float

    def __call__(self, argument: Floats) -> Floats:
        """Return its value at each argument, in the unit of its sigma."""
        value = np.zeros_like(np.asarray(argument, dtype=np.float64))
        if self.amplitude == 0:
            return value
        for rate, phase in zip(self.rate, self.phase, strict=True):
            value += np.sin(rate * argument + phase)
        return value * self.amplitude


def random_fourier(
    rng: np.random.Generator, sigma: float, shortest: float, longest: float
) -> RandomFourierSeries:
    """Draw a random function with this standard deviation and periods between `shortest` and `longest`."""
    period = np.exp(rng.uniform(np.log(shortest), np.log(longest), WAVES))
    phase = rng.uniform(0, 2 * np.pi, WAVES)
    return RandomFourierSeries(2 * np.pi / period, phase, sigma * float(np.sqrt(2 / WAVES)))
