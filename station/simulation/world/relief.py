"""Relief of bare rock: ridges, gullies and steps from six metres to four hundred."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.world.terrain import SOUTH_M, WEST_M, Valley, bumps

LONGEST_M, SHORTEST_M = 400.0, 6.0  # wavelengths; the longest times size
NODES_PER_WAVE = 3.0  # shorter waves cannot be represented
HURST = 0.75  # amplitude grows with wavelength to this power; natural surfaces have 0.7 to 0.9
CREST = 1.0  # of octaves in standard deviations: higher values give fewer, sharper ridges
FADE_M = 400.0  # times size; the relief is absent at the scanner, which would look at a wall


def with_rock_relief(valley: Valley, seed: int, relief_m: float) -> Valley:
    """Return the valley with relief of this standard deviation [m, times size] on its rock, none on ice.

    A sum of octaves of folded noise: where an octave crosses zero stands a ridge, and shorter octaves are
    rough where the longer ones are high, so that crests are jagged and gullies smoother.
    Source: Musgrave in Ebert et al. (2003), chapter 16, ridged multifractal terrain.
    """
    ground = valley.ground
    shape, step_m = ground.node.shape, ground.step_m
    relief: Floats = np.zeros(shape)
    ruggedness: Floats = np.ones(shape)
    longest_m = LONGEST_M * valley.size
    wavelength_m, octave = longest_m / np.sqrt(2), 0
    while wavelength_m >= np.sqrt(2) * max(SHORTEST_M, NODES_PER_WAVE * step_m):
        half_octave_m = (wavelength_m / np.sqrt(2), wavelength_m * np.sqrt(2))
        noise = bumps(rng_for(seed, 11, octave), shape, step_m, *half_octave_m, 1.0)
        ridge = CREST - np.abs(noise)
        relief += (wavelength_m / longest_m) ** HURST * ruggedness * ridge
        ruggedness = np.clip(0.6 + 0.5 * ruggedness * ridge, 0.2, 1.5)
        wavelength_m, octave = wavelength_m / 2, octave + 1
    relief = (relief - relief.mean()) / relief.std()
    x_m = (WEST_M * valley.size + np.arange(shape[1]) * step_m)[None, :]
    y_m = (SOUTH_M * valley.size + np.arange(shape[0]) * step_m)[:, None]
    fade = 1 - np.exp(-(x_m**2 + y_m**2) / (FADE_M * valley.size) ** 2)
    rock = (1 - valley.ice.node) ** 2
    node = ground.node + relief_m * valley.size * fade * rock * relief
    return Valley(ground.with_nodes(node), valley.ice, valley.size)
