"""Ray casting over the height field: where a laser beam meets the ground.

A ray is given by its initial direction: bearing (counter-clockwise from east) and slope (rise over horizontal
distance). It bends by the coefficient of refraction of its bearing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats, Ints
from station.simulation.world.air import EARTH_M, bending_m
from station.simulation.world.terrain import NodeField

NEAREST_M = 15.0  # nearer surfaces belong to the scanner's shelter
MAX_SLOPE = 4.0  # no ray is steeper than 76°
MAX_ITERATIONS = 12  # of Newton's method; nearly all shots need four
HIT_TOLERANCE_M = 1e-5  # of height between ray and ground, for a hit


@dataclass(frozen=True)
class RayHits:
    """Points where rays met the ground, NaN for rays that met none."""

    along_m: Floats  # (n,) horizontal distance from the eye
    east_m: Floats
    north_m: Floats
    up_m: Floats
    slope_east: Floats  # of the ground, per metre
    slope_north: Floats


@dataclass(frozen=True)
class HorizonProfile:
    """Rise of the horizon with distance, along evenly spaced bearings."""

    bearing_rad: Floats  # (b,)
    coefficient: Floats  # (b,) of refraction
    distance_m: Floats  # (r,)
    slope: Floats  # (b, r) of the line of sight to each point
    horizon: Floats  # (b, r) the largest slope up to that distance

    def first_crossing(self, bearing_rad: Floats, slope: Floats) -> Floats:
        """Return the approximate horizontal length of each ray [m], NaN if it leaves the valley."""
        count = len(self.distance_m)
        spacing_rad = self.bearing_rad[1] - self.bearing_rad[0]
        row = np.rint((bearing_rad - self.bearing_rad[0]) / spacing_rad).astype(np.int64)
        crossing = self._search(row, slope)
        in_valley = (crossing > 0) & (crossing < count)
        flat_index = row * count + np.where(in_valley, crossing, 1)
        lower, upper = self.slope.take(flat_index - 1), self.slope.take(flat_index)
        share = (slope - lower) / np.where(upper > lower, upper - lower, 1)
        guess = self.distance_m.take(np.where(in_valley, crossing, 1) - 1) + np.clip(share, 0, 1) * (
            self.distance_m[1] - self.distance_m[0]
        )
        return np.where(in_valley, guess, np.nan)

    def _search(self, row: Ints, slope: Floats) -> Ints:
        """Return the index of the first distance at which the horizon reaches the slope of each ray."""
        lift = 4 * MAX_SLOPE  # one long sorted array: each bearing's horizon lies above the previous one
        keys = self.horizon + lift * np.arange(len(self.horizon))[:, None]
        position = np.searchsorted(keys.ravel(), slope + lift * row)
        return np.asarray(position - row * len(self.distance_m))


def horizon_profile(
    ground: NodeField,
    eye_m: Floats,
    bearings_rad: tuple[float, float],
    reach_m: float,
    coefficient_at: Callable[[Floats], Floats],
) -> HorizonProfile:
    """Return the horizon of the ground as seen from the eye, between two bearings, out to `reach_m`."""
    spacing_rad = ground.step_m / reach_m
    rows = int((bearings_rad[1] - bearings_rad[0]) / spacing_rad) + 4
    bearing_rad = bearings_rad[0] + spacing_rad * (np.arange(rows, dtype=np.float64) - 1)
    coefficient = coefficient_at(bearing_rad)
    distance_m = np.arange(NEAREST_M, reach_m, ground.step_m)
    up_m = ground.at(
        eye_m[0] + np.cos(bearing_rad)[:, None] * distance_m,
        eye_m[1] + np.sin(bearing_rad)[:, None] * distance_m,
    )
    up_m += bending_m(coefficient[:, None], distance_m)
    slope = np.nan_to_num((up_m - eye_m[2]) / distance_m, nan=-MAX_SLOPE).clip(-MAX_SLOPE, MAX_SLOPE)
    return HorizonProfile(bearing_rad, coefficient, distance_m, slope, np.maximum.accumulate(slope, axis=1))


def cast_rays(
    ground: NodeField,
    eye_m: Floats,
    bearing_rad: Floats,
    slope: Floats,
    reach_m: float,
    coefficient_at: Callable[[Floats], Floats],
) -> RayHits:
    """Trace each ray to the first ground it meets, to a hundredth of a millimetre in height.

    Crests are sampled at the spacing of the nodes, so a ray that only grazes a crest may pass it. On rough
    rock, this and rays for which Newton's method fails are less than one in a hundred.
    """
    profile = horizon_profile(
        ground, eye_m, (float(bearing_rad.min()), float(bearing_rad.max())), reach_m, coefficient_at
    )
    along_m = profile.first_crossing(bearing_rad, slope)
    coefficient = np.interp(bearing_rad, profile.bearing_rad, profile.coefficient)
    return trace_from(ground, eye_m, bearing_rad, slope, coefficient, along_m)


def trace_from(
    ground: NodeField, eye_m: Floats, bearing_rad: Floats, slope: Floats, coefficient: Floats, along_m: Floats
) -> RayHits:
    """Trace each ray to the ground near the horizontal distance `along_m`, by Newton's method.

    `coefficient` is that of refraction (n,). Rays for which `along_m` is NaN meet no ground.
    """
    hits = np.full((6, len(along_m)), np.nan)
    active = np.flatnonzero(np.isfinite(along_m))
    along = along_m[active]
    ray = np.stack((np.cos(bearing_rad), np.sin(bearing_rad), slope, coefficient))[:, active]
    max_step_m = 3 * ground.step_m
    for _ in range(MAX_ITERATIONS):
        east, north = eye_m[0] + along * ray[0], eye_m[1] + along * ray[1]
        up, slope_east, slope_north = ground.with_slope(east, north)
        above = eye_m[2] + along * ray[2] - bending_m(ray[3], along) - up
        closing = ray[2] - ray[3] * along / EARTH_M - (slope_east * ray[0] + slope_north * ray[1])
        on_ground = np.abs(above) < HIT_TOLERANCE_M
        hit = on_ground & (closing < 0)
        hits[:, active[hit]] = np.stack((along, east, north, up, slope_east, slope_north))[:, hit]
        remaining = np.flatnonzero(~on_ground & np.isfinite(above))
        if not len(remaining):
            break
        safe = np.where(closing < -1e-6, closing, -1e-6)
        along = (along + np.clip(-above / safe, -max_step_m, max_step_m))[remaining]
        ray, active = ray[:, remaining], active[remaining]
    return RayHits(*hits)
