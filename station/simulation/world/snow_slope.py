"""A snow slope opposite a mast: 50 to 300 m away, with bands of rock too steep for snow, and roofs.

East-north-up at the mark, on a knoll; the slope rises to the north, beyond a gully.
"""

from __future__ import annotations

import numpy as np

from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world.terrain import NodeField, Valley, bumps

WEST_M, EAST_M, SOUTH_M, NORTH_M = -200.0, 200.0, -20.0, 330.0
PROFILE_M = ((-20.0, 1.0), (0.0, 0.0), (8.0, -2.0), (45.0, -44.0), (55.0, -45.0), (330.0, 130.0))  # north, up
BANDS_M = (105.0, 165.0, 230.0)  # north coordinates of the bands of rock
BAND_HEIGHT_M, BAND_RUN_M = 9.0, 6.0
BAND_WAVES_M = (40.0, 160.0)  # wavelengths of their gaps
GULLIES_M, GULLY_WAVES_M = 0.8, (30.0, 120.0)
BARE_SLOPE = (1.15, 1.25)  # tangents: snow lies below the first, none above the second
ROOFS_M = (  # east, north of galleries and huts, as steep as the slope, on which no snow stays
    (-70.0, 85.0), (-25.0, 70.0), (35.0, 78.0), (75.0, 95.0), (-50.0, 125.0), (60.0, 140.0), (-75.0, 165.0),
    (15.0, 165.0), (70.0, 185.0),
)  # fmt: skip
ROOF_M = 14.0  # length and width
AREAS_M = {  # east, north, half diagonals: of rectangles
    "slope": (0.0, 135.0, 84.0, 28.0),
    "upper slope": (0.0, 200.0, 98.0, 28.0),
}


def build_snow_slope(scenario: Scenario) -> Valley:
    """Build the slope; its `ice` is all ground on which snow lies from the start."""
    step_m = scenario.terrain_step_m
    nx, ny = round((EAST_M - WEST_M) / step_m) + 1, round((NORTH_M - SOUTH_M) / step_m) + 1
    north_m: Floats = (SOUTH_M + step_m * np.arange(ny, dtype=np.float64))[:, None]
    away = np.clip((north_m - 60.0) / 20.0, 0, 1)  # the knoll and the gully are smooth
    profile = np.array(PROFILE_M).T
    up_m = np.interp(north_m, *profile) + np.zeros((ny, nx))
    for number, band_m in enumerate(BANDS_M):
        wave = bumps(rng_for(scenario.seed, 60, number), (ny, nx), step_m, *BAND_WAVES_M, 1.0)[ny // 2]
        height_m = BAND_HEIGHT_M * np.clip(0.5 + 1.5 * wave, 0, 1)
        rise = np.clip((north_m - band_m) / BAND_RUN_M, 0, 1)
        up_m += height_m * rise**2 * (3 - 2 * rise)
    gullies, fine = (
        bumps(rng_for(scenario.seed, 61, number), (ny, nx), step_m, *waves, 1.0)
        for number, waves in enumerate(
            (GULLY_WAVES_M, (scenario.roughness_length_m, 4 * scenario.roughness_length_m))
        )
    )
    up_m += away * (GULLIES_M * gullies + scenario.roughness_m * fine)
    ground = NodeField(WEST_M, SOUTH_M, step_m, up_m)
    low, high = BARE_SLOPE
    steepness = np.hypot(*np.gradient(up_m, step_m))
    snow = np.clip((high - steepness) / (high - low), 0, 1)
    east_m = WEST_M + step_m * np.arange(nx, dtype=np.float64)[None, :]
    for roof_east_m, roof_north_m in ROOFS_M:
        away_m = np.maximum(np.abs(east_m - roof_east_m), np.abs(north_m - roof_north_m))
        snow[away_m <= ROOF_M / 2] = 0
    return Valley(ground, ground.with_nodes(snow), scenario.size)
