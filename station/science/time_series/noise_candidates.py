"""Candidates of the process noise of a filter, and which of them is the likeliest so far."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from station.quantities import Floats
from station.science.time_series.cell_filter import STEP_SIGMAS, ProcessNoise

MEMORY_D = 10.0  # after which another candidate is as likely to be right
FIRST_LEVEL_NOISE_M2_D = 1e-5  # before any scan


class NoiseCandidates:
    """Process noises (k,), and the probability of each after the scans so far.

    Which one is right may change at any time, with the weather, so that none ever becomes so unlikely that
    some scans cannot make it the likeliest.
    """

    def __init__(
        self, level_noises_m2_d: Sequence[float], rate_noises_m2_d3: Sequence[float], first_rate: int
    ) -> None:
        """Begin with all equally likely; `first_rate` is the index of the rate noise before any scan."""
        noises = np.array(list(product(level_noises_m2_d, rate_noises_m2_d3))).T
        self.all = ProcessNoise(*noises)
        self.probability = np.full(noises.shape[1], 1 / noises.shape[1])
        self.best = level_noises_m2_d.index(FIRST_LEVEL_NOISE_M2_D) * len(rate_noises_m2_d3) + first_rate

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.probability)

    def to_array(self) -> Floats:
        """Return the probabilities, and the index of the likeliest."""
        return np.append(self.probability, self.best)

    def restore(self, values: Floats) -> None:
        """Continue from what `to_array` returned."""
        self.probability, self.best = values[:-1], int(values[-1])

    @property
    def likeliest(self) -> ProcessNoise:
        """The likeliest process noise so far; both are numbers."""
        return ProcessNoise(self.all.level_m2_d[self.best], self.all.rate_m2_d3[self.best])

    def learn(self, days: float, innovation_m: Floats, expected_m2: Floats) -> None:
        """Take the innovations (k, n) of a scan and their expected variances, some days after the last one.

        Source: Herbster and Warmuth (1998), fixed share; equations.md, 6.12.
        """
        loss = np.minimum(innovation_m**2 / expected_m2, STEP_SIGMAS**2) + np.log(expected_m2)
        likelihood = np.log(self.probability) - loss.sum(axis=1) / 2
        probability = np.exp(likelihood - likelihood.max())
        changed = 1 - np.exp(-days / MEMORY_D)
        self.probability = (1 - changed) * probability / probability.sum() + changed / len(probability)
        self.best = int(np.argmax(self.probability))
