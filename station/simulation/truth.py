"""What a simulated station truly saw: the surface on the map's grid, hour by hour, and every error.

The ground is defined in east-north-up at the mark; a map point's height is where its plumb line, a straight
line in that frame, meets the ground. Where plumb lines run comes from pyproj.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer
from scipy.interpolate import RectBivariateSpline

from station.quantities import Bools, Floats, Grid
from station.simulation.change import Change
from station.simulation.scenario import Scenario
from station.simulation.terrain import Heights, Valley

CRS = "EPSG:32632"
LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 46.7958, 10.7828, 3245.0  # the scanner above Hintereisferner
KNOTS_M = 250.0  # of the plumb lines: between them a cubic errs by less than a nanometre
FINENESS = 4.0  # points of a cell's mean per node of the ground, each way
STRIP_POINTS = 400_000  # at once, which bounds the memory


def map_from_enu() -> Transformer:
    """Return pyproj's way from east-north-up at the mark to easting, northing, ellipsoidal height."""
    return Transformer.from_pipeline(
        "+proj=pipeline"
        " +step +inv +proj=topocentric +ellps=WGS84"
        f" +lon_0={LONGITUDE_DEG} +lat_0={LATITUDE_DEG} +h_0={HEIGHT_M}"
        " +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=32 +ellps=WGS84"
    )


def grid_of(scenario: Scenario) -> Grid:
    """Return the raster on the map that covers the scenario's extent, its edges whole multiples of a cell."""
    west, south, east, north = (scenario.size * edge for edge in scenario.extent_m)
    to_map = map_from_enu()
    eastings, northings, _ = to_map.transform([0.0, 0.0], [0.0, 0.0], [0.0, 1.0])
    cell_m = scenario.cell_m
    west_m = np.floor((eastings[0] + west) / cell_m) * cell_m
    north_m = np.ceil((northings[0] + north) / cell_m) * cell_m
    return Grid(
        float(west_m),
        float(north_m),
        cell_m,
        nx=round((east - west) / cell_m),
        ny=round((north - south) / cell_m),
    )


@dataclass(frozen=True)
class PlumbLines:
    """The plumb line of every map point near the station, in east-north-up at the mark.

    Each is `foot + height · up`, straight: the ellipsoid's normal.
    """

    foot: tuple[RectBivariateSpline, ...]  # east, north, up at ellipsoidal height 0, by (northing, easting)
    up: tuple[RectBivariateSpline, ...]  # the same of the unit vector upwards

    def at(self, northing_m: Floats, easting_m: Floats) -> tuple[list[Floats], list[Floats]]:
        """Return foot and upward vector on the mesh of the two, each as three (ny, nx)."""
        return (
            [np.asarray(part(northing_m, easting_m)) for part in self.foot],
            [np.asarray(part(northing_m, easting_m)) for part in self.up],
        )


def plumb_lines(grid: Grid) -> PlumbLines:
    """Ask pyproj for the plumb lines over the grid and a little beyond."""
    nx, ny = (int(cells * grid.cell_m / KNOTS_M) + 6 for cells in (grid.nx, grid.ny))
    easting_m = grid.west_m + KNOTS_M * (np.arange(nx) - 2)
    northing_m = grid.north_m - grid.ny * grid.cell_m + KNOTS_M * (np.arange(ny) - 2)
    mesh_e, mesh_n = np.meshgrid(easting_m, northing_m)
    to_map = map_from_enu()
    span_m = 4000.0
    foot = to_map.transform(mesh_e, mesh_n, np.zeros_like(mesh_e), direction="INVERSE")
    head = to_map.transform(mesh_e, mesh_n, np.full_like(mesh_e, span_m), direction="INVERSE")
    return PlumbLines(
        tuple(RectBivariateSpline(northing_m, easting_m, part) for part in foot),
        tuple(
            RectBivariateSpline(northing_m, easting_m, (top - part) / span_m)
            for top, part in zip(head, foot, strict=True)
        ),
    )


def heights(ground: Heights, lines: PlumbLines, northing_m: Floats, easting_m: Floats) -> Floats:
    """Return the ground's ellipsoidal height on the mesh of the two (ny, nx) [m]."""
    foot, up = lines.at(northing_m, easting_m)
    height_m = np.full(foot[0].shape, HEIGHT_M)
    for _ in range(4):  # each round shrinks the error by the ground's slope times 0.0007, from 800 m
        there = ground.at(foot[0] + height_m * up[0], foot[1] + height_m * up[1])
        height_m = (there - foot[2]) / up[2]
    return np.asarray(height_m)


@dataclass(frozen=True)
class TrueSurface:
    """Cell means of the first ground and of every change's pattern, in ellipsoidal height."""

    grid: Grid
    elevation_m: Floats  # (ny, nx)
    pattern_m: tuple[Floats, ...]  # each (ny, nx), metres of height for an amount of one
    ice: Floats  # (ny, nx) share

    def change_m(self, happening: tuple[Change, ...], hours: float) -> Floats:
        """Return how much higher the surface lies than before anything changed (ny, nx) [m]."""
        change = np.zeros(self.grid.shape)
        for one, pattern_m in zip(happening, self.pattern_m, strict=True):
            change += one.amount(hours) * pattern_m
        return change

    def stable(self) -> Bools:
        """Tell which cells no change of this scenario ever touches."""
        touched = np.zeros(self.grid.shape, dtype=np.bool_)
        for pattern_m in self.pattern_m:
            touched |= pattern_m != 0
        return ~touched


def true_surface(place: Valley, happening: tuple[Change, ...], grid: Grid) -> TrueSurface:
    """Average the ground and its changes over the cells of the map, from many points in each."""
    fine = max(2, round(FINENESS * grid.cell_m / place.ground.step_m))
    lines = plumb_lines(grid)
    share = (np.arange(fine) + 0.5) / fine - 0.5
    easting_m = (grid.x_m[:, None] + share * grid.cell_m).ravel()
    rows = max(1, STRIP_POINTS // (len(easting_m) * fine))
    strips = []
    for first in range(0, grid.ny, rows):
        northing_m = (grid.y_m[first : first + rows, None] - share * grid.cell_m).ravel()
        # the spline wants rising arguments: from the south up, then turned
        strip = _fields(place, happening, lines, northing_m[::-1], easting_m)[:, ::-1]
        cells = strip.reshape(len(strip), -1, fine, grid.nx, fine)
        strips.append(cells.mean(axis=(2, 4)))
    elevation_m, ice, *patterns = np.concatenate(strips, axis=1)
    return TrueSurface(grid, elevation_m, tuple(patterns), ice)


def _fields(
    place: Valley,
    happening: tuple[Change, ...],
    lines: PlumbLines,
    northing_m: Floats,
    easting_m: Floats,
) -> Floats:
    """Return height, ice and each pattern on the mesh (2 + changes, ny, nx)."""
    foot, up = lines.at(northing_m, easting_m)
    height_m = heights(place.ground, lines, northing_m, easting_m)
    east_m, north_m = foot[0] + height_m * up[0], foot[1] + height_m * up[1]
    _, slope_east, slope_north = place.ground.with_slope(east_m, north_m)
    # a metre along the mark's vertical lifts the plumb line's crossing by a little more or less than a metre
    lift = 1 / (up[2] - slope_east * up[0] - slope_north * up[1])
    patterns = [change.pattern.at(east_m, north_m) * lift for change in happening]
    return np.stack([height_m, place.ice.at(east_m, north_m), *patterns])
