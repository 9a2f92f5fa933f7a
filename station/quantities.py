"""Data types of the science: frozen dataclasses of arrays, with the unit in every name.

Angles are in radians, lengths in metres, temperatures in °C, pressures in hPa. Arrays over shots have the
shape `(n,)`, arrays over cells `(ny, nx)` with row 0 in the north.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntFlag
from math import radians, sqrt
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from station.grid_plane import MAP_PLANE, GridPlane

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Reals = NDArray[np.floating[Any]]  # of either precision
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Numbers = TypeVar("Numbers", Ints, Ints32)
Bools = NDArray[np.bool_]

IntensityScale = Literal["auto", "reflectance", "linear", "decibel", "none"]  # how a file tells brightness

VERTICAL_AXIS = (0.0, 0.0, 1.0)  # east, north, up


@dataclass(frozen=True)
class Shots:
    """A block of laser echoes, in the frame of the scan (the scanner's or the map).

    `time_s` is in the time base of the scan, which its inclination log shares; None if the scan has no times.
    `intensity` is linear in the reflectance of the ground, at least for echoes from the same place.
    """

    xyz_m: Floats  # (3, n)
    time_s: Floats | None  # (n,)
    intensity: Floats | None = None  # (n,) 0-1, 0 if unknown; None if the scan has none
    viewpoint: int = 0  # its number, in an epoch of several positions

    def __len__(self) -> int:
        """Return the number of echoes."""
        return len(self.xyz_m[0])


@dataclass(frozen=True)
class Scanner:
    """Specifications of an instrument, from its maker and the papers."""

    model: str
    wavelength_um: float
    beam_divergence_rad: float  # full angle at 1/e²
    exit_diameter_m: float
    range_sigma_m: float  # of one shot
    angle_resolution_rad: float  # full width of one encoder step
    inclination_sigma_rad: float  # of one sample of the inclination log
    inclination_range_rad: float  # largest tilt its sensor measures, in either direction
    range_max_m: float
    beam_origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # forward, left, up from the frame's origin


@dataclass(frozen=True)
class InclinationLog:
    """Tilt of the scanner as logged by its inclination sensor at about 1 Hz, not cleaned.

    Roll is the rotation about the scanner's x axis, pitch about its y axis.
    """

    time_s: Floats  # (k,) in the scan's time base
    roll_rad: Floats  # (k,)
    pitch_rad: Floats  # (k,)


@dataclass(frozen=True)
class AzimuthTrack:
    """Azimuth of the scan head over time, about the scanner's z axis, counter-clockwise from x."""

    time_s: Floats  # (k,) increasing
    azimuth_rad: Floats  # (k,) unwrapped


@dataclass(frozen=True)
class TiltSeries:
    """Tilt to apply to each shot, by time in the time base of the scan."""

    time_s: Floats  # (k,) increasing
    roll_rad: Floats  # (k,)
    pitch_rad: Floats  # (k,)


@dataclass(frozen=True)
class Air:
    """Air at the scanner."""

    temperature_c: float
    pressure_hpa: float
    humidity_pct: float


@dataclass(frozen=True)
class WeatherLog:
    """The station's weather record; NaN where a value is missing."""

    time_utc_s: Floats  # (k,) seconds since 1970, increasing
    temperature_c: Floats  # (k,)
    pressure_hpa: Floats  # (k,)
    humidity_pct: Floats  # (k,)


@dataclass(frozen=True)
class Grid:
    """A fixed raster, pixel-exact: `west_m` and `north_m` are outer edges, rows run from north to south.

    On another plane than the map, easting, northing and height stand for its u, v and w.
    """

    west_m: float
    north_m: float
    cell_m: float
    nx: int
    ny: int
    plane: GridPlane = MAP_PLANE

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return (self.ny, self.nx)

    @property
    def x_m(self) -> Floats:
        """Eastings of the cell centres (nx,)."""
        return np.asarray(self.west_m + (np.arange(self.nx) + 0.5) * self.cell_m, dtype=np.float64)

    @property
    def y_m(self) -> Floats:
        """Northings of the cell centres (ny,), descending."""
        return np.asarray(self.north_m - (np.arange(self.ny) + 0.5) * self.cell_m, dtype=np.float64)

    def row_and_column(self, cell: Numbers) -> tuple[Numbers, Numbers]:
        """Return row and column of cells (n,) of the flattened grid, six times as fast as `np.divmod`."""
        row = cell // self.nx
        return row, cell - row * self.nx

    def horizontal_range_m(self, row: Any, column: Any, position_m: tuple[float, ...]) -> NDArray[Any]:  # noqa: ANN401 - of any shape
        """Return the horizontal distance of cells from a position on the grid [m]; of a plane, at w = 0."""
        x_m, y_m = self.x_m[column] - position_m[0], self.y_m[row] - position_m[1]
        return self.plane.horizontal_m((x_m, y_m, np.full(1, -position_m[2])))


@dataclass(frozen=True)
class Viewpoint:
    """A scanner, and its position on the grid."""

    scanner: Scanner
    position_m: tuple[float, float, float]


@dataclass(frozen=True)
class ScanGeometry:
    """What does not change from scan to scan: scanner, grid, position and settings.

    `position_m` is the scanner's position on the grid, None if scans in the map frame do not contain it;
    `axis` is the head's axis of rotation (east, north, up). Scans from several positions have `viewpoints`,
    and scanner and position are those of the first one of the site file.
    """

    scanner: Scanner
    grid: Grid
    position_m: tuple[float, float, float] | None
    axis: tuple[float, float, float] = VERTICAL_AXIS
    min_points: int = 1
    published_budget: bool = False  # Voordendag et al. (2023) instead of the corrected form
    registration_sigma_m: float = 0.0  # of the published budget
    store_terms: bool = False
    viewpoints: tuple[Viewpoint, ...] = ()


@dataclass(frozen=True)
class ChangeErrors:
    """Errors of an estimate due to change of the moving ground; scans with similar change share them.

    `modes` are errors of the parameters in their own units, one sigma each and mutually independent.
    `polar_change` is the estimated change by azimuth sector around the scanner, in sigmas of its prior.
    """

    modes: Floats  # (p, m)
    polar_change: Floats  # (s,)


@dataclass(frozen=True)
class SharedParameters:
    """Estimate and covariance of the parameters that all points of a scan share (equations.md, 6.1).

    `estimate` and `covariance` are in the parameters' own units, given by `units`. `line_tilt_variance` is
    the independent variance of each group of scan lines about the parameter of its knot; zero except for the
    tilt. `change_errors` is the part of the covariance that other scans may have in common with this one.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimate: Floats  # (p,)
    covariance: Floats  # (p, p)
    line_tilt_variance: Floats  # (p,)
    change_errors: ChangeErrors | None = None

    def scaled(self, factor: float) -> SharedParameters:
        """Return the same estimate with its variances multiplied by a factor."""
        errors = self.change_errors
        return replace(
            self,
            covariance=self.covariance * factor,
            line_tilt_variance=self.line_tilt_variance * factor,
            change_errors=errors and replace(errors, modes=errors.modes * sqrt(factor)),
        )

    def __add__(self, other: SharedParameters) -> SharedParameters:
        """Return the shared parameters of a sum or difference of two independent surfaces."""
        return replace(
            self,
            covariance=self.covariance + other.covariance,
            line_tilt_variance=self.line_tilt_variance + other.line_tilt_variance,
        )


@dataclass(frozen=True)
class VarianceComponents:
    """A priori standard deviations of the parameters of a station's scans, one sigma each.

    Initial values: equations.md, 6.4; tilt of a mount: adjustment.md, 4. A station estimates its own from its
    scans.
    """

    tilt_rad: float = radians(0.008)
    heading_rad: float = radians(0.0015)
    translation_m: float = 0.003
    range_bias_m: float = 0.004
    range_scale_ppm: float = 0.8
    refraction: float = 0.08
    refraction_ice: float = 0.03
    refraction_by_azimuth: float = 0.02
    tilt_drift_rad: float = radians(0.0018)
    tilt_jitter_rad: float = radians(0.0010)
    line_jitter_rad: float = radians(0.0008)


class Quality(IntFlag):
    """Quality flags of a cell."""

    FEW_POINTS = 1  # fewer than three points
    HIGH_INCIDENCE = 2  # incidence above 80°
    OUTSIDE_REFERENCE = 4  # observed, but without a reference to measure change from
    STABLE_GROUND = 8
    CHANGE_SIGNIFICANT = 16  # at the 95 % level
    NOT_SEEN = 32  # no points, or fewer than grid.min_points; set when an epoch is written
    BARE_GROUND = 64  # not known to be stable, but as dark as stable ground: rock, not ice or snow


ROWS_PER_BLOCK = 32  # of the grid: few enough to stay in the processor's cache
CELL_DTYPE = np.dtype(
    [
        ("elevation_m", np.float32),
        ("uncertainty_m", np.float32),  # of a single cell, everything included
        ("systematic_uncertainty_m", np.float32),  # the part that cells share; the random one averages out
        ("spread_m", np.float32),  # standard deviation of the points in the cell
    ]
)


def _identity(_name: str, column: NDArray[Any]) -> NDArray[Any]:
    return column


@dataclass(frozen=True)
class Measurement:
    """Height, change and uncertainty of the cells of a scan; columns have the shape (n,).

    `cell_index` (ny, nx) maps the grid to the columns: -1 where neither scan nor reference has a height.
    `count` is the number of points; `cells` has the fields of `CELL_DTYPE`, NaN where the scan observed
    nothing; `terms` is the error budget of the scan's own heights by term, if requested.
    """

    grid: Grid
    cell_index: Ints32
    count: Ints32
    cells: NDArray[np.void]  # of CELL_DTYPE
    change_m: Floats32  # mean residual to the reference, NaN where there is none
    quality: NDArray[np.uint8]  # bits of Quality
    terms: dict[str, Floats32]

    @classmethod
    def from_rasters(cls, grid: Grid, quality: NDArray[np.uint8], **rasters: NDArray[Any]) -> Measurement:
        """Return a measurement from rasters (ny, nx), including those of terms; every cell has an index."""
        cell_index = np.arange(grid.nx * grid.ny, dtype=np.int32).reshape(grid.shape)
        cells = np.empty(cell_index.size, CELL_DTYPE)
        for name in CELL_DTYPE.names or ():
            cells[name] = rasters.pop(name).ravel()
        columns = {name: raster.ravel() for name, raster in rasters.items()}
        count, change_m = (columns.pop(name) for name in ("count", "change_m"))
        return cls(grid, cell_index, count, cells, change_m, quality.ravel(), columns)

    def to_rasters(
        self,
        *names: str,
        rows: slice = slice(None),
        transform: Callable[[str, NDArray[Any]], NDArray[Any]] = _identity,
    ) -> list[NDArray[Any]]:
        """Return columns as rasters on some rows of the grid, or on all; NaN or 0 in empty cells.

        `transform(name, values)` converts the values of a column, and its fill value too.
        """
        cell_index = self.cell_index[rows]
        rasters = [np.full(cell_index.shape, transform(name, self._empty(name))) for name in names]
        for first in range(0, len(cell_index), ROWS_PER_BLOCK):
            block = slice(first, first + ROWS_PER_BLOCK)
            present = np.flatnonzero(cell_index[block] >= 0)
            selected = cell_index[block].reshape(-1)[present]
            cells = self.cells.take(selected)  # all fields at once: fetching the cells takes the time
            for name, raster in zip(names, rasters, strict=True):
                column = self._column(name)
                values = cells[name] if column is None else column.take(selected)
                raster[block].reshape(-1)[present] = transform(name, values)
        return rasters

    def _empty(self, name: str) -> NDArray[Any]:
        """Return the fill value of a column (1,)."""
        column = self._column(name)
        dtype = self.cells.dtype[name] if column is None else column.dtype
        return np.array([np.nan if dtype.kind == "f" else 0], dtype)

    def _column(self, name: str) -> NDArray[Any] | None:
        """Return a column that is not a field of `cells`; None for one that is."""
        return getattr(self, name) if name in ("count", "change_m", "quality") else self.terms.get(name)


@dataclass(frozen=True)
class Reference:
    """The reference surface that change is measured from.

    `elevation_m` are nodes at the cell centres, NaN where unknown; between them the surface is bilinear. On
    rough ground the shots of a cell lie above or below it on average. `mean_residual_m` is what its own scans
    show of that, so that change, counted from it, is zero on their average in every cell.
    """

    grid: Grid
    version: str
    elevation_m: Floats  # (ny, nx)
    mean_residual_m: Floats32  # (ny, nx) of its scans to the surface
    random_variance_m2: Floats32  # (ny, nx) of the mean of its scans
    roughness_m2: Floats32  # (ny, nx) variance of the terrain about the surface within each cell
    shared: SharedParameters | None  # None: external surface with unknown shared errors
    scan_ids: tuple[str, ...]
    intensity: Floats32  # (ny, nx) mean, 0-1; NaN where unknown
    variance_factor: Floats32  # (ny, nx) random variance of the cells, empirical over modelled
    stable: Bools  # (ny, nx) steep and without change in the scans
    components: VarianceComponents  # of the station, estimated from its scans
    visibility: Floats32  # (ny, nx) share of its scans that observed the cell; NaN where unknown
    point_count: NDArray[np.float16]  # (ny, nx) mean of the scans that observed the cell; NaN if unknown
    time_s: float = np.nan  # mean start of its scans, since 1970; NaN if unknown
    sop_scan_count: int | None = None  # of its scans that an SOP is from; None if tilt counts from none

    @classmethod
    def from_elevation(
        cls, grid: Grid, version: str, elevation_m: Floats, stable: Bools | None = None
    ) -> Reference:
        """Return a reference from an external surface, taken as free of errors."""
        zeros = np.where(np.isfinite(elevation_m), 0.0, np.nan).astype(np.float32)
        return cls(
            grid=grid,
            version=version,
            elevation_m=elevation_m,
            mean_residual_m=zeros,
            random_variance_m2=zeros,
            roughness_m2=zeros,
            shared=None,
            scan_ids=(),
            intensity=np.full(grid.shape, np.nan, np.float32),
            variance_factor=np.ones(grid.shape, np.float32),
            stable=np.zeros(grid.shape, bool) if stable is None else stable,
            components=VarianceComponents(),
            visibility=np.full(grid.shape, np.nan, np.float32),
            point_count=np.full(grid.shape, np.nan, np.float16),
        )
