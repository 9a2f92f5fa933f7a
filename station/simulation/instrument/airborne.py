"""Echoes from the air: snow, rain, dust and birds on the way, and dense clouds close to the scanner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario

NEAREST_M = 3.0  # nearer echoes are not recorded
CLOUD_RANGE_M = (20.0, 150.0)
CLOUD_WIDTH_DEG, CLOUD_HEIGHT_DEG = (4.0, 15.0), (3.0, 12.0)
CLOUD_DEPTH_M = (3.0, 20.0)
CLOUD_DENSITY = (0.3, 0.9)  # share of the shots that it stops
FILL = (0.15, 0.9)  # median share of the beam that a particle fills, and its scatter in the logarithm


@dataclass(frozen=True)
class Cloud:
    """A cloud of drifting snow or dust in the scanner's frame; nearest range, depth, density."""

    azimuth_rad: float
    elevation_rad: float
    half_width_rad: float
    half_height_rad: float
    range_m: float
    depth_m: float
    density: float

    def covers(self, azimuth_rad: Floats, elevation_rad: Floats) -> Bools:
        """Return a mask of the directions that pass through it."""
        across = (azimuth_rad - self.azimuth_rad) / self.half_width_rad
        return np.asarray(np.hypot(across, (elevation_rad - self.elevation_rad) / self.half_height_rad) < 1)


def cloud_of_scan(scenario: Scenario, scan: int) -> Cloud | None:
    """Return the cloud of one scan, None in most."""
    rng = rng_for(scenario.seed, 55, scan)
    if rng.uniform() >= scenario.airborne_clouds:
        return None
    low, high = np.radians(scenario.elevation_deg)
    return Cloud(
        azimuth_rad=rng.uniform(*scenario.azimuth_rad),
        elevation_rad=rng.uniform(low, (low + high) / 2),  # most often before the ground
        half_width_rad=np.radians(rng.uniform(*CLOUD_WIDTH_DEG)) / 2,
        half_height_rad=np.radians(rng.uniform(*CLOUD_HEIGHT_DEG)) / 2,
        range_m=rng.uniform(*CLOUD_RANGE_M),
        depth_m=rng.uniform(*CLOUD_DEPTH_M),
        density=rng.uniform(*CLOUD_DENSITY),
    )


def airborne_range_m(
    scenario: Scenario,
    cloud: Cloud | None,
    azimuth_rad: Floats,
    elevation_rad: Floats,
    way_m: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return the range of each shot's echo from the air (n,) [m], NaN for shots that reach `way_m`."""
    count = len(way_m)
    struck = rng.random(count) < scenario.airborne_share
    struck &= way_m > NEAREST_M
    along = rng.random(count)
    if scenario.airborne == "near":  # a density of 1/r is even in the logarithm
        range_m = NEAREST_M * (np.maximum(way_m, NEAREST_M) / NEAREST_M) ** along
    else:
        range_m = NEAREST_M + (way_m - NEAREST_M) * along
    range_m = np.where(struck, range_m, np.nan)
    if cloud is None:
        return range_m
    stopped = cloud.covers(azimuth_rad, elevation_rad) & (rng.random(count) < cloud.density)
    cloud_m = cloud.range_m + cloud.depth_m * rng.random(count)
    return np.where(stopped & (cloud_m < way_m), np.fmin(range_m, cloud_m), range_m)


def particle_brightness(reflectance: float, count: int, rng: np.random.Generator) -> Floats:
    """Return the brightness of particles that fill part of the beam (count,) [1]."""
    median, scatter = FILL
    return np.clip(reflectance * median * np.exp(scatter * rng.standard_normal(count)), 0, reflectance)
