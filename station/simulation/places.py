"""Places in the valley that its owner knows by name: the hut and the far ridge.

Bearings are counter-clockwise from east, lengths those of the valley at full size.
"""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats
from station.simulation.scenario import Scenario
from station.simulation.terrain import Valley

RIDGE_DEG = (124.0, 136.0)  # the sector in which the far ridge stands
RIDGE_FROM_M = 2200.0
HUT_AWAY_M = (850.0, 950.0)
HUT_M = 25.0  # length and width, but at least two cells
HUT_BEARING_DEG = (40.0, 110.0)  # on the scanner's own side of the valley, far from the ridge
HUT_STEEPEST_DEG = 35.0  # snow would lie there, if it were not a roof
ROCK_ICE = 0.01  # where the share of ice is smaller, there is rock
SIGHT_POINTS = 120  # along a line of sight


def hut_cells(scenario: Scenario) -> int:
    """Return how many cells long and wide the hut is."""
    return max(2, round(HUT_M * scenario.size / scenario.cell_m))


def hut_m(scenario: Scenario, place: Valley) -> tuple[float, float]:
    """Return east and north of the hut: of all gentle rock in sight there, what faces the scanner best."""
    eye_m = np.array(scenario.mount_position_m)
    step_m = 10 * place.size
    away_m = np.arange(HUT_AWAY_M[0] * place.size, HUT_AWAY_M[1] * place.size, step_m)
    first_rad, last_rad = np.radians(HUT_BEARING_DEG)
    bearing_rad = np.arange(first_rad, last_rad, step_m / away_m[0])
    bearing_rad, away_m = (part.ravel() for part in np.meshgrid(bearing_rad, away_m))
    east_m, north_m = away_m * np.cos(bearing_rad), away_m * np.sin(bearing_rad)
    half_m = hut_cells(scenario) * scenario.cell_m / 2
    worst = np.full(len(east_m), np.inf)
    for shift_east in (-half_m, 0, half_m):
        for shift_north in (-half_m, 0, half_m):
            facing = _facing(place, eye_m, east_m + shift_east, north_m + shift_north)
            worst = np.minimum(worst, facing)
    best = int(np.argmax(worst))
    return float(east_m[best]), float(north_m[best])


def roof(scenario: Scenario, place: Valley) -> Bools:
    """Tell which nodes are the hut, with a margin for the map's raster, to whose cells it is rounded."""
    east_m, north_m = hut_m(scenario, place)
    ground = place.ground
    ny, nx = ground.node.shape
    x_m = ground.west_m + np.arange(nx) * ground.step_m - east_m
    y_m = ground.south_m + np.arange(ny) * ground.step_m - north_m
    reach_m = (hut_cells(scenario) / 2 + 1.5) * scenario.cell_m + ground.step_m
    return np.asarray(np.hypot(*np.meshgrid(x_m, y_m)) < np.sqrt(2) * reach_m)


def _facing(place: Valley, eye_m: Floats, east_m: Floats, north_m: Floats) -> Floats:
    """Return the cosine of incidence at each place, -1 where it is ice, steep or out of sight (n,)."""
    ground = place.ground
    up_m, slope_east, slope_north = ground.with_slope(east_m, north_m)
    ray = np.stack((east_m - eye_m[0], north_m - eye_m[1], up_m - eye_m[2]))
    steep = np.hypot(slope_east, slope_north)
    cosine = (ray[0] * slope_east + ray[1] * slope_north - ray[2]) / np.linalg.norm(ray, axis=0)
    cosine /= np.sqrt(1 + steep**2)
    share = np.linspace(0.03, 0.98, SIGHT_POINTS)[:, None]
    between_m = ground.at(eye_m[0] + share * ray[0], eye_m[1] + share * ray[1])
    good = (between_m < eye_m[2] + share * ray[2]).all(axis=0)
    good &= (place.ice.at(east_m, north_m) < ROCK_ICE) & (steep < np.tan(np.radians(HUT_STEEPEST_DEG)))
    return np.where(good, cosine, -1.0)
