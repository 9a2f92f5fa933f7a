"""The plane that a grid lies on: the map, or for a rock face a plane of the owner's choice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Reals = NDArray[np.floating[Any]]
Place = tuple[float, float, float]
Vector = tuple[Any, Any, Any]  # of arrays (n,), or numbers where all are the same
STEEPEST_UP = 1e-6  # of a normal: ground that is steeper counts as vertical


@dataclass(frozen=True)
class GridPlane:
    """A plane of the map, with coordinates u, v, w [m] from its origin; by default the map itself.

    u is horizontal, to the right of whoever looks at the plane; v points up the plane, w along its normal,
    which is the upper or outer side. `facing_deg` is the azimuth to which that side faces, clockwise from
    grid north, and `dip_deg` its inclination: 0 is level, 90 vertical, more overhangs. In degrees, as in the
    site file and in stored files, so that no digit is lost. Source: equations.md, 4.13.
    """

    origin_m: Place = (0.0, 0.0, 0.0)
    facing_deg: float = 180.0
    dip_deg: float = 0.0

    @cached_property
    def is_map(self) -> bool:
        """True if u, v and w are easting, northing and height."""
        return self == GridPlane()

    @cached_property
    def axes(self) -> Floats:
        """Unit vectors along u, v and w: east, north and up (3, 3) [1]."""
        sin_a, cos_a = (f(math.radians(self.facing_deg)) for f in (math.sin, math.cos))
        sin_d, cos_d = (f(math.radians(self.dip_deg)) for f in (math.sin, math.cos))
        return np.array(
            [
                [-cos_a, sin_a, 0.0],
                [-cos_d * sin_a, -cos_d * cos_a, sin_d],
                [sin_d * sin_a, sin_d * cos_a, cos_d],
            ]
        )

    def from_map(self, points_m: Floats) -> Floats:
        """Return u, v and w (3, ...) of points of the map (3, ...) [m]."""
        if self.is_map:
            return points_m
        east_m, north_m, up_m = (axis - origin for axis, origin in zip(points_m, self.origin_m, strict=True))
        return np.stack(self.in_grid_axes((east_m, north_m, up_m)))

    def to_map(self, points_m: Floats) -> Floats:
        """Return easting, northing and height (3, ...) of points u, v, w (3, ...) [m]."""
        if self.is_map:
            return points_m
        u_m, v_m, w_m = points_m
        offset_m = self.in_map_axes((u_m, v_m, w_m))
        return np.stack([axis + origin for axis, origin in zip(offset_m, self.origin_m, strict=True)])

    def place_from_map(self, place_m: Place) -> Place:
        """Return u, v and w of one place of the map [m]."""
        u_m, v_m, w_m = self.from_map(np.array(place_m)).tolist()
        return u_m, v_m, w_m

    def place_to_map(self, place_m: Place) -> Place:
        """Return easting, northing and height of one place u, v, w [m]."""
        east_m, north_m, height_m = self.to_map(np.array(place_m)).tolist()
        return east_m, north_m, height_m

    def in_map_axes(self, vector: Vector) -> Vector:
        """Return the components east, north and up of vectors with the components u, v and w (n,)."""
        if self.is_map:
            return vector
        u, v, w = vector
        (ue, un, _), (ve, vn, vu), (we, wn, wu) = self.axes.tolist()
        return ue * u + ve * v + we * w, un * u + vn * v + wn * w, vu * v + wu * w

    def in_grid_axes(self, vector: Vector) -> Vector:
        """Return the components u, v and w of vectors with the components east, north and up (n,)."""
        if self.is_map:
            return vector
        east, north, up = vector
        (ue, un, _), (ve, vn, vu), (we, wn, wu) = self.axes.tolist()
        return ue * east + un * north, ve * east + vn * north + vu * up, we * east + wn * north + wu * up

    def horizontal_m(self, offset_m: Vector) -> NDArray[Any]:
        """Return the horizontal length of offsets u, v, w (n,) [m]."""
        east_m, north_m, _ = self.in_map_axes(offset_m)
        return np.asarray(np.hypot(east_m, north_m))

    def tan_slope(self, u_gradient: Reals, v_gradient: Reals) -> Reals:
        """Return the tangent of the slope of ground with these gradients of w (n,) [1]; overhangs: large."""
        if self.is_map:
            return np.hypot(u_gradient, v_gradient)
        east, north, up = self.in_map_axes((-u_gradient, -v_gradient, 1.0))
        return np.asarray(np.hypot(east, north) / np.maximum(up, STEEPEST_UP))


MAP_PLANE = GridPlane()
