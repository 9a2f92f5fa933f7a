"""A beach below a scanner on a roof: promenade, sea wall, groynes, sand, and the sea with its tide.

East-north-up at the mark on the roof; the sea is in the west.
"""

from __future__ import annotations

import numpy as np

from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world.terrain import NodeField, Valley, bumps

WEST_M, EAST_M, SOUTH_M, NORTH_M = -420.0, 20.0, -300.0, 300.0
# Distance from the mark towards the sea, height: roof, promenade, sea wall, dry beach, foreshore
PROFILE_M = (
    (-20.0, 0.0), (2.0, 0.0), (10.0, -30.0), (60.0, -30.5), (75.0, -35.5), (120.0, -37.2), (420.0, -46.0),
)  # fmt: skip
PAVED_M = 76.0  # from there to the sea it is sand
MEAN_SEA_M = -39.0  # height of mean sea level
GROYNES_M = (-170.0, -80.0, 90.0, 180.0)  # north coordinates
GROYNE_END_M = 300.0
GROYNE_TOP_M, GROYNE_SLOPE_M, GROYNE_HEIGHT_M = 5.0, 4.0, 0.8  # half width of the top, width of a side
BAR_M, BAR_WIDTH_M = 155.0, 30.0  # distance of its crest, and of the trough behind it from the crest
TIDE_S = 12.4206 * 3600  # M2
DRAIN_S = 3 * 3600.0  # for which sand stays wet once the water has left it
WET_MARGIN_M = 0.1  # height over which sand becomes dry
RUN_UP_M = 0.15  # of the waves, above the level of the sea
SAND = (0.45, 0.10)  # reflectance at 1550 nm, dry and wet: Nolet et al. (2014), Fig. 2, about
AREAS_M = {  # east, north, half diagonals: of rectangles
    "upper beach": (-100.0, 5.0, 25.0, 85.0),
    "bar": (-155.0, 5.0, 20.0, 70.0),
    "lower beach": (-195.0, 5.0, 14.0, 70.0),
}


def build_beach(scenario: Scenario) -> Valley:
    """Build the beach at low water; its `ice` is the sand, all other ground is stone."""
    step_m = scenario.terrain_step_m
    nx, ny = round((EAST_M - WEST_M) / step_m) + 1, round((NORTH_M - SOUTH_M) / step_m) + 1
    away_m: Floats = -(WEST_M + step_m * np.arange(nx, dtype=np.float64))[None, :]
    north_m: Floats = (SOUTH_M + step_m * np.arange(ny, dtype=np.float64))[:, None]
    waves_m = (scenario.roughness_length_m, 4 * scenario.roughness_length_m)
    fine = bumps(rng_for(scenario.seed, 62), (ny, nx), step_m, *waves_m, 1.0)
    beside_m = np.min([np.abs(north_m - groyne_m) for groyne_m in GROYNES_M], axis=0)
    groyne = np.clip((GROYNE_TOP_M + GROYNE_SLOPE_M - beside_m) / GROYNE_SLOPE_M, 0, 1)
    groyne = groyne * ((away_m > PAVED_M) & (away_m < GROYNE_END_M))
    sand = np.clip((away_m - PAVED_M) / 4.0, 0, 1) * (groyne == 0)
    up_m = np.interp(away_m, *np.array(PROFILE_M).T) + GROYNE_HEIGHT_M * groyne
    up_m = up_m + scenario.roughness_m * fine * sand
    ground = NodeField(WEST_M, SOUTH_M, step_m, up_m)
    return Valley(ground, ground.with_nodes(sand), scenario.size)


def bar(valley: Valley) -> NodeField:
    """Return the pattern of a bar that grows from the sand of the trough before it, of unit height."""
    ground = valley.ground
    away_m = -(ground.west_m + ground.step_m * np.arange(ground.node.shape[1], dtype=np.float64))
    crest, trough = (
        np.exp(-(((away_m - at_m) / (BAR_WIDTH_M / 3)) ** 2)) for at_m in (BAR_M, BAR_M + BAR_WIDTH_M)
    )
    pattern = (crest - trough)[None, :] * valley.ice.node
    pattern[np.abs(pattern) < 1e-3] = 0
    return ground.with_nodes(pattern)


def sea_level_m(scenario: Scenario, hours: float) -> float:
    """Return the level of the sea from the mark [m], with the run-up of its waves; low water at the start."""
    phase_rad = 2 * np.pi * hours * 3600 / TIDE_S
    return MEAN_SEA_M + RUN_UP_M - scenario.tide_m * float(np.cos(phase_rad))


def wet_ground(scenario: Scenario, ground: NodeField, hours: float) -> NodeField:
    """Return how wet the ground is, 0 to 1: 1 if the sea covered it within the last hours."""
    before_h = np.linspace(0, DRAIN_S / 3600, 13)
    highest_m = max(sea_level_m(scenario, hours - before) for before in before_h)
    return ground.with_nodes(np.clip((highest_m + WET_MARGIN_M - ground.node) / WET_MARGIN_M, 0, 1))
