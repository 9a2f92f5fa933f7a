"""True surface of a simulated station on the map's grid, hour by hour.

The ground is defined in east-north-up at the mark. The height of a map point is where its vertical, a
straight line in that frame, meets the ground. The verticals come from pyproj.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from pyproj import Transformer
from scipy.interpolate import RectBivariateSpline

from station.quantities import Bools, Floats, Grid
from station.simulation.scenario import Mark, Scenario
from station.simulation.world import rock_face
from station.simulation.world.change import SurfaceChange
from station.simulation.world.terrain import NodeField, Valley

KNOT_SPACING_M = 250.0  # of the verticals: a cubic between them errs by less than a nanometre
FINENESS = 4.0  # sample points per node spacing in each direction, for cell means
STRIP_POINTS = 400_000  # per strip, which bounds the memory


def map_from_enu(mark: Mark) -> Transformer:
    """Return pyproj's transformation from east-north-up at the mark to map and ellipsoidal height."""
    return Transformer.from_pipeline(
        "+proj=pipeline"
        " +step +inv +proj=topocentric +ellps=WGS84"
        f" +lon_0={mark.longitude_deg} +lat_0={mark.latitude_deg} +h_0={mark.height_m}"
        f" +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone={mark.zone} +ellps=WGS84"
    )


def geocentric_from_enu(mark: Mark) -> Floats:
    """Return the matrix (4, 4) from east-north-up at the mark to WGS 84 geocentric coordinates: a POP."""
    to_geocentric = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84"
        f" +lon_0={mark.longitude_deg} +lat_0={mark.latitude_deg} +h_0={mark.height_m}"
    )
    span_m = 1000.0
    corners_m = np.array(to_geocentric.transform(*(span_m * np.eye(3, 4, 1))))
    matrix = np.eye(4)
    matrix[:3, 3] = corners_m[:, 0]
    matrix[:3, :3] = (corners_m[:, 1:] - corners_m[:, :1]) / span_m
    return matrix


def grid_of(scenario: Scenario) -> Grid:
    """Return the map raster that covers the scenario's extent, its edges at whole multiples of a cell.

    On a rock face it is that of the face.
    """
    west, south, east, north = (scenario.size * edge for edge in scenario.extent_m)
    cell_m = scenario.cell_m
    if scenario.kind == "rockfall":
        nx, ny = round((east - west) / cell_m), round((north - south) / cell_m)
        return Grid(west, north, cell_m, nx, ny, rock_face.plane())
    to_map = map_from_enu(scenario.mark)
    eastings, northings, _ = to_map.transform([0.0, 0.0], [0.0, 0.0], [0.0, 1.0])
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
class Verticals:
    """The vertical of every map point near the station, in east-north-up at the mark.

    Each is `base + height · up`, straight: the ellipsoid's normal.
    """

    base: tuple[RectBivariateSpline, ...]  # east, north, up at ellipsoidal height 0, by (northing, easting)
    up: tuple[RectBivariateSpline, ...]  # the same of the unit vector upwards
    height_m: float  # of the mark

    def at(self, northing_m: Floats, easting_m: Floats) -> tuple[list[Floats], list[Floats]]:
        """Return base and upward vector on the mesh of northings and eastings, each as three (ny, nx)."""
        return (
            [np.asarray(part(northing_m, easting_m)) for part in self.base],
            [np.asarray(part(northing_m, easting_m)) for part in self.up],
        )


def fit_verticals(grid: Grid, mark: Mark) -> Verticals:
    """Fit splines to pyproj's verticals over the grid and a margin."""
    nx, ny = (int(cells * grid.cell_m / KNOT_SPACING_M) + 6 for cells in (grid.nx, grid.ny))
    easting_m = grid.west_m + KNOT_SPACING_M * (np.arange(nx) - 2)
    northing_m = grid.north_m - grid.ny * grid.cell_m + KNOT_SPACING_M * (np.arange(ny) - 2)
    mesh_e, mesh_n = np.meshgrid(easting_m, northing_m)
    to_map = map_from_enu(mark)
    span_m = 4000.0
    base = to_map.transform(mesh_e, mesh_n, np.zeros_like(mesh_e), direction="INVERSE")
    upper = to_map.transform(mesh_e, mesh_n, np.full_like(mesh_e, span_m), direction="INVERSE")
    return Verticals(
        tuple(RectBivariateSpline(northing_m, easting_m, part) for part in base),
        tuple(
            RectBivariateSpline(northing_m, easting_m, (top - part) / span_m)
            for top, part in zip(upper, base, strict=True)
        ),
        mark.height_m,
    )


