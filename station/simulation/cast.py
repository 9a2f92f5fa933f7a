"""Where a laser beam meets the ground: ray casting over the height field.

Rays are told by the direction they leave in: bearing (counter-clockwise from east) and climb (rise over
horizontal distance). They bend by the coefficient of refraction of their bearing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Floats, Ints
from station.simulation.air import EARTH_M, bending_m
from station.simulation.terrain import Heights

NEAREST_M = 15.0  # what lies nearer is the hut
STEEPEST = 4.0  # no ray climbs or falls more steeply than 76°
ROUNDS = 12  # of Newton's method; nearly all shots need four
CLOSE_M = 1e-5  # of height between ray and ground: the ray has met it


@dataclass(frozen=True)
class Hits:
    """Where rays met the ground, NaN where they met none."""

    along_m: Floats  # (n,) horizontal distance from the eye
    east_m: Floats
    north_m: Floats
    up_m: Floats
    slope_east: Floats  # of the ground there, per metre
    slope_north: Floats


@dataclass(frozen=True)
class Fan:
    """The horizon as it rises with distance, along evenly spaced bearings."""

    bearing_rad: Floats  # (b,)
    coefficient: Floats  # (b,) of refraction
    distance_m: Floats  # (r,)
    climb: Floats  # (b, r) at which each place is seen
    horizon: Floats  # (b, r) the highest climb so far

    def first_crossing(self, bearing_rad: Floats, climb: Floats) -> Floats:
        """Return about how far each ray flies, NaN if it leaves the valley."""
        count = len(self.distance_m)
        spacing_rad = self.bearing_rad[1] - self.bearing_rad[0]
        row = np.rint((bearing_rad - self.bearing_rad[0]) / spacing_rad).astype(np.int64)
        found = self._search(row, climb)
        good = (found > 0) & (found < count)
        place = row * count + np.where(good, found, 1)
        before, behind = self.climb.take(place - 1), self.climb.take(place)
        share = (climb - before) / np.where(behind > before, behind - before, 1)
        guess = self.distance_m.take(np.where(good, found, 1) - 1) + np.clip(share, 0, 1) * (
            self.distance_m[1] - self.distance_m[0]
        )
        return np.where(good, guess, np.nan)

    def _search(self, row: Ints, climb: Floats) -> Ints:
        """Return the first place on each ray's bearing whose horizon reaches its climb."""
        lift = 4 * STEEPEST  # one long sorted array: each bearing's horizons lie above the last one's
        keys = self.horizon + lift * np.arange(len(self.horizon))[:, None]
        found = np.searchsorted(keys.ravel(), climb + lift * row)
        return np.asarray(found - row * len(self.distance_m))


def fan(
    ground: Heights,
    eye_m: Floats,
    bearings_rad: tuple[float, float],
    reach_m: float,
    coefficient_at: Callable[[Floats], Floats],
) -> Fan:
    """Look over the ground from the eye, between two bearings, as far as the reach."""
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
    climb = np.nan_to_num((up_m - eye_m[2]) / distance_m, nan=-STEEPEST).clip(-STEEPEST, STEEPEST)
    return Fan(bearing_rad, coefficient, distance_m, climb, np.maximum.accumulate(climb, axis=1))


def cast(
    ground: Heights,
    eye_m: Floats,
    bearing_rad: Floats,
    climb: Floats,
    reach_m: float,
    coefficient_at: Callable[[Floats], Floats],
) -> Hits:
    """Follow each ray to the first ground it meets, to a hundredth of a millimetre of height.

    Crests are seen from distances a node's spacing apart, so a ray that only grazes one may pass it.
    """
    look = fan(ground, eye_m, (float(bearing_rad.min()), float(bearing_rad.max())), reach_m, coefficient_at)
    along_m = look.first_crossing(bearing_rad, climb)
    coefficient = np.interp(bearing_rad, look.bearing_rad, look.coefficient)
    hits = np.full((6, len(along_m)), np.nan)
    active = np.flatnonzero(np.isfinite(along_m))
    along = along_m[active]
    ray = np.stack((np.cos(bearing_rad), np.sin(bearing_rad), climb, coefficient))[:, active]
    furthest = 3 * ground.step_m
    for _ in range(ROUNDS):
        east, north = eye_m[0] + along * ray[0], eye_m[1] + along * ray[1]
        up, slope_east, slope_north = ground.with_slope(east, north)
        above = eye_m[2] + along * ray[2] - bending_m(ray[3], along) - up
        closing = ray[2] - ray[3] * along / EARTH_M - (slope_east * ray[0] + slope_north * ray[1])
        met = np.abs(above) < CLOSE_M
        seen = met & (closing < 0)
        hits[:, active[seen]] = np.stack((along, east, north, up, slope_east, slope_north))[:, seen]
        left = np.flatnonzero(~met & np.isfinite(above))
        if not len(left):
            break
        safe = np.where(closing < -1e-6, closing, -1e-6)
        along = (along + np.clip(-above / safe, -furthest, furthest))[left]
        ray, active = ray[:, left], active[left]
    return Hits(*hits)
