"""Known places in the valley: the hut and the far ridge.

Bearings are counter-clockwise from east, lengths those of the valley at full size.
"""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats
from station.simulation.scenario import Scenario
from station.simulation.world.terrain import Valley

RIDGE_DEG = (124.0, 136.0)  # sector of the far ridge
RIDGE_FROM_M = 2200.0
HUT_AWAY_M = (850.0, 950.0)
HUT_M = 25.0  # length and width, at least two cells
HUT_BEARING_DEG = (40.0, 110.0)  # on the scanner's side of the valley, far from the ridge
HUT_STEEPEST_DEG = 35.0  # snow would lie on such a slope if it were not a roof
ROCK_ICE = 0.01  # a smaller share of ice counts as rock
SIGHT_POINTS = 120  # along a line of sight


def hut_cells(scenario: Scenario) -> int:
    """Return the length and width of the hut [cells]."""
    return max(2, round(HUT_M * scenario.size / scenario.cell_m))


def hut_m(scenario: Scenario, valley: Valley) -> tuple[float, float]:
    """Return east and north of the hut [m]: of all gentle visible rock, the site best facing the scanner."""
    eye_m = np.array(scenario.mount_position_m)
    step_m = 10 * valley.size
    away_m = np.arange(HUT_AWAY_M[0] * valley.size, HUT_AWAY_M[1] * valley.size, step_m)
    first_rad, last_rad = np.radians(HUT_BEARING_DEG)
    bearing_rad = np.arange(first_rad, last_rad, step_m / away_m[0])
    bearing_rad, away_m = (values.ravel() for values in np.meshgrid(bearing_rad, away_m))
    east_m, north_m = away_m * np.cos(bearing_rad), away_m * np.sin(bearing_rad)
    half_m = hut_cells(scenario) * scenario.cell_m / 2
    worst = np.full(len(east_m), np.inf)
    for shift_east in (-half_m, 0, half_m):
        for shift_north in (-half_m, 0, half_m):
            cosine = _cos_incidence(valley, eye_m, east_m + shift_east, north_m + shift_north)
            worst = np.minimum(worst, cosine)
    best = int(np.argmax(worst))
    return float(east_m[best]), float(north_m[best])


def roof(scenario: Scenario, valley: Valley) -> Bools:
    """Return a mask of the hut's nodes, with a margin for the map's raster, to whose cells it is rounded."""
    east_m, north_m = hut_m(scenario, valley)
    ground = valley.ground
    ny, nx = ground.node.shape
    x_m = ground.west_m + np.arange(nx) * ground.step_m - east_m
    y_m = ground.south_m + np.arange(ny) * ground.step_m - north_m
    reach_m = (hut_cells(scenario) / 2 + 1.5) * scenario.cell_m + ground.step_m
    return np.asarray(np.hypot(*np.meshgrid(x_m, y_m)) < np.sqrt(2) * reach_m)


def _cos_incidence(valley: Valley, eye_m: Floats, east_m: Floats, north_m: Floats) -> Floats:
    """Return the cosine of incidence at each place (n,), -1 for ice, steep or hidden ground."""
    ground = valley.ground
    up_m, slope_east, slope_north = ground.with_slope(east_m, north_m)
    ray = np.stack((east_m - eye_m[0], north_m - eye_m[1], up_m - eye_m[2]))
    steep = np.hypot(slope_east, slope_north)
    cosine = (ray[0] * slope_east + ray[1] * slope_north - ray[2]) / np.linalg.norm(ray, axis=0)
    cosine /= np.sqrt(1 + steep**2)
    share = np.linspace(0.03, 0.98, SIGHT_POINTS)[:, None]
    between_m = ground.at(eye_m[0] + share * ray[0], eye_m[1] + share * ray[1])
    suitable = (between_m < eye_m[2] + share * ray[2]).all(axis=0)
    suitable &= (valley.ice.at(east_m, north_m) < ROCK_ICE) & (steep < np.tan(np.radians(HUT_STEEPEST_DEG)))
    return np.where(suitable, cosine, -1.0)
