"""Cold air over the ice: rays that end on ice bend otherwise than rays that end on rock.

A layer of cold air adds a temperature gradient, hence to the coefficient of refraction, that decays
exponentially with height over the ice. Its effect is the curvature integrated twice along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world.air import EARTH_M, bending_m
from station.simulation.world.terrain import NodeField

COLDEST_HOUR = 4.0  # UTC
DAILY_SHARE, RANDOM_SHARE = 0.5, 0.3  # of the layer's mean strength: amplitude over the day, scatter
QUADRATURE_POINTS = 48  # along the ray, dense towards its end
QUADRATURE_POWER = 3
LAYER_PASSES = 3  # the drop within the layer brings the ray further into it
ICE = 0.001  # least share of ice at the end of a ray that is bent


@dataclass(frozen=True)
class ColdAir:
    """Additional refraction over ice in one scan."""

    whole_path: float  # added to the coefficient of refraction of rays that end on ice
    at_ice: float  # added to it at the ice
    height_m: float  # over the ice, at which `at_ice` is down to 1/e


def cold_air_of_scan(scenario: Scenario, scan: int) -> ColdAir | None:
    """Return the cold air of one scan, None if it is switched off."""
    if not scenario.air or not (scenario.refraction_ice_sigma or scenario.ice_layer_k):
        return None
    whole_path = scenario.refraction_ice_sigma * rng_for(scenario.seed, 49, scan).standard_normal()
    hour = (scenario.scan_start_utc_s(scan) + scenario.scan_s / 2) / 3600
    daily = DAILY_SHARE * np.cos(2 * np.pi * (hour - COLDEST_HOUR) / 24)
    strength = 1 + daily + RANDOM_SHARE * rng_for(scenario.seed, 48, scan).standard_normal()
    return ColdAir(float(whole_path), float(scenario.ice_layer_k * strength), scenario.ice_layer_m)


def added_coefficient(
    cold_air: ColdAir,
    ground: NodeField,
    ice: NodeField,
    eye_m: Floats,
    ray: tuple[Floats, Floats, Floats],
    along_m: Floats,
) -> Floats:
    """Return what cold air adds to the coefficient of refraction of a whole ray (n,).

    `ray` is bearing [rad], initial slope and coefficient of refraction of each ray (n,), which ends after the
    horizontal distance `along_m`. The drop at its end is ∫ k(u) u du / R_E, u the distance from the end; a
    constant coefficient of 2/L² ∫ k(u) u du gives the same.
    """
    bearing_rad, slope, coefficient = ray
    if not cold_air.at_ice:
        end_m = eye_m[0] + along_m * np.cos(bearing_rad), eye_m[1] + along_m * np.sin(bearing_rad)
        return cold_air.whole_path * ice.at(*end_m)
    share = 1 - (np.arange(QUADRATURE_POINTS)[:, None] + 0.5) / QUADRATURE_POINTS
    from_end = share**QUADRATURE_POWER
    width = QUADRATURE_POWER * share ** (QUADRATURE_POWER - 1) / QUADRATURE_POINTS
    s_m = along_m * (1 - from_end)
    east_m, north_m = eye_m[0] + s_m * np.cos(bearing_rad), eye_m[1] + s_m * np.sin(bearing_rad)
    icy = np.nan_to_num(ice.at(east_m, north_m))
    whole_path = cold_air.whole_path * icy[-1]
    straight_m = eye_m[2] + s_m * slope - bending_m(coefficient + whole_path, s_m)
    height_m = np.nan_to_num(straight_m - ground.at(east_m, north_m), nan=np.inf)
    drop_m: Floats = np.zeros_like(s_m)
    for _ in range(LAYER_PASSES):
        layer = cold_air.at_ice * icy * np.exp(-np.maximum(height_m - drop_m, 0) / cold_air.height_m)
        bend = layer * width * along_m / EARTH_M
        drop_m = s_m * np.cumsum(bend, axis=0) - np.cumsum(bend * s_m, axis=0)
    return np.asarray(whole_path + 2 * (layer * from_end * width).sum(axis=0))
