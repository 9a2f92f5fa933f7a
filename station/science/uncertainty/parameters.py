"""Layout of the parameters that all points of a scan share, and their knots in azimuth.

Source: equations.md, 6.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from station.grid_plane import MAP_PLANE, GridPlane
from station.quantities import VERTICAL_AXIS, Bools, Floats, Grid, Ints, Reals

GLOBAL = (
    ("tilt_east", "rad"),
    ("tilt_north", "rad"),
    ("heading", "rad"),
    ("translation_east", "m"),
    ("translation_north", "m"),
    ("translation_up", "m"),
    ("range_bias", "m"),
    ("range_scale", "1e-6"),
    ("refraction", "1"),
    ("refraction_ice", "1"),  # of paths to ice and snow, in excess of those to rock
)
TILT_KNOT_RAD = math.radians(1.0)
TILT_KNOTS_PER_REFRACTION = 5  # sight-tilt knots for each refraction knot
LINE_GROUPS_PER_KNOT = 5  # scan-line groups between two sight-tilt knots: 0.2° each, about one second
AXIS_NEAR_NORTH_COS = math.cos(math.radians(45.0))  # closer to north or south, azimuth zero is not north
MAX_AXIS_TILT_COS = math.cos(math.radians(10.0))  # with more tilt, map azimuth no longer bounds head azimuth


@dataclass(frozen=True)
class ParameterLayout:
    """Index map of the parameter vector: globals, then sight tilt, refraction and cross tilt at knots.

    Azimuths are head azimuths: about the head's rotation axis `axis` (east, north, up), clockwise from grid
    north. Every scan line therefore has one azimuth, even on a tilted mount. Azimuth zero is the direction
    normal to the axis that is closest to north. Of an axis within 45° of north it is the one closest to down,
    of an axis within 45° of south the one closest to up: north would be lost or turn with the axis. The first
    knot lies at `start_rad`; with `full_circle` the knots cover all 360°. The parameters refer to east, north
    and up also if the heights that they change are those above another `plane`.
    """

    start_rad: float
    knot_intervals: int  # between sight-tilt knots
    full_circle: bool
    axis: tuple[float, float, float] = VERTICAL_AXIS
    plane: GridPlane = MAP_PLANE

    @property
    def sight_tilt_knots(self) -> int:
        """Number of sight-tilt knots."""
        return self.knot_intervals + (not self.full_circle)

    @property
    def refraction_knots(self) -> int:
        """Number of refraction knots, which is also the number of cross-tilt knots."""
        return self.knot_intervals // TILT_KNOTS_PER_REFRACTION + (not self.full_circle)

    @property
    def line_groups(self) -> int:
        """Number of scan-line groups."""
        return self.knot_intervals * LINE_GROUPS_PER_KNOT

    @property
    def line_azimuth_rad(self) -> Floats:
        """Head azimuth at the middle of each scan-line group (line_groups,) [rad]."""
        middle = np.arange(self.line_groups, dtype=np.float64) + 0.5
        return np.asarray(self.start_rad + TILT_KNOT_RAD / LINE_GROUPS_PER_KNOT * middle)

    @property
    def sight_directions(self) -> Floats:
        """Viewing direction of the head at each line group, normal to its axis (3, line_groups)."""
        east, north = _head_axes(self.axis)
        azimuth_rad = self.line_azimuth_rad
        return np.asarray(np.outer(east, np.sin(azimuth_rad)) + np.outer(north, np.cos(azimuth_rad)))

    @property
    def refraction_azimuth_rad(self) -> Floats:
        """Head azimuth of each refraction knot (refraction_knots,) [rad]."""
        knot = np.arange(self.refraction_knots, dtype=np.float64)
        return np.asarray(self.start_rad + TILT_KNOT_RAD * TILT_KNOTS_PER_REFRACTION * knot)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names (p,)."""
        tilt_azimuth_rad = self.start_rad + TILT_KNOT_RAD * np.arange(self.sight_tilt_knots)
        return (
            *(name for name, _ in GLOBAL),
            *(f"sight_tilt_{_degrees(a)}" for a in tilt_azimuth_rad),
            *(f"refraction_{_degrees(a)}" for a in self.refraction_azimuth_rad),
            *(f"cross_tilt_{_degrees(a)}" for a in self.refraction_azimuth_rad),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Parameter units (p,)."""
        return (
            *(unit for _, unit in GLOBAL),
            *["rad"] * self.sight_tilt_knots,
            *["1"] * self.refraction_knots,
            *["rad"] * self.refraction_knots,
        )

    @property
    def knot_slices(self) -> tuple[slice, slice, slice]:
        """Parameters of the sight-tilt, refraction and cross-tilt knots."""
        tilt, refraction = len(GLOBAL), len(GLOBAL) + self.sight_tilt_knots
        cross_tilt, end = refraction + self.refraction_knots, refraction + 2 * self.refraction_knots
        return slice(tilt, refraction), slice(refraction, cross_tilt), slice(cross_tilt, end)

    @property
    def moves_beam(self) -> Bools:
        """True for parameters (p,) that change the elevation at which beams reach the ground."""
        return self._named("tilt", "refraction", "sight_tilt")

    @property
    def in_log(self) -> Bools:
        """True for parameters (p,) that an inclination log measures."""
        return self._named("tilt", "sight_tilt")

    @property
    def moves_unlogged(self) -> Bools:
        """True for parameters (p,) of motion that no inclination log measures."""
        return self._named("heading", "translation")

    def _named(self, *prefixes: str) -> Bools:
        """Return True for parameters (p,) whose names begin with one of these."""
        return np.array([name.startswith(prefixes) for name in self.names])

    def active_parameters(self, knot: Ints) -> Ints:
        """Return the indices (m, 16) of the non-zero columns of J just after sight-tilt knots (m,).

        They are the ten globals and, of each of the three knot series, the two knots that enclose the cell.
        """
        refraction_knot = knot // TILT_KNOTS_PER_REFRACTION
        refraction_pair = refraction_knot, (refraction_knot + 1) % self.refraction_knots
        pairs = (knot, (knot + 1) % self.sight_tilt_knots), refraction_pair, refraction_pair
        columns = [
            part.start + index for part, pair in zip(self.knot_slices, pairs, strict=True) for index in pair
        ]
        return np.stack([*np.broadcast_arrays(*range(len(GLOBAL)), *columns)], axis=-1)

    def knot_position(self, offset_m: tuple[Reals, Reals, Reals]) -> Reals:
        """Return the fractional sight-tilt knot index (n,) of points at `offset_m`, on the grid."""
        offset_m = self.plane.in_map_axes(offset_m)
        east, north = (
            sum(component * offset for component, offset in zip(direction, offset_m, strict=True))
            for direction in _head_axes(self.axis)
        )
        azimuth_rad: Reals = np.asarray((np.arctan2(east, north) - self.start_rad) % (2 * math.pi))
        position: Reals = azimuth_rad / TILT_KNOT_RAD
        if self.full_circle:
            return np.minimum(position, np.nextafter(self.knot_intervals, 0))
        # Beyond the middle of the gap between the last knot and the first, the first one is closer.
        gap_middle = (self.knot_intervals + 2 * math.pi / TILT_KNOT_RAD) / 2
        return np.asarray(
            np.clip(np.where(position > gap_middle, 0.0, position), 0.0, np.nextafter(self.knot_intervals, 0))
        )


def _degrees(azimuth_rad: float) -> str:
    return f"{math.degrees(azimuth_rad) % 360:05.1f}"


@lru_cache(maxsize=4)
def _head_axes(axis: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return the head's viewing directions at azimuth 90° and 0°, both normal to the axis."""
    up = np.array(axis)
    near_north = abs(up[1]) > AXIS_NEAR_NORTH_COS
    zero = np.array([0.0, 0.0, -np.sign(up[1])]) if near_north else np.array([0.0, 1.0, 0.0])
    zero -= (zero @ up) * up
    zero /= np.linalg.norm(zero)
    return np.cross(zero, up), zero


def parameter_layout(
    grid: Grid, position_m: tuple[float, float, float], axis: tuple[float, float, float] = VERTICAL_AXIS
) -> ParameterLayout:
    """Return the parameter layout for a grid seen from `position_m`: knots cover the sector it spans."""
    x_m = np.array([grid.west_m, grid.west_m + grid.nx * grid.cell_m]) - position_m[0]
    y_m = np.array([grid.north_m - grid.ny * grid.cell_m, grid.north_m]) - position_m[1]
    offset_m = np.repeat(x_m, 2), np.tile(y_m, 2), np.full(4, -position_m[2])
    east, north, _ = grid.plane.in_map_axes(offset_m)
    corners = np.array([math.atan2(e, n) for e, n in zip(east, north, strict=True)])
    middle = math.atan2(east[[0, -1]].mean(), north[[0, -1]].mean())
    relative_rad = (corners - middle + math.pi) % (2 * math.pi) - math.pi
    inside = np.ptp(relative_rad) >= math.pi or (
        grid.plane.is_map and x_m[0] <= 0 <= x_m[1] and y_m[0] <= 0 <= y_m[1]
    )
    if inside or axis[2] < MAX_AXIS_TILT_COS:
        knots = round(2 * math.pi / TILT_KNOT_RAD)
        return ParameterLayout(0.0, knots, full_circle=True, axis=axis, plane=grid.plane)
    spacing_rad = TILT_KNOT_RAD * TILT_KNOTS_PER_REFRACTION
    first = math.floor((middle + relative_rad.min()) / spacing_rad)
    last = math.ceil((middle + relative_rad.max()) / spacing_rad)
    return ParameterLayout(
        first * spacing_rad,
        (last - first) * TILT_KNOTS_PER_REFRACTION,
        full_circle=False,
        axis=axis,
        plane=grid.plane,
    )


@dataclass(frozen=True)
class KnotInterpolation:
    """Interpolation matrix P from sight-tilt knots to line groups, its pseudo-inverse and I − P P⁺."""

    matrix: Floats  # (lines, knots) P
    pinv: Floats  # (knots, lines) P⁺, the least-squares fit
    residual_projector: Floats  # (lines, lines) I − P P⁺, the residual of that fit


@lru_cache(maxsize=4)
def knot_interpolation(params: ParameterLayout) -> KnotInterpolation:
    """Return the interpolation matrices of a parameter layout (cached)."""
    matrix = interpolate_to_lines(params, np.eye(params.sight_tilt_knots))
    pinv = np.linalg.inv(matrix.T @ matrix) @ matrix.T
    return KnotInterpolation(matrix, pinv, np.eye(params.line_groups) - interpolate_to_lines(params, pinv))


def interpolate_to_lines(params: ParameterLayout, at_knots: Floats) -> Floats:
    """Return values at line groups (lines, k), linearly interpolated between sight-tilt knots (knots, k)."""
    lower = np.arange(params.line_groups) // LINE_GROUPS_PER_KNOT
    fraction = ((np.arange(params.line_groups) % LINE_GROUPS_PER_KNOT + 0.5) / LINE_GROUPS_PER_KNOT)[:, None]
    return np.asarray(
        at_knots[lower] * (1 - fraction) + at_knots[(lower + 1) % params.sight_tilt_knots] * fraction
    )