def surface_heights(ground: NodeField, verticals: Verticals, northing_m: Floats, easting_m: Floats) -> Floats:
    """Return the ground's ellipsoidal height on the mesh of northings and eastings (ny, nx) [m]."""
    base, up = verticals.at(northing_m, easting_m)
    height_m = np.full(base[0].shape, verticals.height_m)
    for _ in range(4):  # each iteration reduces the error of 800 m by the ground's slope times 0.0007
        ground_m = ground.at(base[0] + height_m * up[0], base[1] + height_m * up[1])
        height_m = (ground_m - base[2]) / up[2]
    return np.asarray(height_m)


@dataclass(frozen=True)
class TrueSurface:
    """Cell means of the initial ground and of every change pattern, in ellipsoidal height."""

    grid: Grid
    elevation_m: Floats  # (ny, nx)
    pattern_m: tuple[Floats, ...]  # each (ny, nx), metres of height for a unit amount
    ice: Floats  # (ny, nx) share

    def change_m(
        self, changes: tuple[SurfaceChange, ...], hours: float, names: Container[str] | None = None
    ) -> Floats:
        """Return the height of the surface relative to the initial ground (ny, nx) [m].

        With `names`, by the changes of these names alone.
        """
        change = np.zeros(self.grid.shape)
        for surface_change, pattern_m in zip(changes, self.pattern_m, strict=True):
            if names is None or surface_change.name in names:
                change += surface_change.amount(hours) * pattern_m
        return change

    def stable(self) -> Bools:
        """Return a mask of the cells that no change of this scenario affects (ny, nx)."""
        touched = np.zeros(self.grid.shape, dtype=np.bool_)
        for pattern_m in self.pattern_m:
            touched |= pattern_m != 0
        return ~touched


def true_surface(valley: Valley, changes: tuple[SurfaceChange, ...], grid: Grid, mark: Mark) -> TrueSurface:
    """Average the ground and its change patterns over the cells of the map, from many points in each."""
    fine = max(2, round(FINENESS * grid.cell_m / valley.ground.step_m))
    verticals = fit_verticals(grid, mark) if grid.plane.is_map else None
    share = (np.arange(fine) + 0.5) / fine - 0.5
    easting_m = (grid.x_m[:, None] + share * grid.cell_m).ravel()
    rows = max(1, STRIP_POINTS // (len(easting_m) * fine))
    strips = []
    for first in range(0, grid.ny, rows):
        northing_m = (grid.y_m[first : first + rows, None] - share * grid.cell_m).ravel()
        # the spline needs ascending arguments: from the south, then flipped
        strip = _fields(valley, changes, verticals, northing_m[::-1], easting_m)[:, ::-1]
        cells = strip.reshape(len(strip), -1, fine, grid.nx, fine)
        strips.append(cells.mean(axis=(2, 4)))
    elevation_m, ice, *patterns = np.concatenate(strips, axis=1)
    return TrueSurface(grid, elevation_m, tuple(patterns), ice)


def _fields(
    valley: Valley,
    changes: tuple[SurfaceChange, ...],
    verticals: Verticals | None,
    northing_m: Floats,
    easting_m: Floats,
) -> Floats:
    """Return height, ice and each pattern on the mesh (2 + changes, ny, nx); of a rock face, out of it."""
    if verticals is None:
        mesh = np.meshgrid(easting_m, northing_m)
        fields = (valley.ground, valley.ice, *(change.pattern for change in changes))
        return np.stack([field.at(*mesh) for field in fields])
    base, up = verticals.at(northing_m, easting_m)
    height_m = surface_heights(valley.ground, verticals, northing_m, easting_m)
    east_m, north_m = base[0] + height_m * up[0], base[1] + height_m * up[1]
    _, slope_east, slope_north = valley.ground.with_slope(east_m, north_m)
    # a metre along the mark's vertical raises the intersection with a local vertical by slightly more or less
    lift = 1 / (up[2] - slope_east * up[0] - slope_north * up[1])
    patterns = [change.pattern.at(east_m, north_m) * lift for change in changes]
    return np.stack([height_m, valley.ice.at(east_m, north_m), *patterns])
