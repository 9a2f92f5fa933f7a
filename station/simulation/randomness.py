"""Random functions of time or direction that are the same for the same seed, whoever asks first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats

WAVES = 48  # enough that the sum of sines is close to normally distributed


def stream(seed: int, *place: int) -> np.random.Generator:
    """Return the random numbers of one place (a kind of error, a scan) and of no other."""
    return np.random.default_rng([seed, *place])


@dataclass(frozen=True)
class Wander:
    """A smooth random function of mean zero: sines of random phase, the periods spread over decades.

    It can be asked anywhere in any order and is not the exponential covariance an estimator would assume.
    """

    rate: Floats  # (w,) radians per unit of the argument
    phase: Floats  # (w,)
    amplitude: float

    def __call__(self, at: Floats) -> Floats:
        """Return its value at each argument, in the unit of its sigma."""
        value = np.zeros_like(np.asarray(at, dtype=np.float64))
        if self.amplitude == 0:
            return value
        for rate, phase in zip(self.rate, self.phase, strict=True):
            value += np.sin(rate * at + phase)
        return value * self.amplitude


def wander(rng: np.random.Generator, sigma: float, shortest: float, longest: float) -> Wander:
    """Draw a random function with this standard deviation and periods between the two."""
    period = np.exp(rng.uniform(np.log(shortest), np.log(longest), WAVES))
    phase = rng.uniform(0, 2 * np.pi, WAVES)
    return Wander(2 * np.pi / period, phase, sigma * float(np.sqrt(2 / WAVES)))
