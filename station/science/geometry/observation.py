"""Observation geometry of shots and cells: offset from the scanner, range, incidence and slope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Floats

Points = tuple[Floats, Floats, Floats]


@dataclass(frozen=True)
class Observation:
    """Observation geometry of shots or cells (n,) as seen from the scanner."""

    offset_m: Points
    east_gradient: Floats
    north_gradient: Floats
    range_m: Floats
    cos_incidence: Floats
    cos_slope: Floats

    @classmethod
    def from_points(
        cls, points: Points, position_m: tuple[float, float, float], east: Floats, north: Floats
    ) -> Observation:
        """Return the geometry of map points [m] with the given terrain gradients, seen from a position."""
        x_m, y_m, z_m = (axis - origin for axis, origin in zip(points, position_m, strict=True))
        range_m = np.maximum(np.sqrt(x_m**2 + y_m**2 + z_m**2), 1e-3)
        cos_slope = 1 / np.sqrt(1 + east**2 + north**2)
        cos_incidence = np.abs(z_m - east * x_m - north * y_m) * cos_slope / range_m
        return cls((x_m, y_m, z_m), east, north, range_m, np.minimum(cos_incidence, 1.0), cos_slope)

    @property
    def tan_slope(self) -> Floats:
        """Tangent of the terrain's slope (n,) [1]."""
        return np.hypot(self.east_gradient, self.north_gradient)
